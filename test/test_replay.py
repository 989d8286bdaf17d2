# SPDX-License-Identifier: Apache-2.0
"""A bag, or a CSV file, replayed is the observer's own result."""

import sqlite3

import bag_files as files
from commands import ROOT
from fhaosmo_ros.core.online.estimator import OnlineEstimator
from fhaosmo_ros.core.parameters.files import dumps
from fhaosmo_ros.tools.bags.reader import BagReader
from fhaosmo_ros.tools.bags.writer import BagWriter
from fhaosmo_ros.tools.replay import command as replay
import numpy as np
import pytest

STAMPS, Y = files.signal(3000)


@pytest.fixture(name='bag')
def _bag(tmp_path):
    return files.write(tmp_path / 'bag', files.floats(STAMPS, Y))


def expected(stamps, y, parameters=None):
    """What a node would estimate: one sample after the other."""
    estimator = OnlineEstimator(parameters)
    found = [estimator.update(*row) for row in zip(stamps.tolist(), y.tolist(), strict=True)]
    return np.array([[*e.z, e.unknown_input, e.gamma] for e in found if not e.status.rejected])


def table(path):
    with np.load(path) as arrays:
        names = [f'z{i + 1}' for i in range(9) if f'z{i + 1}' in arrays]
        return np.column_stack([arrays[n] for n in [*names, 'unknown_input', 'gamma']])


def run(*arguments):
    return replay.main([str(a) for a in arguments])


def test_output_is_a_bag_with_the_estimators_topics_or_a_table(bag, tmp_path, monkeypatch):
    monkeypatch.setattr(replay, 'BLOCK', 700)  # several blocks, the last one not full
    out, arrays = tmp_path / 'out', tmp_path / 'out.npz'
    model = ['-p', 'order:=2', '-p', 'phi:=["0","0"]', '-p', 'gains:=fixed']
    assert run(bag, '-o', out, '-o', arrays, *model) == 0
    rows = expected(STAMPS, Y, {'order': 2, 'phi': ['0', '0'], 'gains': 'fixed'})
    with BagReader(out) as reader:
        for topic, expected_values in (
            ('state', rows[:, :2]), ('unknown_input', rows[:, 2]), ('gamma', rows[:, 3]),
            ('stamp', STAMPS),
        ):  # fmt: skip
            found = reader.samples(f'/estimator/{topic}')
            np.testing.assert_array_equal(found.values, expected_values)
            np.testing.assert_array_equal(found.stamps, STAMPS)
        _, _, innovation, _ = next(reader.objects(['/estimator/innovation']))
        assert innovation.layout.dim[0].label == 'eps1,eps2,eps3'
        counts = {c.topic: c.msgcount for c in reader.connections}
        assert counts.pop('/estimator/parameters') == 1
        assert set(counts.values()) == {len(STAMPS)}
    np.testing.assert_array_equal(table(arrays), rows)
    # A bag that has estimates gets the replayed ones beside them.
    again = tmp_path / 'again'
    assert run(out, '-o', again) == 0
    with BagReader(again) as reader:
        for name in ('/replay/estimator', '/estimator'):
            assert len(reader.samples(f'{name}/state').stamps) == len(STAMPS)


def test_parameters_of_a_named_node_by_file_and_command_line(bag, tmp_path, capsys):
    (tmp_path / 'p.yaml').write_text(
        'rig: {left: {ros__parameters: {epsilon: 3.0, lambda: 15, publish_rate: 50.0}}}\n'
        'estimator: {ros__parameters: {}}'
    )
    rules = ['variant:=sign', 'alpha:=30', 'gamma_rate:=0.1', 'lambda:=[20, 15.5, 15, 1e1]']
    arguments = ['--params-file', tmp_path / 'p.yaml', '--node', '/rig/left']
    arguments += [word for rule in rules for word in ('-p', rule)]
    assert run(bag, '-o', tmp_path / 'o.npz', *arguments) == 0
    assert 'warning' not in capsys.readouterr().err
    values = {'variant': 'sign', 'alpha': 30, 'epsilon': 3.0, 'gamma_rate': 0.1}
    values['lambda'] = [20, 15.5, 15, 10]
    np.testing.assert_array_equal(table(tmp_path / 'o.npz'), expected(STAMPS, Y, values))
    assert run(bag, '-o', tmp_path / 'default.npz') == 0
    assert 'replay: warning: the bag has no ~/parameters' in capsys.readouterr().err


def test_any_number_of_any_type_with_stamps_that_go_back(tmp_path, capsys):
    stamps, y = files.signal(400)
    late = stamps + 3_000_000  # the bag's own stamps, not those of the headers
    stamps[100] -= 5_000_000
    messages = [
        ('/sensor', files.JOINTS, at, files.joint_state(stamp, [1.0, 2.0, value]))
        for at, stamp, value in zip(late.tolist(), stamps.tolist(), y.tolist(), strict=True)
    ]
    bag = files.write(tmp_path / 'bag', messages)
    choice = ['-p', 'input_topic:=/sensor', '-p', 'input_field:=position[2]']
    assert run(bag, *choice, '-o', tmp_path / 'o.npz') == 0
    said = capsys.readouterr().out
    assert '1 rejected' in said  # as live
    np.testing.assert_array_equal(table(tmp_path / 'o.npz'), expected(stamps, y))
    assert run(bag, *choice, '-p', 'input_stamp:=reception', '-o', tmp_path / 'b.npz') == 0
    np.testing.assert_array_equal(table(tmp_path / 'b.npz'), expected(late, y))


def test_several_known_inputs_are_held_each_by_itself(tmp_path, capsys):
    stamps, y = files.signal(600)
    times = [stamps[100::250] + 1, stamps[50::100]]  # of one time: before the sample
    values = [np.array([0.5, -0.25]), np.linspace(-1.0, 1.0, 6)]
    messages = files.floats(stamps[400:401], np.array([np.nan]), '/b')
    for at, u, topic in zip(times, values, ('/left', '/b'), strict=True):
        messages += files.floats(at, u, topic)
    messages += files.floats(stamps, y)
    bag = files.write(tmp_path / 'bag', sorted(messages, key=lambda m: m[2]))
    parameters = {'phi': ['0', '0', 'k*(a + 2*b) - z3'], 'inputs': ['a', 'unused', 'b']}
    parameters |= {'constants.k': 0.5}
    (tmp_path / 'p.yaml').write_text(dumps(parameters))
    arguments = ['--params-file', tmp_path / 'p.yaml', '-o', tmp_path / 'o.npz', '--force']
    assert run(bag, *arguments, '-p', 'known_input_topics:=[/left, /b]') == 0
    u = np.zeros((len(y), 3))
    for column, at, known in zip((0, 2), times, values, strict=True):
        u[:, column] = np.append(0.0, known)[np.searchsorted(at, stamps, side='right')]
    estimates = OnlineEstimator(parameters).run(stamps, y, u)
    with np.load(tmp_path / 'o.npz') as found:
        np.testing.assert_array_equal(found['unknown_input'], estimates.unknown_input)
    assert run(bag, *arguments, '-p', 'known_input_topics:=[/a, /b, /c]') == 2
    assert 'each known input that phi uses (a, b)' in capsys.readouterr().err
    without = ['-p', 'phi:=[0, 0, -z3]', '-p', 'known_input_topics:=[/a, /b]']
    for more, said in ([], '/a: a is held at 0'), (without, "'known_input_topics' is not used"):
        with pytest.warns(UserWarning, match=said):
            assert run(bag, *arguments, *more) == 0


def test_topic_of_an_unknown_type_is_copied(tmp_path):
    """A sqlite3 bag of Humble has no definitions."""
    stamps, y = files.signal(500)
    messages = files.floats(stamps, y) + files.floats(stamps[:1], y[:1], '/odd')
    bag = files.write(tmp_path / 'bag', messages, 'sqlite3', version=8)
    with sqlite3.connect(bag / 'bag.db3') as database:
        database.execute("UPDATE topics SET type = 'rig_msgs/msg/Odd' WHERE name = '/odd'")
        database.execute('DROP TABLE message_definitions')
        database.execute('UPDATE schema SET schema_version = 3')
    database.close()
    before, after = (bag / 'metadata.yaml').read_text().split('name: /odd')
    after = after.replace(files.FLOAT, 'rig_msgs/msg/Odd', 1)
    (bag / 'metadata.yaml').write_text(f'{before}name: /odd{after}')
    assert run(bag, '-o', tmp_path / 'o.npz', '-o', tmp_path / 'o') == 0
    np.testing.assert_array_equal(table(tmp_path / 'o.npz'), expected(stamps, y))
    with BagReader(tmp_path / 'o') as copied:
        assert [data for _, _, data, _ in copied.messages(['/odd'])] == [files.float64(y[0])]


def test_types_of_a_sourced_workspace_go_into_the_bag(tmp_path, monkeypatch):
    share = tmp_path / 'prefix' / 'share' / 'rig_msgs' / 'msg'
    share.mkdir(parents=True)
    (share / 'Inner.msg').write_text('float32 force\n')
    (share / 'Outer.msg').write_text('std_msgs/Header header\nrig_msgs/Inner[2] inner\n')
    monkeypatch.setenv('AMENT_PREFIX_PATH', f'/nowhere:{tmp_path / "prefix"}')
    with BagWriter(tmp_path / 'bag') as bag:
        bag.add('/rig', 'rig_msgs/msg/Outer')
        bag.write('/rig', 5, bytes([0, 1, *[0] * 10, 1, *[0] * 7]) + np.float32([1, 2]).tobytes())
    with BagReader(tmp_path / 'bag') as reader:
        ((_, _, message, _),) = reader.objects(['/rig'])
        assert reader.field('/rig', 'inner[1].force').value(message) == 2.0


@pytest.mark.parametrize('lag', [None, 0.2])
def test_smoothed_estimates_are_the_librarys(lag, tmp_path):
    y = Y.copy()
    y[500:503] = np.nan
    bag = files.write(tmp_path / 'bag', files.floats(STAMPS, y))
    file = ROOT / 'config' / 'demo.yaml'
    way = ['-p', f'smoothing_lag:={lag}'] if lag else ['--smooth']
    assert run(bag, '-o', tmp_path / 'o.npz', *way, '--params-file', file) == 0
    estimator = OnlineEstimator(OnlineEstimator.from_yaml(file).parameters, smoothing_lag=lag or 0)
    if not lag:
        estimator.smooth()
    parts = [estimator.run(STAMPS, y), *([] if lag else [estimator.finish()])]
    with np.load(tmp_path / 'o.npz') as found:
        stamps = np.concatenate([part.t for part in parts])
        d = np.concatenate([part.unknown_input for part in parts])
        for column in ('stamp_ns', 'bag_time_ns'):
            np.testing.assert_array_equal(found[column], stamps)
        np.testing.assert_allclose(found['unknown_input'], d, rtol=0.0, atol=1e-7)
        np.testing.assert_array_equal(found['y'], y[np.isin(STAMPS, stamps)])


T = np.arange(300) * 1e-3
SINE, U = 0.1 * np.sin(T), np.cos(9.0 * T)
MODEL = {'order': 2, 'phi': ['0', '-z1 + torque'], 'inputs': ['torque']}


@pytest.mark.parametrize(('first', 'delimiter', 'arguments'), [
    ('t,angle,torque', ',', ['-p', 'input_topic:=/joint_states', '-p', 'input_field:=position']),
    ('torque;x;"angle";t', ';', ['--columns', 't, angle, torque']),
    ('# t angle torque', ' ', ['--columns', 't,angle,torque']),
    ('', '\t', ['--columns', '1,2,3']),
])  # fmt: skip
def test_csv_file_is_estimated_as_its_arrays(tmp_path, first, delimiter, arguments):
    y = SINE.copy()
    y[100] = SINE[100] if delimiter == ' ' else np.nan  # an empty cell is a missing sample
    columns = [U, 0.0 * T, y, T] if first.startswith('torque') else [T, y, U]
    lines = [delimiter.join(map(repr, map(float, row))) for row in zip(*columns, strict=True)]
    path = tmp_path / 'my.csv'
    path.write_text('\n'.join([first, *lines][not first :]).replace('nan', ''))
    given = [text for name, value in MODEL.items() for text in ('-p', f'{name}:={value}')]
    assert run(path, *given, '-o', tmp_path / 'my.npz', *arguments) == 0
    stamps = np.maximum(np.round(T * 1e9).astype(np.int64), 1)
    expected = OnlineEstimator(MODEL).run(stamps, y, U)
    used = np.isfinite(y)
    with np.load(tmp_path / 'my.npz') as found:
        np.testing.assert_array_equal(found['stamp_ns'], stamps[used])
        np.testing.assert_array_equal(found['unknown_input'], expected.unknown_input[used])
