# SPDX-License-Identifier: Apache-2.0
"""`ros2 bag record` writes the time of reception as log time, the source's as publish time."""

import bag_files as files
import bag_variants as variants
from fhaosmo_ros.core.model.triangular import TriangularModel
from fhaosmo_ros.core.online.estimator import OnlineEstimator
from fhaosmo_ros.inputs import measured_output
from fhaosmo_ros.tools.cli.options import BagInputs
from fhaosmo_ros.tools.replay import command as replay
from fhaosmo_ros.tools.tuning.source import recorded
import numpy as np
import pytest

COUNT = 4000
STAMPS = files.ORIGIN + np.arange(COUNT) * 1_000_000
Y = 0.2 + 0.1 * np.sin((STAMPS - STAMPS[0]) * 1e-9)


@pytest.fixture(name='late')
def _late():
    """Reception: up to 66 ms late, in the order of publication."""
    return np.maximum.accumulate(STAMPS + np.random.default_rng(5).integers(0, 66_000_000, COUNT))


def live():
    """Unknown input, as the node estimates it from the source stamps."""
    estimator = OnlineEstimator()
    return np.array([
        estimator.update(stamp, y).unknown_input
        for stamp, y in zip(STAMPS.tolist(), Y.tolist(), strict=True)
    ])  # fmt: skip


def replayed(bag, folder, *arguments):
    out = folder / 'out.npz'
    assert replay.main([str(bag), '-o', str(out), '--force', *arguments]) == 0
    with np.load(out) as arrays:
        return arrays['unknown_input'], arrays['stamp_ns']


@pytest.mark.parametrize('how', ['zstd', 'fastwrite'])
def test_replay_takes_the_source_stamps(how, late, tmp_path, capsys):
    messages = files.floats(late, Y)
    bag = variants.write(tmp_path / 'bag', messages, 'jazzy', 'mcap', how, published=STAMPS)
    d, stamps = replayed(bag, tmp_path)
    assert 'stamps: source' in capsys.readouterr().out
    np.testing.assert_array_equal(d, live())
    np.testing.assert_array_equal(stamps, STAMPS)
    np.testing.assert_array_equal(replayed(bag, tmp_path, '--stamp', 'source')[0], d)
    received, stamps = replayed(bag, tmp_path, '--stamp', 'bag')
    assert 'stamps: bag' in capsys.readouterr().out
    np.testing.assert_array_equal(stamps[-1], late[-1])
    assert not np.array_equal(received, d)


def test_estimator_that_used_its_clock_gets_the_times_of_reception(late, tmp_path):
    late += np.arange(COUNT)  # no two the same
    messages = files.floats(late, Y)
    bag = variants.write(tmp_path / 'bag', messages, 'jazzy', 'mcap', 'plain', published=STAMPS)
    _, stamps = replayed(bag, tmp_path, '-p', 'sampling:=clock')
    np.testing.assert_array_equal(stamps, late)


def test_publish_time_that_its_writer_did_not_know(tmp_path, capsys):
    bag = variants.write(
        tmp_path / 'bag', files.floats(STAMPS, Y), 'jazzy', 'mcap', 'plain', published=0 * STAMPS
    )
    np.testing.assert_array_equal(replayed(bag, tmp_path)[0], live())
    assert 'stamps: bag' in capsys.readouterr().out


def test_sqlite_has_no_publish_times(tmp_path, capsys):
    bag = files.write(tmp_path / 'bag', files.floats(STAMPS, Y), 'sqlite3')
    assert replay.main([str(bag), '-o', str(tmp_path / 'o.npz'), '--stamp', 'source']) == 2
    assert '--stamp source: expected an mcap bag' in capsys.readouterr().err


def test_tune_takes_them_too(late, tmp_path):
    """Else it would see the jitter of reception."""
    sensors = []
    for name, received in (('exact', STAMPS), ('late', late)):
        messages = files.floats(received, Y)
        bag = variants.write(tmp_path / name, messages, 'jazzy', 'mcap', 'zstd', published=STAMPS)
        inputs = BagInputs(measured_output({}), {}, 'auto', {})
        sensors.append(recorded(bag, inputs, TriangularModel(['0'])).sensor)
    assert sensors[0] == sensors[1]


def test_defaults_are_a_warning(tmp_path, capsys):
    bag = files.write(tmp_path / 'bag', files.floats(STAMPS[:50], Y[:50]))
    replayed(bag, tmp_path)
    assert 'replay: warning: ' in (error := capsys.readouterr().err)
    assert '~/parameters' in error
    (tmp_path / 'p.yaml').write_text('estimator: {ros__parameters: {}}')
    replayed(bag, tmp_path, '--params-file', str(tmp_path / 'p.yaml'))
    assert 'warning' not in capsys.readouterr().err
