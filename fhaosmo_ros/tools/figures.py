# SPDX-License-Identifier: Apache-2.0
"""Figures: the only module that imports matplotlib. It draws on Axes that it is given."""

from pathlib import Path

import matplotlib

matplotlib.use('Agg')

from fhaosmo_ros.tools.run_report import Run
from matplotlib.axes import Axes
from matplotlib.figure import Figure
import numpy as np
from numpy.typing import NDArray

TRUTH = {'color': '#0072B2', 'linewidth': 2.2, 'label': 'true'}
ESTIMATE = {'color': '#D55E00', 'linewidth': 1.1, 'linestyle': '--', 'label': 'estimated'}
"""Blue and vermilion of the Okabe-Ito palette, told apart by dashes in grey print too."""


def draw_comparison(
    axes: Axes, t: NDArray[np.float64], truth: NDArray[np.float64], estimate: NDArray[np.float64]
) -> None:
    """Draw an estimate over the truth; the transient may leave the picture, the truth not."""
    axes.plot(t, truth, **TRUTH)
    axes.plot(t, estimate, **ESTIMATE)
    late = t >= 0.1 * t[-1]
    low = min(truth.min(), estimate[late].min())
    high = max(truth.max(), estimate[late].max())
    margin = 0.15 * (high - low) or 1.0
    axes.set_ylim(low - margin, high + margin)
    axes.grid(alpha=0.3)


def save_run(run: Run, path: Path) -> None:
    """Write a figure of a run: states, unknown input and gamma over time."""
    rows = len(run.names) + 1
    figure = Figure(figsize=(8.0, 1.6 * rows + 0.6), layout='constrained')
    axes = figure.subplots(rows, 1, sharex=True)
    for column, name in enumerate(run.names):
        draw_comparison(axes[column], run.t, run.truth[:, column], run.estimate[:, column])
        axes[column].set_ylabel('unknown\ninput d' if name == 'd' else name)
    axes[0].legend(loc='upper left', ncols=2)
    axes[-1].plot(run.t, run.gamma, color='black', linewidth=1.2)
    axes[-1].set_ylabel('power γ')
    axes[-1].grid(alpha=0.3)
    axes[-1].set_xlabel('time since the first estimate [s]')
    axes[-1].set_xlim(run.t[0], run.t[-1])
    figure.suptitle('States and unknown input, estimated live from y = z1')
    figure.savefig(path, dpi=150)
