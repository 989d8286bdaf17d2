# SPDX-License-Identifier: Apache-2.0
"""
What can be known at all of a d that steps.

Without noise: d one sample late. The first sample after a step depends on its time and its size,
so that it tells little of either.

With noise: the posterior mean of one who knows how d was made. Between two steps the plant is
linear and d constant, so a Kalman filter without any noise of its own is exact for one hypothesis
of when the steps were. Many such hypotheses run side by side, weighted by how well they predict y
(a multiple hypothesis filter): which noise, which waiting times and which sizes the steps have,
it is told. No estimator has a smaller expected squared error, but for what is approximate here:
steps happen between blocks of samples, each block counts as its mean, what was before a step is
summed up by a mean and a covariance, and unlikely hypotheses are dropped. Whatever is tuned on
data knows less.
"""

from fhaosmo_ros.core.family import Recording
from fhaosmo_ros.core.family_parameters import FAMILY_PARAMETERS
from fhaosmo_ros.core.metrics import rms
from fhaosmo_ros.tools.comparison.cells import family_values, Sensor
from fhaosmo_ros.tools.comparison.methods import Setting
from fhaosmo_ros.tools.comparison.scores import JUDGED_FROM
import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm

BLOCK = 0.01
"""Seconds."""
KEPT, YOUNG = 300, 1.0
"""Hypotheses that are kept: those with a step within so many seconds, and the likeliest."""
START = 1.0
"""Standard deviation of the states at the start, in their units."""

Floats = NDArray[np.float64]


def applies(sensor: Sensor) -> bool:
    """Return True for a linear plant, evenly sampled with no or Gaussian noise, whose d steps."""
    return (
        sensor.plant == 'paper' and sensor.disturbances == ('steps',) and sensor.timing == 'even'
    )


def bound(sensor: Sensor) -> float:
    """Return the RMS error of d over the RMS of d on the recordings that judge."""
    recordings = sensor.held_out('steps')
    if sensor.noise == 0.0:
        return rms(np.array([_one_sample_late(r) for r in recordings]))
    values = FAMILY_PARAMETERS.defaults() | family_values(sensor.plant)
    interval = values['step_interval']
    errors = [_error(sensor.setting(), r, interval) for r in recordings]
    return rms(np.array(errors))


def _one_sample_late(recording: Recording) -> float:
    late = recording.t[1:] >= JUDGED_FROM
    return rms(np.diff(recording.d)[late]) / rms(recording.d[1:][late])


def _error(setting: Setting, recording: Recording, interval: float) -> float:
    count = max(1, round(BLOCK / setting.period))
    blocks = len(recording.y) // count
    y = recording.y[: blocks * count].reshape(blocks, count).mean(axis=1)
    ends = np.arange(blocks) * count + count - 1
    found = posterior_means(setting, y, count, interval)
    late = recording.t[ends] >= JUDGED_FROM
    return rms((found - recording.d[ends])[late]) / rms(recording.d[recording.t >= JUDGED_FROM])


def posterior_means(setting: Setting, y: Floats, count: int, interval: float) -> Floats:
    """Return the posterior mean of d after each block of `count` samples, whose means are `y`."""
    n, period = setting.model.order, setting.period * count
    rates = np.eye(n + 1, k=1)
    rates[:n, :n] += setting.model.jacobian(np.zeros(n))
    step = expm(rates * period)
    noise = setting.noise**2 / count
    x, p = np.zeros((1, n + 1)), np.diag([START**2] * n + [setting.size**2])[None]
    x[0, 0] = y[0]
    weight, age = np.ones(1), np.zeros(1)
    means = np.zeros(len(y))
    for k in range(1, len(y)):
        # The family's waiting times: a third of the interval, then exponential.
        likely = np.where(age < interval / 3.0, 0.0, period / (interval * 2.0 / 3.0))
        fresh = weight * likely
        if fresh.sum() > 0.0:  # all that end in a step now become one: they differ little
            share = fresh / fresh.sum()
            mean = share @ x
            apart = x - mean
            spread = np.einsum('h,hij->ij', share, p + apart[:, :, None] * apart[:, None, :])
            mean[n], spread[n], spread[:, n] = 0.0, 0.0, 0.0
            spread[n, n] = setting.size**2
            weight = np.append(weight * (1.0 - likely), fresh.sum())
            age, x = np.append(age, 0.0), np.concatenate([x, mean[None]])
            p = np.concatenate([p, spread[None]])
        age = age + period
        x, p = x @ step.T, step @ p @ step.T
        innovation, variance = y[k] - x[:, 0], p[:, 0, 0] + noise
        gain = p[:, :, 0] / variance[:, None]
        x = x + gain * innovation[:, None]
        p = p - gain[:, :, None] * p[:, None, 0, :]
        with np.errstate(divide='ignore'):
            log = np.log(weight) - 0.5 * (innovation**2 / variance + np.log(variance))
        weight = np.exp(log - log.max())
        kept = np.argsort(-np.where(age < YOUNG, np.inf, weight))[:KEPT]
        x, p, age, weight = x[kept], p[kept], age[kept], weight[kept]
        weight = weight / weight.sum()
        means[k] = weight @ x[:, n]
    return means
