# SPDX-License-Identifier: Apache-2.0
"""One step of all members, and their restart; called by address (D 26 to D 29)."""

from functools import cache
import math

from fhaosmo_ros.core.compiled.cache import compiled, compiled_callback
from fhaosmo_ros.core.compiled.unowned_arrays import doubles_at, integers_at, unowned
from fhaosmo_ros.core.model.bytecode import Floats
from fhaosmo_ros.core.model.integrate import NOW
from fhaosmo_ros.core.observer.arrays import (
    ARRAYS,
    BEYOND,
    CALM,
    COVARIANCE,
    FAR_SIGN,
    FIRST_NOISE,
    FLOW_PERIOD,
    FORGETTING,
    FRESH,
    GROWING,
    HAT,
    Law,
    LEAST_NOISE,
    LIKELIEST,
    LINEAR,
    MOVING,
    observer_at,
    PREDICTION_STEP,
    RECENT,
    ROUGHNESS,
    ROWS,
    SAMPLES,
    STEADY_PERIOD,
    TOLD,
    TURNS,
    UNSETTLED,
    Work,
    Y,
)
from fhaosmo_ros.core.observer.covariance import GATE
from fhaosmo_ros.core.observer.levant import NEAR
from fhaosmo_ros.core.observer.prediction import predict
from fhaosmo_ros.core.observer.self_tuning.filters import (
    allow_jump,
    at,
    correct_covariances,
    correct_states,
    expect_innovations,
    HUBER,
    predict_covariances,
    predict_states,
)
from fhaosmo_ros.core.observer.self_tuning.intervals import take_interval
from fhaosmo_ros.core.observer.self_tuning.jumps import (
    begin_growth,
    follow_growth,
    follow_innovations,
    follow_jump,
    GROWTHS,
    samples_since_jump,
    watch,
)
from fhaosmo_ros.core.observer.self_tuning.members import (
    BANDS,
    COLOUR,
    COLOURS,
    CORRELATION,
    COUNT,
    DECAYED,
    FAR,
    find_tuning,
    FIRST_SAMPLES,
    IN_BAND,
    KAPPA,
    LOG_VARIANCE,
    Members,
    members_in,
    moving_size,
    of_pairs,
    of_states,
    ORDERS,
    put,
    RATIO,
    RESIDUAL,
    scratch_in,
    SHORT,
    SQUARE,
    TAU,
    USED,
    VARIANCE,
)
from fhaosmo_ros.core.observer.self_tuning.noise import (
    CALM_SAMPLES,
    difference,
    find_quantum,
    follow_noise,
    is_explained,
    is_likely,
    knowing,
    stamp_noise,
    STEADY,
)
from fhaosmo_ros.core.observer.self_tuning.start import gather
from fhaosmo_ros.core.observer.self_tuning.weights import (
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
LONG = 8.0
"""Time constants of a member after which its P is steady."""


@compiled()
def follow_period(law: Law, members: Members, memory: Floats, h: float) -> None:
    """Decide which covariances move, and what depends on the period (D 27)."""
    rates, noise = members.rates, members.noise
    if h != memory[FLOW_PERIOD]:
        for g in range(COUNT):
            rates[DECAYED, g] = math.exp(-rates[KAPPA, g] * h)
            tau = rates[TAU, g]
            rates[CORRELATION, g] = math.exp(-h / tau) if tau > 0.0 else 0.0
    changed = abs(h - memory[STEADY_PERIOD]) > NEAR * memory[STEADY_PERIOD]
    likeliest = COLOUR[int(memory[LIKELIEST]) % COUNT]
    for c in range(COLOURS.size):
        ratio, limit = noise[SQUARE, c] / noise[USED, c], ANOTHER if c == likeliest else FAR_OFF
        changed = changed or not 1.0 / limit < ratio < limit
    if changed:
        noise[USED] = noise[SQUARE]
    if changed or not law.flags[LINEAR]:
        memory[UNSETTLED] = 0.0
        memory[STEADY_PERIOD] = h
    memory[UNSETTLED] += h
    n = law.gains.shape[1] - ORDERS
    slowed = 1.0
    for c in range(COLOURS.size):
        slowed = min(slowed, (memory[FIRST_NOISE] / noise[USED, c]) ** (0.5 / (n + 1)))
    moving = 0
    for band in range(BANDS):
        kappa, ratio = rates[KAPPA, band * IN_BAND], RATIO[band * IN_BAND]
        if kappa / ratio * slowed * memory[UNSETTLED] < LONG:
            moving += IN_BAND
    memory[MOVING] = moving


@compiled()
def carry_flow(
    law: Law, work: Work, members: Members, memory: Floats, h: float, u: Floats
) -> None:
    """Predict the mean, with its derivative by each of its entries (D 27); to ``stages[NOW]``."""
    levels, now = law.gains.shape[1], work.stages[NOW]
    known = law.flags[LINEAR] and h == memory[FLOW_PERIOD]
    for j in range(levels - 1 if known else 0, levels):
        for i in range(levels):
            now[0, i], now[1, i] = work.x[HAT, i], 0.0
        now[1, j] = 1.0
        predict(law, work, h, u, law.scalars[PREDICTION_STEP])
        for i in range(levels):
            members.flow[i, j] = now[1, i]
    memory[FLOW_PERIOD] = h


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
    members = unowned(members_in(rows, n))
    if memory[SAMPLES] <= FIRST_SAMPLES:
        gather(law, work, memory, members, y, h)
        return 0.0
    quanta = find_quantum(members, memory, y)
    follow_period(law, members, memory, h)
    roughness_before = memory[ROUGHNESS]
    roughness, highest = difference(members, memory, y)
    of_stamps = stamp_noise(members, memory, h)
    if memory[GROWING] >= GROWTHS - 1.0 or memory[RECENT] > 0.0 or quanta > 0.0:
        memory[MOVING] = COUNT
    if quanta > 0.0:  # P depends on the samples
        memory[UNSETTLED] = 0.0
    moving, now = int(memory[MOVING]), work.stages[NOW]
    carry_flow(law, work, members, memory, h, u)
    # A sample that is not likely changes no member, so that what it makes of them stands apart.
    scratch, d = unowned(scratch_in(work.x[ROWS + law.gains.shape[1] :], n)), n + 1
    ahead, b, s, lines, rest = scratch.x, scratch.b, scratch.s, scratch.lines, scratch.rest
    gain = unowned(of_states(rest, 0, d, moving))
    p = unowned(of_pairs(rest, (3 * d + 3) * moving, d, moving))
    rest = unowned(rest[moving_size(n) * moving :])
    for k in range(ORDERS):
        predict_states(members, n, k, h, x[HAT], now[0], ahead[k])
        if moving > 0:
            predict_covariances(members, n, k, h, p[k], rest, moving)
        expect_innovations(members, n, k, h, p[k], gain[k], s[k], moving)
        innovation, first, residual = b[k], ahead[k][0], members.record[RESIDUAL, k]
        correlation = members.rates[CORRELATION]
        for g in range(COUNT):
            innovation[g] = y - first[g] - correlation[g] * residual[g]
    believed = s
    if memory[BEYOND] > 0.0:  # P grows meanwhile, and the quick members believe anything
        believed = np.minimum(s, 4.0 * members.record[VARIANCE])
    count = min(memory[SAMPLES], NOISE_SAMPLES)
    memory[SAMPLES] = count + 1.0
    largest = knowing(members, scratch, believed)
    floor = max(quanta, law.scalars[LEAST_NOISE] ** 2, EXACT * EXACT * members.rough[1, 1])
    off, sigma = abs(y - now[0, 0]), math.sqrt(members.noise[SQUARE, 0])
    hidden = GATE * math.sqrt(largest)
    growing = follow_growth(
        memory, members.flow, n, off, sigma, hidden, highest + of_stamps, roughness_before
    )
    sign, turn = math.copysign(1.0, y - now[0, 0]), 0.0
    goes_on = memory[BEYOND] > 0.0 and sign == memory[FAR_SIGN]
    goes_on = goes_on and roughness <= HUBER * HUBER and memory[ROUGHNESS] < HUBER
    gate = HUBER if goes_on else GATE
    likely = is_likely(members, b, believed, largest, memory[BEYOND], gate)
    memory[RECENT] = max(memory[RECENT] - 1.0, 0.0)
    begins = not likely and growing
    jumped = begins or (memory[RECENT] > 0.0 and roughness <= HUBER * HUBER)
    kept = math.exp(-h / law.scalars[FORGETTING])
    if roughness > HUBER * HUBER:
        turn = ROUGH_TURN
    elif not likely and sign != memory[FAR_SIGN]:
        turn = 1.0
    memory[TURNS] = max(memory[TURNS] + (turn - memory[TURNS]) / TURNS_SAMPLES, 0.0)
    doubted = memory[TURNS] > OFTEN and memory[ROUGHNESS] < HUBER and quanta == 0.0
    if not likely and not jumped:
        if doubted and is_explained(members, b, believed):
            judge(members, scratch, 1.0, kept, True)
            memory[LIKELIEST] = weigh(members, FLOOR)
        other_side = memory[BEYOND] > 0.0 and sign != memory[FAR_SIGN]
        if other_side:
            begin_growth(memory, off, highest + of_stamps, roughness_before)
            memory[BEYOND] = 0.0
        memory[BEYOND] += 1.0
        rougher = memory[ROUGHNESS] > HUBER and memory[RECENT] == 0.0
        if other_side or rougher:  # a y that is off is so on one side, and evenly
            follow_noise(
                members, scratch, floor, believed, largest, count, memory[ROUGHNESS], of_stamps
            )
        memory[FAR_SIGN] = sign
        return 0.0
    memory[BEYOND] = 0.0
    if jumped:
        tau = 0.0
        if begins:  # while it was within the gate, it could not be seen
            tau = h / (1.0 - min(GATE * sigma / off, 0.9) ** (1.0 / n))
            memory[RECENT] = JUMP_SAMPLES
        for k in range(ORDERS):
            allow_jump(members, scratch, n, k, y, tau, p[k], gain[k])
            members.record[FAR, k] = 0.0
        believed = s
        memory[UNSETTLED] = 0.0
    grown, best_fit = follow_noise(
        members, scratch, floor, believed, largest, count, memory[ROUGHNESS], of_stamps
    )
    memory[CALM] = memory[CALM] + 1.0 if grown <= STEADY else 0.0
    for k in range(ORDERS):
        variance, log_variance, found = (
            members.record[VARIANCE, k], members.record[LOG_VARIANCE, k], s[k]
        )  # fmt: skip
        for g in range(moving):
            variance[g], log_variance[g] = found[g], math.log(found[g])
    calm = memory[CALM] > CALM_SAMPLES or doubted
    judged = calm or best_fit < HUBER * HUBER
    judged = judged and (roughness <= HUBER * HUBER or quanta > 0.0)
    follow_innovations(members, b, s, quanta)
    judge(members, scratch, grown, kept if judged and quanta == 0.0 else -1.0, calm)
    for k in range(ORDERS):
        if quanta > 0.0:
            its = kept if judged else -1.0
            take_interval(members, scratch, k, y, y == memory[Y], p[k], quanta, its)
        else:
            for g in range(moving):
                lines[0, g] = lines[2, g] = 1.0 / (s[k, g] * members.noise[USED, COLOUR[g]])
        if moving > 0:
            correct_covariances(members, n, k, p[k], gain[k], lines, moving)
    correct_states(members, scratch, n, y)
    memory[LIKELIEST] = weigh(members, QUANTISED_FLOOR if quanta > 0.0 else FLOOR)
    since_jump = 0 if jumped else samples_since_jump(members, n, memory[TOLD])
    if since_jump > 2:  # two outliers are no jump
        follow_jump(members, memory, n, since_jump, s, y)
        memory[LIKELIEST] = weigh(members, FLOOR)
    mix(law, members, scratch, x)
    tell_model(law, members, memory, h, jumped, x)
    find_strays(members, n, x[HAT])
    return float((y - x[HAT, 0]) ** 2)


@compiled()
def find_strays(members: Members, n: int, mean: Floats) -> None:
    """Put members that have been far off for long to the mean."""
    far = members.record[FAR]
    for k in range(ORDERS):
        for g in range(COUNT):
            if far[k, g] > LOST_SAMPLES:
                far[k, g] = 0.0
                put(members, n, k, g, mean)


@compiled()
def restart_members(law: Law, levels: Floats, memory: Floats, rows: Floats, y: float) -> None:
    """Begin afresh from `y`: z is not known any more, d and the noise are (D 29)."""
    n = law.gains.shape[1] - ORDERS
    members = members_in(rows, n)
    memory[UNSETTLED] = memory[BEYOND] = memory[GROWING] = memory[RECENT] = 0.0
    memory[TURNS] = 0.0
    watch(members, memory[TOLD])
    levels[HAT, 0] = memory[Y] = y
    levels[COVARIANCE, 0] = members.noise[SQUARE, 0]
    for i in range(1, n):
        size = law.chances[FRESH * law.gains.shape[1] + i, i]
        levels[COVARIANCE, i] = max(size, levels[HAT, i] ** 2)
    for k in range(ORDERS):
        z = members.x[k]
        p = members.p[k]
        d = n + 1 + k
        for g in range(COUNT):
            c = members.rates[CORRELATION, g]
            z[0, g] = y
            for i in range(n):
                size = law.chances[FRESH * law.gains.shape[1] + i, i]
                p[at(d, i, i), g] = max(size, levels[HAT, i] ** 2)
                for j in range(i + 1, d):
                    p[at(d, i, j), g] = 0.0
            p[0, g] = members.noise[SQUARE, COLOUR[g]] / (1.0 - c * c)
            members.record[RESIDUAL, k, g] = members.record[FAR, k, g] = 0.0
            members.record[SHORT, k, g] = 1.0


def _step_at(table: int, y: float, h: float, inputs: int, count: int) -> float:
    """
    Do what `step_members` does on the arrays of a table.

    With h = 0 do what `restart_members` does, with h < 0 what `find_tuning` does, into `inputs`.
    """
    law, work, (levels, memory) = observer_at(integers_at(table, (ARRAYS, 3)), 0)
    rows = levels[ROWS + law.gains.shape[1] :]
    if h > 0.0:
        return step_members(law, work, memory, rows, y, h, doubles_at(inputs, count))
    if h < 0.0:
        members = members_in(rows, law.gains.shape[1] - ORDERS)
        find_tuning(members, doubles_at(inputs, count))
        return 0.0
    restart_members(law, levels, memory, rows, y)
    return 0.0


@cache
def step_address() -> int:
    """Return the address of the machine code of a step; compiles it where that is new."""
    integer, double = types.int64, types.float64
    return compiled_callback(_step_at, double(integer, double, double, integer, integer))
