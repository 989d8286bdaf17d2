# SPDX-License-Identifier: Apache-2.0
"""Figures of a tuning."""

from collections.abc import Sequence
from pathlib import Path

from fhaosmo_ros.core.simulation.recordings import Recording
from fhaosmo_ros.tools.plot.figures import TRUTH
from matplotlib.figure import Figure
import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
BEFORE = {'color': '#999999', 'linewidth': 0.9, 'label': 'before'}
AFTER = {'color': '#D55E00', 'linewidth': 1.2, 'linestyle': '--', 'label': 'tuned'}


def save_estimates(
    shown: Sequence[tuple[str, Recording, Floats, Floats]], settled: float, path: Path
) -> None:
    """
    Draw d and its estimates.

    Parameters
    ----------
    shown : sequence of (title, recording, estimate before, estimate after)
    settled : float
        Errors count from this time on; the time before is shaded.
    path : path

    """
    figure = Figure(figsize=(8.5, 2.1 * len(shown) + 0.8), layout='constrained')
    rows = figure.subplots(len(shown), 1, squeeze=False)[:, 0]
    for axes, (title, recording, before, after) in zip(rows, shown, strict=True):
        axes.plot(recording.t, before, **BEFORE)
        axes.plot(recording.t, recording.d, **TRUTH)
        axes.plot(recording.t, after, **AFTER)
        late = recording.t >= settled
        values = np.concatenate([recording.d, after[late]])
        margin = 0.25 * float(np.ptp(values)) or 1.0
        axes.set_ylim(values.min() - margin, values.max() + margin)
        axes.axvspan(recording.t[0], settled, color='grey', alpha=0.12)
        axes.set_xlim(recording.t[0], recording.t[-1])
        axes.set_ylabel('unknown\ninput d')
        axes.set_title(title, fontsize='medium', loc='left')
        axes.grid(alpha=0.3)
    rows[-1].set_xlabel('time [s] (shaded: errors do not count yet)')
    handles, labels = rows[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc='outside upper center', ncols=3)
    figure.savefig(path, dpi=150)


def save_identified(
    t: Floats,
    d: Floats,
    deviation: float,
    settled: float,
    correlations: Floats,
    chance: float,
    path: Path,
) -> None:
    """
    Draw the estimate of d along a bag, and how white the innovations are.

    Parameters
    ----------
    t, d : (K,) arrays
    deviation : float
        Expected standard deviation of the error of d.
    settled : float
        The time before is shaded.
    correlations : (L,) array
        Of the innovations, from one sample to the next on.
    chance : float
        White innovations stay below this 19 times of 20.
    path : path

    """
    figure = Figure(figsize=(8.5, 5.0), layout='constrained')
    above, below = figure.subplots(2, 1, height_ratios=(2, 1))
    above.fill_between(
        t, d - 2.0 * deviation, d + 2.0 * deviation, color='#56B4E9', alpha=0.4, lw=0.0,
        label='expected error (2 standard deviations)',
    )  # fmt: skip
    above.plot(t, d, color='#D55E00', linewidth=0.9, label='estimate of d')
    late = d[t >= settled]
    margin = 0.25 * float(np.ptp(late)) + 2.0 * deviation or 1.0
    above.set_ylim(float(late.min()) - margin, float(late.max()) + margin)
    above.axvspan(t[0], settled, color='grey', alpha=0.12)
    above.set_xlim(t[0], t[-1])
    above.set_xlabel('time [s]')
    above.set_ylabel('unknown\ninput d')
    above.legend(loc='upper right', fontsize='small')
    lags = np.arange(1, len(correlations) + 1)
    below.bar(lags, correlations, color='#0072B2', width=0.5)
    below.axhspan(-chance, chance, color='grey', alpha=0.3, label='as chance makes it')
    largest = max(1.3 * float(np.abs(correlations).max()), 3.0 * chance)
    below.set_ylim(-largest, largest)
    below.set_xticks(lags[[0, *range(4, len(lags), 5)]])
    below.set_xlabel('samples between two innovations')
    below.set_ylabel('correlation')
    below.legend(loc='upper right', fontsize='small')
    for axes in (above, below):
        axes.grid(alpha=0.3)
    figure.savefig(path, dpi=150)
