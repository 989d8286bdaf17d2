# SPDX-License-Identifier: Apache-2.0
"""
A known delay of y: the inputs that acted when it was measured, and estimates of the present.

A sample that arrives at t tells of the plant at t - `measurement_delay`; its stamp remains t for
the rules of time. A known input that arrives at t acted at t - `input_delay`. So the step to a
sample needs the inputs that arrived LAG = measurement_delay - input_delay before it.

Where there is a delay and the model uses an input, the end of ``Policy.reals`` is the past of the
inputs: PLACE (of the latest piece), COUNT (of pieces) and NUMBER (of inputs); the inputs of the
step, a mean; the inputs at the latest accepted sample; and, with LAG > 0, a ring of pieces, each a
duration (ns) and the inputs that acted for so long. Pieces with the same inputs are one.
"""

from fhaosmo_ros.core.compiled.cache import compiled
from fhaosmo_ros.core.compiled.unowned_arrays import unowned
from fhaosmo_ros.core.model.bytecode import Floats
from fhaosmo_ros.core.model.integrate import NOW
from fhaosmo_ros.core.observer.arrays import HAT, PREDICTION_STEP, State, TILDE
from fhaosmo_ros.core.observer.prediction import predict
from fhaosmo_ros.core.online import memory as at
from fhaosmo_ros.core.online.memory import EstimatorArrays, Policy
import numpy as np

NANOSECONDS = 1e-9
PIECES = 512
"""Room for so many different values of the inputs within the delay; older ones are forgotten."""
PLACE, COUNT, NUMBER, INPUTS = range(4)


def make_past(inputs: int, lag: int) -> Floats:
    """Return the past of so many inputs of which nothing is known."""
    past = np.zeros(INPUTS + 2 * inputs + (PIECES * (1 + inputs) if lag else 0))
    past[NUMBER] = inputs
    return past


@compiled(forceinline=True)
def past_of(policy: Policy, state: State) -> Floats:
    """Return the part of the policy's memory that holds the past of the inputs."""
    return policy.reals[at.STATES + 2 * (state.levels.size + state.memory.size) :]


@compiled(forceinline=True)
def forget_past(policy: Policy, state: State) -> None:
    """Know nothing of the inputs before now."""
    past = past_of(policy, state)
    if past.shape[0] > 0:
        past[COUNT] = 0.0


@compiled(forceinline=True)
def keep_latest(policy: Policy, state: State, u: Floats) -> None:
    """Remember the inputs at a sample that was accepted."""
    past = past_of(policy, state)
    if past.shape[0] > 0:
        for j in range(u.shape[0]):
            past[INPUTS + u.shape[0] + j] = u[j]


@compiled()
def note_inputs(past: Floats, elapsed: int, u: Floats) -> None:
    """Append that the inputs have been `u` for the latest `elapsed` nanoseconds."""
    width = 1 + u.shape[0]
    ring = past[INPUTS + 2 * u.shape[0] :]
    place, same = int(past[PLACE]), past[COUNT] > 0.0
    for j in range(u.shape[0]):
        same = same and ring[place * width + 1 + j] == u[j]
    if not same:
        place = (place + 1) % PIECES
        past[PLACE] = place
        past[COUNT] = min(past[COUNT] + 1.0, float(PIECES))
        ring[place * width] = 0.0
        for j in range(u.shape[0]):
            ring[place * width + 1 + j] = u[j]
    ring[place * width] += elapsed


@compiled()
def withdraw_inputs(past: Floats, elapsed: int, inputs: int) -> None:
    """Take the latest `elapsed` nanoseconds back."""
    width = 1 + inputs
    ring = past[INPUTS + 2 * inputs :]
    while elapsed > 0 and past[COUNT] > 0.0:
        place = int(past[PLACE])
        if ring[place * width] > elapsed:
            ring[place * width] -= elapsed
            return
        elapsed -= int(ring[place * width])
        past[PLACE] = (place - 1) % PIECES
        past[COUNT] -= 1.0


@compiled()
def inputs_before(past: Floats, lag: int, elapsed: int, u: Floats) -> Floats:
    """
    Return the mean of the inputs over `elapsed` nanoseconds that ended `lag` before now.

    Parameters
    ----------
    u : (m,) array
        What they are where nothing is known of the past.

    """
    count, width = u.shape[0], 1 + u.shape[0]
    mean, ring = past[INPUTS : INPUTS + count], past[INPUTS + 2 * count :]
    place, pieces = int(past[PLACE]), int(past[COUNT])
    for j in range(count):
        mean[j] = u[j]
    covered, end = 0, 0  # time of the interval that is in the mean; end of the piece, before now
    for k in range(pieces):
        begin = end + int(ring[place * width])
        share = min(begin, lag + elapsed) - max(end, lag)
        if k == pieces - 1:  # the oldest one known stands for all before it
            share = elapsed - covered
        if share > 0:
            covered += share
            part = share / covered
            for j in range(count):
                value = ring[place * width + 1 + j]
                mean[j] = value if part == 1.0 else mean[j] + part * (value - mean[j])
        if covered >= elapsed:
            break
        end = begin
        place = (place - 1) % PIECES
    return mean


@compiled()
def published(e: EstimatorArrays, filtered: int, out: Floats) -> None:
    """
    Write z_1 .. z_n and d as they are published: at the sample, or carried to the present.

    Parameters
    ----------
    e : EstimatorArrays
    filtered : int
        1 for z_hat, 0 for the internal states.
    out : (n + 1,) array

    """
    _, work, state, policy = e
    levels, ints = state.levels, policy.ints
    n, count, now = out.shape[0] - 1, levels.shape[1], work.stages[NOW]
    for i in range(now.shape[1]):
        internal = i > 0 and (not filtered or i >= count)
        now[0, i] = levels[TILDE, i - 1] if internal else levels[HAT, i]
        now[1, i] = 0.0
    if ints[at.TO_NOW] and ints[at.DELAY] > 0:
        _carry(e)
    for i in range(n + 1):
        out[i] = now[0, i]


@compiled()
def _carry(e: EstimatorArrays) -> None:
    """Follow the model over the delay, by the inputs that have acted since; d by D 17."""
    law, work, state, policy = e
    lag, rest = policy.ints[at.LAG], policy.ints[at.DELAY]
    longest = law.scalars[PREDICTION_STEP]
    past = past_of(policy, state)
    u = past  # empty: the model uses no input
    if past.shape[0] > 0:
        u = past[INPUTS + int(past[NUMBER]) : INPUTS + 2 * int(past[NUMBER])]
    if lag > 0 and past[COUNT] > 0.0:
        width, ring = 1 + u.shape[0], past[INPUTS + 2 * u.shape[0] :]
        place, pieces, age, known = int(past[PLACE]), int(past[COUNT]), 0, 0
        while known + 1 < pieces and age + int(ring[place * width]) < lag:
            age += int(ring[place * width])
            place = (place - 1) % PIECES
            known += 1
        left = lag  # from the oldest piece within the lag to the latest one
        for k in range(known, -1, -1):
            span = left - age
            piece = ring[place * width + 1 : place * width + width]
            if span > 0:
                predict(law, work, span * NANOSECONDS, piece, longest)
            left = age
            place = (place + 1) % PIECES
            if k > 0:
                age -= int(ring[place * width])
        rest -= lag
    if rest > 0:
        predict(law, work, rest * NANOSECONDS, u, longest)


@compiled()
def published_once(e: EstimatorArrays, out: Floats) -> None:
    """Write what is published, with the choice of the parameters; see `published`."""
    published(unowned(e), e.policy.ints[at.FILTERED], unowned(out))
