# SPDX-License-Identifier: Apache-2.0
"""The estimates of each estimator in a bag, with the truth where the bag has it."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from fhaosmo_ros.core.parameters.errors import ConfigurationError
from fhaosmo_ros.core.parameters.per_channel import of_channel
from fhaosmo_ros.core.parameters.tables import ESTIMATOR_PARAMETERS
from fhaosmo_ros.core.parameters.units import derivative_unit, titled
from fhaosmo_ros.core.simulation.metrics import chatter, rms
from fhaosmo_ros.tools.bags.reader import BagReader
from fhaosmo_ros.tools.bags.topics import read_ticks, recorded_parameters, series
from fhaosmo_ros.topics import ESTIMATES, EVENT, STANDARD_DEVIATION, TRUTH
import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
LATE = 0.75
"""Periods of the plant by which the truth may follow its sample of y."""


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

    def title(self, name: str) -> str:
        """Return one of `names` with its unit, which follows from that of y."""
        unit = derivative_unit(self.unit, self.names.index(name))
        return titled('unknown\ninput d' if name == 'd' else name, unit)

    def part(self, rows: slice | NDArray[np.bool_]) -> 'Curves':
        """Return some of the rows."""
        arrays = {k: x for k, x in self._asdict().items() if isinstance(x, np.ndarray)}
        return self._replace(**{name: array[rows] for name, array in arrays.items()})


def read_curves(path: Path, names: list[str] | None, plant: str) -> list[Curves]:
    """
    Read the estimates of some estimators, or of all that a bag holds.

    Raises
    ------
    ConfigurationError
        It is not a bag, or it holds no estimates.

    """
    with BagReader(path) as reader:
        topics = {c.topic for c in reader.connections if c.msgcount}
        first, *others = map(reader.names_above, ESTIMATES)
        found = [name for name in first if all(name in other for other in others)]
        if not found or not set(names or ()) <= set(found):
            raise ConfigurationError(
                f'bag {path}: expected estimates (topics {", ".join(ESTIMATES)}, which replay '
                f'adds) of {", ".join(names or ["an estimator"])}, got those of '
                f'{", ".join(found) or "none"}'
            )
        return [_curves(reader, name, plant, topics) for name in names or found]


def _curves(reader: BagReader, name: str, plant: str, topics: set[str]) -> Curves:
    path, epsilon, unit = reader.path, None, ''
    if recorded := recorded_parameters(reader, name):
        own = of_channel(recorded.values, recorded.channel)
        values = ESTIMATOR_PARAMETERS.defaults() | own
        unit = values['measurement_unit']
        if values['structure'] == 'cascade' and values['gains'] == 'fixed':
            epsilon = values['epsilon']
    optional = [p for p in ('gamma', STANDARD_DEVIATION) if f'{name}/{p}' in topics]
    ticks = read_ticks(path, name, [*optional, *ESTIMATES])
    when = ticks['stamp']
    if not len(when):
        raise ConfigurationError(f'bag {path}: expected whole estimates of {name}, got none')
    estimate = np.column_stack([ticks['state'], ticks['unknown_input']])
    truth = _truth_at(path, plant, when)
    if truth is not None and truth.shape != estimate.shape:
        truth = None  # of another model
    return Curves(
        f'{path.resolve().name} {name}',
        when,
        [*(f'z{i + 1}' for i in range(estimate.shape[1] - 1)), 'd'],
        estimate,
        ticks['innovation'],
        ticks.get('gamma'),
        ticks.get(STANDARD_DEVIATION),
        truth,
        epsilon,
        unit,
        _events(reader, f'{name}/{EVENT}', int(when[-1])) if f'{name}/{EVENT}' in topics else (),
    )


def _truth_at(path: Path, plant: str, when: NDArray[np.int64]) -> Floats | None:
    """
    Return z_1 .. z_n and d at stamps of samples; NaN where the bag lacks them, None without any.

    The plant publishes y, then its states, then d. So the truth of a sample is the first message
    after it, unless that comes so late that it is another sample's.
    """
    columns = []
    for part in TRUTH:
        found = series(path, f'{plant}/{part}')
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
            second, _, nanosecond = since.partition('.')
            stamp = message.header.stamp
            ended = stamp.sec * 1_000_000_000 + stamp.nanosec
            spans[int(second) * 1_000_000_000 + int(nanosecond)] = end if status.level else ended
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
