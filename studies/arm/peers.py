# SPDX-License-Identifier: Apache-2.0
"""
The observers that others use, joint by joint, with the same terms as ours.

Classical: A. De Luca and R. Mattone, ICRA 2005, doi:10.1109/ROBOT.2005.1570247. Kalman filter on
p: J. Hu and R. Xiong, IEEE Transactions on Industrial Electronics 65(4), 2018,
doi:10.1109/TIE.2017.2748056; on Y: the same filter on the integral of p. Sliding mode: G.
Garofalo, N. Mansfeld, J. Jankowski, C. Ott, ICRA 2019, doi:10.1109/ICRA.2019.8793529.
"""

from collections.abc import Callable
from typing import NamedTuple

from fhaosmo_ros.core.arm.model import ArmModel
from fhaosmo_ros.tools.tuning.search import Dimension
import numpy as np
from scipy.linalg import solve_discrete_are
from scipy.signal import lfilter
from studies.arm.world import Floats, PERIOD, Touched


class Momentum(NamedTuple):
    """What all of them take, K rows: p, increments of Y, and u."""

    p: Floats
    moved: Floats
    drive: Floats
    size: Floats  # (n,) mean diagonal of M


def momentum(model: ArmModel, w: Touched, by_position: bool) -> Momentum:
    """Return p = M qd and u, with qd from differences of positions or from the sensor."""
    moved = np.diff(w.q, axis=0, prepend=w.q[:1])
    velocity = moved / PERIOD if by_position else w.velocity
    p, y, u, size = np.zeros_like(w.q), np.zeros_like(w.q), np.zeros_like(w.q), 0.0
    before = None
    for k in range(len(w.q)):
        terms = model.terms(w.q[k], velocity[k])
        u[k] = w.torque[k] + terms.coriolis - terms.gravity
        p[k] = terms.mass @ velocity[k]
        y[k] = 0.5 * (terms.mass + (terms.mass if before is None else before)) @ moved[k]
        before, size = terms.mass, size + np.diag(terms.mass) / len(w.q)
    u[1:] = 0.5 * (u[1:] + u[:-1])
    return Momentum(p, y, u, size)


def classical(m: Momentum, values: dict[str, float]) -> Floats:
    """R = K (p - integral of (u + r)): a filter of first order."""
    keep = np.exp(-values['gain'] * PERIOD)
    rate = np.diff(m.p, axis=0, prepend=m.p[:1]) / PERIOD - m.drive
    return np.asarray(lfilter([1.0 - keep], [1.0, -keep], rate, axis=0))


def _filtered(a: Floats, b: Floats, gain: Floats, measured: Floats, drive: Floats) -> Floats:
    """Return the states of an observer with constant gain, (K, n, states)."""
    x, out = np.zeros((measured.shape[1], len(a))), []
    closed = a - np.outer(gain, a[0])
    pushed = b - gain * b[0]
    for y, u in zip(measured, drive, strict=True):
        x = x @ closed.T + np.outer(y, gain) + np.outer(u, pushed)
        out.append(x)
    return np.array(out)


def _gain(a: Floats, noise: Floats) -> Floats:
    h = np.zeros((1, len(a)))
    h[0, 0] = 1.0
    spread = solve_discrete_are(a.T, h.T, noise, np.eye(1))
    return np.asarray((spread @ h.T / (h @ spread @ h.T + 1.0)).ravel())


def kalman_p(m: Momentum, values: dict[str, float]) -> Floats:
    """P' = u + d, d a random walk; `speed` is the bandwidth."""
    h, a = PERIOD, np.array([[1.0, PERIOD], [0.0, 1.0]])
    ratio = (values['speed'] * h) ** 4 / h**2
    noise = ratio * np.array([[h * h / 3.0, h / 2.0], [h / 2.0, 1.0]])
    noise[0, 0] += values['model'] ** 2
    return _filtered(a, np.array([h, 0.0]), _gain(a, noise), m.p, m.drive)[..., 1]


def kalman_y(m: Momentum, values: dict[str, float]) -> Floats:
    """Y' = p, p' = u + d, d a random walk."""
    h = PERIOD
    a = np.array([[1.0, h, h * h / 2.0], [0.0, 1.0, h], [0.0, 0.0, 1.0]])
    intensity = (values['speed'] * h) ** 6 / h**5
    noise = intensity * np.array([
        [h**5 / 20, h**4 / 8, h**3 / 6], [h**4 / 8, h**3 / 3, h * h / 2], [h**3 / 6, h * h / 2, h]
    ])  # fmt: skip
    noise[1, 1] += (values['model'] / h) ** 2
    y = np.cumsum(m.moved, axis=0)
    return _filtered(a, np.array([h * h / 2.0, h, 0.0]), _gain(a, noise), y, m.drive)[..., 2]


def sliding(m: Momentum, values: dict[str, float]) -> Floats:
    """Super-twisting on p: e' = u - k1 |e|^(1/2) sign e + s - p', s' = -k2 sign e; d is -s."""
    k1, k2 = values['k1'] * np.sqrt(m.size), values['k2'] * m.size
    guess, s, out = m.p[0].copy(), np.zeros_like(m.p[0]), np.zeros_like(m.p)
    for k in range(1, len(m.p)):
        e = guess - m.p[k]
        smooth = np.clip(e / (values['layer'] * m.size), -1.0, 1.0)
        push = k1 * np.sqrt(np.abs(e)) * smooth + values['k0'] * e
        guess = guess + PERIOD * (m.drive[k] + s - push)
        s = s - PERIOD * k2 * smooth
        out[k] = s
    return out


SPEED = Dimension('speed', 2.0, 900.0, 60.0)
MODEL = Dimension('model', 1e-4, 10.0, 0.01)
Peer = Callable[[Momentum, dict[str, float]], Floats]
PEERS: dict[str, tuple[Peer, tuple[Dimension, ...]]] = {
    'classical momentum observer': (classical, (Dimension('gain', 1.0, 900.0, 50.0),)),
    'Kalman filter on p': (kalman_p, (SPEED, MODEL)),
    'sliding mode on p': (
        sliding,
        (
            Dimension('k1', 0.1, 300.0, 5.0), Dimension('k2', 1.0, 1e4, 100.0),
            Dimension('layer', 1e-5, 1.0, 1e-2), Dimension('k0', 0.1, 900.0, 30.0),
        ),
    ),
    'Kalman filter on Y': (kalman_y, (SPEED, MODEL)),
}  # fmt: skip
