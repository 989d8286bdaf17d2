# SPDX-License-Identifier: Apache-2.0
"""A bag, or a CSV file, replayed is the observer's own result."""

import csv
from pathlib import Path
import sqlite3

import bag_files as files
from fhaosmo_ros.core.online.estimator import OnlineEstimator
from fhaosmo_ros.core.parameters.files import dumps
from fhaosmo_ros.tools.bags.reader import BagReader
from fhaosmo_ros.tools.bags.topics import series
from fhaosmo_ros.tools.bags.writer import BagWriter
from fhaosmo_ros.tools.replay import command as replay
import numpy as np
import pytest
from rosbags.highlevel import AnyReader

ROOT = Path(__file__).resolve().parents[1]
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


@pytest.fixture(name='blocks')
def _blocks(monkeypatch):
    """Several blocks of estimates, also the last one not full."""
    monkeypatch.setattr(replay, 'BLOCK', 700)


@pytest.mark.usefixtures('blocks')
def test_output_bag_holds_the_estimators_topics(bag, tmp_path):
    out = tmp_path / 'out'
    model = ['-p', 'order:=2', '-p', 'phi:=["0","0"]', '-p', 'gains:=fixed']
    assert run(bag, '-o', out, *model) == 0
    rows = expected(STAMPS, Y, {'order': 2, 'phi': ['0', '0'], 'gains': 'fixed'})
    state = series(out, '/estimator/state')
    np.testing.assert_array_equal(state.values, rows[:, :2])
    assert state.labels == ['z1', 'z2']
    np.testing.assert_array_equal(state.stamps, STAMPS)
    np.testing.assert_array_equal(series(out, '/estimator/unknown_input').values, rows[:, 2])
    np.testing.assert_array_equal(series(out, '/estimator/gamma').values, rows[:, 3])
    np.testing.assert_array_equal(series(out, '/estimator/stamp').values, STAMPS)
    assert series(out, '/estimator/innovation').labels == ['eps1', 'eps2', 'eps3']
    with AnyReader([out]) as reader:
        assert all(c.digest.startswith('RIHS01_') for c in reader.connections)
        counts = {c.topic: c.msgcount for c in reader.connections}
        assert counts.pop('/estimator/parameters') == 1
        assert set(counts.values()) == {len(STAMPS)}
    # A bag that has estimates gets the replayed ones beside them.
    again = tmp_path / 'again'
    assert run(out, '-o', again) == 0
    assert len(series(again, '/replay/estimator/state').stamps) == len(STAMPS)
    assert len(series(again, '/estimator/state').stamps) == len(STAMPS)


@pytest.mark.usefixtures('blocks')
def test_csv_reads_back_as_the_same_numbers(bag, tmp_path):
    assert run(bag, '-o', tmp_path / 'out.csv') == 0
    rows = np.genfromtxt(tmp_path / 'out.csv', delimiter=',', names=True)
    with (tmp_path / 'out.csv').open() as file:
        titles, *lines = csv.reader(file)
    assert titles == [
        'stamp_ns', 'bag_time_ns', 'y', 'z1', 'z2', 'z3', 'unknown_input', 'gamma',
        *(f'eps{k}' for k in (1, 2, 3, 4)), 'status', 'open_levels',
    ]  # fmt: skip
    assert [int(line[0]) for line in lines] == STAMPS.tolist()
    got = np.column_stack([rows[n] for n in ('z1', 'z2', 'z3', 'unknown_input', 'gamma')])
    np.testing.assert_array_equal(got, expected(STAMPS, Y))


def test_parameters_of_file_and_command_line(bag, tmp_path, capsys):
    (tmp_path / 'p.yaml').write_text(
        '/**: {ros__parameters: {variant: sign, alpha: 30, lambda: 15, publish_rate: 50.0}}'
    )
    arguments = ['--params-file', tmp_path / 'p.yaml', '-p', 'lambda:=[20, 15.5, 15, 1e1]']
    assert run(bag, '-o', tmp_path / 'o.npz', *arguments) == 0
    assert 'warning' not in capsys.readouterr().err
    assert run(bag, '-o', tmp_path / 'default.npz') == 0
    assert 'replay: warning: the bag has no ~/parameters' in capsys.readouterr().err
    values = {'variant': 'sign', 'alpha': 30, 'lambda': [20, 15.5, 15, 10]}
    np.testing.assert_array_equal(table(tmp_path / 'o.npz'), expected(STAMPS, Y, values))


def test_parameters_for_a_named_node(bag, tmp_path):
    (tmp_path / 'p.yaml').write_text(
        'rig: {left: {ros__parameters: {epsilon: 3.0}}}\nestimator: {ros__parameters: {}}'
    )
    rules = ['-p', 'plant:order:=7', '-p', 'rig/left:variant:=sign', '-p', '/rig/left:alpha:=30']
    arguments = ['--params-file', tmp_path / 'p.yaml', *rules, '--node', '/rig/left']
    assert run(bag, '-o', tmp_path / 'o.npz', *arguments) == 0
    values = {'variant': 'sign', 'alpha': 30, 'epsilon': 3.0}
    np.testing.assert_array_equal(table(tmp_path / 'o.npz'), expected(STAMPS, Y, values))


def third_joint(stamp, value):
    return files.joint_state(stamp, [1.0, 2.0, value])


@pytest.mark.parametrize(('kind', 'field', 'make', 'rounding'), [
    (files.JOINTS, 'position[2]', third_joint, np.float64),
    ('std_msgs/msg/Float32', '', lambda _, v: files.cdr('std_msgs/msg/Float32', data=v),
     np.float32),
])  # fmt: skip
def test_any_number_of_any_type(kind, field, make, rounding, tmp_path):
    stamps, y = files.signal(400)
    late = stamps + 3_000_000  # the bag's own stamps, not those of the headers
    messages = [
        ('/sensor', kind, at, make(stamp, value))
        for at, stamp, value in zip(late.tolist(), stamps.tolist(), y.tolist(), strict=True)
    ]
    bag = files.write(tmp_path / 'bag', messages)
    choice = ['-p', 'input_topic:=/sensor', '-p', f"input_field:='{field}'"]
    assert run(bag, *choice, '-o', tmp_path / 'o.npz') == 0
    used = stamps if kind == files.JOINTS else late
    y = y.astype(rounding).astype(np.float64)
    np.testing.assert_array_equal(table(tmp_path / 'o.npz'), expected(used, y))
    assert run(bag, *choice, '-p', 'input_stamp:=reception', '-o', tmp_path / 'b.npz') == 0
    np.testing.assert_array_equal(table(tmp_path / 'b.npz'), expected(late, y))


def test_several_known_inputs_are_held_each_by_itself(tmp_path, capsys):
    stamps, y = files.signal(600)
    times = [stamps[100::250] + 1, stamps[50::100] + 1]
    values = [np.array([0.5, -0.25]), np.linspace(-1.0, 1.0, 6)]
    messages = files.floats(stamps, y) + files.floats(stamps[400:401], np.array([np.nan]), '/b')
    for at, u, topic in zip(times, values, ('/left', '/b'), strict=True):
        messages += files.floats(at, u, topic)
    bag = files.write(tmp_path / 'bag', sorted(messages, key=lambda m: m[2]))
    parameters = {'phi': ['0', '0', 'k*(a + 2*b) - z3'], 'inputs': ['a', 'unused', 'b']}
    parameters |= {'constants.k': 0.5}
    (tmp_path / 'p.yaml').write_text(dumps(parameters))
    arguments = ['--params-file', tmp_path / 'p.yaml', '-o', tmp_path / 'o.npz']
    topics = ['-p', 'known_input_topics:=[/left, /b]']
    assert run(bag, *arguments, *topics) == 0
    u = np.zeros((len(y), 3))
    for column, at, known in zip((0, 2), times, values, strict=True):
        u[:, column] = np.concatenate([[0.0], known])[np.searchsorted(at, stamps)]
    estimates = OnlineEstimator(parameters).run(stamps, y, u)
    with np.load(tmp_path / 'o.npz') as found:
        np.testing.assert_array_equal(found['unknown_input'], estimates.unknown_input)
    assert run(bag, *arguments, '--force', '-p', 'known_input_topics:=[/a, /b, /c]') != 0
    assert 'each known input that phi uses (a, b)' in capsys.readouterr().err
    assert run(bag, *arguments, '--force') != 0
    assert "'/a'" in capsys.readouterr().err


def test_stamps_that_go_back_are_rejected_as_live(tmp_path, capsys):
    stamps, y = files.signal(200)
    shown = stamps.copy()
    shown[100] -= 5_000_000
    messages = [
        ('/j', files.JOINTS, at, third_joint(s, v))
        for at, s, v in zip(stamps.tolist(), shown.tolist(), y.tolist(), strict=True)
    ]
    bag = files.write(tmp_path / 'bag', messages)
    options = ['-p', 'input_topic:=/j', '-p', 'input_field:=position[2]']
    assert run(bag, *options, '-o', tmp_path / 'o.npz') == 0
    np.testing.assert_array_equal(table(tmp_path / 'o.npz'), expected(shown, y))
    assert '1 rejected' in capsys.readouterr().out


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
    text = (bag / 'metadata.yaml').read_text()
    at = text.index('name: /odd')
    text = text[:at] + text[at:].replace(files.FLOAT, 'rig_msgs/msg/Odd', 1)
    (bag / 'metadata.yaml').write_text(text)
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
        bag.write('/rig', 5, b'\0\1\0\0' + bytes(13) + b'\0\0\0' + bytes(8))
    with BagReader(tmp_path / 'bag') as reader:
        assert reader.field('/rig', 'inner[1].force').steps == ['inner', 1, 'force']


@pytest.mark.parametrize('way', [['--smooth'], ['-p', 'smoothing_lag:=0.2']])
def test_smoothed_estimates_are_the_librarys(way, tmp_path, capsys):
    stamps, y = STAMPS, Y.copy()
    y[500:503] = np.nan
    bag = files.write(tmp_path / 'bag', files.floats(stamps, y))
    lag = way != ['--smooth']
    options = ['--params-file', ROOT / 'config' / 'demo.yaml']
    assert run(bag, '-o', tmp_path / 'o.npz', *way, *options) == 0
    estimator = OnlineEstimator.from_yaml(ROOT / 'config' / 'demo.yaml')
    if lag:
        estimator = OnlineEstimator(estimator.parameters | {'smoothing_lag': 0.2})
    else:
        estimator.smooth()
    parts = [estimator.run(stamps, y), *([] if lag else [estimator.finish()])]
    with np.load(tmp_path / 'o.npz') as found:
        columns = {name: found[name] for name in found.files}
    for name, key in (('stamp_ns', 't'), ('unknown_input', 'unknown_input')):
        ours = np.concatenate([getattr(part, key) for part in parts])
        np.testing.assert_allclose(columns[name], ours, rtol=0.0, atol=1e-7)
    np.testing.assert_array_equal(columns['bag_time_ns'], columns['stamp_ns'])
    of_stamp = dict(zip(stamps.tolist(), y.tolist(), strict=True))
    np.testing.assert_array_equal(columns['y'], [of_stamp[t] for t in columns['stamp_ns']])
    assert 'smoothed: each estimate by the samples before' in capsys.readouterr().out


# CSV files

T = np.arange(300) * 1e-3
SINE, U = 0.1 * np.sin(T), np.cos(9.0 * T)
MODEL = {'order': 2, 'phi': ['0', '-z1 + torque'], 'inputs': ['torque']}
OPTIONS = [f'{name}:={value}' for name, value in MODEL.items()]


def run_table(path, *arguments):
    given = [text for option in OPTIONS for text in ('-p', option)]
    return run(path, *given, '-o', path.with_suffix('.npz'), *arguments)


@pytest.mark.parametrize(('first', 'delimiter', 'arguments'), [
    ('t,angle,torque', ',', []),
    ('torque;x;"angle";t', ';', ['--columns', 't, angle, torque']),
    ('# t angle torque', ' ', ['-p', 'input_topic:=/joint_states', '-p', 'input_field:=position']),
    ('', '\t', ['--columns', '1,2,3']),
])  # fmt: skip
def test_csv_file_is_estimated_as_its_arrays(tmp_path, first, delimiter, arguments):
    path, columns = tmp_path / 'my.csv', [T, SINE, U]
    if first.startswith('torque'):
        columns = [U, 0.0 * T, SINE, T]
    lines = [delimiter.join(map(repr, map(float, row))) for row in zip(*columns, strict=True)]
    path.write_text('\n'.join([first, *lines][not first :]))
    assert run_table(path, *arguments) == 0
    stamps = np.maximum(np.round(T * 1e9).astype(np.int64), 1)
    expected = OnlineEstimator(MODEL).run(stamps, SINE, U)
    found = np.load(tmp_path / 'my.npz')
    np.testing.assert_array_equal(found['stamp_ns'], stamps)
    np.testing.assert_array_equal(found['unknown_input'], expected.unknown_input)


def test_empty_cell_is_a_missing_sample(tmp_path, capsys):
    (tmp_path / 'my.csv').write_text('t,y,u\n0,0.1,0\n0.001,,0\n0.002,0.1,0\n')
    assert run_table(tmp_path / 'my.csv') == 0
    assert '2 samples used, 1 rejected' in capsys.readouterr().out


@pytest.mark.parametrize(('text', 'columns', 'said'), [
    ('t,y,u\n0,1,2\n0.001,x,3\n', '', 'my.csv: expected lines of numbers: could not convert str'),
    ('t,y,u\n0,1\n', '', 'my.csv: expected lines of numbers: '),
    ('t,y,u\n', '', 'my.csv: expected lines of numbers, got none'),
    ('', '', '--columns: expected 3 titles, of the time, y, torque, got'),
    ('t,angle,u\n0,1,2\n', 't,anlge,u', "t, angle, u, got 'anlge'; did you mean 'angle'?"),
    ('t,y,u\n0,1,2\n', 't,y', '--columns: expected 3 titles, of the time, y, torque, got t, y'),
    ('t,y,u\n-1,1,2\n', '', 'my.csv: expected times of 0 to 9.2e+09 s, got -1.0 in sample 0'),
    ('t,y,u\nnan,1,2\n', '', 'my.csv: expected times of 0 to 9.2e+09 s, got nan in sample 0'),
])  # fmt: skip
def test_bad_table_is_said_in_one_line(tmp_path, capsys, text, columns, said):
    (tmp_path / 'my.csv').write_text(text)
    assert run_table(tmp_path / 'my.csv', '--columns', columns) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert said in line
    assert not (tmp_path / 'my.npz').exists()
