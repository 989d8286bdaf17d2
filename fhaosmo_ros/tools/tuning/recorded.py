# SPDX-License-Identifier: Apache-2.0
"""The y of a bag, and its quantum."""

from pathlib import Path
from typing import NamedTuple

from fhaosmo_ros.core.model.triangular import TriangularModel
from fhaosmo_ros.core.parameters.errors import ConfigurationError
from fhaosmo_ros.messages.fields import Unwrapper
from fhaosmo_ros.tools.bags.known_inputs import inputs_at
from fhaosmo_ros.tools.bags.reader import BagReader
from fhaosmo_ros.tools.cli.options import BagInputs
import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
FEWEST = 20
"""Changes of y that say a quantum."""
ON_GRID = 0.02
"""Values count as quantised if they are this close to multiples of the quantum, relatively."""


class RecordedOutput(NamedTuple):
    """The y of a bag, of K samples."""

    t: Floats  # (K,) stamps from the first one on (s)
    y: Floats  # (K,) samples
    u: Floats  # (K, m) known inputs


def recorded(bag: Path, inputs: BagInputs, model: TriangularModel) -> RecordedOutput:
    """Return the y of a bag, and the known inputs of a model."""
    y_at, u_at, stamp, values = inputs
    with BagReader(bag) as reader:
        topic = y_at.absolute('')
        found = reader.field(topic, y_at.field, y_at.name)
        samples = reader.samples(topic, found, stamp)
        y = samples.values
        if found.wraps:
            y = np.array(list(map(Unwrapper(), y.tolist())))
        u = np.zeros((len(y), len(model.inputs)))
        if model.uses_input:
            u = inputs_at(samples, reader, model, u_at, values)
    if not len(y):
        raise ConfigurationError(f'bag {bag}: expected samples of y, got none')
    return RecordedOutput((samples.stamps - samples.stamps[0]) * 1e-9, y, u)


def usable(data: RecordedOutput) -> RecordedOutput:
    """Return the samples that are finite and later than all before them."""
    finite = np.isfinite(np.column_stack(data)).all(axis=1)
    latest = np.maximum.accumulate(np.where(finite, data.t, -np.inf))
    keep = finite & (data.t > np.concatenate([[-np.inf], latest[:-1]])[: len(data.t)])
    return RecordedOutput(*(part[keep] for part in data))


def quantum(y: Floats) -> float:
    """Return the resolution of y, 0 if its values lie on no grid, or on a very fine one."""
    steps = np.abs(np.diff(y))
    steps = steps[steps > 0.0]
    if len(steps) < FEWEST:
        return 0.0
    multiples = steps / np.quantile(steps, 0.01)
    whole = np.round(multiples)
    few = len(np.unique(whole)) < len(steps) / 10
    near = np.abs(multiples - whole) <= ON_GRID * np.maximum(multiples, 1.0)
    return float(np.sum(steps) / np.sum(whole)) if few and near.mean() >= 0.99 else 0.0
