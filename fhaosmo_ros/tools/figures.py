# SPDX-License-Identifier: Apache-2.0
"""Figures: the only module that imports matplotlib. It draws on Axes that it is given."""

from pathlib import Path

from fhaosmo_ros.core.errors import ConfigurationError
from fhaosmo_ros.tools.plot_data import Curves
from fhaosmo_ros.tools.run_report import Run
import matplotlib
from matplotlib.axes import Axes
from matplotlib.figure import Figure
import numpy as np
from numpy.typing import NDArray

WINDOWLESS = ('agg', 'cairo', 'pdf', 'pgf', 'ps', 'svg', 'template')
"""Backends of matplotlib, in small letters."""
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


COLOURS = ('#D55E00', '#009E73', '#CC79A7', '#E69F00', '#56B4E9')
"""Okabe-Ito, without the truth's blue; each curve also has dashes of its own."""
DASHES = ('-', '--', '-.', ':')


def _limits(axes: Axes, rows: list[NDArray[np.float64]]) -> None:
    """Fit the picture to what comes after the transient."""
    late = np.concatenate([row[len(row) // 10 :] for row in rows])
    late = late[np.isfinite(late)]
    if len(late):
        margin = 0.1 * float(np.ptp(late)) or 0.1 * abs(float(late[0])) or 1.0
        axes.set_ylim(late.min() - margin, late.max() + margin)


def draw_innovations(axes: Axes, t: NDArray[np.float64], eps: NDArray[np.float64]) -> None:
    """Draw |eps_1| .. |eps_N| on a logarithmic scale."""
    for k in range(eps.shape[1]):
        axes.plot(t, np.abs(eps[:, k]) + 1e-300, linewidth=0.8, label=f'ε{k + 1}')
    axes.set_yscale('log')
    size = np.abs(eps)[np.abs(eps) > 0.0]
    if len(size):
        axes.set_ylim(np.percentile(size, 1) / 3.0, size.max() * 3.0)


def save_curves(curves: list[Curves], epsilon: float | None, path: Path, window: bool) -> None:
    """
    Write a figure of several estimates laid one over another.

    Parameters
    ----------
    curves : list of Curves
    epsilon : float or None
        Threshold of the gates; drawn, and the gates with it, if known.
    path : path
        Its suffix names the format.
    window : bool
        Make a window too, for `show`.

    """
    names = max((c.names for c in curves), key=len)
    extra = 2 if epsilon is None else 3
    rows = len(names) + extra
    size = (8.5, 1.45 * rows + 0.9)
    if window:
        import matplotlib.pyplot as plt

        _expect_windows()
        figure = plt.figure(figsize=size, layout='constrained')
    else:
        figure = Figure(figsize=size, layout='constrained')
    axes = figure.subplots(rows, 1, sharex=True)
    origin = min(c.stamps[0] for c in curves)
    for number, c in enumerate(curves):
        style = {
            'color': COLOURS[number % len(COLOURS)], 'linestyle': DASHES[number % len(DASHES)],
            'linewidth': 1.2, 'label': c.label,
        }  # fmt: skip
        t = (c.stamps - origin) * 1e-9
        for k in range(len(c.names)):
            row = axes[len(names) - 1 if c.names[k] == 'd' else k]
            if c.truth is not None and number == 0:
                row.plot(t, c.truth[:, k], **TRUTH)
            row.plot(t, c.estimate[:, k], **style)
        axes[len(names)].plot(t, c.gamma, **style)
        if epsilon is not None:
            gates = (np.abs(c.innovation) <= epsilon)[:, :-1]
            levels = 1 + np.cumprod(gates, axis=1).sum(axis=1)
            axes[-1].step(t, levels, where='post', **style)
    for k, name in enumerate(names):
        shown = [c.estimate[:, c.names.index(name)] for c in curves if name in c.names]
        _limits(axes[k], shown)
        axes[k].set_ylabel('unknown\ninput d' if name == 'd' else name)
    axes[len(names)].set_ylabel('power γ')
    first = curves[0]
    row = axes[len(names) + 1]
    draw_innovations(row, (first.stamps - origin) * 1e-9, first.innovation)
    row.set_ylabel('|innovation|' if len(curves) == 1 else '|innovation|\n(first)')
    if epsilon is not None:
        low, high = row.get_ylim()
        row.set_ylim(low, max(high, 3.0 * epsilon))
        row.axhspan(low, epsilon, color='grey', alpha=0.15, label='band ε')
        axes[-1].set_ylabel('open levels')
        axes[-1].set_yticks(range(1, first.innovation.shape[1] + 1))
    row.legend(loc='upper right', ncols=5, fontsize='small')
    for one in axes:
        one.grid(alpha=0.3)
    axes[-1].set_xlabel('time since the first estimate [s]')
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc='outside upper center', ncols=2, fontsize='small')
    figure.savefig(path, dpi=150)


def show() -> None:
    """Wait until the user has closed the window."""
    import matplotlib.pyplot as plt

    plt.show()


def _expect_windows() -> None:
    """
    Let matplotlib choose its backend, or take that of MPLBACKEND.

    Raises
    ------
    ConfigurationError
        It can't open windows here.

    """
    import matplotlib.pyplot as plt

    try:
        plt.switch_backend(matplotlib.get_backend())
        found = plt.get_backend()
    except ImportError as error:
        found = str(error)
    if found.lower() in WINDOWLESS or ' ' in found:
        raise ConfigurationError(
            '--show: expected a display (DISPLAY or WAYLAND_DISPLAY), PyQt or tkinter, and no '
            f'MPLBACKEND without windows, got {found}'
        )
