# SPDX-License-Identifier: Apache-2.0
"""What gains are made for: recordings of a simulated family, or the y of a bag."""

from pathlib import Path
from typing import Any, NamedTuple

from fhaosmo_ros.core.model.triangular import TriangularModel
from fhaosmo_ros.core.parameters.declaration import Parameters
from fhaosmo_ros.core.parameters.errors import ConfigurationError
from fhaosmo_ros.core.simulation.recording_parameters import FAMILY_PARAMETERS
from fhaosmo_ros.core.simulation.recordings import Family, Recording
from fhaosmo_ros.messages.fields import Unwrapper
from fhaosmo_ros.tools.bags.held_input import HeldInputs
from fhaosmo_ros.tools.bags.reader import BagReader
from fhaosmo_ros.tools.cli.options import BagInputs
from fhaosmo_ros.tools.tuning.sensor import identify, Sensor
import numpy as np
from numpy.typing import NDArray

HELD_OUT_SEED = 1_000_003
"""Added to the seed: held-out recordings share no random number with the others."""


class TuningData(NamedTuple):
    """Recordings to train on, others to judge by, and the complete parameters of their family."""

    training: list[Recording]
    held_out: list[Recording]
    parameters: dict[str, Any]


class RecordedOutput(NamedTuple):
    """
    A bag's y.

    Attributes
    ----------
    t, y : (K,) arrays
        Stamps from the first one on (s), and samples.
    u : (K, m) array
    sensor : Sensor
        Estimated from t and y.

    """

    t: NDArray[Any]
    y: NDArray[Any]
    u: NDArray[Any]
    sensor: Sensor


def simulated(values: Parameters, seed: int) -> TuningData:
    """Return recordings of the family that `values` (of `TUNE_PARAMETERS`) describe."""
    family = Family(FAMILY_PARAMETERS.complete(values))
    return TuningData(
        family.recordings(values['recordings'], seed),
        family.recordings(values['held_out'], seed + HELD_OUT_SEED),
        family.parameters,
    )


def recorded(bag: Path, inputs: BagInputs, model: TriangularModel) -> RecordedOutput:
    """Return the y of a bag, and the known inputs of a model."""
    y_at, u_at, stamp, values = inputs
    with BagReader(bag) as reader:
        topic = y_at.absolute('')
        found = reader.field(topic, y_at.field, y_at.name)
        blocks = list(reader.blocks(topic, found, stamp))
        stamps, y = (np.concatenate([block[k] for block in blocks]) for k in (1, 2))
        if found.wraps:
            y = np.array(list(map(Unwrapper(), y.tolist())))
        u = np.zeros((len(y), len(model.inputs)))
        if model.uses_input:
            held = HeldInputs(reader, model, u_at, values)
            u = np.concatenate([u for _, u in held.along(blocks)])
    if not len(y):
        raise ConfigurationError(f'bag {bag}: expected samples of y, got none')
    t = (stamps - stamps[0]) * 1e-9
    return RecordedOutput(t, y, u, identify(t, y))
