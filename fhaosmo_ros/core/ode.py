# SPDX-License-Identifier: Apache-2.0
"""
Plant and observer as one system of differential equations, integrated with a fixed step.

This is how the paper simulates: in continuous time, the observer sees y = z_1 at every stage of
the solver. The right-hand side is the explicit scheme's own (D 2 to D 7 in docs/mathematics.md),
the solvers are those a fixed-step simulation offers: `ode1` (Euler), `ode3` (Bogacki-Shampine),
`ode4` (classical Runge-Kutta).
"""

from fhaosmo_ros.core import cascade, layout, levant
from fhaosmo_ros.core.borrowed import borrowed
from fhaosmo_ros.core.disturbance import disturbance
from fhaosmo_ros.core.law import (
    ADAPTIVE,
    DEAD_ZONE,
    DELAY,
    GAMMA_INITIAL,
    Law,
    LEAKAGE,
    LEVANT,
    make_work,
    MAX,
    MIN,
    RATE,
)  # fmt: skip
from fhaosmo_ros.core.layout import HAT, ROWS, TILDE
from fhaosmo_ros.core.tape import evaluate, Floats, Ints
from numba import njit
import numpy as np

SOLVERS = ('ode1', 'ode3', 'ode4')
# Stage k of each of them starts from the slope of stage k - 1 alone, at the same node.
STAGES = np.array([1, 3, 4])
NODES = np.array([[0.0, 0.0, 0.0, 0.0], [0.0, 0.5, 0.75, 0.0], [0.0, 0.5, 0.5, 1.0]])
WEIGHTS = np.array(
    [[1.0, 0.0, 0.0, 0.0], [2 / 9, 1 / 3, 4 / 9, 0.0], [1 / 6, 1 / 3, 1 / 3, 1 / 6]]
)


@njit(cache=True, error_model='numpy', forceinline=True)
def rates(
    flags: Ints, gains: Floats, curves: Floats, scalars: Floats, tape: Floats, offsets: Ints,
    x: Floats, m: Floats, stack: Floats,
    plant_tape: Floats, plant_offsets: Ints, kind: int, wave: Floats, point: Floats,
    state: Floats, out: Floats, stage: int, t: float, wait: float,
) -> float:  # fmt: skip
    """
    Write d(state)/dt into a row of `out`; the state is z, then the levels row by row, then gamma.

    Parameters
    ----------
    x, m, stack : arrays
        Scratch memory of the recursion.
    plant_tape, plant_offsets, kind, wave : arrays and int
        The plant's Phi and its d(t); the observer's model need not be the plant's.
    point : (2, n) array
        Scratch memory; row 1 stays 0.
    wait : float
        Time (s) until gamma leaks, if the innovations stay small.

    Returns
    -------
    float
        L.

    """
    n, levels = point.shape[1], gains.shape[1]
    for i in range(n):
        point[0, i] = state[i]
    for i in range(n):  # P triangular
        phi, _ = evaluate(plant_tape, plant_offsets[i], plant_offsets[i + 1], point, 0.0, stack)
        follower = state[i + 1] if i + 1 < n else disturbance(kind, wave, t)
        out[stage, i] = follower + phi
    for r in range(ROWS):
        for i in range(levels):
            x[r, i] = state[n + r * levels + i]
    gamma = state[n + ROWS * levels]
    # A forward Euler step of length 1 moves the state by its rate.
    if flags[LEVANT]:
        loss, gradient = levant.explicit(
            flags, gains, curves, tape, offsets, x, m, stack, gamma, state[0], 1.0, 0.0
        )
    else:
        loss, gradient = cascade.explicit(
            flags, gains, curves, scalars, tape, offsets, x, m, stack, gamma, state[0], 1.0, 0.0
        )
    for r in range(ROWS):
        for i in range(levels):
            k = n + r * levels + i
            out[stage, k] = x[r, i] - state[k]
    slope = 0.0
    if flags[ADAPTIVE]:
        rests = loss <= scalars[DEAD_ZONE] * scalars[DEAD_ZONE]
        if not rests:
            slope = -scalars[RATE] * gradient  # P adaptationlawgamma
        if scalars[DEAD_ZONE] == 0.0 or (rests and wait <= 0.0):
            slope -= scalars[LEAKAGE] * (gamma - scalars[GAMMA_INITIAL])
    out[stage, n + ROWS * levels] = slope
    return loss


@njit(cache=True, error_model='numpy', nogil=True)
def integrate(
    flags: Ints, gains: Floats, curves: Floats, scalars: Floats, tape: Floats, offsets: Ints,
    x: Floats, m: Floats, stack: Floats,
    plant_tape: Floats, plant_offsets: Ints, kind: int, wave: Floats, point: Floats,
    state: Floats, slopes: Floats, stages: int, nodes: Floats, weights: Floats,
    h: float, every: int, rows: Floats,
) -> None:  # fmt: skip
    """
    Integrate in place and record every `every`-th state, the first one included.

    Parameters
    ----------
    state : (2, S) array
        The state, and scratch memory for the point of a stage.
    slopes : (4, S) array
        Scratch memory.
    stages, nodes, weights : int and (4,) arrays
        The solver: a row of `STAGES`, `NODES`, `WEIGHTS`.
    h : float
        Step in seconds.
    rows : (K, S) array
        Receives the states at 0, every * h, 2 * every * h, ...

    """
    flags, gains, curves, scalars = (
        borrowed(flags), borrowed(gains), borrowed(curves), borrowed(scalars)
    )  # fmt: skip
    tape, offsets, x, m = borrowed(tape), borrowed(offsets), borrowed(x), borrowed(m)
    stack, plant_tape, plant_offsets = (
        borrowed(stack),
        borrowed(plant_tape),
        borrowed(plant_offsets),
    )
    wave, point, slopes = borrowed(wave), borrowed(point), borrowed(slopes)
    now, at = borrowed(state[0]), borrowed(state[1])
    size, count = state.shape[1], rows.shape[0]
    for i in range(size):
        rows[0, i] = now[i]
    wait, loss = 0.0, 0.0
    for k in range((count - 1) * every):
        t = k * h
        for stage in range(stages):
            step = nodes[stage] * h
            for i in range(size):
                at[i] = now[i]
                if stage > 0:
                    at[i] += step * slopes[stage - 1, i]
            found = rates(
                flags, gains, curves, scalars, tape, offsets, x, m, stack, plant_tape,
                plant_offsets, kind, wave, point, at, slopes, stage, t + step, wait,
            )  # fmt: skip
            if stage == 0:
                loss = found
        for i in range(size):
            for stage in range(stages):
                now[i] += h * weights[stage] * slopes[stage, i]
        if flags[ADAPTIVE]:  # projection (D 8)
            now[size - 1] = min(max(now[size - 1], scalars[MIN]), scalars[MAX])
            rests = loss <= scalars[DEAD_ZONE] * scalars[DEAD_ZONE]
            wait = max(wait - h, 0.0) if rests else scalars[DELAY]
        if (k + 1) % every == 0:
            for i in range(size):
                rows[(k + 1) // every, i] = now[i]


def solve(
    law: Law, depth: int, system: tuple[Floats, Ints, int, Floats], z: Floats, levels: Floats,
    gamma: float, solver: str, h: float, every: int, count: int,
) -> Floats:  # fmt: skip
    """
    Return `count` states, `every` steps of `h` apart, as rows (z, levels row by row, gamma).

    Parameters
    ----------
    law : Law
        The observer; its scheme is not used.
    depth : int
        Stack size that the tapes of plant and observer need.
    system : tuple
        The plant's tape and offsets, kind of d and its numbers (see disturbance.py).
    z, levels : (n,) and (4, N) arrays
        Initial states.
    solver : {'ode1', 'ode3', 'ode4'}

    """
    index = SOLVERS.index(solver)
    state = np.zeros((2, len(z) + levels.size + 1))
    state[0] = np.concatenate([z, levels.ravel(), [gamma]])
    rows = np.empty((count, state.shape[1]))
    tape, offsets, kind, wave = system
    integrate(
        *law, *make_work(law, depth),
        tape, offsets, kind, wave, np.zeros((2, len(z))), state, np.zeros((4, state.shape[1])),
        int(STAGES[index]), NODES[index], WEIGHTS[index], h, every, rows,
    )  # fmt: skip
    return rows


def unpack(rows: Floats, n: int) -> tuple[Floats, Floats, Floats, Floats]:
    """Return z (K, n), z_hat and z_tilde (K, N) and gamma (K,) of rows that `solve` returned."""
    levels = rows[:, n:-1].reshape(len(rows), layout.ROWS, -1)
    return rows[:, :n], levels[:, HAT], levels[:, TILDE], rows[:, -1]
