# SPDX-License-Identifier: Apache-2.0
"""Figures of a tuning."""

from collections.abc import Sequence
import math
from pathlib import Path

from fhaosmo_ros.core.simulation.recordings import Recording
from fhaosmo_ros.tools.plot.figures import TRUTH
from fhaosmo_ros.tools.tuning.bag_gains import BEGIN, Run
from matplotlib.axes import Axes
from matplotlib.figure import Figure
import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
BEFORE = {'color': '#999999', 'linewidth': 0.9, 'label': 'before'}
AFTER = {'color': '#D55E00', 'linewidth': 1.2, 'linestyle': '--', 'label': 'tuned'}


def save_estimates(
    shown: Sequence[tuple[str, Recording, Floats, Floats]], settled: float, path: Path
) -> None:
    """Draw d with its estimates before and after, as (title, recording, before, after) says."""
    figure = Figure(figsize=(8.5, 2.1 * len(shown) + 0.8), layout='constrained')
    rows = figure.subplots(len(shown), 1, squeeze=False)[:, 0]
    for axes, (title, recording, before, after) in zip(rows, shown, strict=True):
        axes.plot(recording.t, before, **BEFORE)
        axes.plot(recording.t, recording.d, **TRUTH)
        axes.plot(recording.t, after, **AFTER)
        late = recording.t >= settled
        _finish(axes, recording.t, settled, np.concatenate([recording.d, after[late]]))
        axes.set_title(title, fontsize='medium', loc='left')
    rows[-1].set_xlabel('time [s] (shaded: errors do not count yet)')
    figure.legend(*rows[0].get_legend_handles_labels(), loc='outside upper center', ncols=3)
    figure.savefig(path, dpi=150)


def save_identified(run: Run, deviation: float, path: Path) -> None:
    """Draw d along a bag with the `deviation` that is expected, and how white innovations are."""
    figure = Figure(figsize=(8.5, 5.0), layout='constrained')
    above, below = figure.subplots(2, 1, height_ratios=(2, 1))
    t, d, begin = run.t, run.unknown_input, int(BEGIN * len(run.t))
    band = d[begin:, None] + 2.0 * deviation * np.array([-1.0, 1.0])
    above.fill_between(
        t, d - 2.0 * deviation, d + 2.0 * deviation, color='#56B4E9', alpha=0.4, lw=0.0,
        label='expected error (2 standard deviations)',
    )  # fmt: skip
    above.plot(t, d, color='#D55E00', linewidth=0.9, label='estimate of d')
    _finish(above, t, t[begin], band)
    above.set_xlabel('time [s]')
    lags = np.arange(1, len(run.correlations) + 1)
    chance = 2.0 / math.sqrt(len(t) - begin)
    below.bar(lags, run.correlations, color='#0072B2', width=0.5)
    below.axhspan(-chance, chance, color='grey', alpha=0.3, label='as chance makes it')
    largest = max(1.3 * float(np.abs(run.correlations).max()), 3.0 * chance)
    below.set(ylim=(-largest, largest), xticks=lags[[0, *range(4, len(lags), 5)]])
    below.set(xlabel='samples between two innovations', ylabel='correlation')
    below.grid(alpha=0.3)
    for axes in (above, below):
        axes.legend(loc='upper right', fontsize='small')
    figure.savefig(path, dpi=150)


def _finish(axes: Axes, t: Floats, settled: float, values: Floats) -> None:
    """Show these values of d, and shade the time in which estimates settle."""
    margin = 0.25 * float(np.ptp(values)) or 1.0
    axes.set_ylim(float(values.min()) - margin, float(values.max()) + margin)
    axes.axvspan(t[0], settled, color='grey', alpha=0.12)
    axes.set_xlim(t[0], t[-1])
    axes.set_ylabel('unknown\ninput d')
    axes.grid(alpha=0.3)
