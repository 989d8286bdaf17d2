# SPDX-License-Identifier: Apache-2.0
"""Torque at the shoulder of a two-joint robot, beside the wrench that was measured there."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from fhaosmo_ros.tools.bags.reader import BagReader
import numpy as np
from numpy.typing import NDArray
from scipy.signal import butter, filtfilt, savgol_filter
from studies.recipes import peers
from studies.recipes.judging import (
    FIXED,
    fixed,
    Fold,
    Method,
    model,
    OURS,
    Recorded,
    self_tuning,
    simulated,
)

Floats = NDArray[np.float64]
DATA = 'bag of the pendubot'
QUANTITY, SCALE = 'torque at the shoulder [N m]', 1.0
SHOWN, SHOWN_FOLD, BAND = (0.5, 4.7), 0, False
JOINTS, WRENCH = '/pndbt/joint_states', '/pndbt/netft_data'
RATE = 200.0
"""Of the joint states (Hz)."""
CUTOFF = 15.0
"""Of the zero-phase low pass of the measured torque (Hz), as its recorders used it."""
WINDOW, SLIDING, SETTLED = 31, 0.05, 0.5
"""Samples of the smoother that identifies the model, offline; rad/s; s."""
BANDWIDTHS = np.geomspace(10.0, 300.0, 14).tolist()


def read(path: Path) -> Recorded:
    """Return the shoulder's speed, the angles and the elbow's speed, and the measured torque."""
    with BagReader(path) as bag:
        messages = bag.read_all([JOINTS, WRENCH])
    stamps: dict[str, list[float]] = {JOINTS: [], WRENCH: []}
    rows: dict[str, list[list[float]]] = {JOINTS: [], WRENCH: []}
    for topic, _, message in messages:
        stamp = message.header.stamp
        stamps[topic].append(stamp.sec + stamp.nanosec * 1e-9)
        if topic == JOINTS:
            rows[topic].append([*message.position, *message.velocity])
        else:
            rows[topic].append([-message.wrench.torque.z])
    t = np.array(stamps[JOINTS])
    angle, elbow, speed, elbow_speed = np.array(rows[JOINTS]).T
    torque = np.array(rows[WRENCH])[:, 0]
    low_pass = butter(2, CUTOFF, fs=len(torque) / np.ptp(stamps[WRENCH]))
    torque = np.interp(t, stamps[WRENCH], filtfilt(*low_pass, torque))
    u = np.column_stack([angle, np.unwrap(elbow), elbow_speed])
    return Recorded(path.stem, t - t[0], speed, u, torque, t > t[0] + SETTLED)


def identify(r: Recorded) -> tuple[dict[str, float], float, float]:
    """
    Return the model's constants, the offset of the wrench, and the R² of the torque.

    Least squares on the equations of both joints, with derivatives by a Savitzky-Golay smoother,
    which uses the future: with absolute angle s = q1 + q2 of link 2,

        torque = p q1'' + h (cos q2 s'' - sin q2 s'²) + g1 cos q1 + v q1' + c sign q1' + offset
        s'' = -(h/i) (cos q2 q1'' + sin q2 q1'²) - k cos s - friction        (the elbow is free)
    """
    h = 1.0 / RATE
    t = np.arange(r.t[0], r.t[-1], h)
    angle, elbow, torque = (np.interp(t, r.t, x) for x in (r.u[:, 0], r.u[:, 1], r.d))
    speed, elbow_speed = (savgol_filter(x, WINDOW, 3, 1, h) for x in (angle, elbow))
    acceleration = savgol_filter(angle, WINDOW, 3, 2, h)
    absolute, turning = acceleration + savgol_filter(elbow, WINDOW, 3, 2, h), speed + elbow_speed
    cos, sin = np.cos(elbow), np.sin(elbow)
    table = [
        acceleration, cos * absolute - sin * turning**2, np.cos(angle), speed,
        np.tanh(speed / SLIDING), np.ones_like(t),
    ]  # fmt: skip
    (p, coupling, g1, v, c, offset), misfit, *_ = np.linalg.lstsq(
        np.array(table).T, torque, rcond=None
    )
    of_elbow = [
        -cos * acceleration - sin * speed**2, -np.cos(angle + elbow), elbow_speed,
        np.tanh(elbow_speed),
    ]  # fmt: skip
    ratio, k = np.linalg.lstsq(np.array(of_elbow).T, absolute, rcond=None)[0][:2]
    constants = {
        'p': p, 'h': coupling, 'r': coupling * ratio, 'g1': g1, 'k': k, 'v': v, 'c': c,
    }  # fmt: skip
    explained = 1.0 - float(misfit[0]) / float(np.sum((torque - torque.mean()) ** 2))
    return {name: float(x) for name, x in constants.items()}, float(offset), explained


def inertia(p: Mapping[str, Any], r: Recorded) -> Floats:
    """Return J(q2), by which the shoulder's acceleration is torque / J."""
    result: Floats = p['constants.p'] - p['constants.r'] * np.cos(r.u[:, 1]) ** 2
    return result


def this_observer(p: Mapping[str, Any], r: Recorded, number: float) -> Floats:
    """Return the torque: d J(q2)."""
    return self_tuning(p, r, number) * inertia(p, r)


def this_observer_fixed(p: Mapping[str, Any], r: Recorded, bandwidth: float) -> Floats:
    """Return the torque: d J(q2)."""
    return fixed(p, r, bandwidth) * inertia(p, r)


def kalman_filter(p: Mapping[str, Any], r: Recorded, bandwidth: float) -> Floats:
    """Return the torque: d J(q2)."""
    return peers.kalman_filter(p, r, bandwidth) * inertia(p, r)


def momentum_observer(p: Mapping[str, Any], r: Recorded, bandwidth: float) -> Floats:
    """
    Return the torque by the residual of the generalised momentum, with the measured speeds.

    m' = torque - g1 cos q1 - v q1' - c sign q1' + h sin q2 s' q1' for m = p q1' + h cos q2 s', and
    residual = bandwidth (m - integral of (known + residual))   (De Luca and Mattone
    2003, doi:10.1109/ROBOT.2003.1241665).
    """
    c = {name.partition('.')[2]: x for name, x in p.items() if name.startswith('constants.')}
    speed, (angle, elbow, elbow_speed) = r.y, r.u.T
    turning = speed + elbow_speed
    momentum = c['p'] * speed + c['h'] * np.cos(elbow) * turning
    known = (
        c['h'] * np.sin(elbow) * turning * speed
        - c['g1'] * np.cos(angle) - c['v'] * speed - c['c'] * np.tanh(speed / SLIDING)
    )  # fmt: skip
    found, residual, integral = np.zeros(len(r.t)), 0.0, momentum[0]
    for k in range(1, len(r.t)):
        integral += (r.t[k] - r.t[k - 1]) * (known[k] + residual)
        residual = bandwidth * (momentum[k] - integral)
        found[k] = residual
    return found


METHODS = {
    'momentum observer': Method(momentum_observer, BANDWIDTHS),
    'Kalman filter, d a random walk': Method(kalman_filter, BANDWIDTHS),
    FIXED: Method(this_observer_fixed, BANDWIDTHS),
    OURS: Method(this_observer),
}
DRAWN = ('momentum observer', FIXED, OURS)


def conditions(data: Path) -> tuple[dict[str, list[Fold]], dict[str, float]]:
    """Return model and peers from the first half of the bag, judged on the second; and remarks."""
    whole = read(data)
    half = len(whole.t) // 2
    first, second = (cut(whole, part) for part in (slice(half), slice(half, None)))
    constants, offset, explained = identify(first)
    first, second = (r._replace(d=r.d - offset) for r in (first, second))
    found = {'second half': [Fold(model('joint_torque', constants), [first], [second])]}
    return found, constants | {'offset': offset, 'R2': explained}


def cut(r: Recorded, part: slice) -> Recorded:
    """Return a part of a recording."""
    t = r.t[part]
    return Recorded(r.name, t, r.y[part], r.u[part], r.d[part], t > t[0] + SETTLED)


def short() -> dict[str, list[Fold]]:
    """Return a fold of two short simulations of the shoulder, below an elbow that is moved."""
    p = model('joint_torque')
    inputs = (-1.57, 0.1), (0.0, 0.1), (0.0, 0.5)
    both = [
        r._replace(d=r.d * inertia(p, r))
        for r in simulated(p, 2, RATE, 0.02, (20.0, 6.0), inputs, SETTLED, 4.0)
    ]
    return {'simulated': [Fold(p, both[:1], both[1:])]}
