# SPDX-License-Identifier: Apache-2.0
"""What people use today, each with one number to choose: its bandwidth (rad/s)."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from scipy.signal import bilinear, lfilter
from studies.harness import Floats
from studies.recipes.judging import plant_of, Recorded


def low_passed(x: Floats, bandwidth: float, period: float, order: int, derivative: int) -> Floats:
    """Return a derivative of x behind (s / bandwidth + 1)^-order, from rest at the first value."""
    numerator = [1.0] + [0.0] * derivative
    denominator = np.poly([-bandwidth] * order) / bandwidth**order
    b, a = bilinear(numerator, denominator, 1.0 / period)
    first = x[0]
    filtered = lfilter(b, a, x - first)
    return filtered + (first if derivative == 0 else 0.0)


def inputs_of(r: Recorded) -> Floats:
    """Return the known inputs, one that is 0 where there are none."""
    return r.u if r.u.size else np.zeros((len(r.y), 1))


def disturbance_observer(p: Mapping[str, Any], r: Recorded, bandwidth: float) -> Floats:
    """
    Return d = Q(s) (s² y - Phi_2), Q = (s / bandwidth + 1)^-2, for a model of order 2.

    The low-passed second derivative less what the model explains (Chen et al. 2016,
    doi:10.1109/TIE.2015.2478397).
    """
    model, h = plant_of(p), r.period
    velocity = low_passed(r.y, bandwidth, h, 2, 1)
    samples = zip(np.column_stack([r.y, velocity]), inputs_of(r), strict=True)
    explained = np.array([model.evaluate(z, u)[1] for z, u in samples])
    acceleration = low_passed(r.y, bandwidth, h, 2, 2)
    return acceleration - low_passed(explained, bandwidth, h, 2, 0)


def kalman_filter(p: Mapping[str, Any], r: Recorded, bandwidth: float) -> Floats:
    """
    Return d of an extended Kalman filter whose model of d is a random walk.

    Only the ratio of the two noises matters; it is given as the bandwidth of the steady filter of
    the chain of integrators: q = bandwidth^(2N) noise² h, N = n + 1.
    """
    model = plant_of(p)
    n, h = model.order, r.period
    q = bandwidth ** (2 * n + 2) * h
    x = np.zeros(n + 1)
    x[0] = r.y[0]
    covariance = np.diag([(3.0 * bandwidth) ** (2 * k) for k in range(n + 1)])
    chain, found, inputs = np.eye(n + 1, k=1), np.zeros(len(r.y)), inputs_of(r)
    for k in range(1, len(r.y)):
        dt, u = r.t[k] - r.t[k - 1], inputs[k]
        rates = [np.zeros(n + 1)]
        for share in (0.0, 0.5, 0.5, 1.0):
            point = x + share * dt * rates[-1]
            rate = chain @ point
            rate[:n] += model.evaluate(point[:n], u)
            rates.append(rate)
        x = x + dt / 6.0 * (rates[1] + 2.0 * rates[2] + 2.0 * rates[3] + rates[4])
        slopes = chain.copy()
        slopes[:n, :n] += model.jacobian(x[:n], u)
        a = last = np.eye(n + 1)
        for power in range(1, 5):
            last = last @ slopes * (dt / power)
            a = a + last
        covariance = a @ covariance @ a.T
        covariance[n, n] += q * dt
        gain = covariance[:, 0] / (covariance[0, 0] + 1.0)
        x = x + gain * (r.y[k] - x[0])
        covariance = covariance - np.outer(gain, covariance[0])
        found[k] = x[n]
    return found


def complementary_filter(p: Mapping[str, Any], r: Recorded, bandwidth: float) -> Floats:
    """
    Return d of z1' = Phi(u) + d + 2 w e, d' = w² e with e = y - z1 and w = `bandwidth`.

    In one dimension this is the filter of Mahony et al. (2008, doi:10.1109/TAC.2008.923738)
    with its estimate of the bias.
    """
    model, angle, bias, found = plant_of(p), float(r.y[0]), 0.0, np.zeros(len(r.y))
    for k in range(1, len(r.y)):
        dt, rate = r.t[k] - r.t[k - 1], model.evaluate(r.y[k : k + 1], r.u[k])[0]
        wrong = r.y[k] - angle - dt * (rate + bias)
        angle += dt * (rate + bias + 2.0 * bandwidth * wrong)
        bias += dt * bandwidth**2 * wrong
        found[k] = bias
    return found
