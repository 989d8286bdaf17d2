# SPDX-License-Identifier: Apache-2.0
"""
A family of recordings for training and for judging estimators: seeded, with their truth.

::

    family = Family({'noise_std': 1e-3, 'disturbances': ['steps']})
    training, held_out = family.recordings(6), family.recordings(10, seed=1000)
    r = training[0]        # r.t, r.y, r.u, r.z, r.d

A recording is a function of the parameters, its number and the seed alone; a plant's YAML serves
as well.
"""

from collections.abc import Mapping
from functools import partial
from typing import Any, NamedTuple

from fhaosmo_ros.core.model.triangular import TriangularModel
from fhaosmo_ros.core.observer.configuration import per_level
from fhaosmo_ros.core.parameters.declaration import Parameter, ParameterTable
from fhaosmo_ros.core.parameters.errors import ConfigurationError
from fhaosmo_ros.core.parameters.tables import (
    MODEL,
    ONLINE_PARAMETERS,
    PLANT_NODE_PARAMETERS,
    PLANT_PARAMETERS,
)
from fhaosmo_ros.core.simulation.metrics import rms
from fhaosmo_ros.core.simulation.plant import quantised, respond
import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray

Floats = NDArray[np.float64]
SHORTEST = 1e-9  # stamps stay this far apart (s), as two integer nanoseconds do
SHAPES = ('sines', 'steps', 'chirp')
SINES = 5  # in a sum
SHARED = tuple(
    PLANT_NODE_PARAMETERS[name]
    for name in (
        'initial_state', 'integration_step', 'noise_std', 'noise_seed', 'quantisation',
        'sample_rate',
    )
)  # fmt: skip
"""A plant's YAML describes these for its family, too."""
SENSOR = (ONLINE_PARAMETERS['measurement_delay'],)
"""An estimator's YAML describes this."""
fixed = partial(Parameter, live=False)  # all of them are read once
FAMILY = (
    fixed('duration', 20.0, 'Length of a recording.', unit='s', lower=0.1, upper=1e5),
    fixed('disturbances', ['sines', 'steps', 'chirp'],
          'Shapes of d, taken in turn: sines (five with random frequencies in band_of_d, phases '
          'and amplitudes), steps (random levels at random times), chirp (through band_of_d, '
          'upwards or downwards). Never one sine: gains tuned on it would resonate at it.',
          choices=SHAPES, lengths='1 or more'),
    fixed('rms_of_d', 0.07, 'RMS of d in each recording.', lower=0.0, lower_open=True, upper=1e9),
    fixed('band_of_d', [0.5, 8.0], 'Lowest and highest angular frequency of sines and chirp.',
          unit='rad/s', lower=0.0, lower_open=True, upper=1e5, lengths='2'),
    fixed('step_interval', 3.0, 'Mean time between two steps, at least a third of it.', unit='s',
          lower=1e-3, upper=1e5),
    fixed('rms_of_u', 1.0,
          'RMS of the known input, sines in band_of_d as well, where the model uses u.',
          lower=0.0, upper=1e9),
    fixed('period_jitter', 0.0,
          'Standard deviation of the moments of sampling about the even grid; the stamps tell.',
          unit='s', lower=0.0, upper=10.0),
    fixed('stamp_jitter', 0.0,
          'Standard deviation of the stamps about the moments of sampling; nothing tells.',
          unit='s', lower=0.0, upper=10.0),
    fixed('dropout', 0.0, 'Share of the samples that are lost.', lower=0.0, upper=0.9),
    fixed('dropout_length', 1.0, 'Mean number of samples that are lost one after the other.',
          lower=1.0, upper=1e6),
    fixed('outliers', 0.0, 'Share of the samples that are outliers.', lower=0.0, upper=1.0),
    fixed('outlier_std', 1.0,
          'Standard deviation of what an outlier adds to the noise of its sample (unit of y).',
          lower=0.0, upper=1e9),
)  # fmt: skip
FAMILY_PARAMETERS = ParameterTable(MODEL, SENSOR, SHARED, FAMILY)


class Recording(NamedTuple):
    """What a sensor would have given, and the truth at the moments of sampling."""

    t: Floats  # (K,) stamps (s), increasing
    y: Floats  # (K,) measured output
    u: Floats  # (K,) or (K, m): known inputs of the interval that ends at each sample
    z: Floats  # (K, n)
    d: Floats  # (K,)
    shape: str  # of the disturbance


class Family:
    """
    Makes recordings.

    Parameters
    ----------
    parameters : mapping, optional
        Values for `FAMILY_PARAMETERS`; defaults for the rest.

    Raises
    ------
    ConfigurationError
        An unknown name, a bad value, or values that do not fit together.

    """

    def __init__(self, parameters: Mapping[str, Any] | None = None) -> None:
        p = self.parameters = FAMILY_PARAMETERS.complete(parameters)
        self.model = TriangularModel.of(p)
        self._start = per_level(
            PLANT_PARAMETERS['initial_state'], p['initial_state'], self.model.order
        )
        low, *rest = p['band_of_d']
        if len(rest) != 1 or not low < rest[0]:
            raise FAMILY_PARAMETERS['band_of_d'].error(
                p['band_of_d'], 'two angular frequencies, the lower one first'
            )

    def recordings(self, count: int, seed: int = 0) -> list[Recording]:
        """Return the first recordings of a seed; shapes take turns."""
        return [self.recording(k, seed) for k in range(count)]

    def recording(self, number: int, seed: int = 0) -> Recording:
        """
        Return one recording.

        Raises
        ------
        ConfigurationError
            The plant leaves the finite numbers.

        """
        p = self.parameters
        random = np.random.default_rng([p['noise_seed'], seed, number])
        shape = p['disturbances'][number % len(p['disturbances'])]
        true_t, t = self._times(random)
        spacing = p['integration_step']
        grid = np.arange(int(np.ceil(true_t[-1] / spacing)) + 2) * spacing
        table = p['rms_of_d'] * self._wave(shape, grid, random)
        u = np.zeros((len(t), len(self.model.inputs)))
        for k, name in enumerate(self.model.inputs):
            if name in self.model.used_inputs:
                u[:, k] = p['rms_of_u'] * self._wave('sines', true_t, random)
        if u.shape[1] == 1:
            u = u[:, 0]
        measured_t = np.maximum(true_t - p['measurement_delay'], 0.0)
        moments = np.union1d(true_t, measured_t)
        acting = u[np.searchsorted(true_t, moments)]
        z, d = respond(self.model, self._start, moments, table, spacing, acting, spacing)
        measured = z[np.searchsorted(moments, measured_t), 0]
        z, d = (values[np.searchsorted(moments, true_t)] for values in (z, d))
        if not np.isfinite(z).all():
            raise ConfigurationError(
                f'plant: expected states that stay finite for {p["duration"]:g} s under d with '
                f'an RMS of {p["rms_of_d"]:g}, got infinite ones (recording {number})'
            )
        y = measured + p['noise_std'] * random.standard_normal(len(t))
        if p['outliers'] > 0.0:
            hit = random.uniform(size=len(t)) < p['outliers']
            y[hit] += p['outlier_std'] * random.standard_normal(np.count_nonzero(hit))
        return Recording(t, quantised(y, p['quantisation']), u, z, d, shape)

    def _times(self, random: Generator) -> tuple[Floats, Floats]:
        """Return the moments of sampling and the stamps of the samples that are not lost."""
        p = self.parameters
        count = int(p['duration'] * p['sample_rate']) + 1
        grid = np.arange(count) / p['sample_rate']
        moments = _increasing(grid + p['period_jitter'] * random.standard_normal(count))
        stamps = _increasing(moments + p['stamp_jitter'] * random.standard_normal(count))
        if p['dropout'] > 0.0:  # runs of samples, geometric in length; the first sample stays
            begin = p['dropout'] / (p['dropout_length'] * (1.0 - p['dropout']))
            end = 1.0 / p['dropout_length']
            kept = [True]
            for draw in random.uniform(size=count)[1:]:
                kept.append(draw >= (begin if kept[-1] else 1.0 - end))
            moments, stamps = moments[kept], stamps[kept]
        return moments, stamps

    def _wave(self, shape: str, t: Floats, random: Generator) -> Floats:
        """Return a random signal of unit RMS."""
        low, high = self.parameters['band_of_d']
        if shape == 'sines':  # one in each of `SINES` parts of the band, so that none is left out
            share = (np.arange(SINES) + random.uniform(size=SINES)) / SINES
            amplitude = random.uniform(0.5, 1.5, SINES)
            amplitude *= np.sqrt(2.0 / np.sum(amplitude**2))
            phase = random.uniform(0.0, 2.0 * np.pi, (SINES, 1))
            sines = np.sin(np.outer(low * (high / low) ** share, t) + phase)
            return np.asarray(np.sum(amplitude[:, np.newaxis] * sines, axis=0))
        if shape == 'chirp':  # from one end of the band to the other, exponentially
            first, last = (low, high) if random.uniform() < 0.5 else (high, low)
            rate = np.log(last / first) / t[-1]
            angle = first / rate * np.expm1(rate * t)
            return np.asarray(np.sqrt(2.0) * np.sin(angle + random.uniform(0.0, 2.0 * np.pi)))
        interval = self.parameters['step_interval']
        levels = max(2, int(np.ceil(3.0 * t[-1] / interval)) + 1)
        waits = interval * (1.0 / 3.0 + random.exponential(2.0 / 3.0, levels))
        wave = random.standard_normal(levels + 1)[np.searchsorted(np.cumsum(waits), t, 'right')]
        return np.asarray(wave / rms(wave))


def _increasing(t: Floats) -> Floats:
    t = np.maximum(np.sort(t), 0.0)
    rank = np.arange(len(t)) * SHORTEST
    return np.asarray(np.maximum.accumulate(t - rank) + rank)
