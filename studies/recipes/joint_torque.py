# SPDX-License-Identifier: Apache-2.0
"""Torque at the shoulder of a two-joint robot, beside the wrench that was measured there."""

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

from fhaosmo_ros.tools.bags.reader import BagReader
import numpy as np
from scipy.signal import butter, filtfilt, savgol_filter
from studies.harness import Floats
from studies.recipes import judging
from studies.recipes.judging import FIXED, Fold, kalman_filter, Method, OURS, Recipe, Recorded

JOINTS, WRENCH = '/pndbt/joint_states', '/pndbt/netft_data'
RATE = 200.0  # of the joint states (Hz)
CUTOFF = 15.0  # of the zero-phase low pass of the measured torque (Hz), as its recorders used it
WINDOW, SLIDING, SETTLED = 31, 0.05, 0.5
"""Samples of the smoother that identifies the model, offline; rad/s; s."""
BANDWIDTHS = np.geomspace(10.0, 300.0, 14).tolist()


def read(path: Path) -> Recorded:
    """Return the shoulder's speed, the angles and the elbow's speed, and the measured torque."""
    with BagReader(path) as bag:
        messages = bag.read_all([JOINTS, WRENCH])
    rows: dict[str, list[list[float]]] = {JOINTS: [], WRENCH: []}
    for topic, _, message in messages:
        stamp = message.header.stamp.sec + message.header.stamp.nanosec * 1e-9
        joints = topic == JOINTS
        values = [*message.position, *message.velocity] if joints else [-message.wrench.torque.z]
        rows[topic].append([stamp, *values])
    t, angle, elbow, speed, elbow_speed = np.array(rows[JOINTS]).T
    measured, wrench = np.array(rows[WRENCH]).T
    low_pass = butter(2, CUTOFF, fs=len(wrench) / np.ptp(measured))
    shoulder = np.interp(t, measured, filtfilt(*low_pass, wrench))
    u = np.column_stack([angle, np.unwrap(elbow), elbow_speed])
    return Recorded(path.stem, t - t[0], speed, u, shoulder, SETTLED)


def identify(r: Recorded) -> tuple[dict[str, float], float]:
    """
    Return the model's constants, and the offset of the wrench.

    Least squares on the equations of both joints, with derivatives by a Savitzky-Golay smoother,
    which uses the future: with absolute angle s = q1 + q2 of link 2,

        torque = p q1'' + h (cos q2 s'' - sin q2 s'²) + g1 cos q1 + v q1' + c sign q1' + offset
        s'' = -(h/i) (cos q2 q1'' + sin q2 q1'²) - k cos s - friction        (the elbow is free)
    """
    period = 1.0 / RATE
    t = np.arange(r.t[0], r.t[-1], period)
    angle, elbow, torque = (np.interp(t, r.t, x) for x in (r.u[:, 0], r.u[:, 1], r.d))
    speed, elbow_speed = (savgol_filter(x, WINDOW, 3, 1, period) for x in (angle, elbow))
    acceleration, of_elbow = (savgol_filter(x, WINDOW, 3, 2, period) for x in (angle, elbow))
    absolute, turning = acceleration + of_elbow, speed + elbow_speed
    cos, sin = np.cos(elbow), np.sin(elbow)
    table = [
        acceleration, cos * absolute - sin * turning**2, np.cos(angle), speed,
        np.tanh(speed / SLIDING), np.ones_like(t),
    ]  # fmt: skip
    p, h, g1, v, c, offset = np.linalg.lstsq(np.array(table).T, torque, rcond=None)[0].tolist()
    of_elbow = [
        -cos * acceleration - sin * speed**2, -np.cos(angle + elbow), elbow_speed,
        np.tanh(elbow_speed),
    ]  # fmt: skip
    ratio, k = np.linalg.lstsq(np.array(of_elbow).T, absolute, rcond=None)[0][:2].tolist()
    return {'p': p, 'h': h, 'r': h * ratio, 'g1': g1, 'k': k, 'v': v, 'c': c}, offset


def torque(method: judging.Estimate, p: Mapping[str, Any], r: Recorded, number: float) -> Floats:
    """Return the torque by what a method says of d, which is torque / J(q2)."""
    inertia = p['constants.p'] - p['constants.r'] * np.cos(r.u[:, 1]) ** 2
    return method(p, r, number) * inertia


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


def conditions(data: Path) -> dict[str, list[Fold]]:
    """Return model and peers from the first half of the bag, judged on the second."""
    whole = read(data)
    half = len(whole.t) // 2
    first, second = (
        whole._replace(**{name: getattr(whole, name)[part] for name in ('t', 'y', 'u', 'd')})
        for part in (slice(half), slice(half, None))
    )
    constants, offset = identify(first)
    first, second = (r._replace(d=r.d - offset) for r in (first, second))
    return {'second half': [Fold(judging.model('joint_torque', constants), [first], [second])]}


RECIPE = Recipe(
    {
        'momentum observer': Method(momentum_observer, BANDWIDTHS),
        'Kalman filter, d a random walk': Method(partial(torque, kalman_filter), BANDWIDTHS),
        FIXED: Method(partial(torque, judging.this_observer), BANDWIDTHS),
        OURS: Method(partial(torque, judging.this_observer)),
    },
    conditions, 'torque at the shoulder [N m]', ('momentum observer', FIXED, OURS),
    (0.5, 4.7), band=False, data='bag of the pendubot',
)  # fmt: skip
