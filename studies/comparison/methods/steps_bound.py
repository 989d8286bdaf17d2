# SPDX-License-Identifier: Apache-2.0
"""
Lower bound on any estimator's error for step disturbances.

Without noise it is the error of d delayed by one sample. The first sample after a step depends on
the step's time and size, so it determines neither of them.

With noise it is the error of the posterior mean, for which the noise, the waiting times and the
sizes of the steps are known. Between two steps the plant is linear and d constant, so for one
hypothesis of the times of the steps a Kalman filter without process noise is exact. Many
hypotheses run in parallel, weighted by how well they predict y (a multiple hypothesis filter). No
estimator has a smaller expected squared error, apart from these approximations: steps happen
between blocks of samples; a block counts as its mean; all hypotheses with a step at the same time
are merged into one mean and covariance, as in H. A. P. Blom and Y. Bar-Shalom, IEEE Transactions
on Automatic Control 33(8), 1988, doi:10.1109/9.1299; unlikely hypotheses are dropped. An estimator
that is tuned on data knows less.
"""

from fhaosmo_ros.core.simulation.metrics import rms
from fhaosmo_ros.core.simulation.recording_parameters import FAMILY_PARAMETERS
from fhaosmo_ros.core.simulation.recordings import Recording
import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm
from studies.comparison.cells import family_values, Sensor
from studies.comparison.methods.method import Setting
from studies.comparison.scores import JUDGED_FROM, mean

BLOCK = 0.01
"""Length of a block of samples in seconds."""
KEPT, YOUNG = 300, 1.0
"""Number of hypotheses that are kept: those with a step less than YOUNG seconds ago come first."""
START = 1.0
"""Standard deviation of the states at the start, in their units."""

Floats = NDArray[np.float64]


def applies(sensor: Sensor) -> bool:
    """Return True for a linear plant, evenly sampled with no or Gaussian noise, whose d steps."""
    return (
        sensor.plant == 'paper' and sensor.disturbances[0] == 'steps' and sensor.timing == 'even'
    )


def bound(sensor: Sensor) -> float:
    """Return the error of d on the recordings that judge, as `scores` does."""
    recordings = sensor.held_out('steps')
    if sensor.noise == 0.0:
        return mean(_one_sample_late(r) for r in recordings)
    values = FAMILY_PARAMETERS.defaults() | family_values(sensor.plant)
    interval = values['step_interval']
    return mean(_error(sensor.setting(), r, interval) for r in recordings)


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
        if fresh.sum() > 0.0:  # all that end in a step now are merged: they differ little
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
