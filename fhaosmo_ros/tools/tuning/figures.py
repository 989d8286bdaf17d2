# SPDX-License-Identifier: Apache-2.0
"""The figure of a tuning by a bag."""

import math
from pathlib import Path

from fhaosmo_ros.tools.tuning.bag_gains import BEGIN, Run
from matplotlib.figure import Figure
import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


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
    margin = 0.25 * float(np.ptp(band)) or 1.0
    above.set(ylim=(band.min() - margin, band.max() + margin), xlim=(t[0], t[-1]))
    above.axvspan(t[0], t[begin], color='grey', alpha=0.12)
    above.set(xlabel='time [s]', ylabel='unknown\ninput d')
    lags = np.arange(1, len(run.correlations) + 1)
    chance = 2.0 / math.sqrt(len(t) - begin)
    below.bar(lags, run.correlations, color='#0072B2', width=0.5)
    below.axhspan(-chance, chance, color='grey', alpha=0.3, label='as chance makes it')
    largest = max(1.3 * float(np.abs(run.correlations).max()), 3.0 * chance)
    below.set(ylim=(-largest, largest), xticks=lags[[0, *range(4, len(lags), 5)]])
    below.set(xlabel='samples between two innovations', ylabel='correlation')
    for axes in (above, below):
        axes.grid(alpha=0.3)
        axes.legend(loc='upper right', fontsize='small')
    figure.savefig(path, dpi=150)
