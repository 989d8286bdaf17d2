# SPDX-License-Identifier: Apache-2.0
"""A figure and a table from the estimates in bags."""

import bag_files as files
from fhaosmo_ros.tools import plot, replay
import pytest

MAGIC = {'png': b'\x89PNG\r\n\x1a\n', 'svg': b'<?xml', 'pdf': b'%PDF-'}


@pytest.fixture(name='bag')
def _bag(tmp_path):
    stamps, y = files.signal(500)
    bag = files.write(tmp_path / 'bag', files.floats(stamps, y))
    assert replay.main([str(bag), '-o', str(tmp_path / 'one')]) == 0
    arguments = ['-o', str(tmp_path / 'two'), '-p', 'variant:=sign']
    assert replay.main([str(tmp_path / 'one'), *arguments]) == 0
    return tmp_path / 'two'


@pytest.mark.parametrize('kind', MAGIC)
def test_formats_by_file_name(kind, bag, tmp_path, capsys):
    out = tmp_path / f'figure.{kind}'
    assert plot.main([str(bag), '-o', str(out), '-p', 'epsilon:=2.0']) == 0
    assert out.read_bytes().startswith(MAGIC[kind])
    text = capsys.readouterr().out
    assert 'two /estimator' in text
    assert 'two /replay/estimator' in text


@pytest.mark.parametrize(
    ('arguments', 'words'),
    [
        (['BAG', '-o', 'x.jpg'], ['.png, .svg, .pdf', 'x.jpg']),
        (['BAG', '--names', '/no'], ['/estimator, /replay/estimator', "'/no'"]),
        (['/no/bag'], ['/no/bag', 'does not exist']),
        (['PLAIN'], ['topics of an estimator', '/y']),
    ],
)
def test_wrong_input_is_said_in_one_line(arguments, words, bag, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    capsys.readouterr()
    places = {'BAG': str(bag), 'PLAIN': str(tmp_path / 'bag')}
    assert plot.main([places.get(a, a) for a in arguments]) == 2
    error = capsys.readouterr().err.strip().splitlines()
    assert len(error) == 1
    assert all(word in error[0] for word in words)
    assert not list(tmp_path.glob('*.png'))


def test_window_needs_a_display(bag, tmp_path, capsys, monkeypatch):
    monkeypatch.delenv('DISPLAY', raising=False)
    monkeypatch.delenv('WAYLAND_DISPLAY', raising=False)
    assert plot.main([str(bag), '-o', str(tmp_path / 'f.png'), '--show']) == 2
    assert 'DISPLAY' in capsys.readouterr().err
    assert not (tmp_path / 'f.png').exists()
