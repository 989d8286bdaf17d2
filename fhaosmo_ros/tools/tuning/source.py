# SPDX-License-Identifier: Apache-2.0
"""Training and held-out recordings: of a simulated family, or pieces of a bag."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

from fhaosmo_ros.core.model.triangular import TriangularModel
from fhaosmo_ros.core.parameters.declaration import Parameters
from fhaosmo_ros.core.parameters.errors import ConfigurationError
from fhaosmo_ros.core.simulation.recording_parameters import FAMILY_PARAMETERS
from fhaosmo_ros.core.simulation.recordings import Family, Recording
from fhaosmo_ros.inputs import Input, measured_output
from fhaosmo_ros.messages.fields import Unwrapper
from fhaosmo_ros.tools.bags.held_input import HeldInputs
from fhaosmo_ros.tools.bags.reader import BagReader
from fhaosmo_ros.tools.bags.topics import truth_at
from fhaosmo_ros.tools.tuning.sensor import identify, noise_at_stamps, Sensor
import numpy as np
from numpy.typing import NDArray

HELD_OUT_SEED = 1_000_003
"""Added to the seed: held-out recordings share no random number with the others."""


@dataclass
class TuningData:
    """
    The recordings of a tuning, and where they come from.

    Attributes
    ----------
    training, held_out : list of Recording
    origin : str
        Where they come from, in words.
    parameters : dict
        Of the family, complete.
    sensor : Sensor or None
        Estimated from the y of a bag.
    least_noise : float
        RMS noise of y, estimated from y alone; y minus the true z_1 may show less.
    notes : list of str
        What a reader of the report should know.

    """

    training: list[Recording]
    held_out: list[Recording]
    origin: str
    parameters: dict[str, Any]
    sensor: Sensor | None = None
    least_noise: float = 0.0
    notes: list[str] = field(default_factory=list)


class BagSource(NamedTuple):
    """A bag, its fields that are y and u, and the plant whose topics are the truth."""

    path: Path
    y: Input = measured_output({})
    u: Mapping[str, Input] = MappingProxyType({})
    stamp: str = 'auto'
    values: Mapping[str, Any] = MappingProxyType({})
    plant: str = '/plant'


def simulated(values: Parameters, seed: int) -> TuningData:
    """Return recordings of the family that `values` (of `TUNE_PARAMETERS`) describe."""
    family = Family(FAMILY_PARAMETERS.complete(values))
    return TuningData(
        family.recordings(values['recordings'], seed),
        family.recordings(values['held_out'], seed + HELD_OUT_SEED),
        'simulated family',
        family.parameters,
    )


class RecordedOutput(NamedTuple):
    """
    A bag's y without the truth.

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


def from_bag(source: BagSource, values: Parameters) -> TuningData | RecordedOutput:
    """
    Return pieces of a bag that holds the truth, else its y.

    Parameters
    ----------
    source : BagSource
    values : Parameters
        Of `TUNE_PARAMETERS`.

    """
    model = TriangularModel.of(values)
    t, y, u, truth = _read(source, model)
    sensor = identify(t, y)
    if truth is None:
        return RecordedOutput(t, y, u, sensor)
    data = _pieces(t, y, u, truth, values)
    data.sensor, data.origin = sensor, f'pieces of bag {source.path.resolve().name}'
    # The truth is that at the time of a sample, not at its stamp, so y - z_1 has no jitter.
    data.least_noise = max(noise_at_stamps(r.t, r.y) for r in data.training)
    return data


def _read(
    source: BagSource, model: TriangularModel
) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any], NDArray[Any] | None]:
    with BagReader(source.path) as reader:
        topic = source.y.absolute('')
        found = reader.field(topic, source.y.field, source.y.name)
        blocks = list(reader.blocks(topic, found, source.stamp))
        times, stamps, y = (np.concatenate([block[k] for block in blocks]) for k in range(3))
        if found.wraps:
            y = np.array(list(map(Unwrapper(), y.tolist())))
        u = np.zeros((len(y), len(model.inputs)))
        if model.uses_input:
            held = HeldInputs(reader, model, source.u, source.values)
            u = np.concatenate([u for _, u in held.along(blocks)])
    truth = None
    found = truth_at(source.path, source.plant, times)
    if found is not None and found.values.shape[1] == model.order + 1:
        known = found.known
        stamps, y, u, truth = stamps[known], y[known], u[known], found.values[known]
    if not len(y):
        raise ConfigurationError(f'bag {source.path}: expected samples with their truth, got none')
    return (stamps - stamps[0]) * 1e-9, y, u, truth


def _pieces(
    t: NDArray[Any],
    y: NDArray[Any],
    u: NDArray[Any],
    truth: NDArray[Any],
    values: Parameters,
) -> TuningData:
    """Cut into pieces of `duration`, at least two; every second one is held out."""
    keep = np.concatenate([[True], np.diff(np.maximum.accumulate(t)) > 0.0]) & np.isfinite(y)
    t, y, u, truth = t[keep], y[keep], u[keep], truth[keep]
    span = float(t[-1] - t[0]) if len(t) else 0.0
    count = max(2, int(span / values['duration']))
    length = span / count
    if length <= 1.2 * values['settled']:
        raise ConfigurationError(
            f'bag: expected at least {2.4 * values["settled"]:g} s with the truth (two pieces, '
            f'each longer than settled = {values["settled"]:g} s), got {span:.1f} s'
        )
    edges = np.searchsorted(t, t[0] + length * np.arange(count + 1))
    edges[-1] = len(t)
    parts = [
        Recording(t[a:b] - t[a], y[a:b], u[a:b], truth[a:b, :-1], truth[a:b, -1], 'recorded')
        for a, b in pairwise(edges)
    ]
    family = dict(FAMILY_PARAMETERS.complete(values))
    notes = [
        'The recordings are pieces of one run: gains can fit its one kind of d. Judge them on '
        'another run as well.'
    ]
    return TuningData(parts[::2], parts[1::2], 'bag', family, notes=notes)
