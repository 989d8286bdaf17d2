# SPDX-License-Identifier: Apache-2.0
"""
Jumps: of d (D 33), and of y that are too small to be lost samples and that no d explains (D 35).

After a jump of d y is farther and farther off. A sensor that slips puts an offset on y. A few
samples of it are enough for quick members to become likely, whose d explains anything, and is
larger by orders of magnitude. So the innovations of the member that was likely are tested for a
mean (Willsky and Jones 1976).
"""

import math

from fhaosmo_ros.core.compiled.cache import compiled
from fhaosmo_ros.core.model.bytecode import Floats
from fhaosmo_ros.core.observer.arrays import (
    BEYOND,
    FIRST_OFF,
    FIRST_ROUGH,
    GROWING,
    MISS,
    UNEVEN,
    UNSETTLED,
    UPSET,
)
from fhaosmo_ros.core.observer.covariance import GATE
from fhaosmo_ros.core.observer.self_tuning.filters import HUBER
from fhaosmo_ros.core.observer.self_tuning.members import (
    BANDWIDTHS,
    by_binomials,
    COLOUR,
    COUNT,
    FAR,
    HALF,
    KAPPA,
    Members,
    put,
    RESIDUAL,
    SCORE,
    SQUARE,
    WINDOW,
)
from fhaosmo_ros.core.observer.self_tuning.noise import ROUGH
from fhaosmo_ros.core.observer.step import LOST_SAMPLES
import numpy as np

GROWTHS = 3.0
"""If so many samples in a row are farther off than the first one, d has jumped (D 33)."""
FARTHER, POWER, SMOOTH, SMOOTHEST = 1.3, 0.7, 5.0, 30.0
"""
Farther means: so many times as far, and 3 sigma more; so much of what a jump of d makes of it; and
so many times the highest differences of y, which noise does not get to. Differences must not have
been larger than usual before, unless y is farther off by the last factor.
"""
SHAPE, BELIEVED = 2.0, 8.0
"""
By so much, in twice the log-likelihood, a jump has to explain the innovations better than growing
ones or more noise, and than any other member; and white noise to be likelier than coloured noise.
"""
MEMBER, AGE = range(2)
"""Entries of `Members.watch`."""


@compiled()
def begin_growth(memory: Floats, off: float, highest: float, roughness: float) -> None:
    """Take the first of the unlikely samples in a row."""
    memory[FIRST_OFF], memory[UNEVEN], memory[FIRST_ROUGH] = off, highest, roughness


@compiled()
def respond(flow: Floats, n: int, z: Floats, before: Floats) -> float:
    """Carry what a jump of d by 1 has done to z to the next sample, in place; return z_1."""
    before[:] = z
    for i in range(n):
        z[i] = flow[i, n]
        for j in range(n):
            z[i] += flow[i, j] * before[j]
    return float(z[0])


@compiled()
def growth(flow: Floats, n: int, hidden: float, count: float) -> float:
    """
    Return how many times as far y is off, `count` samples later, because d has jumped.

    It is the less, the longer ago d has jumped: so long that y was off by at most the part
    `hidden` of what it is now in the sample before.
    """
    z, before = np.zeros(n), np.zeros(n)
    first = respond(flow, n, z, before)
    off = respond(flow, n, z, before)
    for _ in range(LOST_SAMPLES):  # after so many y would be lost
        if first > hidden * off:
            break
        first, off = off, respond(flow, n, z, before)
    for _ in range(int(count) - 1):
        off = respond(flow, n, z, before)
    return off / first if first > 0.0 else 1.0


@compiled()
def follow_growth(
    memory: Floats,
    flow: Floats,
    n: int,
    off: float,
    sigma: float,
    hidden: float,
    highest: float,
    roughness: float,
) -> bool:
    """
    Return True if unlikely samples are farther and farther off, so that d has jumped (D 33).

    Parameters
    ----------
    flow : (N, N) array
        Derivative of the prediction to this sample.
    off : float
        How far y is off the mean's prediction.
    sigma : float
        Standard deviation of the noise.
    hidden : float
        How far y could be off without being unlikely.
    highest : float
        Square of the highest difference of y, as a variance of white noise.
    roughness : float
        Squared differences of y over their usual size, of late, without this sample.

    """
    count = memory[BEYOND]
    if count == 0.0:
        begin_growth(memory, off, highest, roughness)
    first = memory[FIRST_OFF]
    memory[UNEVEN] += (highest - memory[UNEVEN]) / (count + 1.0)
    least = FARTHER * first + HUBER * sigma
    if count > 0.0:
        least = max(least, POWER * first * growth(flow, n, hidden / first, count))
    uneven = math.sqrt(memory[UNEVEN])
    least = max(least, SMOOTH * uneven)
    memory[GROWING] = memory[GROWING] + 1.0 if count > 0.0 and off > least else 0.0
    calm = memory[FIRST_ROUGH] < ROUGH or off > SMOOTHEST * uneven
    return bool(memory[GROWING] >= GROWTHS and calm)


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
    recent, g = members.recent, int(members.watch[MEMBER])
    if quanta > 0.0 or COLOUR[g] > 0:
        recent[:] = 0.0
    else:
        for j in range(WINDOW - 1):
            recent[j] = recent[j + 1]
        recent[WINDOW - 1] = b[g] / math.sqrt(s[g] * members.noise[SQUARE, 0])
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
    g = int(members.watch[MEMBER])
    if best <= GATE * GATE or not recent or BANDWIDTHS[g] * WINDOW > 1.0:
        return 0
    if best <= otherwise(r, n) + SHAPE:
        return 0
    score, before = members.record[SCORE], members.before[0 if members.watch[AGE] >= count else 1]
    gained, most, coloured = score[g] - before[g], 0.0, -math.inf
    for m in range(HALF):
        most = max(most, 2.0 * (score[m] - before[m] - gained))
    for m in range(HALF, COUNT):
        coloured = max(coloured, 2.0 * (before[m] - before[g]))
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
    g = int(members.watch[MEMBER])
    variance, total = s[g] * members.noise[SQUARE, 0], 0.0
    for j in range(WINDOW - count, WINDOW):
        total += members.recent[j] * math.sqrt(variance)
    before = members.x[:, g] - total * members.gain[:, g]  # nothing of the jump is in z or d
    estimate = before.copy()
    estimate[0] += total / count
    by_binomials(estimate[n:], -members.rates[KAPPA, g])
    for m in range(COUNT):
        put(members, n, m, estimate)
        members.p[0, m] += variance / count
        members.record[RESIDUAL, m], members.record[FAR, m] = y - estimate[0], 0.0
    members.record[SCORE] = members.before[1]
    memory[UNSETTLED], memory[UPSET] = 0.0, 1.0
    watch(members, members.watch[MEMBER])


@compiled()
def shift(members: Members, memory: Floats, of_state: float, variance: float) -> None:
    """
    Let all members go on after a jump of y that has lost it (D 23).

    Parameters
    ----------
    of_state : float
        By what z_1 is another one now; 0 where y's offset is.
    variance : float
        That of the innovation which told the jump.

    """
    for g in range(COUNT):
        members.x[0, g] += of_state
        members.p[0, g] += variance
    members.rough[0, 0] += of_state - memory[MISS]
    memory[UNSETTLED] = memory[GROWING] = 0.0
    watch(members, members.watch[MEMBER])
