# SPDX-License-Identifier: Apache-2.0
"""
The one Runge-Kutta integrator, with its methods as tables of numbers.

Plant, prediction, and the simulation of plant and observer together differ in their rates of
change only. Each fills ``stages[NOW]``, and then for every step::

    begin_step(stages)
    for stage in range(method.nodes.size):
        ...  # write the rates at stages[POINT] into stages[SLOPE]
        take_slope(method, stage, h, stages)

after which ``stages[NOW]`` is the state one step later.
"""

from typing import NamedTuple

from fhaosmo_ros.core.compiled.cache import compiled
from fhaosmo_ros.core.model.bytecode import Bytecode, evaluate, Floats
import numpy as np

NOW, POINT, TOTAL, SLOPE = range(4)
"""
Parts of an array ``stages`` of shape (4, rows, n): the state, where the rates are evaluated, the
state after the step as far as it has been added up, and the rates. Row 0 holds the values; row 1,
where there is one, their derivatives in some direction.
"""


class Method(NamedTuple):
    """
    An explicit Runge-Kutta method in which stage k starts from the slope of stage k - 1 alone.

    Attributes
    ----------
    nodes : (stages,) array
        When a stage is evaluated, as a part of the step.
    weights, divisors : (stages,) arrays
        A stage's slope counts for h * weight / divisor.

    """

    nodes: Floats
    weights: Floats
    divisors: Floats


def _method(nodes: list[float], weights: list[float], divisors: list[float]) -> Method:
    return Method(np.array(nodes), np.array(weights), np.array(divisors))


EULER = _method([0.0], [1.0], [1.0])
"""Explicit Euler, of order 1 (`ode1` of a fixed-step simulation)."""
BOGACKI_SHAMPINE = _method([0.0, 0.5, 0.75], [2 / 9, 1 / 3, 4 / 9], [1.0] * 3)
"""Of order 3 (`ode3`). Bogacki and Shampine 1989, doi:10.1016/0893-9659(89)90079-7."""
CLASSICAL = _method([0.0, 0.5, 0.5, 1.0], [1 / 6, 1 / 3, 1 / 3, 1 / 6], [1.0] * 4)
"""The classical method of order 4 (`ode4`)."""
CLASSICAL_DIVIDED = _method([0.0, 0.5, 0.5, 1.0], [1.0] * 4, [6.0, 3.0, 3.0, 6.0])
"""
The same with the shares h / 6 and h / 3 instead of h * (1 / 6) and h * (1 / 3).

They differ in the last bit. The observer's prediction has always used these and the simulations
the others; with both, results agree bit for bit with those of bags recorded before.
"""


@compiled(forceinline=True)
def begin_step(stages: Floats) -> None:
    """Begin a step at ``stages[NOW]``."""
    for r in range(stages.shape[1]):
        for i in range(stages.shape[2]):
            stages[POINT, r, i] = stages[TOTAL, r, i] = stages[NOW, r, i]


@compiled(forceinline=True)
def take_slope(method: Method, stage: int, h: float, stages: Floats) -> None:
    """Add up the slope of a stage and go to the point of the next one, or end the step."""
    share = h * method.weights[stage] / method.divisors[stage]
    last = stage + 1 == method.nodes.size
    reach = 0.0 if last else method.nodes[stage + 1] * h
    for r in range(stages.shape[1]):
        for i in range(stages.shape[2]):
            stages[TOTAL, r, i] += share * stages[SLOPE, r, i]
            if last:
                stages[NOW, r, i] = stages[TOTAL, r, i]
            else:
                stages[POINT, r, i] = stages[NOW, r, i] + reach * stages[SLOPE, r, i]


@compiled(forceinline=True)
def triangular_rates(
    model: Bytecode, drive: float, u: Floats, stack: Floats, stages: Floats
) -> None:
    """
    Write the rates of P triangular, and their derivatives, at ``stages[POINT]``.

    Parameters
    ----------
    model : Bytecode
        Phi_1 .. Phi_n.
    drive : float
        What the last state is driven by beside Phi_n: d, or 0.
    u : (m,) array
        Known inputs.
    stack : (2, depth) array
        Scratch memory.
    stages : (4, 2, n) array

    """
    point, n = stages[POINT], stages.shape[2]
    for i in range(n):
        phi, dphi = evaluate(model, i, point, u, stack)
        follower, dfollower = drive, 0.0
        if i + 1 < n:
            follower, dfollower = point[0, i + 1], point[1, i + 1]
        stages[SLOPE, 0, i] = follower + phi
        stages[SLOPE, 1, i] = dfollower + dphi
