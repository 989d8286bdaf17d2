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
from fhaosmo_ros.tools.bags.recorded_parameters import recorded_parameters
from fhaosmo_ros.tools.bags.topics import messages, read_ticks, series, truth_at
from fhaosmo_ros.topics import ESTIMATES, EVENT, STANDARD_DEVIATION
import numpy as np
from numpy.typing import NDArray


class Curves(NamedTuple):
    """
    Estimates of one estimator over the stamps of their samples.

    Attributes
    ----------
    label : str
        Bag and estimator.
    stamps : (K,) array of int
        In nanoseconds.
    names : list of str
        z1 .. zn and d.
    estimate : (K, n + 1) array
    gamma : (K,) array or None
        None of a self-tuning estimator, which has no power.
    innovation : (K, N) array
    truth : (K, n + 1) array or None
        NaN where the bag lacks it.
    epsilon : float or None
        Threshold of its gates, if it has gates and the bag has its parameters.
    unit : str
        Of y, '' if the bag does not say it.
    deviation : (K, n + 1) array or None
        Standard deviations of the estimates, of a self-tuning estimator.
    events : list of (int, int)
        Begin and end of each event, in nanoseconds.

    """

    label: str
    stamps: NDArray[np.int64]
    names: list[str]
    estimate: NDArray[np.float64]
    gamma: NDArray[np.float64] | None
    innovation: NDArray[np.float64]
    truth: NDArray[np.float64] | None
    epsilon: float | None
    unit: str = ''
    deviation: NDArray[np.float64] | None = None
    events: Sequence[tuple[int, int]] = ()

    def title(self, name: str) -> str:
        """Return one of `names` with its unit, which follows from that of y."""
        unit = derivative_unit(self.unit, self.names.index(name))
        return titled('unknown\ninput d' if name == 'd' else name, unit)


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
        return _read_curves(reader, path, topics, names, plant)


def _read_curves(
    reader: BagReader, path: Path, topics: set[str], names: list[str] | None, plant: str
) -> list[Curves]:
    last = f'/{[*ESTIMATES][-1]}'
    found = sorted(t.removesuffix(last) for t in topics if t.endswith(last))
    found = [name for name in found if all(f'{name}/{part}' in topics for part in ESTIMATES)]
    for name in names or []:
        if name not in found:
            raise ConfigurationError(
                f'bag {path}: expected estimates of one of {", ".join(found) or "none"}, '
                f'got {name!r}'
            )
    if not found:
        raise ConfigurationError(
            f'bag {path}: expected the topics of an estimator ({", ".join(ESTIMATES)} below its '
            f'name), got {", ".join(sorted(topics)) or "none"}; replay adds them'
        )
    return [
        _curves(path, name, plant, topics, *_settings(reader, name)) for name in names or found
    ]


def _settings(reader: BagReader, name: str) -> tuple[float | None, str]:
    """Return the threshold of an estimator's gates, and the unit of y, if the bag says them."""
    recorded = recorded_parameters(reader, name)
    if recorded is None:
        return None, ''
    values = ESTIMATOR_PARAMETERS.defaults() | of_channel(recorded.values, recorded.channel)
    gates = values['structure'] == 'cascade' and values['gains'] == 'fixed'
    epsilon = values['epsilon'] if gates else None
    return epsilon, values['measurement_unit']


def _curves(
    path: Path, name: str, plant: str, topics: set[str], epsilon: float | None, unit: str
) -> Curves:
    of_gains = [p for p in ('gamma', STANDARD_DEVIATION) if f'{name}/{p}' in topics]
    ticks = read_ticks(path, name, [*of_gains, *ESTIMATES])
    when = ticks['stamp']
    estimate = np.column_stack([ticks['state'], ticks['unknown_input']])
    truth = truth_at(path, plant, when)
    if truth is not None and truth.values.shape != estimate.shape:
        truth = None  # of another model
    labels = series(path, f'{name}/state').labels or [
        f'z{i + 1}' for i in range(estimate.shape[1] - 1)
    ]
    return Curves(
        f'{path.resolve().name} {name}',
        when,
        [*labels, 'd'],
        estimate,
        ticks.get('gamma'),
        ticks['innovation'],
        truth.values if truth else None,
        epsilon,
        unit,
        ticks.get(STANDARD_DEVIATION),
        read_events(path, name, int(when[-1])) if f'{name}/{EVENT}' in topics else [],
    )


def read_events(path: Path, name: str, end: int) -> list[tuple[int, int]]:
    """Return begin and end of each event of an estimator; one that lasts is given the last end."""
    spans: list[tuple[int, int]] = []
    for _, message in messages(path, f'{name}/{EVENT}'):
        (status,) = message.status
        since = {pair.key: pair.value for pair in status.values}.get('since')
        if since is None:  # there has been none
            continue
        second, _, nanosecond = since.partition('.')
        begin = int(second) * 1_000_000_000 + int(nanosecond)
        ends = message.header.stamp
        if status.level:
            spans.append((begin, end))
        elif spans:
            spans[-1] = spans[-1][0], ends.sec * 1_000_000_000 + ends.nanosec
        else:
            spans.append((begin, ends.sec * 1_000_000_000 + ends.nanosec))
    return spans


def metrics(curves: list[Curves]) -> str:
    """Return a table: a row for each state and d of each estimator, over the second half."""
    width = max(len(c.label) for c in curves)
    lines = [f'{"2nd half":{width}}  {"":4}{"RMS":>12}{"RMS error":>12}{"chatter":>10}']
    for c in curves:
        half = slice(len(c.stamps) // 2, None)
        for k, name in enumerate(c.names):
            estimate = c.estimate[half, k]
            line = f'{c.label:{width}}  {name:4}{rms(estimate):12.3g}'
            if c.truth is not None:
                truth = c.truth[half, k]
                known = np.isfinite(truth)
                estimate, truth = estimate[known], truth[known]
                line += f'{rms(estimate - truth):12.3g}{chatter(estimate, truth):10.3g}'
            lines.append(line)
    return '\n'.join(lines)
