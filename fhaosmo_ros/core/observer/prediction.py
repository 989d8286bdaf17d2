# SPDX-License-Identifier: Apache-2.0
"""
The observer's model on its own: what it says of the time between two samples (D 1, D 17).

The state that is predicted lies in ``work.stages[NOW]``: z_1 .. z_n, d, .. in row 0, and their
derivatives along gamma in row 1.
"""

import math

from fhaosmo_ros.core.compiled.cache import compiled
from fhaosmo_ros.core.model.bytecode import Floats
from fhaosmo_ros.core.model.integrate import (
    begin_step,
    CLASSICAL_DIVIDED,
    NOW,
    take_slope,
    triangular_rates,
)
from fhaosmo_ros.core.observer.arrays import Law, State, TILDE, Work, Y

MOST_STEPS = 4000
"""Steps of one prediction, whatever the interval: bounds what a sample may cost."""
METHOD = CLASSICAL_DIVIDED


@compiled()
def predict_step(law: Law, work: Work, h: float, u: Floats) -> None:
    """Integrate D 1 and D 17 over `h` by one step of the classical Runge-Kutta method."""
    stages = work.stages
    begin_step(stages)
    for stage in range(METHOD.nodes.size):
        triangular_rates(law.model, 0.0, u, work.stack, stages)
        take_slope(METHOD, stage, h, stages)


@compiled()
def predict(law: Law, work: Work, h: float, u: Floats, longest: float) -> None:
    """Integrate over `h` in equal steps of at most `longest`."""
    count = 1
    if h > longest:
        count = int(min(math.ceil(h / longest * (1.0 - 1e-9)), MOST_STEPS))
    for _ in range(count):
        predict_step(law, work, h / count, u)


@compiled()
def begin_at_estimates(work: Work, state: State) -> None:
    """Begin a prediction at the last sample and the internal estimates."""
    now = work.stages[NOW]
    for i in range(now.shape[1]):
        now[0, i] = state.levels[TILDE, i - 1] if i > 0 else state.memory[Y]
        now[1, i] = 0.0


@compiled()
def predicted_measurement(
    law: Law, work: Work, state: State, h: float, u: Floats, count: int
) -> float:
    """Return y after `count` steps of `h` from the present estimates."""
    begin_at_estimates(work, state)
    for _ in range(count):
        predict_step(law, work, h, u)
    return float(work.stages[NOW, 0, 0])
