# SPDX-License-Identifier: Apache-2.0
"""A CSV file replayed is the online estimator's own result; what is wrong is said in one line."""

from fhaosmo_ros.core import OnlineEstimator
from fhaosmo_ros.tools.replay import command as replay
import numpy as np
import pytest

T = np.arange(300) * 1e-3
Y, U = 0.1 * np.sin(T), np.cos(9.0 * T)
MODEL = {'order': 2, 'phi': ['0', '-z1 + torque'], 'inputs': ['torque']}
OPTIONS = [f'{name}:={value}' for name, value in MODEL.items()]


def run(path, *arguments):
    given = [text for option in OPTIONS for text in ('-p', option)]
    return replay.main([str(path), *given, '-o', str(path.with_suffix('.npz')), *arguments])


@pytest.mark.parametrize(('first', 'delimiter', 'arguments'), [
    ('t,angle,torque', ',', []),
    ('torque;x;"angle";t', ';', ['--columns', 't, angle, torque']),
    ('# t angle torque', ' ', ['-p', 'input_topic:=/joint_states', '-p', 'input_field:=position']),
    ('', '\t', ['--columns', '1,2,3']),
])  # fmt: skip
def test_csv_file_is_estimated_as_its_arrays(tmp_path, first, delimiter, arguments):
    path, columns = tmp_path / 'my.csv', [T, Y, U]
    if first.startswith('torque'):
        columns = [U, 0.0 * T, Y, T]
    lines = [delimiter.join(map(repr, map(float, row))) for row in zip(*columns, strict=True)]
    path.write_text('\n'.join([first, *lines][not first :]))
    assert run(path, *arguments) == 0
    stamps = np.maximum(np.round(T * 1e9).astype(np.int64), 1)
    expected = OnlineEstimator(MODEL).run(stamps, Y, U)
    found = np.load(tmp_path / 'my.npz')
    np.testing.assert_array_equal(found['stamp_ns'], stamps)
    np.testing.assert_array_equal(found['unknown_input'], expected.unknown_input)


def test_empty_cell_is_a_missing_sample(tmp_path, capsys):
    (tmp_path / 'my.csv').write_text('t,y,u\n0,0.1,0\n0.001,,0\n0.002,0.1,0\n')
    assert run(tmp_path / 'my.csv') == 0
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
    assert run(tmp_path / 'my.csv', '--columns', columns) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert said in line
    assert not (tmp_path / 'my.npz').exists()
