# SPDX-License-Identifier: Apache-2.0
"""The figure of a demonstration."""

from collections.abc import Sequence
from pathlib import Path

from fhaosmo_ros.tools.demo.report import Run
from fhaosmo_ros.tools.plot.figures import draw_band, TRUTH
from matplotlib.axes import Axes
from matplotlib.figure import Figure
import numpy as np
from numpy.typing import NDArray

ESTIMATE = {'color': '#D55E00', 'linewidth': 1.1, 'linestyle': '--', 'label': 'estimated'}
"""Vermilion of the Okabe-Ito palette, dashed so that grey print tells it from the truth."""


def draw_comparison(
    axes: Axes, t: NDArray[np.float64], truth: NDArray[np.float64], estimate: NDArray[np.float64]
) -> None:
    """Draw an estimate over the truth; the limits fit the truth and what follows the transient."""
    axes.plot(t, truth, **TRUTH)
    axes.plot(t, estimate, **ESTIMATE)
    late = t >= 0.1 * t[-1]
    low = min(np.nanmin(truth), estimate[late].min())
    high = max(np.nanmax(truth), estimate[late].max())
    margin = 0.15 * (high - low) or 1.0
    axes.set_ylim(low - margin, high + margin)
    axes.grid(alpha=0.3)


def save_run(run: Run, path: Path, marks: Sequence[tuple[int, str]] = ()) -> None:
    """
    Write a figure of a run: states, d, and the noise found or gamma over time.

    Parameters
    ----------
    run : Run
    path : path
    marks : sequence of (int, str)
        What happened to the plant: stamps (ns), and words.

    """
    rows = len(run.names) + 1
    figure = Figure(figsize=(8.0, 1.6 * rows + 0.6), layout='constrained')
    axes = figure.subplots(rows, 1, sharex=True)
    for column, name in enumerate(run.names):
        truth, estimate = run.truth[:, column], run.estimate[:, column]
        draw_comparison(axes[column], run.t, truth, estimate)
        if run.tuned is not None:
            draw_band(axes[column], run.t, estimate, run.tuned.deviation[:, column])
        axes[column].set_ylabel('unknown\ninput d' if name == 'd' else name)
    if run.tuned is None:
        axes[-1].plot(run.t, run.gamma, color='black', linewidth=1.2)
        axes[-1].set_ylabel('power γ')
    else:
        axes[-1].plot(run.t, run.tuned.true_noise, **TRUTH)
        axes[-1].plot(run.t, run.tuned.noise, **ESTIMATE)
        axes[-1].set_yscale('log')
        axes[-1].set_ylabel('noise on y\n(standard dev.)')
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc='outside lower center', ncols=3)
    for stamp, words in marks:
        t = (stamp - run.origin) * 1e-9
        for row in axes:
            row.axvline(t, color='black', linewidth=0.8, linestyle=':')
        axes[-2].annotate(
            words, (t, 1.0), (3, -3), xycoords=('data', 'axes fraction'), va='top',
            textcoords='offset points', fontsize='small',
        )  # fmt: skip
    axes[-1].grid(alpha=0.3)
    axes[-1].set_xlabel('time since the first estimate [s]')
    axes[-1].set_xlim(run.t[0], run.t[-1])
    figure.suptitle('States and unknown input, estimated live from y = z1')
    figure.savefig(path, dpi=150)
