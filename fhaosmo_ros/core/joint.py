# SPDX-License-Identifier: Apache-2.0
"""Simulate a plant and its observer together, as the paper does (see ode.py)."""

from collections.abc import Mapping
from typing import Any, NamedTuple

from fhaosmo_ros.core import layout
from fhaosmo_ros.core.configuration import ObserverConfiguration, per_level
from fhaosmo_ros.core.disturbance import disturbances, KINDS, NAMES
from fhaosmo_ros.core.errors import ConfigurationError
from fhaosmo_ros.core.model import TriangularModel
from fhaosmo_ros.core.ode import solve, SOLVERS, unpack
from fhaosmo_ros.core.parameters import PLANT_PARAMETERS
import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


class JointRun(NamedTuple):
    """
    Truth and estimates on one time grid.

    Attributes
    ----------
    t : (K,) array
        Seconds.
    z, unknown_input : (K, n) and (K,) arrays
        The plant's states and d.
    z_hat, z_tilde : (K, N) arrays
        Filtered and internal states; z_tilde[:, i] belongs to z_{i+2}.
    gamma : (K,) array

    """

    t: Floats
    z: Floats
    unknown_input: Floats
    z_hat: Floats
    z_tilde: Floats
    gamma: Floats


def simulate(
    observer: Mapping[str, Any],
    plant: Mapping[str, Any],
    solver: str = 'ode3',
    step: float = 1e-3,
    duration: float = 20.0,
    every: int = 1,
) -> JointRun:
    """
    Integrate plant and observer from their initial states over `duration`.

    Parameters
    ----------
    observer, plant : mapping
        Parameters as for `Observer` and `Plant`; scheme, noise and integration_step play no part.
    solver : {'ode1', 'ode3', 'ode4'}
        Euler, Bogacki-Shampine, classical Runge-Kutta.
    step : float
        Fixed step in seconds.
    duration : float
        Simulated seconds.
    every : int
        Record every `every`-th step.

    Raises
    ------
    ConfigurationError
        A bad parameter, or one of the arguments here.

    """
    if solver not in SOLVERS:
        raise ConfigurationError(f'solver: expected one of {", ".join(SOLVERS)}, got {solver!r}')
    if not 0.0 < step <= duration < float('inf'):
        raise ConfigurationError(
            f'step: expected 0 < step <= duration (s), got {step} and {duration}'
        )
    if every < 1:
        raise ConfigurationError(f'every: expected an integer >= 1, got {every}')
    configuration = ObserverConfiguration(observer)
    p = PLANT_PARAMETERS.defaults() | PLANT_PARAMETERS.coerce(plant)
    model = TriangularModel(p['phi'], p['order'])
    z = per_level(PLANT_PARAMETERS['initial_state'], p['initial_state'], model.order)
    levels = np.zeros((layout.ROWS, configuration.levels))
    levels[layout.HAT] = configuration.initial_estimate
    levels[layout.TILDE] = configuration.initial_internal
    if configuration.parameters['start_from_measurement']:
        levels[layout.HAT, 0] = z[0]
    wave = np.array([p[f'disturbance_{name}'] for name in NAMES], dtype=np.float64)
    system = (model.tape, model.offsets, KINDS.index(p['disturbance']), wave)
    count = round(duration / step) // every + 1
    depth = max(model.depth, configuration.model.depth)
    rows = solve(
        configuration.law,
        depth,
        system,
        z,
        levels,
        configuration.gamma_initial,
        solver,
        step,
        every,
        count,
    )
    t = np.arange(count, dtype=np.float64) * (every * step)
    d = disturbances(system[2], wave, t)
    truth, *estimate = unpack(rows, model.order)
    return JointRun(t, truth, d, *estimate)
