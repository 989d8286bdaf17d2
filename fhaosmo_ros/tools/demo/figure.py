# SPDX-License-Identifier: Apache-2.0
"""The figure of a demonstration."""

from collections.abc import Mapping, Sequence
from pathlib import Path

from fhaosmo_ros.tools.demo.report import Floats, Run, SELF_TUNING, true_noise
from fhaosmo_ros.tools.plot.figures import COLOURS, draw_band, TRUTH
from fhaosmo_ros.topics import STANDARD_DEVIATION
from matplotlib.figure import Figure
import numpy as np

LIVE = {'color': COLOURS[0], 'linewidth': 1.1, 'linestyle': '--'}
"""Of the live estimate; dashed, so that grey print tells it from the truth."""


def save_figure(
    run: Run, compared: Mapping[str, Floats], marks: Sequence[tuple[int, str]], path: Path
) -> None:
    """Draw states, d, what the other observers make of d, and the power or the noise."""
    rows = [*run.names, *(['compared'] if compared else []), 'last']
    figure = Figure(figsize=(8.0, 1.5 * len(rows) + 0.8), layout='constrained')
    axes = dict(zip(rows, figure.subplots(len(rows), 1, sharex=True), strict=True))
    for k, name in enumerate(run.names):
        axes[name].plot(run.t, run.truth[:, k], **TRUTH)
        axes[name].plot(run.t, run.estimate[:, k], label='estimated live', **LIVE)
        if STANDARD_DEVIATION in run.of_gains:
            deviation = run.of_gains[STANDARD_DEVIATION][:, k]
            draw_band(axes[name], run.t, run.estimate[:, k], deviation)
        low, high = run.truth[:, k].min(), run.truth[:, k].max()
        margin = 0.3 * (high - low) or 1.0  # what is beyond leaves the picture
        axes[name].set_ylim(low - margin, high + margin)
        axes[name].set_ylabel('unknown\ninput d' if name == 'd' else name)
    handles, labels = axes['d'].get_legend_handles_labels()
    figure.legend(handles, labels, loc='outside upper center', ncols=3)
    if compared:
        row = axes['compared']
        d = run.truth[:, -1]
        shown = {name: e for name, e in compared.items() if name != SELF_TUNING}
        for colour, (name, estimate) in zip(('#999999', '#009E73'), shown.items(), strict=True):
            row.plot(run.t, estimate - d, color=colour, linewidth=0.8, label=name)
        row.plot(run.t, run.estimate[:, -1] - d, label='live: the power adapts', **LIVE)
        size = 1.5 * float(np.abs(d).max())
        row.set_ylim(-size, size)
        row.set_ylabel('error of d')
        row.legend(loc='upper right', ncols=3, fontsize='x-small')
    last = axes['last']
    if 'gamma' in run.of_gains:
        gamma = run.of_gains['gamma']
        last.plot(run.t, gamma, color='black', linewidth=1.2)
        last.axhline(gamma[0], color='black', linewidth=0.8, linestyle=':')
        last.set_ylabel('power γ')
    else:
        last.plot(run.t, true_noise(run), **TRUTH)
        last.plot(run.t, run.of_gains['tuning'][:, 0], **LIVE)
        last.set_yscale('log')
        last.set_ylabel('noise on y')
    for stamp, words in marks:
        t = (stamp - run.y.stamps[run.rows[0]]) * 1e-9
        for row in axes.values():
            row.axvline(t, color='black', linewidth=0.8, linestyle=':')
        corner = {'xycoords': ('data', 'axes fraction'), 'textcoords': 'offset points'}
        axes['d'].annotate(words, (t, 1.0), (3, -3), va='top', fontsize='small', **corner)
    for row in axes.values():
        row.grid(alpha=0.3)
    last.set_xlabel('time since the first estimate [s]')
    last.set_xlim(run.t[0], run.t[-1])
    figure.savefig(path, dpi=150)
