# SPDX-License-Identifier: Apache-2.0
"""One step of all members, and their restart; called by address (D 26 to D 29)."""

from functools import cache
import math
from typing import NamedTuple

from fhaosmo_ros.core.compiled.cache import compiled, compiled_callback
from fhaosmo_ros.core.compiled.unowned_arrays import doubles_at, integers_at
from fhaosmo_ros.core.model.bytecode import Floats
from fhaosmo_ros.core.model.integrate import NOW
from fhaosmo_ros.core.observer.arrays import (
    ACTIVE,
    ARRAYS,
    BEYOND,
    CALM,
    COVARIANCE,
    DRIFT,
    FAR_SIGN,
    FIRST_MISS,
    FIRST_NOISE,
    FLOW_PERIOD,
    FORGETTING,
    FRESH,
    GOES_BACK,
    GROWING,
    HAT,
    JUMP,
    Law,
    LEAST_NOISE,
    LIKELIEST,
    LINEAR,
    MISS,
    MOVING,
    observer_at,
    PERIOD,
    PREDICTION_STEP,
    RECENT,
    ROUGHNESS,
    ROWS,
    SAMPLES,
    STEADY_PERIOD,
    TELL,
    TOLD,
    TURNS,
    UNSETTLED,
    WATCHED,
    Work,
    Y,
)
from fhaosmo_ros.core.observer.covariance import GATE, MOST_DRIFT, REMEMBERED
from fhaosmo_ros.core.observer.levant import NEAR
from fhaosmo_ros.core.observer.prediction import predict
from fhaosmo_ros.core.observer.self_tuning.covariances import at
from fhaosmo_ros.core.observer.self_tuning.filters import (
    allow_jump,
    correct,
    correct_states,
    expect,
    HUBER,
    predict_states,
)
from fhaosmo_ros.core.observer.self_tuning.intervals import choose_members, take_interval
from fhaosmo_ros.core.observer.self_tuning.jumps import (
    begin_growth,
    follow_growth,
    follow_innovations,
    follow_jump,
    GROWTHS,
    samples_since_jump,
    shift,
    watch,
)
from fhaosmo_ros.core.observer.self_tuning.members import (
    COLOUR,
    COLOURS,
    CORRELATION,
    COUNT,
    DECAYED,
    FAR,
    find_tuning,
    FIRST,
    FIRST_SAMPLES,
    HALF,
    IN_BAND,
    KAPPA,
    KINDS,
    Members,
    members_in,
    ORDER,
    ORDERS,
    put,
    RATIO,
    RESIDUAL,
    Scratch,
    scratch_in,
    SHORT,
    SQUARE,
    TAU,
    USED,
    VARIANCE,
    WHITE,
)
from fhaosmo_ros.core.observer.self_tuning.noise import (
    CALM_SAMPLES,
    difference,
    follow_noise,
    follow_quantum,
    is_explained,
    is_likely,
    knowing,
    rounding,
    stamp_noise,
    STEADY,
)
from fhaosmo_ros.core.observer.self_tuning.start import gather
from fhaosmo_ros.core.observer.self_tuning.weights import (
    are_finite,
    FLOOR,
    judge,
    mix,
    QUANTISED_FLOOR,
    tell_model,
    weigh,
)
from fhaosmo_ros.core.observer.step import LOST_SAMPLES
from numba import types
import numpy as np

NOISE_SAMPLES = 1000.0
"""The noise is averaged over so many samples."""
JUMP_SAMPLES = 10.0
"""What is beyond 3 sigma in so many samples after that is due to the jump, too."""
TURNS_SAMPLES, OFTEN, ROUGH_TURN = 40.0, 0.07, -0.5
"""
If unlikely samples are on the other side than the last one in a larger share of so many samples,
and y itself moves as ever, members are judged by them too: those that were likely are wrong.
A sample whose difference is large counts as `ROUGH_TURN` of these: noise may have grown.
"""
EXACT = 1e-5
"""y is taken to be no more exact than this, in parts of what it moves between samples (RMS)."""
ANOTHER, FAR_OFF = 1.5, 3.0
"""Factors on the variance of the noise, of the likeliest colour and others, that make P move."""
SAME = 1e-9
"""Intervals that differ by this part are equal: seconds of a clock, as floats, are not exact."""
GAP = 2.5
"""After an interval of so many usual ones P is not the steady one; after shorter ones nearly."""
LONG = 8.0
"""Time constants of a member after which its P is steady."""
EVEN = 16
"""Covariances of so many members, or of a multiple, move: whole vectors of the processor."""


@compiled(forceinline=True)
def is_same(h: float, memory: Floats) -> bool:
    """Return True if what depends on the interval is known, but for a part of `SAME`."""
    return bool(abs(h - memory[FLOW_PERIOD]) <= SAME * memory[FLOW_PERIOD])


@compiled()
def follow_period(law: Law, members: Members, memory: Floats, h: float) -> None:
    """Decide which covariances move, and what depends on the period (D 27)."""
    rates, noise = members.rates, members.noise
    if not is_same(h, memory):
        for g in range(HALF):
            if ORDER[g] == 0:
                rates[DECAYED, g] = math.exp(-rates[KAPPA, g] * h)
            else:
                rates[DECAYED, g] = rates[DECAYED, g - KINDS]
        of_colours = np.zeros(COLOURS.size)
        for c in range(1, COLOURS.size):
            of_colours[c] = math.exp(-h / rates[TAU, FIRST[c]])
        for g in range(HALF, COUNT):
            rates[DECAYED, g] = rates[DECAYED, WHITE[g]]
            rates[CORRELATION, g] = of_colours[COLOUR[g]]
    steady, mean = memory[STEADY_PERIOD], memory[PERIOD] if memory[PERIOD] > 0.0 else h
    changed = abs(mean - steady) > NEAR * steady or h > GAP * steady
    likeliest = COLOUR[int(memory[LIKELIEST])]
    for c in range(COLOURS.size):
        ratio, limit = noise[SQUARE, c] / noise[USED, c], ANOTHER if c == likeliest else FAR_OFF
        changed = changed or not 1.0 / limit < ratio < limit
    if changed:
        noise[USED] = noise[SQUARE]
    if changed or not law.flags[LINEAR]:
        memory[UNSETTLED] = 0.0
        memory[STEADY_PERIOD] = mean
    memory[UNSETTLED] += h
    n = law.gains.shape[1] - ORDERS
    slowed = 1.0
    for c in range(COLOURS.size):
        slowed = min(slowed, (memory[FIRST_NOISE] / noise[USED, c]) ** (0.5 / (n + 1)))
    moving = 0
    for g in range(HALF, COUNT, IN_BAND):
        if rates[KAPPA, g] / RATIO[g] * slowed * memory[UNSETTLED] < LONG:
            moving += IN_BAND
    memory[MOVING] = min(-(-moving // EVEN) * EVEN, HALF)


@compiled()
def carry_flow(
    law: Law, work: Work, members: Members, memory: Floats, h: float, u: Floats
) -> None:
    """Predict the mean, with its derivative by each of its entries (D 27); to ``stages[NOW]``."""
    levels, now = law.gains.shape[1], work.stages[NOW]
    known = law.flags[LINEAR] and is_same(h, memory)
    for j in range(levels - 1 if known else 0, levels):
        for i in range(levels):
            now[0, i], now[1, i] = work.x[HAT, i], 0.0
        now[1, j] = 1.0
        predict(law, work, h, u, law.scalars[PREDICTION_STEP])
        for i in range(levels):
            members.flow[i, j] = now[1, i]
    if not is_same(h, memory):
        memory[FLOW_PERIOD] = h


class Sample(NamedTuple):
    """
    What is known of a sample before it is used or passed over.

    Attributes
    ----------
    y, h : float
        The sample, and the time since the one before.
    off : float
        By what it is off the prediction of the mean.
    quanta : float
        See `rounding`.
    roughness, roughness_before : float
        Square of its difference over the usual one; the mean of those before.
    uneven : float
        Square of the highest difference as a variance of y, and that of the stamps.
    of_stamps : float
        See `stamp_noise`.
    floor : float
        The least that the variance of the noise can be.
    largest : float
        See `knowing`.
    samples : float
        Number of samples to average the noise over.
    kept : float
        Part of the log-likelihoods that is not forgotten.

    """

    y: float
    h: float
    off: float
    quanta: float
    roughness: float
    roughness_before: float
    uneven: float
    of_stamps: float
    floor: float
    largest: float
    samples: float
    kept: float


@compiled()
def pass_over(
    members: Members,
    scratch: Scratch,
    memory: Floats,
    believed: Floats,
    sample: Sample,
    doubted: bool,
) -> None:
    """Count a sample that is not likely; where it may be noise that has grown, follow that."""
    if doubted and is_explained(members, scratch.b, believed):
        judge(members, scratch, 1.0, sample.kept, True)
        memory[LIKELIEST] = weigh(members, FLOOR)
    sign = math.copysign(1.0, sample.off)
    other_side = memory[BEYOND] > 0.0 and sign != memory[FAR_SIGN]
    if other_side:
        begin_growth(memory, abs(sample.off), sample.uneven, sample.roughness_before)
        memory[BEYOND] = 0.0
    memory[BEYOND] += 1.0
    memory[MISS] = sample.off
    if memory[BEYOND] == 1.0:
        memory[FIRST_MISS] = sample.off
    rougher = memory[ROUGHNESS] > HUBER and memory[RECENT] == 0.0
    if other_side or rougher:  # a y that is off is so on one side, and evenly
        follow_noise(
            members, scratch, sample.floor, believed, sample.largest, sample.samples,
            memory[ROUGHNESS], sample.of_stamps,
        )  # fmt: skip
    memory[FAR_SIGN] = sign


@compiled()
def take(
    members: Members,
    scratch: Scratch,
    memory: Floats,
    n: int,
    believed: Floats,
    sample: Sample,
    doubted: bool,
) -> None:
    """Correct the members by a sample, and weigh them."""
    y, quanta = sample.y, sample.quanta
    grown, best_fit = follow_noise(
        members, scratch, sample.floor, believed, sample.largest, sample.samples,
        memory[ROUGHNESS], sample.of_stamps,
    )  # fmt: skip
    memory[CALM] = memory[CALM] + 1.0 if grown <= STEADY else 0.0
    calm = memory[CALM] > CALM_SAMPLES or doubted
    judged = calm or best_fit < HUBER * HUBER
    judged = judged and (sample.roughness <= HUBER * HUBER or quanta > 0.0)
    kept = sample.kept if judged else -1.0
    follow_innovations(members, scratch.b, scratch.s, quanta)
    if quanta > 0.0:
        back = memory[GOES_BACK]
        take_interval(members, scratch, y, memory[Y], sample.h, quanta, kept, back)
    correct(members, scratch, n, int(memory[MOVING]), quanta > 0.0)
    if quanta == 0.0:
        judge(members, scratch, grown, kept, calm)
    correct_states(members, scratch, n, y)
    memory[LIKELIEST] = weigh(members, QUANTISED_FLOOR if quanta > 0.0 else FLOOR)


@compiled()
def step_members(
    law: Law, work: Work, memory: Floats, rows: Floats, y: float, h: float, u: Floats
) -> float:
    """
    Advance the members, and the estimates in ``work.x``, to the sample `y`.

    Returns
    -------
    float
        Square of the innovation of the mean. A sample that is too far off is counted in
        ``memory[BEYOND]``, and changes no member. Where y has jumped, ``memory[JUMPS]`` is by
        what.

    """
    x, n = work.x, law.gains.shape[1] - ORDERS
    every = members_in(rows, n, COUNT)
    if memory[SAMPLES] <= FIRST_SAMPLES:
        gather(law, work, memory, every, y, h)
        return 0.0
    quanta = rounding(every, memory)
    before, count = memory[ACTIVE], choose_members(every, memory, quanta)
    members = members_in(rows, n, count)
    if count != before:
        memory[LIKELIEST] = weigh(members, FLOOR)
    follow_period(law, members, memory, h)
    roughness_before = memory[ROUGHNESS]
    roughness, highest = difference(members, memory, y)
    of_stamps = stamp_noise(members, memory, h)
    if memory[GROWING] >= GROWTHS - 1.0 or memory[RECENT] > 0.0 or quanta > 0.0:
        memory[MOVING] = HALF
    if quanta > 0.0:  # P depends on the samples
        memory[UNSETTLED] = 0.0
    now = work.stages[NOW]
    carry_flow(law, work, members, memory, h, u)
    # A sample that is not likely changes no member, so that what it makes of them stands apart.
    scratch = scratch_in(work.x[ROWS + law.gains.shape[1] :], n)
    s = scratch.s
    predict_states(members, scratch, n, h, x[HAT], now[0])
    expect(members, scratch, n, h, y, int(memory[MOVING]))
    believed = s
    if memory[BEYOND] > 0.0:  # P grows meanwhile, and the quick members believe anything
        believed = np.minimum(s, 4.0 * members.record[VARIANCE])
    likeliest = int(memory[LIKELIEST])
    largest = knowing(members, scratch, believed, likeliest)
    expected = believed[likeliest] * members.noise[SQUARE, COLOUR[likeliest]]
    sample = Sample(
        y, h, y - now[0, 0], quanta, roughness, roughness_before, highest + of_stamps, of_stamps,
        max(quanta, law.scalars[LEAST_NOISE] ** 2, EXACT * EXACT * members.rough[1, 1]), largest,
        min(memory[SAMPLES], NOISE_SAMPLES), math.exp(-h / law.scalars[FORGETTING]),
    )  # fmt: skip
    memory[SAMPLES] = sample.samples + 1.0
    off, sigma = abs(sample.off), math.sqrt(members.noise[SQUARE, 0])
    hidden = GATE * math.sqrt(largest)
    growing = follow_growth(
        memory, members.flow, n, off, sigma, hidden, sample.uneven, roughness_before
    )
    sign, turn = math.copysign(1.0, sample.off), 0.0
    goes_on = memory[BEYOND] > 0.0 and sign == memory[FAR_SIGN]
    goes_on = goes_on and roughness <= HUBER * HUBER and memory[ROUGHNESS] < HUBER
    gate = HUBER if goes_on else GATE
    likely = is_likely(members, scratch.b, believed, largest, memory[BEYOND], gate)
    memory[RECENT] = max(memory[RECENT] - 1.0, 0.0)
    begins = not likely and growing
    jumped = begins or (memory[RECENT] > 0.0 and roughness <= HUBER * HUBER)
    if roughness > HUBER * HUBER:
        turn = ROUGH_TURN
    elif not likely and sign != memory[FAR_SIGN]:
        turn = 1.0
    memory[TURNS] = max(memory[TURNS] + (turn - memory[TURNS]) / TURNS_SAMPLES, 0.0)
    doubted = memory[TURNS] > OFTEN and memory[ROUGHNESS] < HUBER and quanta == 0.0
    if not likely and not jumped:
        pass_over(members, scratch, memory, believed, sample, doubted)
        x[COVARIANCE, 0] = expected
        return 0.0
    memory[BEYOND] = 0.0
    if (
        memory[WATCHED] > 0.0
        and not jumped
        and quanta == 0.0
        and drifts(memory, sample.off, expected)
    ):
        memory[BEYOND] = math.inf
        return 0.0
    if jumped:
        tau = 0.0
        if begins:  # while it was within the gate, it could not be seen
            tau = h / (1.0 - min(GATE * sigma / off, 0.9) ** (1.0 / n))
            memory[RECENT] = JUMP_SAMPLES
        allow_jump(members, scratch, n, y, tau)
        members.record[FAR] = 0.0
        believed = s
        memory[UNSETTLED] = 0.0
    take(members, scratch, memory, n, believed, sample, doubted)
    follow_quantum(members, memory, y)
    since_jump = 0 if jumped else samples_since_jump(members, n, memory[TOLD])
    if since_jump > 2:  # two outliers are no jump
        follow_jump(members, memory, n, since_jump, s, y)
        memory[LIKELIEST] = weigh(members, FLOOR)
    mix(law, members, scratch, x)
    if not are_finite(members):
        x[HAT, 0] = math.nan  # so that the step is rejected, and the members begin afresh
    tell_model(law, members, memory, h, jumped, x)
    find_strays(members, n, x[HAT])
    return float((y - x[HAT, 0]) ** 2)


@compiled(forceinline=True)
def drifts(memory: Floats, off: float, variance: float) -> bool:
    """Return True if y has left its prediction since it jumped: the plant has jumped (D 23)."""
    memory[WATCHED] -= 1.0
    memory[DRIFT] += off / math.sqrt(variance) - memory[DRIFT] / REMEMBERED
    return bool(abs(memory[DRIFT]) > MOST_DRIFT)


@compiled()
def find_strays(members: Members, n: int, mean: Floats) -> None:
    """Put members that have been far off for long to the mean."""
    far = members.record[FAR]
    for g in range(members.active):
        if far[g] > LOST_SAMPLES:
            far[g] = 0.0
            put(members, n, g, mean)


@compiled()
def restart_members(law: Law, levels: Floats, memory: Floats, rows: Floats, y: float) -> None:
    """Begin afresh from `y`: z is not known any more, d and the noise are (D 29)."""
    n = law.gains.shape[1] - ORDERS
    members, d = members_in(rows, n, COUNT), n + ORDERS
    memory[UNSETTLED] = memory[BEYOND] = memory[GROWING] = memory[RECENT] = 0.0
    memory[TURNS] = 0.0
    watch(members, memory[TOLD])
    levels[HAT, 0] = memory[Y] = y
    levels[COVARIANCE, 0] = members.noise[SQUARE, 0]
    members.x[0] = y
    for i in range(n):
        size = law.chances[FRESH * law.gains.shape[1] + i, i]
        if i > 0:
            levels[COVARIANCE, i] = max(size, levels[HAT, i] ** 2)
        for j in range(i, d):
            members.p[at(d, i, j)] = max(size, levels[HAT, i] ** 2) if i == j else 0.0
    for g in range(COUNT):
        a = members.rates[CORRELATION, g]
        members.p[0, g] = members.noise[SQUARE, COLOUR[g]] / (1.0 - a * a)
    members.record[RESIDUAL], members.record[FAR], members.record[SHORT] = 0.0, 0.0, 1.0


def _step_at(table: int, y: float, h: float, inputs: int, count: int) -> float:
    """
    Do what `step_members` does on the arrays of a table.

    With `RESTART` for h do what `restart_members` does, with `TELL` what `find_tuning` does, into
    `inputs`, and with `JUMP` what `shift` does, by y.
    """
    law, work, (levels, memory) = observer_at(integers_at(table, (ARRAYS, 3)), 0)
    rows = levels[ROWS + law.gains.shape[1] :]
    if h > 0.0:
        return step_members(law, work, memory, rows, y, h, doubles_at(inputs, count))
    members = members_in(rows, law.gains.shape[1] - ORDERS, COUNT)
    if h == TELL:
        find_tuning(members, doubles_at(inputs, count))
    elif h == JUMP:
        shift(members, memory, y, work.x[COVARIANCE, 0])
    else:
        restart_members(law, levels, memory, rows, y)
    return 0.0


@cache
def step_address() -> int:
    """Return the address of the machine code of a step; compiles it where that is new."""
    integer, double = types.int64, types.float64
    return compiled_callback(_step_at, double(integer, double, double, integer, integer))
