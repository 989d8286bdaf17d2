# SPDX-License-Identifier: Apache-2.0
"""
Wind on a multirotor, and bias of its gyroscope: flights in RotorPy (PyPI: rotorpy).

An AscTec Hummingbird flies a circle. Wind comes from its position and its thrust, the bias from a
heading that has none.
"""

from collections.abc import Callable
from typing import Any

from fhaosmo_ros.core import ConfigurationError
import numpy as np
from scipy.signal import lfilter
from scipy.spatial.transform import Rotation
from studies.harness import Floats
from studies.recipes import judging
from studies.recipes.judging import FIXED, Fold, Method, OURS, Recipe, Recorded

RATE = 100.0  # of the simulation and of the sensors (Hz)


def fly(
    duration: float, seed: int, wind: Callable[[float], Floats], gyroscope: dict[str, Floats]
) -> dict[str, Floats]:
    """
    Fly a circle in a wind (m/s by time) and return what was measured, a row a sample.

    `seed` is of all noise; `gyroscope` has `initial_bias`, `noise_density` and `random_walk` of
    RotorPy's Imu. `position` (N, 3) and `attitude` (N, 4) are of motion capture; `thrust` (N, 3)
    is commanded thrust over mass in the world by that attitude (m/s²); `rate` (N, 3) is of the
    gyroscope; `wind` (N, 3) and `bias` (N, 3) are the truth.
    """
    try:
        from rotorpy.controllers.quadrotor_control import SE3Control
        from rotorpy.sensors.external_mocap import MotionCapture
        from rotorpy.sensors.imu import Imu
        from rotorpy.trajectories.circular_traj import ThreeDCircularTraj
        from rotorpy.vehicles.hummingbird_params import quad_params
        from rotorpy.vehicles.multirotor import Multirotor
    except ImportError as error:
        needed = "pip install '.[recipes]'"
        raise ConfigurationError(f'RotorPy is not installed here: {needed} ({error})') from None
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
    mean, moved[0] = rng.uniform(-4.0, 4.0, 2), 0.0
    turbulence = lfilter([1.0], [1.0, -keep], moved, axis=0)
    return lambda t: np.append(mean + turbulence[round(t / step)], 0.0)


# Wind

WIND_DURATION, WIND_SETTLED = 40.0, 3.0  # of a flight (s)
QUIET = {
    'initial_bias': np.zeros(3), 'noise_density': np.full(3, 1e-4), 'random_walk': np.zeros(3),
}  # fmt: skip
DIFFERENCE = 'low-passed second difference less thrust'
WIND_BANDWIDTHS = np.geomspace(1.0, 30.0, 10).tolist()


def wind_flight(seed: int) -> list[Recorded]:
    """Return both axes of a flight; d is k times the wind."""
    steps = bool(seed % 2)
    found = fly(WIND_DURATION, seed, gusts(seed, steps), QUIET)
    k, kind = judging.model('wind')['constants.k'], 'steps' if steps else 'turbulence'
    of_axes = (found[name].T for name in ('position', 'thrust', 'wind'))
    return [
        Recorded(f'{kind} {seed}, {name}', found['t'], y, u[:, None], k * wind, WIND_SETTLED)
        for name, y, u, wind in zip('xy', *of_axes, strict=False)
    ]


def winds(_: None) -> dict[str, list[Fold]]:
    """Return the flights with turbulence and those with steps, tuned on both."""
    flights = [wind_flight(seed) for seed in range(6)]
    training = [r for both in flights[:2] for r in both]
    quiet, steps = ([r for f in flights[2 + odd :: 2] for r in f] for odd in (0, 1))
    p = judging.model('wind')
    return {'turbulence': [Fold(p, training, quiet)], 'steps': [Fold(p, training, steps)]}


WIND = Recipe(
    {
        DIFFERENCE: Method(judging.disturbance_observer, WIND_BANDWIDTHS),
        'Kalman filter, wind a random walk': Method(judging.kalman_filter, WIND_BANDWIDTHS),
        FIXED: Method(judging.fixed, WIND_BANDWIDTHS),
        OURS: Method(judging.self_tuning),
    },
    winds, 'wind along the axis [m/s]', (DIFFERENCE, OURS), (3.0, 23.0), scale=2.237,
)  # fmt: skip


# Bias of a gyroscope

BIAS_DURATION, BIAS_SETTLED = 60.0, 10.0
OUTLIERS, JUMP = 0.01, 0.5
"""Share of headings that are wrong, by a normal distribution of this standard deviation (rad)."""
GYROSCOPE = {'noise_density': np.full(3, 5e-4), 'random_walk': np.full(3, 2e-3)}
BIAS_BANDWIDTHS = np.geomspace(0.1, 10.0, 11).tolist()


def bias_flight(seed: int) -> Recorded:
    """Return a flight: heading of motion capture, rate of the gyroscope, minus its bias."""
    rng = np.random.default_rng(seed)
    bias = {'initial_bias': rng.uniform(-0.05, 0.05, 3)}
    found = fly(BIAS_DURATION, seed, gusts(seed, steps=False), GYROSCOPE | bias)
    roll, pitch, yaw = Rotation.from_quat(found['attitude']).as_euler('xyz').T
    t, u = found['t'], np.column_stack([found['rate'][:, 1:], roll, pitch])
    return Recorded(f'flight {seed}', t, np.unwrap(yaw), u, -found['bias'][:, 2], BIAS_SETTLED)


def with_outliers(r: Recorded, seed: int) -> Recorded:
    """Return the recording with some headings that are far off."""
    rng = np.random.default_rng(seed)
    wrong = rng.random(len(r.t)) < OUTLIERS
    return r._replace(y=r.y + wrong * JUMP * rng.standard_normal(len(r.t)))


def biases(_: None) -> dict[str, list[Fold]]:
    """Return the flights as simulated, and with outliers."""
    clean = [bias_flight(seed) for seed in range(5)]
    spoilt = [with_outliers(r, seed) for seed, r in enumerate(clean)]
    both, p = {'as simulated': clean, '1 % wrong headings': spoilt}, judging.model('sensor_bias')
    return {name: [Fold(p, rs[:2], rs[2:])] for name, rs in both.items()}


BIAS = Recipe(
    {
        'complementary filter': Method(judging.complementary_filter, BIAS_BANDWIDTHS),
        'Kalman filter, bias a random walk': Method(judging.kalman_filter, BIAS_BANDWIDTHS),
        OURS: Method(judging.self_tuning),
    },
    biases, 'bias [rad/s]', ('complementary filter', OURS), (0.0, 60.0), scale=-1.0,
)  # fmt: skip
