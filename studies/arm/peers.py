# SPDX-License-Identifier: Apache-2.0
"""
The observers that others use, joint by joint, with the same terms as ours.

Classical: A. De Luca and R. Mattone, ICRA 2005, doi:10.1109/ROBOT.2005.1570247. Kalman filter on
p: J. Hu and R. Xiong, IEEE Transactions on Industrial Electronics 65(4), 2018,
doi:10.1109/TIE.2017.2748056; on Y: the same filter on the integral of p. Sliding mode: G.
Garofalo, N. Mansfeld, J. Jankowski, C. Ott, ICRA 2019, doi:10.1109/ICRA.2019.8793529.
"""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

from fhaosmo_ros.core.arm.model import ArmModel
from fhaosmo_ros.tools.tuning.search import Dimension
import numpy as np
from scipy.linalg import solve_discrete_are
from scipy.signal import lfilter
from studies.arm.world import PERIOD, Touched
from studies.harness import discretised, Floats


class Momentum(NamedTuple):
    """What all of them take, K rows: p, its integral Y, and u."""

    p: Floats
    y: Floats
    drive: Floats
    size: Floats  # (n,) mean diagonal of M


def momentum(model: ArmModel, w: Touched, by_position: bool) -> Momentum:
    """Return p = M qd and u, with qd from differences of positions or from the sensor."""
    moved = np.diff(w.q, axis=0, prepend=w.q[:1])
    velocity = moved / PERIOD if by_position else w.velocity
    terms = [model.terms(q, v) for q, v in zip(w.q, velocity, strict=True)]
    mass = np.array([x.mass for x in terms])
    u = w.torque + np.array([x.turning - x.gravity for x in terms])
    u[1:] = 0.5 * (u[1:] + u[:-1])
    between = 0.5 * (mass + np.concatenate([mass[:1], mass[:-1]]))
    p, y = ((m @ x[..., None])[..., 0] for m, x in ((mass, velocity), (between, moved)))
    return Momentum(p, np.cumsum(y, axis=0), u, np.diagonal(mass, axis1=1, axis2=2).mean(axis=0))


def classical(m: Momentum, values: dict[str, float]) -> Floats:
    """R = K (p - integral of (u + r)): a filter of first order."""
    keep = np.exp(-values['gain'] * PERIOD)
    rate = np.diff(m.p, axis=0, prepend=m.p[:1]) / PERIOD - m.drive
    return np.asarray(lfilter([1.0 - keep], [1.0, -keep], rate, axis=0))


def kalman(on_integral: bool, m: Momentum, values: dict[str, float]) -> Floats:
    """P' = u + d, d a random walk, of bandwidth `speed`, and Y' = p if Y is what is known."""
    h, size = PERIOD, 2 + on_integral
    a, noise = discretised(np.eye(size, k=1), size - 1, h)
    noise *= (values['speed'] * h) ** (2 * size) / h ** (2 * size - 1)
    noise[-2, -2] += (values['model'] / h**on_integral) ** 2
    first = np.eye(size)[:1]
    p = solve_discrete_are(a.T, first.T, noise, np.eye(1))
    gain = p[:, 0] / (p[0, 0] + 1.0)
    b = np.append(a[:-1, -1], 0.0)
    closed, pushed = a - np.outer(gain, a[0]), b - gain * b[0]
    x, found = np.zeros((m.p.shape[1], size)), []
    for y, u in zip(m.y if on_integral else m.p, m.drive, strict=True):
        x = x @ closed.T + np.outer(y, gain) + np.outer(u, pushed)
        found.append(x[:, -1])
    return np.array(found)


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


FILTERED = (Dimension('speed', 2.0, 900.0, 60.0), Dimension('model', 1e-4, 10.0, 0.01))
TWISTED = (
    Dimension('k1', 0.1, 300.0, 5.0), Dimension('k2', 1.0, 1e4, 100.0),
    Dimension('layer', 1e-5, 1.0, 1e-2), Dimension('k0', 0.1, 900.0, 30.0),
)  # fmt: skip
Peer = Callable[[Momentum, dict[str, float]], Floats]
PEERS: dict[str, tuple[Peer, tuple[Dimension, ...]]] = {
    'classical momentum observer': (classical, (Dimension('gain', 1.0, 900.0, 50.0),)),
    'Kalman filter on p': (partial(kalman, False), FILTERED),
    'sliding mode on p': (sliding, TWISTED),
    'Kalman filter on Y': (partial(kalman, True), FILTERED),
}
