# SPDX-License-Identifier: Apache-2.0
"""The policy's steps (see policy.py): from one used sample to the next, also through a gap."""

from fhaosmo_ros.core import policy_layout as at
from fhaosmo_ros.core.flow import ahead, estimates, flow
from fhaosmo_ros.core.kernels import innovations, step
from fhaosmo_ros.core.law import PREDICTING
from fhaosmo_ros.core.layout import GAMMA, HAT, ROWS, Y
from fhaosmo_ros.core.policy_data import is_spike
from fhaosmo_ros.core.policy_time import restore, save, update_mean, WINDOW
from fhaosmo_ros.core.status import LEVEL_SHIFT, REJECTED, Status
from fhaosmo_ros.core.tape import Floats, Ints
from numba import njit
import numpy as np

REJECTED_SPIKE = int(Status.REJECTED_SPIKE)
GAP = int(Status.GAP)
FLAGS = (1 << LEVEL_SHIFT) - 1

NANOSECONDS = 1e-9
GAP_RATIO = 2.0
"""With max_step = 0 an interval of more mean intervals than this is a gap."""
MOST_SUB_STEPS = 10_000
"""Bounds what one sample may cost: a few milliseconds."""


@njit(cache=True, error_model='numpy', inline='always')
def step_over(
    flags: Ints, gains: Floats, curves: Floats, scalars: Floats, tape: Floats, offsets: Ints,
    x: Floats, m: Floats, stack: Floats, levels: Floats, memory: Floats, eps: Floats,
    ints: Ints, reals: Floats, elapsed: int, y: float, u: float, row: int,
) -> int:  # fmt: skip
    """
    Step to a sample `elapsed` later, through a gap in sub-steps; return the status word.

    In a gap the observer sees y as the model continues it from the last sample and the internal
    estimates, plus a straight line that ends in the new sample. The scheme predict_correct follows
    the model by itself, so it takes a gap in one step.
    """
    count = 1
    if ints[at.MAX_STEP]:
        if elapsed > ints[at.MAX_STEP]:
            count = min(-(-elapsed // ints[at.MAX_STEP]), MOST_SUB_STEPS)
    elif ints[at.INTERVALS] == WINDOW and elapsed > GAP_RATIO * reals[at.INTERVAL]:
        count = int(min(elapsed / reals[at.INTERVAL] + 0.5, MOST_SUB_STEPS))
    is_gap = count > 1
    if flags[PREDICTING]:
        count = 1
    h = elapsed * NANOSECONDS / count
    gamma, word, bend, modelled, z = memory[GAMMA], 0, 0.0, True, x
    if count > 1 or reals[at.GATE] > 0.0:
        z = np.empty((ROWS, offsets.shape[0] - 1))
        end = ahead(tape, offsets, m, stack, levels, memory, z, h, u, count)
        modelled = abs(end) <= reals[at.LIMIT]  # False for NaN
        if not modelled:
            end = memory[Y]
        if reals[at.GATE] > 0.0 and is_spike(ints, reals, y - end):
            return REJECTED_SPIKE
        bend = (y - end) / count
        estimates(levels, memory, z)
    ints[at.BRIDGED] = 0
    if is_gap:
        save(reals, levels, memory)
        ints[at.BRIDGED] = 1
        ints[at.BEFORE] = ints[at.LATEST]
        ints[at.GAPS] += 1
        ints[at.SUB_STEPS] += count
        word = GAP
    for k in range(1, count + 1):
        sample = y
        if k < count:
            if modelled:
                flow(tape, offsets, m, stack, z, h, u)
            sample = z[HAT, 0] + k * bend
        word = word & FLAGS | step(
            flags, gains, curves, scalars, tape, offsets, x, m, stack,
            levels, memory, sample, h, u, eps, row,
        )  # fmt: skip
        if ints[at.FROZEN]:
            memory[GAMMA] = gamma
        if word & REJECTED:
            break
    if not word & REJECTED:
        update_mean(ints, reals, elapsed)
    elif is_gap:
        restore(reals, levels, memory)
        memory[Y] = y  # as where a single step fails
        word = word & FLAGS | innovations(scalars, levels, y, eps, row) << LEVEL_SHIFT
    return word
