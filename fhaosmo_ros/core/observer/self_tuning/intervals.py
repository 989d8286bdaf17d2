# SPDX-License-Identifier: Apache-2.0
"""
The members where y is quantised: a sample says within which interval z_1 lies (D 31, D 36).

Estimate and covariance become those of the normal distribution with the mean and the variance that
the truncated one has (Curry, Vander Velde and Potter 1970, IEEE Transactions on Information Theory
16, 152-161).
"""

import math

from fhaosmo_ros.core.compiled.cache import compiled
from fhaosmo_ros.core.model.bytecode import Floats
from fhaosmo_ros.core.observer.arrays import ACTIVE, UNSETTLED
from fhaosmo_ros.core.observer.covariance import GATE
from fhaosmo_ros.core.observer.self_tuning.covariances import at, INEXACT
from fhaosmo_ros.core.observer.self_tuning.filters import HUBER
from fhaosmo_ros.core.observer.self_tuning.members import (
    COUNT,
    FAR,
    FAST,
    HALF,
    LOG_VARIANCE,
    Members,
    ORDERS,
    PRIOR,
    RESIDUAL,
    SCORE,
    Scratch,
    SHORT,
    SQUARE,
    USED,
    VARIANCE,
    WEIGHT,
    WHITE,
)
from fhaosmo_ros.core.observer.self_tuning.normal import exponential, FARTHEST, mills, ROOT

SIZE, CHANCE, MEAN, LOST, SPARE = 1, 3, 4, 5, 6
"""Lines of the scratch."""
VAGUE = 0.1
"""Part of the quantum by which predictions of z_1 are less certain than their P says."""
LEAST_CHANCE = -6.0
"""Logarithm of the least probability that a sample counts with."""
LEAST_PASSAGE = -12.0
"""That of the least probability with which z_1 passes an edge at just this sample."""
LEAST_PASSED = math.exp(LEAST_PASSAGE)
OF_BACK = 3.0
"""
If more than one in so many of y's steps go back at once, noise of as much as `VAGUE` carries z_1
over edges. Innovations do not show noise that is far smaller than the quantum.
"""
SLOW = 0.25
"""
That probability is so small that it has to be found from the speed if z_1 moves, squared, by less
than this part of its variance.
"""
HALF_SURE = math.log(0.5)
"""A repeated sample counts for what is less likely than this, and for z_1 not passing an edge."""
EVENLY, KNOWN = math.log(0.917), math.log(0.88)
"""
A normal number with the variance of an even distribution in the interval lies in it with the first
probability. So a sample that repeats the one before, and that a member expects with more than the
second one, tells it nothing: each such sample would narrow it again.
"""
FEW_STATES = 3
"""
In models of more states a repeated sample narrows no member: many of them in a row would narrow
one whose z_1 is wrong, and one with a d that is thousands of times too large would be likelier.
"""
WELL_WITHIN = 1.75
"""If both edges are so many standard deviations off, z_1 is within them more likely than both."""
HALF_NARROW = 0.015
"""In an interval of twice so few standard deviations the density is taken to be constant."""
FAR_TAIL = 5.5
"""An interval that is so many standard deviations off counts as its nearer end."""
UNUSED = -1e6
"""Log-likelihood of members with coloured noise, which errors of rounding are not."""


@compiled(fastmath=FAST)
def truncate(scratch: Scratch, half: float, least: float, well_within: float, count: int) -> None:
    """
    Find what is known of the members' z_1 if it lies within half a quantum of a sample.

    That is what is known of a normal number of mean 0 and variance 1 that lies between two others:
    its mean, by what its variance is smaller than 1, and the logarithm of the probability that it
    lies there, in the lines `MEAN`, `LOST` and `CHANCE` of the scratch. `SIZE` is the standard
    deviation of which these are parts.

    Parameters
    ----------
    half : float
        Half the quantum.
    least : float
        What is added to the variance of z_1.
    well_within : float
        If both edges are farther off than so many standard deviations, the sample tells nothing.

    """
    p, b, lines, size = scratch.p[0], scratch.b, scratch.lines, scratch.lines[SIZE]
    chance, smaller, mean, lost = lines[CHANCE], lines[SPARE], lines[MEAN], lines[LOST]
    for g in range(count):
        size[g] = math.sqrt(INEXACT * (p[g] + least))
        inverse = 1.0 / size[g]
        off, width = abs(b[g]) * inverse, half * inverse
        near, far = off - width, min(off + width, FARTHEST)
        to_near = min(abs(near), FARTHEST)
        left, right = exponential(-0.5 * to_near * to_near), exponential(-0.5 * far * far)
        beyond = left * mills(to_near)
        share = (beyond if near > 0.0 else ROOT - beyond) - right * mills(far)
        inverse, by_near = 1.0 / share, 1.0 / near
        center = (left - right) * inverse
        less = center * center - (near * left - far * right) * inverse
        nearly, tail, flat = near + by_near, 1.0 - by_near * by_near, 1.0 - width * width / 3.0
        narrow, outside, inside = width < HALF_NARROW, near > FAR_TAIL, near < -well_within
        share = ROOT if inside | outside else share
        chance[g] = (2.0 * width if narrow else share) * (1.0 / ROOT)
        square = near * near if outside else 0.0
        smaller[g] = off * off if narrow else square
        center = nearly if outside else center
        center = off if narrow else center
        mean[g] = 0.0 if inside else math.copysign(center, b[g])
        less = tail if outside else less
        less = flat if narrow else less
        lost[g] = 0.0 if inside else min(max(less, 0.0), 1.0)
    for g in range(count):
        chance[g] = (math.log(chance[g]) if chance[g] != 1.0 else 0.0) - 0.5 * smaller[g]


@compiled(forceinline=True)
def passage(to_edge: float, variance: float, moved: float, spread: float) -> float:
    """
    Return the probability that a normal number passes an edge above it between two samples.

    By the mean rate of upcrossings, density times mean speed (D 36, Rice 1945): the mean of v
    where v > 0 and of 0 elsewhere, for a normal v, is about (m + sqrt(m^2 + 2 s^2 / pi)) / 2.

    Parameters
    ----------
    to_edge : float
        How far the edge is from the mean of the number.
    variance : float
        Of the number.
    moved, spread : float
        How far it moves up between the samples, and the variance of that; noise on each of them
        counts twice.

    """
    density = exponential(-0.5 * to_edge * to_edge / variance) / (ROOT * math.sqrt(variance))
    return density * 0.5 * (moved + math.sqrt(moved * moved + 2.0 / math.pi * spread))


@compiled(fastmath=FAST)
def bound_chances(
    members: Members,
    scratch: Scratch,
    before: float,
    side: float,
    h: float,
    half: float,
    least: float,
    carried: float,
) -> None:
    """
    Find what slow members say of whether z_1 passes an edge at just this sample (D 36).

    With one that comes again, the logarithms of the probabilities are made larger first, since a
    member that expects it is to lose nothing. Then `SPARE` of the scratch bounds them.

    Parameters
    ----------
    before : float
        The sample before.
    side : float
        1 if y has risen by one quantum, -1 if it has fallen, 0 if the sample comes again.
    h : float
        Time since then.
    half : float
        Half the quantum.
    least : float
        What is added to the variance of z_1.
    carried : float
        What noise adds to the variance of its motion.

    """
    chance, bound = scratch.lines[CHANCE], scratch.lines[SPARE]
    z, ahead, p = members.x[0], scratch.x[0], members.p[0]
    speed = members.p[at(len(members.x), 1, 1)]  # variance of the state behind z_1
    if side == 0.0:
        for g in range(members.active):
            moved, spread, was = ahead[g] - z[g], h * h * speed[g], p[g] + least
            up = passage(before + half - z[g], was, moved, spread + carried)
            down = passage(z[g] + half - before, was, -moved, spread + carried)
            slow = moved * moved + spread < SLOW * was
            bound[g] = -(up + down) if slow else 0.0
            chance[g] = max(chance[g], LEAST_CHANCE) - (HALF_SURE if slow else EVENLY)
        return
    for g in range(members.active):
        moved, spread, was = side * (ahead[g] - z[g]), h * h * speed[g], p[g] + least
        passed = passage(side * (before - z[g]) + half, was, moved, spread + carried)
        slow = moved * moved + spread < SLOW * was
        bound[g] = min(passed, 1.0) if slow else 1.0
    for g in range(members.active):
        bound[g] = math.log(bound[g]) if bound[g] > LEAST_PASSED else LEAST_PASSAGE


@compiled(fastmath=FAST)
def take_interval(
    members: Members,
    scratch: Scratch,
    y: float,
    before: float,
    h: float,
    quanta: float,
    kept: float,
    back: float,
) -> None:
    """
    Take a quantised sample into the log-likelihoods, and find how it corrects members (D 31).

    For `correct_states` and `correct_covariances`: innovations in ``scratch.b``, and their factors
    in ``scratch.lines``. Members with coloured noise do not take part.

    Parameters
    ----------
    before : float
        The sample before.
    h : float
        Time since then.
    quanta : float
        Variance of the error of rounding.
    kept : float
        Part of the log-likelihoods that is not forgotten; negative to leave them as they are.
    back : float
        Share of y's steps, of late, that go back where the sample before came from.

    """
    half, noise = math.sqrt(3.0 * quanta), members.noise[SQUARE, 0]
    apart, vague = max(noise - quanta, 0.0), (2.0 * VAGUE * half) ** 2  # not of rounding
    least, carried = apart + vague, 2.0 * min(OF_BACK * back, 1.0) * (apart + vague)
    inverse, taken, innovation, s = scratch.lines[0], scratch.lines[2], scratch.b, scratch.s
    size, chance, mean, lost, bound = (
        scratch.lines[SIZE], scratch.lines[CHANCE], scratch.lines[MEAN], scratch.lines[LOST],
        scratch.lines[SPARE],
    )  # fmt: skip
    score, prior, far = members.record[SCORE], members.record[PRIOR], members.record[FAR]
    for g in range(members.active):
        square = innovation[g] * innovation[g]
        far[g] = far[g] + 1.0 if square > GATE * GATE * s[g] * noise else 0.0
    repeated = y == before
    known = KNOWN if repeated else math.inf
    narrowing = 0.0 if repeated and len(members.x) > FEW_STATES + ORDERS else 1.0
    truncate(scratch, half, least, WELL_WITHIN if repeated else FAR_TAIL, members.active)
    for g in range(members.active):
        late = max(far[g] - 1.0, 0.0)
        limit = HUBER * (1.0 + late * late)
        told = chance[g] <= known
        innovation[g] = min(max(mean[g], -limit), limit) * size[g] if told else 0.0
        inverse[g] = 1.0 / (size[g] * size[g]) if told else 0.0
        taken[g] = lost[g] * inverse[g] * narrowing
    if kept < 0.0:
        return
    bound[: members.active] = 0.0
    if abs(y - before) < 3.0 * half:
        side = 0.0 if repeated else math.copysign(1.0, y - before)
        bound_chances(members, scratch, before, side, h, half, least, carried)
    for g in range(members.active):
        likelihood = min(max(chance[g], LEAST_CHANCE), bound[g])
        score[g] = prior[g] + kept * (score[g] - prior[g]) + likelihood


@compiled()
def choose_members(members: Members, memory: Floats, quanta: float) -> int:
    """
    Return how many members take part: where y is quantised, those with white noise (D 31).

    Errors of rounding are not coloured noise. When y is quantised no more, members with coloured
    noise go on from those with white noise.
    """
    before, count = memory[ACTIVE], HALF if quanta > 0.0 else COUNT
    memory[ACTIVE] = count
    if count < before:
        for g in range(HALF, COUNT):
            members.record[WEIGHT, g], members.record[SCORE, g] = 0.0, UNUSED
    elif count > before:
        memory[UNSETTLED] = 0.0
        members.noise[SQUARE] = members.noise[USED] = members.noise[SQUARE, 0]
        for g in range(HALF, COUNT):
            white = WHITE[g]
            members.x[:, g], members.p[:, g] = members.x[:, white], members.p[:, white]
            members.gain[:, g], members.record[RESIDUAL, g] = members.gain[:, white], 0.0
            members.record[VARIANCE, g] = members.record[VARIANCE, white]
            members.record[LOG_VARIANCE, g] = members.record[LOG_VARIANCE, white]
            members.record[SHORT, g], members.record[FAR, g] = 1.0, 0.0
    return count
