# SPDX-License-Identifier: Apache-2.0
"""
The loop over samples of the filters that bend or adapt; see methods.py.

They predict by Runge-Kutta steps of the whole (nonlinear) model, so they know Phi exactly as ours
does, and correct by y. Each estimate uses the sample of its own time. Covariances are of scaled
states and relative to a variance of the noise.
"""

from libc.math cimport INFINITY, exp, fabs, fmax, log, rint, sqrt
from libc.stdlib cimport calloc, free
from libc.string cimport memcpy, memset

from fhaosmo_ros.core.model.prediction cimport MOST_LEVELS, Prediction
from fhaosmo_ros.core.observer.kalman cimport Row, carry, correct, fill

import numpy as np

cdef double LEAST = 1e-4  # smallest variance of the noise, over the tuned one


cdef struct Filter:
    double x[MOST_LEVELS]  # estimates of z, d, d', ..
    Row p[MOST_LEVELS]  # covariance of their errors
    Row q[MOST_LEVELS]  # what it gains in a period
    double r  # variance of the noise on y
    double share  # probability of this model


cdef void predict(
    Prediction prediction, Filter* f, double h, const double* u
) noexcept nogil:
    """Follow the model for `h` seconds."""
    memcpy(prediction.z, f.x, prediction.n * sizeof(double))
    memset(prediction.dz, 0, prediction.n * sizeof(double))
    prediction.over(h, u)
    memcpy(f.x, prediction.z, prediction.n * sizeof(double))


cdef void grow(int n, const Row* a, Filter* f) noexcept nogil:
    """P <- A P A' + Q."""
    cdef int i, j
    carry(n, a, f.p)
    for i in range(n):
        for j in range(n):
            f.p[i][j] += f.q[i][j]


cdef double take(int n, Filter* f, double e, double huber, const double* scale) noexcept nogil:
    """Correct by the error `e` of a prediction, bounded by Huber; return its variance."""
    cdef double s = f.p[0][0] + f.r
    cdef double larger = s * fmax(fabs(e) / (huber * sqrt(s)), 1.0)
    cdef int i
    for i in range(n):
        f.x[i] += f.p[i][0] / larger * e / scale[i]
    correct(n, f.p, larger - f.p[0][0])
    return s


cdef void mix(
    int n, int count, double switch, const double* scale, const Filter* filters, Filter* mixed
) noexcept nogil:
    """Let each model begin from what all of them say (Blom and Bar-Shalom 1988)."""
    cdef int i, j, m, k
    cdef double weight, away, total
    cdef Filter* one
    for j in range(count):
        one, total = &mixed[j], 0.0
        memset(one.x, 0, sizeof(one.x))
        memset(one.p, 0, sizeof(one.p))
        for i in range(count):
            total += filters[i].share * chance(i == j, count, switch)
        for i in range(count):
            weight = filters[i].share * chance(i == j, count, switch) / total
            for m in range(n):
                one.x[m] += weight * filters[i].x[m]
        for i in range(count):
            weight = filters[i].share * chance(i == j, count, switch) / total
            for m in range(n):
                away = (filters[i].x[m] - one.x[m]) * scale[m]
                for k in range(n):
                    one.p[m][k] += weight * (
                        filters[i].p[m][k] + away * (filters[i].x[k] - one.x[k]) * scale[k]
                    )
        one.share = total


cdef inline double chance(bint same, int count, double switch) noexcept nogil:
    """Return the probability that a model follows another one, or itself."""
    return 1.0 - switch * (count - 1) if same else switch


def several_models(Prediction prediction, samples, bank):
    """
    Run Kalman filters that bend or adapt, one for each model; return (K, N) estimates.

    `samples` is as for `core.observer.kalman.innovations`. `bank` has `a`, `fresh` (N, N):
    transition of a period and covariance at the first sample; `q` (M, N, N): what a period adds,
    by model; `scale` (N,): scaled states over states; `period` (s); `huber`: standard deviations;
    `memory`: share of a sample in the variance of the noise; `switch`: probability of another
    model.
    """
    cdef const double[::1] y = samples.y, h = samples.h
    cdef const double[:, ::1] u = samples.u
    cdef const double[::1] scale = np.ascontiguousarray(bank.scale)
    cdef int n = prediction.n, count = len(bank.q), i, j, _, periods
    if not (
        all(len(matrix) == n for matrix in (bank.a, bank.fresh, bank.scale, *bank.q))
        and len(samples.h) == len(samples.u) == len(samples.y)
        and samples.u.shape[1] >= max(prediction.phi.inputs, 1)
    ):
        raise ValueError('several_models: arrays of sizes that do not fit')
    cdef double period = bank.period, huber = bank.huber, memory = bank.memory
    cdef double switch = bank.switch / max(count - 1, 1) if count > 1 else 0.0
    cdef double[:, ::1] out = np.zeros((y.shape[0], n))
    cdef double e, s, total, best
    cdef Row a[MOST_LEVELS]
    cdef Filter* filters = <Filter*>calloc(count, sizeof(Filter))
    cdef Filter* mixed = <Filter*>calloc(count, sizeof(Filter))
    cdef Filter* f
    cdef Py_ssize_t k
    try:
        if filters == NULL or mixed == NULL:
            raise MemoryError
        fill(a, bank.a)
        for j in range(count):
            fill(filters[j].q, bank.q[j])
            fill(filters[j].p, bank.fresh)
            filters[j].x[0], filters[j].r, filters[j].share = y[0], 1.0, 1.0 / count
        for k in range(y.shape[0]):
            periods = <int>fmax(rint(h[k] / period), 1.0)
            mix(n, count, switch, &scale[0], filters, mixed)
            best = -INFINITY
            for j in range(count):
                f = &filters[j]
                memcpy(f.x, mixed[j].x, sizeof(f.x))
                memcpy(f.p, mixed[j].p, sizeof(f.p))
                if k > 0:
                    predict(prediction, f, h[k], &u[k, 0])
                for _ in range(periods):
                    grow(n, a, f)
                e = (y[k] - f.x[0]) * scale[0]
                s = take(n, f, e, huber, &scale[0])
                f.share = log(mixed[j].share + 1e-300) - 0.5 * (log(s) + e * e / s)
                best = fmax(best, f.share)
                f.r += memory * (fmax(e * e - (s - f.r), LEAST) - f.r)
            total = 0.0
            for j in range(count):
                filters[j].share = exp(filters[j].share - best)
                total += filters[j].share
            for j in range(count):
                filters[j].share /= total
                for i in range(n):
                    out[k, i] += filters[j].share * filters[j].x[i]
    finally:
        free(filters)
        free(mixed)
    return np.asarray(out)
