# SPDX-License-Identifier: Apache-2.0
"""The policy's rules for values (see policy.py), each a small compiled function."""

from fhaosmo_ros.core.compiled.cache import compiled
from fhaosmo_ros.core.observer.arrays import (
    ACTIVE,
    FIRST_NOISE,
    HAT,
    ROWS,
    SAMPLES,
    SELF_TUNING,
    TILDE,
)
from fhaosmo_ros.core.observer.self_tuning.members import COUNT, members_in, ORDERS
from fhaosmo_ros.core.online import memory as at
from fhaosmo_ros.core.online.memory import EstimatorArrays, Policy
from fhaosmo_ros.core.online.stamps import difference

MULTIPLE, SINGLE = 1e-4, 6e-7
"""A step of y is a multiple of another one up to this, and up to rounding of y to 32 bits."""
ENOUGH_REGULAR, MOST_REGULAR = 4, 12
"""After so many regular changes y's sensor holds its values; so many are remembered."""

CHANCE_REPEATS = 2
"""A y with noise may repeat itself so often in a row by chance, if it is a float of 32 bits."""
RARELY, CHANGES = 0.05, 50.0
"""
Of late, less than this share of so many of its values were repeated, but for one: at the end of a
range it is always the same one.
"""
LEAST_NOISE = 1e-3
"""A y has noise if its differences are all more than this part of its first difference, RMS."""
NO_NOISE = 1e-9
"""It has none if these are less than this part of the noise at the start, as variances."""
ROUNDED = 1e-12
"""Differences that are smaller than this part of y may be errors of its rounding to 64 bits."""


@compiled()
def is_stuck(policy: Policy, last: float, y: float, now: int) -> bool:
    """Return True, and count it, if y has been seen unchanged for longer than stuck_time."""
    ints = policy.ints
    silence = abs(difference(now, ints[at.SEEN]))
    ints[at.SEEN] = now
    if y != last or silence > ints[at.MAX_GAP]:
        ints[at.CHANGED] = now
        ints[at.STUCK] = 0
        return False
    if difference(now, ints[at.CHANGED]) <= ints[at.STUCK_TIME]:
        return False
    if not ints[at.STUCK]:
        ints[at.STUCK] = 1
        ints[at.STUCK_EVENTS] += 1
    ints[at.REJECTED_STUCK_] += 1
    return True


@compiled()
def is_held(e: EstimatorArrays, y: float, now: int) -> bool:
    """
    Return True if y repeats a value because its sensor holds it, being slower than the topic.

    Only for self-tuning, which would take every change after it for one of d. A sensor holds
    values if they change after as many samples as before, about, and not by multiples, as an
    encoder's counts do. y may also really stand still: then it repeats itself for longer. What is
    counted here serves `repeats_noise`, too.
    """
    ints, reals = e.policy.ints, e.policy.reals
    if not e.law.flags[SELF_TUNING] or (ints[at.TIMED] and difference(now, ints[at.LATEST]) <= 0):
        return False  # a sample that comes twice is no repetition
    before, usual = reals[at.SAMPLE], ints[at.HELD_FOR]
    change = y - before
    reals[at.SAMPLE] = y
    if change == 0.0:
        ints[at.REPEATS] += 1
        short = ints[at.REPEATS] <= 2 * usual + 1
        short = short and 2 * abs(difference(now, ints[at.LATEST])) < ints[at.MAX_GAP]
        return bool(ints[at.HOLDS] and short)
    low, high = min(abs(change), abs(reals[at.CHANGE])), max(abs(change), abs(reals[at.CHANGE]))
    others = high / low if low > 0.0 else 0.0
    ints[at.STUCK] = 0
    elsewhere = 0.0
    if ints[at.REPEATS] > 0 and before != reals[at.REPEATED]:
        elsewhere, reals[at.REPEATED] = 1.0, before
    reals[at.ELSEWHERE] += (elsewhere - reals[at.ELSEWHERE]) / CHANGES
    if ints[at.REPEATS] == 0 or 4 * abs(ints[at.REPEATS] - usual) > max(usual, 4):
        ints[at.REGULAR] = max(ints[at.REGULAR] - 2, 0)
    elif low > 0.0 and abs(others - round(others)) > MULTIPLE + SINGLE * abs(y) / low:
        ints[at.REGULAR] = min(ints[at.REGULAR] + 1, MOST_REGULAR)
    if ints[at.REGULAR] == 0:
        ints[at.HELD_FOR], ints[at.HOLDS] = ints[at.REPEATS], 0
    elif ints[at.REGULAR] >= ENOUGH_REGULAR and not ints[at.HOLDS]:
        ints[at.HOLDS] = 1
        e.state.memory[SAMPLES] = 0.0  # the members begin afresh, with the sensor's own period
    ints[at.REPEATS], reals[at.CHANGE] = 0, change
    return False


@compiled()
def repeats_noise(e: EstimatorArrays, y: float) -> bool:
    """
    Return True, and count it, if y repeats itself although it has noise; after `is_held`.

    The sensor is stuck then, or at the end of its range: that y stands still is no motion. Only
    for self-tuning, which knows whether y has noise, and is not quantised.
    """
    (levels, memory), ints, n = e.state, e.policy.ints, e.law.gains.shape[1] - ORDERS
    if ints[at.REPEATS] <= CHANCE_REPEATS or y != e.policy.reals[at.SAMPLE]:
        return False  # also of another y whose stamp is not later: `is_held` leaves that alone
    if ints[at.REPEATS] == CHANCE_REPEATS + 1 and not ints[at.STUCK] and memory[ACTIVE] == COUNT:
        rough = members_in(levels[ROWS + n + ORDERS :], n, COUNT).rough[1]  # by white noise
        least = max(LEAST_NOISE**2 * rough[1], NO_NOISE * memory[FIRST_NOISE])
        least = max(least, (ROUNDED * e.policy.reals[at.SAMPLE]) ** 2)
        noisy = True
        for p in range(1, rough.size):
            noisy = noisy and rough[p] > least
        if noisy and e.policy.reals[at.ELSEWHERE] < RARELY:
            ints[at.STUCK] = 1
            ints[at.STUCK_EVENTS] += 1
    ints[at.REJECTED_STUCK_] += ints[at.STUCK]
    return bool(ints[at.STUCK])


@compiled()
def is_spike(policy: Policy, innovation: float) -> bool:
    """Return True, and count it, if y is too far from its prediction to be believed yet."""
    ints, reals = policy.ints, policy.reals
    if abs(innovation) <= reals[at.GATE]:
        ints[at.SPIKES] = 0
        return False
    ints[at.SPIKES] += 1
    if ints[at.SPIKES] > ints[at.GATE_SAMPLES]:
        ints[at.SPIKES] = 0
        ints[at.SPIKES_BELIEVED] += 1
        return False
    ints[at.REJECTED_SPIKES] += 1
    return True


@compiled(forceinline=True)
def has_diverged(e: EstimatorArrays, innovation: float, failed: bool, now: int) -> bool:
    """Return True if the state is beyond divergence_limit, or y is lost for divergence_time."""
    levels, ints, reals = e.state.levels, e.policy.ints, e.policy.reals
    for i in range(levels.shape[1]):
        if not max(abs(levels[HAT, i]), abs(levels[TILDE, i])) <= reals[at.LIMIT]:
            return True
    if not failed and abs(innovation) <= reals[at.EPSILON]:
        ints[at.LOST] = 0
        return False
    if not ints[at.LOST]:
        ints[at.LOST] = 1
        ints[at.LOST_SINCE] = now
        return False
    if ints[at.DIVERGENCE_TIME] == 0:
        return False
    return bool(difference(now, ints[at.LOST_SINCE]) > ints[at.DIVERGENCE_TIME])
