# SPDX-License-Identifier: Apache-2.0
"""
Jumps of y that are too small to be lost samples, and that no d explains (D 35).

A sensor that slips puts an offset on y. A few samples of it are enough for quick members to become
likely, whose d explains anything, and is larger by orders of magnitude. So the innovations of the
member that was likely are tested for a mean (Willsky and Jones 1976).
"""

import math

from fhaosmo_ros.core.compiled.cache import compiled
from fhaosmo_ros.core.model.bytecode import Floats
from fhaosmo_ros.core.observer.arrays import JUMPS, UNSETTLED
from fhaosmo_ros.core.observer.covariance import GATE
from fhaosmo_ros.core.observer.self_tuning.filters import HUBER
from fhaosmo_ros.core.observer.self_tuning.members import (
    BANDWIDTHS,
    COLOUR,
    COUNT,
    FAR,
    KAPPA,
    Members,
    ORDERS,
    RESIDUAL,
    SCORE,
    SQUARE,
    WINDOW,
)

SHAPE, BELIEVED = 2.0, 8.0
"""
By so much, in twice the log-likelihood, a jump has to explain the innovations better than growing
ones or more noise, and than any other member; and white noise to be likelier than coloured noise.
"""
MEMBER, AGE = range(2)
"""Entries of `Members.watch`."""


@compiled()
def watch(members: Members, member: float) -> None:
    """Begin to follow the innovations of a member."""
    members.recent[:] = 0.0
    members.watch[MEMBER], members.watch[AGE] = member, 0.0
    members.before[0] = members.before[1] = members.record[SCORE]


@compiled()
def follow_innovations(members: Members, b: Floats, s: Floats, quanta: float) -> None:
    """
    Take a sample into the window.

    Only of members with white noise, since coloured noise explains jumps; and of a y that is not
    quantised, whose errors of rounding have a mean for many samples.
    """
    recent, (k, g) = members.recent, divmod(int(members.watch[MEMBER]), COUNT)
    if quanta > 0.0 or COLOUR[g] > 0:
        recent[:] = 0.0
    else:
        for j in range(WINDOW - 1):
            recent[j] = recent[j + 1]
        recent[WINDOW - 1] = b[k, g] / math.sqrt(s[k, g] * members.noise[SQUARE, 0])
    members.watch[AGE] += 1.0
    if members.watch[AGE] >= WINDOW:
        members.watch[AGE] = 0.0
        members.before[1] = members.before[0]
        members.before[0] = members.record[SCORE]


@compiled()
def samples_since_jump(members: Members, n: int, told: float) -> int:
    """Return for how many samples y has been off by a constant (D 35); 0 if it is not."""
    r, best, first, total = members.recent, 0.0, 0, 0.0
    for m in range(WINDOW - 1, -1, -1):
        total += r[m]
        if total * total > best * (WINDOW - m):
            best, first = total * total / (WINDOW - m), m
    recent, count = first >= WINDOW // 2, WINDOW - first
    if (best <= HUBER * HUBER or not recent) and members.watch[MEMBER] != told:
        members.recent[:] = 0.0
        members.watch[MEMBER] = told
        return 0
    k, g = divmod(int(members.watch[MEMBER]), COUNT)
    if best <= GATE * GATE or not recent or BANDWIDTHS[g] * WINDOW > 1.0:
        return 0
    if best <= otherwise(r, n) + SHAPE:
        return 0
    score, before = members.record[SCORE], members.before[0 if members.watch[AGE] >= count else 1]
    gained, most, coloured = score[k, g] - before[k, g], 0.0, -math.inf
    for i in range(ORDERS):
        for m in range(COUNT):
            if COLOUR[m] > 0:
                coloured = max(coloured, 2.0 * (before[i, m] - before[k, g]))
            else:
                most = max(most, 2.0 * (score[i, m] - before[i, m] - gained))
    return count if best > most + BELIEVED and coloured < -BELIEVED else 0


@compiled()
def otherwise(r: Floats, n: int) -> float:
    """
    Return how well anything but a jump explains innovations: twice the gain of log-likelihood.

    A line through all of the window; powers, up to n, of the time since any sample of it, as a d
    that has jumped gives them; and noise that has grown since any sample.
    """
    middle, level, slope, size = 0.5 * (WINDOW - 1), 0.0, 0.0, 0.0
    for j in range(WINDOW):
        level += r[j]
        slope += (j - middle) * r[j]
        size += (j - middle) ** 2
    most, squares = level * level / WINDOW + slope * slope / size, 0.0
    for m in range(WINDOW - 1, -1, -1):
        count = WINDOW - m
        squares += r[m] * r[m]
        most = max(most, squares - count * (1.0 + math.log(max(squares / count, 1.0))))
        for power in range(1, n + 1 if count > 1 else 1):
            along, size = 0.0, 0.0
            for j in range(m, WINDOW):
                shape = float(j - m + 1) ** power
                along += shape * r[j]
                size += shape * shape
            most = max(most, along * along / size)
    return most


@compiled()
def follow_jump(members: Members, memory: Floats, n: int, count: int, s: Floats, y: float) -> None:
    """Let all members go on from the one that is followed, as if only z_1 had jumped (D 35)."""
    k, g = divmod(int(members.watch[MEMBER]), COUNT)
    variance, total = s[k, g] * members.noise[SQUARE, 0], 0.0
    for j in range(WINDOW - count, WINDOW):
        total += members.recent[j] * math.sqrt(variance)
    state = members.x[k][:, g] - total * members.gain[k][:, g]  # nothing of the jump is in z or d
    state[0] += total / count
    c, d = members.rates[KAPPA, g], state[n]
    rate, second = -c * d, c * c * d
    if k > 0:
        rate, second = rate + state[n + 1], second - 2.0 * c * state[n + 1]
    if k > 1:
        second += state[n + 2]
    for i in range(ORDERS):
        x, p = members.x[i], members.p[i]
        for m in range(COUNT):
            kappa = members.rates[KAPPA, m]
            for j in range(n + 1):
                x[j, m] = state[j]
            if i > 0:
                x[n + 1, m] = rate + kappa * d
            if i > 1:
                x[n + 2, m] = second + kappa * (2.0 * rate + kappa * d)
            p[0, m] += variance / count
            members.record[RESIDUAL, i, m] = y - state[0]
            members.record[FAR, i, m] = 0.0
    members.record[SCORE] = members.before[1]
    memory[UNSETTLED], memory[JUMPS] = 0.0, total / count
    watch(members, members.watch[MEMBER])
