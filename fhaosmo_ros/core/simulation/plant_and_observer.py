# SPDX-License-Identifier: Apache-2.0
"""
Plant and observer as one system of differential equations, integrated with a fixed step.

This is how the paper simulates: in continuous time, the observer sees y = z_1 at every stage of
the solver. The right-hand side is the explicit scheme's own (D 2 to D 7 in docs/mathematics.md).
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

from fhaosmo_ros.core.compiled.cache import compiled
from fhaosmo_ros.core.compiled.unowned_arrays import unowned
from fhaosmo_ros.core.model.bytecode import Floats
from fhaosmo_ros.core.model.integrate import (
    begin_step,
    BOGACKI_SHAMPINE,
    CLASSICAL,
    EULER,
    Method,
    NOW,
    POINT,
    SLOPE,
    take_slope,
    triangular_rates,
)
from fhaosmo_ros.core.model.triangular import TriangularModel
from fhaosmo_ros.core.observer import cascade, levant
from fhaosmo_ros.core.observer.arrays import (
    ADAPTIVE,
    ALPHA,
    DEAD_ZONE,
    DELAY,
    GAMMA_INITIAL,
    HAT,
    LAMBDA,
    Law,
    LEAKAGE,
    LEVANT,
    make_work,
    MAX,
    MIN,
    RATE,
    ROWS,
    SIGN,
    TILDE,
    Work,
)
from fhaosmo_ros.core.observer.configuration import ObserverConfiguration, per_level
from fhaosmo_ros.core.parameters.errors import ConfigurationError
from fhaosmo_ros.core.parameters.tables import PLANT_PARAMETERS
from fhaosmo_ros.core.simulation.disturbance import disturbance, disturbances
from fhaosmo_ros.core.simulation.plant import make_system, System, unknown_input
import numpy as np


class Solver(NamedTuple):
    """
    How plant and observer are integrated.

    Attributes
    ----------
    method : Method
    holds_sign : bool
        True if sign(eps_i) is taken at the first stage of a step and held for its other stages,
        as simulators with zero-crossing detection do with their sign block. All else, |eps_i|
        included, follows every stage. For the variants with sign; a fuzzy curve is not held.

    """

    method: Method
    holds_sign: bool = False


SOLVERS = {
    'ode1': Solver(EULER),
    'ode3': Solver(BOGACKI_SHAMPINE),
    'ode4': Solver(CLASSICAL),
    'ode4 held': Solver(CLASSICAL, holds_sign=True),
}
"""What a fixed-step simulation offers, by its usual names."""


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


class _Joint(NamedTuple):
    """
    Plant and observer; the state is z, then the levels row by row, then gamma.

    The observer's model need not be the plant's. Its scheme is not used. Known inputs u are 0.
    `free` is its law without injections (lambda = alpha = 0). `signs` holds sign(eps_i), or is
    empty if they are not held.
    """

    plant: System
    law: Law
    work: Work
    u: Floats
    free: Law
    signs: Floats


@compiled(forceinline=True)
def observer_rates(joint: _Joint, law: Law, state: Floats, slopes: Floats) -> tuple[float, float]:
    """Write the rates of the observer's levels by one of its laws; return L and dL/dgamma."""
    work, u = joint.work, joint.u
    x, levels = work.x, work.x.shape[1]
    size = ROWS * levels + 1
    n = state.size - size
    for r in range(ROWS):
        for i in range(levels):
            x[r, i] = state[n + r * levels + i]
    gamma = state[n + ROWS * levels]
    # A forward Euler step of length 1 moves the state by its rate.
    if law.flags[LEVANT]:
        loss, gradient = levant.explicit(law, work, gamma, state[0], 1.0, u)
    else:
        loss, gradient = cascade.explicit(law, work, gamma, state[0], 1.0, u)
    for r in range(ROWS):
        for i in range(levels):
            k = n + r * levels + i
            slopes[k] = x[r, i] - state[k]
    return loss, gradient


@compiled()
def hold_signs(joint: _Joint, state: Floats, slopes: Floats, first: bool) -> None:
    """
    Remember the signs of the innovations, or replace those behind `slopes` by the held ones.

    Parameters
    ----------
    state, slopes : (S,) arrays
        The observer's rates are those of the sign at this state, and are changed in place.
    first : bool
        True at the first stage of a step.

    """
    levels = joint.signs.size
    n = state.size - ROWS * levels - 1
    free = slopes[:0]
    for i in range(levels):
        hat, measured = n + i, state[0]
        if joint.law.flags[LEVANT]:
            hat = n
        elif i > 0:
            measured = state[n + levels + i - 1]
        sign = np.sign(measured - state[hat])
        if first:
            joint.signs[i] = sign
        elif joint.signs[i] != sign:
            if not free.size:
                free = np.empty(state.size)
                observer_rates(joint, joint.free, state, free)
            for k in (n + i, n + levels + i):  # HAT, TILDE: what the injections add
                slopes[k] = free[k] + joint.signs[i] * sign * (slopes[k] - free[k])


@compiled(forceinline=True)
def rates(
    joint: _Joint, state: Floats, slopes: Floats, t: float, wait: float, first: bool
) -> float:
    """
    Write the rates of a state.

    Parameters
    ----------
    joint : _Joint
    state, slopes : (S,) arrays
    t : float
        Seconds.
    wait : float
        Time (s) until gamma leaks, if the innovations stay small.
    first : bool
        True at the first stage of a step.

    Returns
    -------
    float
        L.

    """
    plant, law = joint.plant, joint.law
    c, n = law.scalars, plant.stages.shape[2]
    for i in range(n):
        plant.stages[POINT, 0, i] = state[i]
    d = disturbance(plant.kind, plant.wave, t)
    triangular_rates(plant.model, d, joint.u, plant.stack, plant.stages)
    for i in range(n):
        slopes[i] = plant.stages[SLOPE, 0, i]
    loss, gradient = observer_rates(joint, law, state, slopes)
    if joint.signs.size:
        hold_signs(joint, state, slopes, first)
    slope, gamma = 0.0, state[state.size - 1]
    if law.flags[ADAPTIVE]:
        rests = loss <= c[DEAD_ZONE] * c[DEAD_ZONE]
        if not rests:
            slope = -c[RATE] * gradient  # P adaptationlawgamma
        if c[DEAD_ZONE] == 0.0 or (rests and wait <= 0.0):
            slope -= c[LEAKAGE] * (gamma - c[GAMMA_INITIAL])
    slopes[state.size - 1] = slope
    return loss


@compiled(nogil=True)
def integrate(
    joint: _Joint, method: Method, stages: Floats, h: float, every: int, rows: Floats
) -> None:
    """
    Integrate and record every `every`-th state, the first one included.

    Parameters
    ----------
    joint : _Joint
    method : Method
        The solver.
    stages : (4, 1, S) array
        ``stages[NOW]`` is the initial state; the rest is scratch memory.
    h : float
        Step in seconds.
    rows : (K, S) array
        Receives the states at 0, every * h, 2 * every * h, ...

    """
    joint, stages = unowned(joint), unowned(stages)
    c, now = joint.law.scalars, stages[NOW, 0]
    size, count = stages.shape[2], rows.shape[0]
    for i in range(size):
        rows[0, i] = now[i]
    wait, loss = 0.0, 0.0
    for k in range((count - 1) * every):
        t = k * h
        begin_step(stages)
        for stage in range(method.nodes.size):
            time = t + method.nodes[stage] * h
            found = rates(joint, stages[POINT, 0], stages[SLOPE, 0], time, wait, stage == 0)
            if stage == 0:
                loss = found
            take_slope(method, stage, h, stages)
        if joint.law.flags[ADAPTIVE]:  # projection (D 8)
            now[size - 1] = min(max(now[size - 1], c[MIN]), c[MAX])
            rests = loss <= c[DEAD_ZONE] * c[DEAD_ZONE]
            wait = max(wait - h, 0.0) if rests else c[DELAY]
        if (k + 1) % every == 0:
            for i in range(size):
                rows[(k + 1) // every, i] = now[i]


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
    solver : {'ode1', 'ode3', 'ode4', 'ode4 held'}
        Euler, Bogacki-Shampine, classical Runge-Kutta, the same with held signs; see `Solver`.
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
    if configuration.self_tuning:
        raise ConfigurationError(
            "parameter 'gains': expected fixed for a solver's steps, got 'self_tuning'"
        )
    p = PLANT_PARAMETERS.complete(plant)
    model = TriangularModel.of(p)
    z = per_level(PLANT_PARAMETERS['initial_state'], p['initial_state'], model.order)
    levels = configuration.initial_state().levels[:ROWS]
    if configuration.parameters['start_from_measurement']:
        levels[HAT, 0] = z[0]
    system = make_system(model, *unknown_input(p))
    inputs = max(len(model.inputs), len(configuration.model.inputs))
    law, depth = configuration.law, max(model.depth, configuration.model.depth)
    state = np.concatenate([z, levels.ravel(), [configuration.gamma_initial]])
    stages = np.zeros((4, 1, len(state)))
    stages[NOW, 0] = state
    rows = np.empty((round(duration / step) // every + 1, len(state)))
    method, holds = SOLVERS[solver]
    free = law._replace(gains=law.gains.copy())
    free.gains[[LAMBDA, ALPHA]] = 0.0
    signs = np.zeros(configuration.levels if holds and law.flags[SIGN] else 0)
    joint = _Joint(system, law, make_work(law, depth), np.zeros(inputs), free, signs)
    integrate(joint, method, stages, step, every, rows)
    t = np.arange(len(rows), dtype=np.float64) * (every * step)
    n = model.order
    found = rows[:, n:-1].reshape(len(rows), ROWS, -1)
    d = disturbances(system.kind, system.wave, t)
    return JointRun(t, rows[:, :n], d, found[:, HAT], found[:, TILDE], rows[:, -1])
