# SPDX-License-Identifier: Apache-2.0
"""Flights in RotorPy (PyPI: rotorpy): an AscTec Hummingbird in the wind, with its sensors."""

from collections.abc import Callable
from typing import Any

from fhaosmo_ros.core.parameters.errors import ConfigurationError
import numpy as np
from scipy.spatial.transform import Rotation
from studies.harness import Floats

RATE = 100.0
"""Of the simulation and of the sensors (Hz)."""
NEEDED = "pip install '.[recipes]'"


def fly(
    duration: float, seed: int, wind: Callable[[float], Floats], gyroscope: dict[str, Floats]
) -> dict[str, Floats]:
    """
    Fly a circle in the wind and return what was measured, a row a sample, and the truth.

    Parameters
    ----------
    duration : float
        Seconds.
    seed : int
        Of all noise.
    wind : callable
        Wind (m/s, three numbers) at a time (s).
    gyroscope : dict
        `initial_bias`, `noise_density`, `random_walk` of RotorPy's Imu.

    Returns
    -------
    dict of arrays
        `t`; `position` (N, 3) and `attitude` (N, 4) of motion capture; `thrust` (N, 3), commanded
        thrust over mass in the world by that attitude (m/s²); `rate` (N, 3) of the gyroscope;
        `wind` (N, 3), `bias` (N, 3): the truth.

    """
    try:
        from rotorpy.controllers.quadrotor_control import SE3Control
        from rotorpy.sensors.external_mocap import MotionCapture
        from rotorpy.sensors.imu import Imu
        from rotorpy.trajectories.circular_traj import ThreeDCircularTraj
        from rotorpy.vehicles.hummingbird_params import quad_params
        from rotorpy.vehicles.multirotor import Multirotor
    except ImportError as error:
        raise ConfigurationError(f'RotorPy is not installed here: {NEEDED} ({error})') from None
    np.random.seed(seed)  # noqa: NPY002 (RotorPy draws from the global generator)
    vehicle, control = Multirotor(quad_params), SE3Control(quad_params)
    circle = ThreeDCircularTraj(freq=np.full(3, 0.1), yaw_bool=True)
    cameras, imu = MotionCapture(RATE), Imu(gyroscope_params=gyroscope, sampling_rate=RATE)
    state: dict[str, Any] = {k: np.array(v, float) for k, v in vehicle.initial_state.items()}
    state['x'] = circle.update(0.0)['x']
    rows, thrust, before = [], np.zeros(3), state['w']
    for t in np.arange(0.0, duration, 1.0 / RATE):
        seen = cameras.measurement(state, with_noise=True)
        turning = state | {'w': (before + state['w']) / 2.0}  # mean of the interval
        rate = imu.measurement(turning, {'vdot': np.zeros(3), 'wdot': np.zeros(3)})['gyro']
        state['wind'] = wind(t)
        row = (t, seen['x'], seen['q'], thrust, rate, state['wind'], imu.gyro_bias)
        rows.append([np.copy(value) for value in row])
        command = control.update(t, state, circle.update(t))
        up = Rotation.from_quat(seen['q']).as_matrix()[:, 2]
        thrust = command['cmd_thrust'] / quad_params['mass'] * up
        before = state['w']
        state = vehicle.step(state, command, 1.0 / RATE)
    names = ('t', 'position', 'attitude', 'thrust', 'rate', 'wind', 'bias')
    return {name: np.array(column) for name, *column in zip(names, *rows, strict=True)}


def gusts(seed: int, steps: bool) -> Callable[[float], Floats]:
    """
    Return a wind along x and y: steps at random times, or turbulence about a mean wind.

    Turbulence is that of Dryden in its first-order form: noise behind a low pass with a length
    scale of 10 m at a mean wind of 4 m/s.
    """
    rng = np.random.default_rng(seed)
    if steps:
        times = np.cumsum(rng.exponential(4.0, 60))
        levels = rng.uniform(-6.0, 6.0, (61, 2))
        return lambda t: np.append(levels[np.searchsorted(times, t)], 0.0)
    step, size = 1.0 / RATE, 1.5
    keep = np.exp(-step / (10.0 / 4.0))
    moved = rng.standard_normal((12_000, 2)) * size * np.sqrt(1.0 - keep**2)
    mean, turbulence = rng.uniform(-4.0, 4.0, 2), np.zeros((12_000, 2))
    for k in range(1, 12_000):
        turbulence[k] = keep * turbulence[k - 1] + moved[k]
    return lambda t: np.append(mean + turbulence[round(t / step)], 0.0)
