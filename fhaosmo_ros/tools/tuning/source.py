# SPDX-License-Identifier: Apache-2.0
"""Recordings to train on and to judge by: of a simulated family, or pieces of a bag."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

from fhaosmo_ros.core.errors import ConfigurationError
from fhaosmo_ros.core.family import Family, Recording
from fhaosmo_ros.core.family_parameters import FAMILY_PARAMETERS
from fhaosmo_ros.core.model import TriangularModel
from fhaosmo_ros.tools.bag_reader import BagReader
from fhaosmo_ros.tools.held_input import HeldInput
from fhaosmo_ros.tools.truth import truth_at
from fhaosmo_ros.tools.tuning.sensor import identify, noise_at_stamps, Sensor
import numpy as np
from numpy.typing import NDArray

HELD_OUT_SEED = 1_000_003
"""Added to the seed: held-out recordings share no random number with the others."""


@dataclass
class Data:
    """
    What there is to work with.

    Attributes
    ----------
    training, held_out : list of Recording
    origin : str
        Where they come from, in words.
    sensor : Sensor or None
        What a bag's y said.
    parameters : dict
        Of the family, complete.
    least_noise : float
        RMS noise of y that shows without the truth, which may say less.

    """

    training: list[Recording]
    held_out: list[Recording]
    origin: str
    parameters: dict[str, Any]
    sensor: Sensor | None = None
    least_noise: float = 0.0
    notes: list[str] = field(default_factory=list)


class BagChoice(NamedTuple):
    """Which numbers of a bag are y and u, and whose topics hold the truth; as `replay` has it."""

    path: Path
    topic: str = '/y'
    field: str | None = None
    input_topic: str = '/u'
    input_field: str | None = None
    stamp: str = 'auto'
    plant: str = '/plant'


def simulated(values: Mapping[str, Any], seed: int) -> Data:
    """Return recordings of the family that `values` (of `TUNE_PARAMETERS`, complete) describe."""
    family = Family({name: values[name] for name in FAMILY_PARAMETERS})
    return Data(
        family.recordings(values['recordings'], seed),
        family.recordings(values['held_out'], seed + HELD_OUT_SEED),
        'simulated family', family.parameters,
    )  # fmt: skip


def from_bag(choice: BagChoice, values: Mapping[str, Any], given: set[str], seed: int) -> Data:
    """
    Return pieces of a bag that holds the truth, else a family with the sensor of its y.

    Parameters
    ----------
    choice : BagChoice
    values : mapping
        Of `TUNE_PARAMETERS`, complete.
    given : set of str
        Names that the user set: what the bag says does not replace them.
    seed : int

    """
    model = TriangularModel(values['phi'], values['order'])
    t, y, u, truth = _read(choice, model)
    sensor = identify(t, y)
    if truth is not None:
        data = _pieces(t, y, u, truth, values)
        data.sensor, data.origin = sensor, f'pieces of bag {choice.path.resolve().name}'
        # The truth is that of the moment of a sample, not of its stamp: it knows no jitter.
        data.least_noise = max(noise_at_stamps(r.t, r.y) for r in data.training)
        return data
    seen = sensor._asdict()
    data = simulated(dict(values) | {k: v for k, v in seen.items() if k not in given}, seed)
    data.sensor = sensor
    data.origin = f'simulated family with the sensor of bag {choice.path.resolve().name}'
    return data


def _read(
    choice: BagChoice, model: TriangularModel
) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any], NDArray[Any] | None]:
    with BagReader(choice.path) as reader:
        found = reader.field(choice.topic, choice.field)
        if choice.stamp == 'header' and not found.has_header:
            raise ConfigurationError(
                f'--stamp header: expected messages with a header on {choice.topic}, '
                f'got {reader.message_type(choice.topic)}'
            )
        header = found.has_header and choice.stamp != 'bag'
        blocks = list(reader.blocks(choice.topic, found, header))
        times, stamps, y = (np.concatenate([block[k] for block in blocks]) for k in range(3))
        u = np.zeros(len(y))
        if model.uses_input:
            u = HeldInput(reader, choice.input_topic, choice.input_field, lambda _: None)(times)
    truth = None
    found = truth_at(choice.path, choice.plant, times)
    if found is not None and found.values.shape[1] == model.order + 1:
        known = found.known
        stamps, y, u, truth = stamps[known], y[known], u[known], found.values[known]
    if not len(y):
        raise ConfigurationError(f'bag {choice.path}: expected samples with their truth, got none')
    return (stamps - stamps[0]) * 1e-9, y, u, truth


def _pieces(
    t: NDArray[Any], y: NDArray[Any], u: NDArray[Any], truth: NDArray[Any],
    values: Mapping[str, Any],
) -> Data:  # fmt: skip
    """Cut into pieces of `duration`, at least two; every other one is held out."""
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
    family = {name: values[name] for name in FAMILY_PARAMETERS}
    notes = [
        'The recordings are pieces of one run: gains can fit its one kind of d. Judge them on '
        'another run as well.'
    ]
    return Data(parts[::2], parts[1::2], 'bag', family, notes=notes)
