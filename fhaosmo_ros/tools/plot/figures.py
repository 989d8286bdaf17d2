# SPDX-License-Identifier: Apache-2.0
"""Figures of runs and of estimates in bags."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from fhaosmo_ros.tools.plot.curves import Curves
from matplotlib.axes import Axes
from matplotlib.figure import Figure
import numpy as np
from numpy.typing import NDArray

TRUTH = {'color': '#0072B2', 'linewidth': 2.2, 'label': 'true'}
"""Blue of the Okabe-Ito palette."""
COLOURS = ('#D55E00', '#009E73', '#CC79A7', '#E69F00', '#56B4E9')
"""Okabe-Ito palette, without the blue of the truth; each curve also has its own dashes."""
OTHERS = ('#bbbbbb', *COLOURS[1:])
"""Of what the run is compared with: what chatters is grey."""
DASHES = ('-', '--', '-.', ':')
COLUMNS = 1500
"""Of a thinned curve; more than a figure has pixels in a row."""


def envelope(t: NDArray[Any], x: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
    """
    Thin a curve to the least and the greatest sample of each of `COLUMNS` equal spans of time.

    The picture stays the same, also where the curve chatters, has gaps or is NaN for a while.
    Matplotlib takes about 50 bytes for each sample that it draws.
    """
    begins = _columns(t)
    if len(begins) == len(t):
        return t, x
    ends = np.fmin.reduceat(x, begins), np.fmax.reduceat(x, begins)
    return np.repeat(t[begins], 2), np.column_stack(ends).ravel()


def _columns(t: NDArray[Any]) -> NDArray[np.intp]:
    """Return where each of `COLUMNS` equal spans of time begins; all samples if they are few."""
    span = float(np.ptp(t)) if len(t) else 0.0
    if len(t) <= 2 * COLUMNS or not span > 0.0:
        return np.arange(len(t))
    column = ((t - t.min()) * (COLUMNS / span)).astype(np.int64)
    return np.flatnonzero(np.diff(column, prepend=-1))


def save_curves(
    curves: list[Curves],
    path: Path,
    compared: Sequence[Curves] = (),
    marks: Sequence[tuple[int, str]] = (),
) -> None:
    """
    Write a figure of several estimates laid one over another.

    From top to bottom: a row for each state, for d, for errors of d if others are compared, for
    gamma if an estimate has it, and for the innovations of the first estimate.

    Parameters
    ----------
    curves : list of Curves
    path : path
        Its suffix names the format.
    compared : sequence of Curves
        Others, whose errors of d are drawn beside that of the first one.
    marks : sequence of (int, str)
        Times in nanoseconds at which something changed, and what.

    """
    first, names = curves[0], max((c.names for c in curves), key=len)
    gamma = ['gamma'] if any(c.gamma is not None for c in curves) else []
    rows = [*names, *(['error of d'] if compared else []), *gamma, 'innovation']
    figure = Figure(figsize=(8.5, 1.45 * len(rows) + 0.9), layout='constrained')
    axes = dict(zip(rows, figure.subplots(len(rows), 1, sharex=True), strict=True))
    origin = min(c.stamps[0] for c in curves)
    for number, c in enumerate(curves):
        colour, dashes = COLOURS[number % len(COLOURS)], DASHES[number % len(DASHES)]
        style = {'color': colour, 'linestyle': dashes, 'linewidth': 1.2, 'label': c.label}
        t = (c.stamps - origin) * 1e-9
        for k, name in enumerate(c.names):
            row = axes[name if name == 'd' else names[k]]
            if c.truth is not None and number == 0:
                row.plot(*envelope(t, c.truth[:, k]), **TRUTH)
            row.plot(*envelope(t, c.estimate[:, k]), **style)
            if c.deviation is not None:
                draw_band(row, t, c.estimate[:, k], c.deviation[:, k], colour)
        for begin, end in (np.array(c.events).reshape(-1, 2) - origin) * 1e-9:
            axes['d'].axvspan(begin, end, color=colour, alpha=0.12, linewidth=0.0)
        if c.gamma is not None:
            axes['gamma'].plot(*envelope(t, c.gamma), **style)
            axes['gamma'].set_ylabel('power γ')
    for name in names:
        those = [c for c in curves if name in c.names]
        axes[name].set_ylabel(those[0].title(name))
        # What comes after the first tenth fills the picture.
        late = [c.estimate[len(c.stamps) // 10 :, c.names.index(name)] for c in those]
        known = np.concatenate(late)
        known = known[np.isfinite(known)]
        if len(known):
            margin = 0.1 * float(np.ptp(known)) or 0.1 * abs(float(known[0])) or 1.0
            axes[name].set_ylim(known.min() - margin, known.max() + margin)
    t = (first.stamps - origin) * 1e-9
    _draw_innovations(axes['innovation'], t, first.innovation, first.epsilon)
    axes['innovation'].set_ylabel('|innovation|' + ('\n(first)' if len(curves) > 1 else ''))
    if compared:
        row = axes['error of d']
        for c, colour in zip([*compared, first], OTHERS, strict=False):
            error = c.estimate[:, -1] - c.truth[:, -1]
            row.plot(*envelope(t, error), linewidth=0.8, label=c.label, color=colour)
        row.lines[-1].set(color=COLOURS[0], linestyle='--', linewidth=1.2)  # the run itself
        size = 1.5 * float(np.nanmax(np.abs(first.estimate[:, -1])))
        row.set_ylim(-size, size)  # what is beyond leaves the picture
        row.set_ylabel('error of d')
        row.legend(loc='upper right', ncols=len(row.lines), fontsize='x-small')
    for row in axes.values():
        row.grid(alpha=0.3)
        for stamp, _ in marks:
            row.axvline((stamp - origin) * 1e-9, color='black', linewidth=0.8, linestyle=':')
    axes['d'].set_title(', '.join(words for _, words in marks), fontsize='small', loc='right')
    axes[rows[-1]].set_xlabel('time since the first estimate [s]')
    handles, labels = axes[rows[0]].get_legend_handles_labels()
    figure.legend(handles, labels, loc='outside upper center', ncols=2, fontsize='small')
    figure.savefig(path, dpi=150)


def draw_band(
    axes: Axes,
    t: NDArray[np.float64],
    estimate: NDArray[np.float64],
    deviation: NDArray[np.float64],
    colour: str = COLOURS[0],
) -> None:
    """Draw the band of two standard deviations, in which the truth is for 95 % of the time."""
    known = np.where(np.isfinite(deviation), deviation, np.nan)
    begins = _columns(t)
    low = np.fmin.reduceat(estimate - 2.0 * known, begins)
    high = np.fmax.reduceat(estimate + 2.0 * known, begins)
    axes.fill_between(
        t[begins], low, high, color=colour, alpha=0.22, linewidth=0.0,
        label='± 2 standard deviations',
    )  # fmt: skip


def _draw_innovations(
    axes: Axes, t: NDArray[np.float64], eps: NDArray[np.float64], epsilon: float | None
) -> None:
    """Draw |eps_1| .. |eps_N| on a logarithmic scale, and the band within which gates open."""
    size = np.abs(eps)
    for k in range(eps.shape[1]):
        axes.semilogy(*envelope(t, size[:, k]), linewidth=0.8, label=f'ε{k + 1}')
    size = size[size > 0.0]
    if len(size):
        axes.set_ylim(np.percentile(size, 1) / 3.0, 3.0 * size.max())
    if epsilon is not None:
        low, high = axes.get_ylim()
        axes.axhspan(low, epsilon, color='grey', alpha=0.15, label='band ε')
        axes.set_ylim(low, max(high, 3.0 * epsilon))
    axes.legend(loc='upper right', ncols=5, fontsize='small')
