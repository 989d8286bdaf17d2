# SPDX-License-Identifier: Apache-2.0
"""The estimates in a bag, of one estimator name, with the truth where the bag has it."""

from pathlib import Path
from typing import NamedTuple

from fhaosmo_ros.core.channel_parameters import of_channel
from fhaosmo_ros.core.errors import ConfigurationError
from fhaosmo_ros.core.metrics import chatter, rms
from fhaosmo_ros.core.parameters import ESTIMATOR_PARAMETERS
from fhaosmo_ros.tools.bag_reader import BagReader
from fhaosmo_ros.tools.recorded_parameters import recorded_parameters
from fhaosmo_ros.tools.series import series
from fhaosmo_ros.tools.ticks import read_ticks
from fhaosmo_ros.tools.truth import truth_at
import numpy as np
from numpy.typing import NDArray

PARTS = ('state', 'unknown_input', 'gamma', 'innovation', 'stamp')
"""Topics of an estimator, in the order in which it publishes them."""


class Curves(NamedTuple):
    """
    Estimates over the time of the samples behind them.

    Attributes
    ----------
    label : str
        Bag and estimator.
    stamps : (K,) array of int
        In nanoseconds.
    names : list of str
        z1 .. zn and d.
    estimate : (K, n + 1) array
    gamma : (K,) array
    innovation : (K, N) array
    truth : (K, n + 1) array or None
        NaN where the bag does not reach.
    epsilon : float or None
        The gate of its levels, if it has one and the bag tells.

    """

    label: str
    stamps: NDArray[np.int64]
    names: list[str]
    estimate: NDArray[np.float64]
    gamma: NDArray[np.float64]
    innovation: NDArray[np.float64]
    truth: NDArray[np.float64] | None
    epsilon: float | None


def read_curves(path: Path, names: list[str] | None, plant: str) -> list[Curves]:
    """
    Read the estimates of some estimators, or of all that a bag holds.

    Raises
    ------
    ConfigurationError
        Not a bag, or one without estimates.

    """
    with BagReader(path) as reader:
        topics = {c.topic for c in reader.connections if c.msgcount}
        return _read_curves(reader, path, topics, names, plant)


def _read_curves(
    reader: BagReader, path: Path, topics: set[str], names: list[str] | None, plant: str
) -> list[Curves]:
    found = sorted(t.removesuffix('/gamma') for t in topics if t.endswith('/gamma'))
    found = [name for name in found if all(f'{name}/{part}' in topics for part in PARTS)]
    for name in names or []:
        if name not in found:
            raise ConfigurationError(
                f'bag {path}: expected estimates of one of {", ".join(found) or "none"}, '
                f'got {name!r}'
            )
    if not found:
        raise ConfigurationError(
            f'bag {path}: expected the topics of an estimator ({", ".join(PARTS)} below its '
            f'name), got {", ".join(sorted(topics)) or "none"}; replay adds them'
        )
    return [_curves(path, name, plant, _epsilon(reader, name)) for name in names or found]


def _epsilon(reader: BagReader, name: str) -> float | None:
    recorded = recorded_parameters(reader, name)
    if recorded is None:
        return None
    values = ESTIMATOR_PARAMETERS.defaults() | of_channel(recorded.values, recorded.channel)
    return values['epsilon'] if values['structure'] == 'cascade' else None


def _curves(path: Path, name: str, plant: str, epsilon: float | None) -> Curves:
    ticks = read_ticks(path, name, PARTS)
    when = ticks['stamp']
    estimate = np.column_stack([ticks['state'], ticks['unknown_input']])
    truth = truth_at(path, plant, when)
    if truth is not None and truth.values.shape != estimate.shape:
        truth = None  # of another model
    labels = series(path, f'{name}/state').labels or [
        f'z{i + 1}' for i in range(estimate.shape[1] - 1)
    ]
    return Curves(
        f'{path.resolve().name} {name}', when, [*labels, 'd'], estimate, ticks['gamma'],
        ticks['innovation'], truth.values if truth else None, epsilon,
    )  # fmt: skip


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
