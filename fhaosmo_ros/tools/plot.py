# SPDX-License-Identifier: Apache-2.0
"""Plot the estimates of bags beside the truth where it is known, and a table of metrics."""

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from fhaosmo_ros.core.parameters.errors import ConfigurationError
from fhaosmo_ros.core.parameters.per_channel import of_channel
from fhaosmo_ros.core.parameters.units import derivative_unit, titled
from fhaosmo_ros.core.simulation.metrics import chatter, rms
from fhaosmo_ros.stop_signals import Stop
from fhaosmo_ros.tools.bags.reader import BagReader
from fhaosmo_ros.tools.bags.recorded import read_ticks, recorded_parameters
from fhaosmo_ros.tools.cli.command import output_at, run_command
from fhaosmo_ros.topics import ESTIMATES, EVENT, STANDARD_DEVIATION, TRUTH
from matplotlib.axes import Axes
from matplotlib.figure import Figure
import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
SUFFIXES = ('.png', '.svg', '.pdf')
LATE = 0.75
"""Periods of the plant by which the truth may follow its sample of y."""
TRUE_STYLE = {'color': '#0072B2', 'linewidth': 2.2, 'label': 'true'}
"""Blue of the Okabe-Ito palette."""
COLOURS = ('#D55E00', '#009E73', '#CC79A7', '#E69F00', '#56B4E9')
"""Okabe-Ito palette, without the blue of the truth; each curve also has its own dashes."""
DASHES = ('-', '--', '-.', ':')
COLUMNS = 1500
"""Of a thinned curve; more than a figure has pixels in a row."""


def main(argv: list[str] | None = None) -> int:
    """Run the command; return 0 if there is a figure, else none is written."""
    parser = argparse.ArgumentParser(
        prog='plot',
        description='Draw the estimates in bags, live and replayed, one over another.',
    )
    add = parser.add_argument
    add('bags', type=Path, nargs='+', metavar='BAG')
    add(
        '-o', '--output', type=Path, metavar='FILE',
        help='.png, .svg or .pdf (default: BAG.png in the current folder)',
    )  # fmt: skip
    add('--force', action='store_true', help='replace an output that exists')
    add('--names', nargs='+', metavar='NAME', help='estimators (default: all in the bags)')
    add('--plant', metavar='NAME', help='whose topics are the truth (default: /plant, if any)')
    return run_command(parser, argv, _plot)


def _plot(arguments: argparse.Namespace, stop: Stop) -> None:
    path = arguments.output or Path(f'{arguments.bags[0].resolve().stem}.png')
    if path.suffix not in SUFFIXES:
        raise ConfigurationError(
            f'--output: expected a name that ends in {", ".join(SUFFIXES)}, got {path}'
        )
    with stop.raising():
        plant = f'/{(arguments.plant or "plant").strip("/")}'
        names = [f'/{name.strip("/")}' for name in arguments.names or ()]
        curves = [c for bag in arguments.bags for c in read_curves(bag, names, plant)]
    if arguments.plant and all(c.truth is None for c in curves):
        of_truth = ', '.join(f'{plant}/{part}' for part in TRUTH)
        raise ConfigurationError(f'--plant: expected a bag with {of_truth}, got none')
    # Not within raising: it leaves nothing behind.
    with output_at(path, arguments.force) as figure, stop.raising():
        save_curves(curves, figure)
    late = [c.part(slice(len(c.stamps) // 2, None)) for c in curves]
    print(f'{metrics(late, "2nd half")}\nfigure: {path}', flush=True)


class Curves(NamedTuple):
    """Estimates of one estimator over the stamps of their samples."""

    label: str  # bag and estimator
    stamps: NDArray[np.int64]  # (K,) in nanoseconds
    names: list[str]  # z1 .. zn and d
    estimate: Floats  # (K, n + 1)
    innovation: Floats  # (K, N)
    gamma: Floats | None = None  # (K,); None of a self-tuning estimator, which has no power
    deviation: Floats | None = None  # (K, n + 1) standard deviations, of a self-tuning estimator
    truth: Floats | None = None  # (K, n + 1); NaN where the bag lacks it
    epsilon: float | None = None  # of its gates, if it has gates and the bag has its parameters
    unit: str = ''  # of y, '' if the bag does not say it
    events: Sequence[tuple[int, int]] = ()  # begin and end of each, in nanoseconds

    def part(self, rows: slice | NDArray[np.bool_]) -> 'Curves':
        """Return some of the rows."""
        arrays = {k: x for k, x in self._asdict().items() if isinstance(x, np.ndarray)}
        return self._replace(**{name: array[rows] for name, array in arrays.items()})


def read_curves(path: Path, names: Sequence[str], plant: str) -> list[Curves]:
    """Read the estimates of some estimators, or of all that a bag holds, at least one."""
    with BagReader(path) as reader:
        first, *others = map(reader.names_above, ESTIMATES)
        found = [name for name in first if all(name in other for other in others)]
        if not found or not set(names) <= set(found):
            raise ConfigurationError(
                f'bag {path}: expected estimates (topics {", ".join(ESTIMATES)}, which replay '
                f'adds) of {", ".join(names or ["an estimator"])}, got those of '
                f'{", ".join(found) or "none"}'
            )
        return [_curves(reader, name, plant) for name in names or found]


def _curves(reader: BagReader, name: str, plant: str) -> Curves:
    epsilon, unit = None, ''
    if recorded := recorded_parameters(reader, name):
        values = of_channel(recorded.values, recorded.channel)
        unit = values['measurement_unit']
        if values['structure'] == 'cascade' and values['gains'] == 'fixed':
            epsilon = values['epsilon']
    optional = [p for p in ('gamma', STANDARD_DEVIATION) if reader.count(f'{name}/{p}')]
    ticks = read_ticks(reader, name, [*optional, *ESTIMATES])
    when = ticks['stamp']
    if not len(when):
        raise ConfigurationError(
            f'bag {reader.path}: expected whole estimates of {name}, got none'
        )
    estimate = np.column_stack([ticks['state'], ticks['unknown_input']])
    truth = _truth_at(reader, plant, when)
    return Curves(
        label=f'{reader.path.resolve().name} {name}',
        stamps=when,
        names=[*(f'z{i + 1}' for i in range(estimate.shape[1] - 1)), 'd'],
        estimate=estimate,
        innovation=ticks['innovation'],
        gamma=ticks.get('gamma'),
        deviation=ticks.get(STANDARD_DEVIATION),
        truth=truth if np.shape(truth) == estimate.shape else None,  # else it is of another model
        epsilon=epsilon,
        unit=unit,
        events=_events(reader, f'{name}/{EVENT}', int(when[-1])),
    )


def _truth_at(reader: BagReader, plant: str, when: NDArray[np.int64]) -> Floats | None:
    """
    Return z_1 .. z_n and d at stamps of samples; NaN where the bag lacks them, None without any.

    The plant publishes y, then its states, then d. So the truth of a sample is the first message
    after it, unless that comes so late that it is another sample's.
    """
    columns = []
    for part in TRUTH:
        found = reader.samples(f'{plant}/{part}')
        if not len(found.stamps):
            return None
        row = np.searchsorted(found.stamps, when)
        its_own = row < len(found.stamps)
        row = row.clip(max=len(found.stamps) - 1)
        if len(found.stamps) > 1:
            its_own &= found.stamps[row] - when <= LATE * np.median(np.diff(found.stamps))
        values = found.values[row].astype(np.float64).reshape(len(row), -1)
        columns.append(np.where(its_own[:, None], values, np.nan))
    return np.column_stack(columns)


def _events(reader: BagReader, topic: str, end: int) -> list[tuple[int, int]]:
    """Return begin and end of each event of an estimator; one that lasts is given the last end."""
    spans: dict[int, int] = {}
    for _, _, message in reader.read_all([topic]):
        (status,) = message.status
        since = {pair.key: pair.value for pair in status.values}.get('since')
        if since is not None:  # else there has been none
            stamp = message.header.stamp
            ended = stamp.sec * 1_000_000_000 + stamp.nanosec
            spans[int(since.replace('.', ''))] = end if status.level else ended
    return list(spans.items())


def metrics(curves: list[Curves], title: str) -> str:
    """Return a table: a row for each state and d of each estimator."""
    width = max(len(c.label) for c in curves)
    lines = [f'{title:{width}}  {"":4}{"RMS":>12}{"RMS error":>12}{"chatter":>10}']
    for c in curves:
        for k, name in enumerate(c.names):
            line = f'{c.label:{width}}  {name:4}{rms(c.estimate[:, k]):12.3g}'
            if c.truth is not None:
                known = np.isfinite(c.truth[:, k])
                estimate, truth = c.estimate[known, k], c.truth[known, k]
                line += f'{rms(estimate - truth):12.3g}{chatter(estimate, truth):10.3g}'
            lines.append(line)
    return '\n'.join(lines)


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


def save_curves(curves: list[Curves], path: Path, marks: Sequence[tuple[int, str]] = ()) -> None:
    """
    Write a figure of several estimates laid one over another.

    From top to bottom: a row for each state, for d, for the error of d where the truth is known,
    for gamma if an estimate has it, and for the innovations of the first estimate. `marks` are
    times (ns) at which something changed, and what.
    """
    first, names = curves[0], max((c.names for c in curves), key=len)
    gamma = ['gamma'] if any(c.gamma is not None for c in curves) else []
    known = next((c for c in curves if c.truth is not None), None)
    error = ['error of d'] if known else []
    rows = [*names, *error, *gamma, 'innovation']
    figure = Figure(figsize=(8.5, 1.45 * len(rows) + 0.9), layout='constrained')
    axes = figure.subplot_mosaic([[row] for row in rows], sharex=True)
    origin = min(c.stamps[0] for c in curves)
    errors_alone = []  # lines of curves that are in no other row
    for number, c in enumerate(curves):
        colour, dashes = COLOURS[number % len(COLOURS)], DASHES[number % len(DASHES)]
        style = {'color': colour, 'linestyle': dashes, 'linewidth': 1.2, 'label': c.label}
        t = (c.stamps - origin) * 1e-9
        for k, name in enumerate(c.names):
            row = axes[name]
            if c.truth is not None and c is known:
                row.plot(*envelope(t, c.truth[:, k]), **TRUE_STYLE)
            row.plot(*envelope(t, c.estimate[:, k]), **style)
            if c.deviation is not None:
                draw_band(row, t, c.estimate[:, k], c.deviation[:, k], colour)
        if c.truth is not None:
            missed = c.estimate[:, -1] - c.truth[:, -1]
            drawn = axes['error of d'].plot(*envelope(t, missed), **style)
            errors_alone += drawn if not c.names else []
        for begin, end in (np.array(c.events).reshape(-1, 2) - origin) * 1e-9:
            axes['d'].axvspan(begin, end, color=colour, alpha=0.12, linewidth=0.0)
        if c.gamma is not None:
            axes['gamma'].plot(*envelope(t, c.gamma), **style)
            axes['gamma'].set_ylabel('power γ')
    for name in names:
        those = [c for c in curves if name in c.names]
        unit = derivative_unit(those[0].unit, those[0].names.index(name))
        axes[name].set_ylabel(titled('unknown\ninput d' if name == 'd' else name, unit))
        # What comes after the first tenth fills the picture.
        late = [c.estimate[len(c.stamps) // 10 :, c.names.index(name)] for c in those]
        shown = np.ma.masked_invalid(np.concatenate(late)).compressed()
        if len(shown):
            margin = 0.1 * float(np.ptp(shown)) or 0.1 * abs(float(shown[0])) or 1.0
            axes[name].set_ylim(shown.min() - margin, shown.max() + margin)
    t = (first.stamps - origin) * 1e-9
    _draw_innovations(axes['innovation'], t, first.innovation, first.epsilon)
    axes['innovation'].set_ylabel('|innovation|' + ('\n(first)' if len(curves) > 1 else ''))
    if error:  # as large as in the row of d; what is beyond leaves the picture
        size = max(map(abs, axes['d'].get_ylim()))
        axes['error of d'].set(ylim=(-size, size), ylabel='error of d')
    for row in axes.values():
        row.grid(alpha=0.3)
        for stamp, _ in marks:
            row.axvline((stamp - origin) * 1e-9, color='black', linewidth=0.8, linestyle=':')
    axes['d'].set_title(', '.join(words for _, words in marks), fontsize='small', loc='right')
    axes[rows[-1]].set_xlabel('time since the first estimate [s]')
    handles = axes[rows[0]].get_legend_handles_labels()[0] + errors_alone
    figure.legend(handles=handles, loc='outside upper center', ncols=2, fontsize='small')
    figure.savefig(path, dpi=150)


def draw_band(
    axes: Axes, t: Floats, estimate: Floats, deviation: Floats, colour: str = COLOURS[0]
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


def _draw_innovations(axes: Axes, t: Floats, eps: Floats, epsilon: float | None) -> None:
    """Draw |eps_1| .. |eps_N| on a logarithmic scale, and the band within which gates open."""
    size = np.abs(eps)
    for k in np.flatnonzero(size.any(axis=0)):  # a self-tuning estimator has the first one alone
        axes.semilogy(*envelope(t, size[:, k]), linewidth=0.8, label=f'ε{k + 1}')
    size = size[size > 0.0]
    if len(size):
        axes.set_ylim(np.percentile(size, 1) / 3.0, 3.0 * size.max())
    if epsilon is not None:
        low, high = axes.get_ylim()
        axes.axhspan(low, epsilon, color='grey', alpha=0.15, label='band ε')
        axes.set_ylim(low, max(high, 3.0 * epsilon))
    if axes.get_legend_handles_labels()[0]:
        axes.legend(loc='upper right', ncols=5, fontsize='small')
