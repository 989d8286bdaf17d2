# SPDX-License-Identifier: Apache-2.0
"""The policy's steps (see policy.py): from one used sample to the next, also through a gap."""

from fhaosmo_ros.core.compiled.cache import compiled
from fhaosmo_ros.core.model.bytecode import Floats
from fhaosmo_ros.core.model.integrate import NOW
from fhaosmo_ros.core.observer.arrays import (
    BEYOND,
    GAMMA,
    OFFSET,
    PENDING,
    PREDICTING,
    SELF_TUNING,
    SPREAD,
    Y,
)
from fhaosmo_ros.core.observer.prediction import (
    begin_at_estimates,
    predict_step,
    predicted_measurement,
)
from fhaosmo_ros.core.observer.status import (
    FLAGS_MASK,
    GAP,
    JUMPED,
    LEVEL_SHIFT,
    REJECTED,
    REJECTED_SPIKE,
)
from fhaosmo_ros.core.observer.step import innovations, step
from fhaosmo_ros.core.online import memory as at
from fhaosmo_ros.core.online.memory import EstimatorArrays, Policy
from fhaosmo_ros.core.online.outliers import is_spike
from fhaosmo_ros.core.online.stamps import restore, save, update_mean, WINDOW

NANOSECONDS = 1e-9
GAP_RATIO = 2.0
"""With max_step = 0 an interval of more mean intervals than this is a gap."""
MOST_SUB_STEPS = 10_000
"""Bounds what one sample may cost: a few milliseconds."""


@compiled(inline='always')
def sub_steps(policy: Policy, elapsed: int) -> int:
    """Return the number of steps that an interval is divided into: more than 1 for a gap."""
    longest, mean = policy.ints[at.MAX_STEP], policy.reals[at.INTERVAL]
    if longest:
        if elapsed > longest:
            return int(min(-(-elapsed // longest), MOST_SUB_STEPS))
    elif policy.ints[at.INTERVALS] == WINDOW and elapsed > GAP_RATIO * mean:
        return int(min(elapsed / mean + 0.5, MOST_SUB_STEPS))
    return 1


@compiled(inline='always')
def step_over(e: EstimatorArrays, elapsed: int, y: float, u: Floats, eps: Floats, row: int) -> int:
    """
    Step to a sample `elapsed` later, through a gap in sub-steps; return the status word.

    In a gap the observer sees y as the model continues it from the last sample and the internal
    estimates, plus a straight line that ends in the new sample. The scheme predict_correct follows
    the model by itself, so it takes a gap in one step.
    """
    law, work, state, policy = e
    ints, reals, memory = policy.ints, policy.reals, state.memory
    count, corrected = sub_steps(policy, elapsed), y - memory[OFFSET]
    is_gap = count > 1 and memory[BEYOND] == 0.0  # after rejected samples it is none
    if law.flags[PREDICTING] or not is_gap:
        count = 1
    h = elapsed * NANOSECONDS / count
    gamma, word, bend, modelled = memory[GAMMA], 0, 0.0, True
    if count > 1 or reals[at.GATE] > 0.0:
        end = predicted_measurement(law, work, state, h, u, count)
        modelled = abs(end) <= reals[at.LIMIT]  # False for NaN
        if not modelled:
            end = memory[Y]
        if reals[at.GATE] > 0.0 and is_spike(policy, corrected - end):
            return REJECTED_SPIKE
        bend = (corrected - end) / count
        begin_at_estimates(work, state)
    ints[at.BRIDGED] = 0
    kept = is_gap and not law.flags[SELF_TUNING]  # the members are too many to be kept
    if is_gap:
        if kept:
            save(policy, state)
            ints[at.BRIDGED] = 1
        ints[at.BEFORE] = ints[at.LATEST]
        ints[at.GAPS] += 1
        ints[at.SUB_STEPS] += count
        word = GAP
    for k in range(1, count + 1):
        sample = y
        if k < count:  # then the scheme is not predict_correct, which needs work.stages itself
            if modelled:
                predict_step(law, work, h, u)
            sample = work.stages[NOW, 0, 0] + k * bend + memory[OFFSET]
        word = word & FLAGS_MASK | step(law, work, state, sample, h, u, eps, row)
        if word & REJECTED_SPIKE:  # as if it had not come: the next one is stepped to from LATEST
            memory[PENDING] = 0.0
            ints[at.REJECTED_SPIKES] += 1
            ints[at.JUMPS] += (word & JUMPED) > 0
            if is_gap:
                ints[at.GAPS] -= 1
                ints[at.SUB_STEPS] -= count
                ints[at.BRIDGED] = 0
            if kept:
                beyond, spread = memory[BEYOND], memory[SPREAD]
                restore(policy, state)
                memory[BEYOND], memory[SPREAD] = beyond, spread
            return word & (FLAGS_MASK ^ GAP) | word >> LEVEL_SHIFT << LEVEL_SHIFT
        if ints[at.FROZEN]:
            memory[GAMMA] = gamma
        if word & REJECTED:
            break
    if not word & REJECTED:
        update_mean(policy, elapsed)
        ints[at.JUMPS] += (word & JUMPED) > 0
    elif kept:
        restore(policy, state)
        memory[Y] = corrected  # as where a single step fails
        word = word & FLAGS_MASK | innovations(law, state, corrected, eps, row) << LEVEL_SHIFT
    return word
