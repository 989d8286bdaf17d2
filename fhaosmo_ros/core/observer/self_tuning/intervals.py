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
from fhaosmo_ros.core.observer.self_tuning.filters import at, HUBER, INEXACT
from fhaosmo_ros.core.observer.self_tuning.members import (
    COUNT,
    FAR,
    HALF,
    LOG_VARIANCE,
    Members,
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

VAGUE = 0.1
"""Part of the quantum by which predictions of z_1 are less certain than their P says."""
LEAST_CHANCE = -6.0
"""Logarithm of the least probability that a sample counts with."""
LEAST_PASSAGE = -12.0
"""That of the least probability with which z_1 passes an edge at just this sample."""
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
WELL_WITHIN = 1.75
"""If both edges are so many standard deviations off, z_1 is within them more likely than both."""
NARROW = 0.03
"""In an interval of so few standard deviations the density is taken to be constant."""
FAR_TAIL = 5.5
"""An interval that is so many standard deviations off counts as its nearer end."""
UNUSED = -1e6
"""Log-likelihood of members with coloured noise, which errors of rounding are not."""


@compiled(forceinline=True)
def chance_below(x: float) -> float:
    """Return the probability that a normal number of variance 1 is less than `x`."""
    return 0.5 * math.erfc(-x / math.sqrt(2.0))


@compiled(forceinline=True)
def density(x: float) -> float:
    """Return the density of a normal number of variance 1."""
    return math.exp(-0.5 * x * x) / math.sqrt(2.0 * math.pi)


@compiled(inline='always')
def within(low: float, high: float) -> tuple[float, float, float]:
    """
    Return what is known of a normal number of mean 0 and variance 1 that lies between two others.

    Returns
    -------
    chance : float
        The logarithm of the probability that it does.
    mean : float
    lost : float
        Its variance is smaller than 1 by this.

    """
    nearer, farther = (low, high) if low + high > 0.0 else (-high, -low)
    width = high - low
    if nearer < -FAR_TAIL:
        return 0.0, 0.0, 0.0
    if width < NARROW:
        mean = 0.5 * (nearer + farther)
        chance = math.log(width * density(mean))
        lost = 1.0 - width * width / 12.0
    elif nearer > FAR_TAIL:
        mean = nearer + 1.0 / nearer
        chance = -0.5 * nearer * nearer
        lost = 1.0 - 1.0 / (nearer * nearer)
    else:
        share = chance_below(-nearer) - chance_below(-farther)
        left, right = density(nearer), density(farther)
        mean = (left - right) / share
        lost = mean * mean - (nearer * left - farther * right) / share
        chance = math.log(share)
    return chance, mean if low + high > 0.0 else -mean, min(max(lost, 0.0), 1.0)


@compiled(inline='always')
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
    density = math.exp(-0.5 * to_edge * to_edge / variance) / math.sqrt(2.0 * math.pi * variance)
    return density * 0.5 * (moved + math.sqrt(moved * moved + 2.0 / math.pi * spread))


@compiled()
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
    half, p, noise = math.sqrt(3.0 * quanta), scratch.p[0], members.noise[SQUARE, 0]
    apart, vague = max(noise - quanta, 0.0), (2.0 * VAGUE * half) ** 2  # not of rounding
    least, carried = apart + vague, 2.0 * (apart + min(OF_BACK * back, 1.0) * vague)
    inverse, taken, innovation = scratch.lines[0], scratch.lines[2], scratch.b
    score, prior, far = members.record[SCORE], members.record[PRIOR], members.record[FAR]
    repeated, one_step = y == before, 0.0 < abs(y - before) < 3.0 * half
    side = 1.0 if y > before else -1.0
    speed = members.p[at(len(members.x), 1, 1)]  # variance of the state behind z_1
    for g in range(members.active):
        square = innovation[g] * innovation[g]
        far[g] = far[g] + 1.0 if square > GATE * GATE * scratch.s[g] * noise else 0.0
        variance = INEXACT * (p[g] + least)
        size, off = math.sqrt(variance), y - scratch.x[0, g]
        chance = mean = lost = 0.0
        if not repeated or half - abs(off) < WELL_WITHIN * size:
            chance, mean, lost = within((off - half) / size, (off + half) / size)
        likelihood = max(chance, LEAST_CHANCE)
        moved, spread = scratch.x[0, g] - members.x[0, g], h * h * speed[g]
        was = members.p[0, g] + least
        if (repeated or one_step) and moved * moved + spread < SLOW * was:
            off = side * (before - members.x[0, g])
            passed = passage(off + half, was, side * moved, spread + carried)
            if repeated:
                passed += passage(half - off, was, -side * moved, spread + carried)
                likelihood = min(likelihood - HALF_SURE, -passed)
            elif passed < 1.0:
                passed = math.log(max(passed, 1e-9))
                likelihood = min(likelihood, max(passed, LEAST_PASSAGE))
        elif repeated:
            likelihood = min(likelihood - EVENLY, 0.0)
        if kept >= 0.0:
            score[g] = prior[g] + kept * (score[g] - prior[g]) + likelihood
        if repeated and chance > KNOWN:
            innovation[g] = inverse[g] = taken[g] = 0.0
        else:
            late = max(far[g] - 1.0, 0.0)
            limit = HUBER * (1.0 + late * late)
            innovation[g] = min(max(mean, -limit), limit) * math.sqrt(variance)
            inverse[g], taken[g] = 1.0 / variance, lost / variance


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
