# SPDX-License-Identifier: Apache-2.0
"""How wrong the estimates of recordings are whose truth is known, without their trajectories."""

from libc.math cimport NAN, fabs

from fhaosmo_ros.core.model.prediction cimport MOST_LEVELS
from fhaosmo_ros.core.online.policy cimport Policy

import numpy as np


def judge(Policy policy not None, recordings, double settled, double band):
    """
    Run through recordings by the policy of the node; it starts afresh at each.

    Parameters
    ----------
    policy : Policy
    recordings : Truth
        See scoring.py.
    settled, band : float
        See `Trial`.

    Returns
    -------
    squares : (R, 2, n + 1) array
        Sums of the squared errors of z and d by recording, of the internal and of the filtered
        estimates, from `settled` on.
    transient, variation : (R, 2) arrays
        See `Scores`.

    """
    cdef const long long[::1] stamps = recordings.stamps, begins = recordings.begins
    cdef const double[::1] y = recordings.y
    cdef const double[:, ::1] u = recordings.u, truth = recordings.truth
    cdef Py_ssize_t r, k, first, count = begins.shape[0] - 1
    cdef int n = policy.structure.order, i, filtered
    cdef double[:, :, ::1] squares = np.zeros((count, 2, n + 1))
    cdef double[:, ::1] transient = np.zeros((count, 2)), variation = np.zeros((count, 2))
    cdef double[MOST_LEVELS + 1] found
    cdef double[2] before  # estimates of d at the sample before
    cdef double time, wrong
    policy.check(u.shape[1])
    inside = (np.diff(np.concatenate([[0], begins, [y.shape[0]]])) >= 0).all()
    if count < 0 or truth.shape[1] != n + 1 or not inside or not (
        stamps.shape[0] == y.shape[0] == u.shape[0] == truth.shape[0]
    ):
        raise ValueError('judge: arrays of different sizes')
    policy.structure.busy = True
    with nogil:
        for r in range(count):
            first = begins[r]
            policy.forget_samples()
            before[0] = before[1] = NAN
            for k in range(first, begins[r + 1]):
                policy.take(stamps[k], y[k], &u[k, 0])
                time = (stamps[k] - stamps[first]) * 1e-9
                for filtered in range(2):
                    policy.published(filtered, found)
                    wrong = found[n] - truth[k, n]
                    if time < settled:
                        if not fabs(wrong) <= band:
                            transient[r, filtered] = time
                        continue
                    for i in range(n + 1):
                        wrong = found[i] - truth[k, i]
                        squares[r, filtered, i] += wrong * wrong
                    if before[filtered] == before[filtered]:  # neither the first one nor NaN
                        variation[r, filtered] += fabs(found[n] - before[filtered])
                    before[filtered] = found[n]
    policy.structure.busy = False
    return np.asarray(squares), np.asarray(transient), np.asarray(variation)
