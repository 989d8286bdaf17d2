# SPDX-License-Identifier: Apache-2.0
"""A figure and a table from the estimates in bags."""

import bag_files as files
from fhaosmo_ros.tools.plot import command as plot
from fhaosmo_ros.tools.plot.figures import COLUMNS, envelope
from fhaosmo_ros.tools.replay import command as replay
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
import numpy as np
import pytest


@pytest.fixture(name='bag')
def _bag(tmp_path):
    stamps, y = files.signal(500)
    bag = files.write(tmp_path / 'bag', files.floats(stamps, y))
    assert replay.main([str(bag), '-o', str(tmp_path / 'one')]) == 0
    arguments = ['-o', str(tmp_path / 'two'), '-p', 'variant:=sign']
    assert replay.main([str(tmp_path / 'one'), *arguments]) == 0
    return tmp_path / 'two'


def test_formats_by_file_name(bag, tmp_path, capsys):
    for kind, magic in {'png': b'\x89PNG\r\n\x1a\n', 'svg': b'<?xml', 'pdf': b'%PDF-'}.items():
        out = tmp_path / f'figure.{kind}'
        assert plot.main([str(bag), '-o', str(out)]) == 0
        assert out.read_bytes().startswith(magic)
    text = capsys.readouterr().out
    assert 'two /estimator' in text
    assert 'two /replay/estimator' in text


def test_thinned_curve_draws_the_same_pixels():
    rng = np.random.default_rng(3)
    t = np.sort(rng.uniform(0.0, 100.0, 200_000)) ** 2  # a rate that changes
    curves = [np.sin(t * 1e-3), rng.normal(size=len(t)), np.where(t % 2000 < 500, np.nan, t)]
    curves[0][777] = 9.0  # one spike
    t[100_000:] += 500.0  # a gap
    for count in (0, 1, 100):
        assert envelope(t[:count], t[:count])[1].tolist() == t[:count].tolist()
    for x in curves:
        thin = envelope(t, x)
        assert len(thin[0]) <= 2 * COLUMNS + 2
        assert [np.nanmin(thin[1]), np.nanmax(thin[1])] == [np.nanmin(x), np.nanmax(x)]
        assert (thin[0][0], thin[0][-1]) == (t[0], t[-1])
        pictures = []
        for curve in ((t, x), thin):
            figure = Figure(figsize=(8.5, 2.0))
            figure.subplots().plot(*curve, linewidth=1.2)
            canvas = FigureCanvasAgg(figure)
            canvas.draw()
            pictures.append(np.asarray(canvas.buffer_rgba())[..., :3].mean(axis=2))
        assert np.mean(np.abs(pictures[0] - pictures[1]) > 100.0) < 2e-3
