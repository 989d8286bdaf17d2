# SPDX-License-Identifier: Apache-2.0
"""
Innovations of the Kalman filter of one model of d and of the noise, along a recorded y (D 30).

The filter is the one that the gains of `tune` mean (D 17 to D 19). States follow the model by
Runge-Kutta steps, their covariance follows a linear model of one sampling period. The last state
is the coloured part of the noise, v_j = a v_{j-1} + w_j, which is 0 for white noise.
"""

from typing import NamedTuple

from fhaosmo_ros.core.compiled.cache import compiled
from fhaosmo_ros.core.model.bytecode import Floats
from fhaosmo_ros.core.model.integrate import NOW
from fhaosmo_ros.core.observer.arrays import Law, Work
from fhaosmo_ros.core.observer.prediction import predict
import numpy as np
from numpy.typing import NDArray


class Samples(NamedTuple):
    """
    A recorded y.

    Attributes
    ----------
    h : (K,) array
        Time since the sample before (s); 0 for the first one.
    periods : (K,) array
        The same in sampling periods, rounded; 0 where the filter begins afresh.
    y : (K,) array
    u : (K, m) array
        Known inputs of the interval that ends at each sample.
    used : (K,) array of bool
        False for samples that do not correct: outliers.

    """

    h: Floats
    periods: NDArray[np.int64]
    y: Floats
    u: Floats
    used: NDArray[np.bool_]


class Linear(NamedTuple):
    """
    The linear model of a sampling period, of N + 1 states: z, d, its derivatives, and v.

    Attributes
    ----------
    a, q : (N + 1, N + 1) arrays
        Transition, and the covariance that a period adds.
    fresh : (N + 1, N + 1) array
        Covariance of the errors where the filter begins.
    variance : float
        Of the white noise on y.
    clip : float
        Innovations of more standard deviations correct as so many (Huber 1964).
    settled : int
        Samples without a gap after which the covariance counts as steady.

    """

    a: Floats
    q: Floats
    fresh: Floats
    variance: float
    clip: float
    settled: int


@compiled(nogil=True)
def innovations(
    law: Law,
    work: Work,
    samples: Samples,
    linear: Linear,
    longest: float,
    b: Floats,
    s: Floats,
    x: Floats,
) -> None:
    """
    Run the filter.

    Parameters
    ----------
    law, work
        Only the model, and memory for its prediction, are used.
    samples : Samples
    linear : Linear
    longest : float
        Longest Runge-Kutta step (s).
    b, s : (K,) arrays
        Filled with the innovations and their variances; NaN where the filter begins.
    x : (K, N) array
        Filled with the estimates.

    """
    now, size = work.stages[NOW], linear.a.shape[0]
    n = size - 1
    p, ap, gain = linear.fresh.copy(), np.empty((size, size)), np.zeros(size)
    noise, since, variance = 0.0, 0, 0.0
    for k in range(samples.y.size):
        if samples.periods[k] == 0:
            p[:] = linear.fresh
            now[:] = 0.0
            now[0, 0] = samples.y[k]
            noise, since = 0.0, 0
            b[k] = s[k] = np.nan
            for i in range(n):
                x[k, i] = now[0, i]
            continue
        predict(law, work, samples.h[k], samples.u[k], longest)
        if samples.periods[k] > 1:
            since = 0
        for _ in range(samples.periods[k]):
            noise *= linear.a[n, n]
            if since > linear.settled:
                continue
            for i in range(size):  # P <- A P A' + Q
                for j in range(size):
                    total = 0.0
                    for m in range(size):
                        total += linear.a[i, m] * p[m, j]
                    ap[i, j] = total
            for i in range(size):
                for j in range(i, size):
                    total = linear.q[i, j]
                    for m in range(size):
                        total += ap[i, m] * linear.a[j, m]
                    p[i, j] = p[j, i] = total
        if since <= linear.settled:
            variance = p[0, 0] + 2.0 * p[0, n] + p[n, n] + linear.variance
            for i in range(size):
                gain[i] = (p[i, 0] + p[i, n]) / variance
        residual = samples.y[k] - now[0, 0] - noise
        b[k], s[k] = residual, variance
        if samples.used[k]:
            limit = linear.clip * np.sqrt(variance)
            residual = min(max(residual, -limit), limit)
            for i in range(n):
                now[0, i] += gain[i] * residual
            noise += gain[n] * residual
            if since <= linear.settled:
                for i in range(size):
                    for j in range(i, size):
                        p[i, j] = p[j, i] = p[i, j] - gain[i] * gain[j] * variance
                since += 1
        else:
            since = 0
        for i in range(n):
            x[k, i] = now[0, i]
