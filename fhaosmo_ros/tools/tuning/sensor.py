# SPDX-License-Identifier: Apache-2.0
"""The y of a bag, and what it says of its sensor: resolution, rate, jitter, losses."""

from pathlib import Path
from typing import NamedTuple

from fhaosmo_ros.core.model.triangular import TriangularModel
from fhaosmo_ros.core.parameters.errors import ConfigurationError
from fhaosmo_ros.messages.fields import Unwrapper
from fhaosmo_ros.tools.bags.held_input import HeldInputs
from fhaosmo_ros.tools.bags.reader import BagReader
from fhaosmo_ros.tools.cli.options import BagInputs
import numpy as np
from numpy.typing import NDArray
from scipy.stats import median_abs_deviation

Floats = NDArray[np.float64]

FEWEST = 200
"""An estimate needs so many samples."""
ON_GRID = 0.02
"""Values count as quantised if they are this close to multiples of the quantum, relatively."""


class Sensor(NamedTuple):
    """What stamps and samples say of a sensor; names as in `FAMILY_PARAMETERS`."""

    quantisation: float  # unit of y; 0 for none that shows
    sample_rate: float  # Hz
    stamp_jitter: float  # s
    dropout: float  # share of the samples that are lost


class RecordedOutput(NamedTuple):
    """The y of a bag, of K samples."""

    t: Floats  # (K,) stamps from the first one on (s)
    y: Floats  # (K,) samples
    u: Floats  # (K, m) known inputs
    sensor: Sensor  # estimated from t and y


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


def identify(t: Floats, y: Floats) -> Sensor:
    """
    Estimate a sensor from what it measured.

    Jitter of the periods and jitter of the stamps cannot be distinguished; it is taken as that of
    the stamps, which is the worse one.

    Parameters
    ----------
    t, y : (K,) arrays
        Stamps (s) and samples; those that do not increase or are not finite are left out.

    Raises
    ------
    ConfigurationError
        Too few samples.

    """
    keep = usable(t, y)
    t, y = t[keep], y[keep]
    if len(t) < FEWEST:
        raise ConfigurationError(
            f'bag: expected at least {FEWEST} samples of y with increasing stamps to estimate the '
            f'sensor from, got {len(t)}'
        )
    h = np.diff(t)
    period = float(np.median(h))
    missing = np.maximum(np.round(h / period).astype(np.int64) - 1, 0)
    jitter = float(median_abs_deviation(h[missing == 0], scale='normal') / np.sqrt(2.0))
    lost = int(missing.sum())
    rate = (lost + len(h)) / float(t[-1] - t[0])
    return Sensor(_quantum(y), rate, jitter, lost / (lost + len(t)))


def usable(t: Floats, *values: Floats) -> NDArray[np.bool_]:
    """Return which samples are finite and later than all before them."""
    finite = np.isfinite(np.column_stack([t, *values])).all(axis=1)
    latest = np.maximum.accumulate(np.where(finite, t, -np.inf))
    return finite & (t > np.concatenate([[-np.inf], latest[:-1]])[: len(t)])


def _quantum(y: Floats) -> float:
    """Return the resolution of y, 0 if its values lie on no grid, or on a very fine one."""
    steps = np.abs(np.diff(y))
    steps = steps[steps > 0.0]
    if len(steps) < FEWEST // 10:
        return 0.0
    multiples = steps / np.quantile(steps, 0.01)
    whole = np.round(multiples)
    few = len(np.unique(whole)) < len(steps) / 10
    near = np.abs(multiples - whole) <= ON_GRID * np.maximum(multiples, 1.0)
    return float(np.sum(steps) / np.sum(whole)) if few and near.mean() >= 0.99 else 0.0
