# SPDX-License-Identifier: Apache-2.0
"""The noise of y, its quantum, and whether a sample is likely (D 29)."""

import math

from fhaosmo_ros.core.compiled.cache import compiled
from fhaosmo_ros.core.model.bytecode import Floats
from fhaosmo_ros.core.observer.arrays import (
    BEYOND,
    FIRST_NOISE,
    GOES_BACK,
    INTERVAL,
    JITTER,
    LATTICE,
    QUANTUM,
    ROUGHNESS,
    Y,
)
from fhaosmo_ros.core.observer.self_tuning.filters import HUBER
from fhaosmo_ros.core.observer.self_tuning.members import (
    COLOUR,
    COLOURS,
    CORRELATION,
    FAR,
    FAST,
    fill,
    FIRST,
    HALF,
    largest_of,
    Members,
    SCORE,
    Scratch,
    SHORT,
    SQUARE,
)

IGNORANT = 3.0
"""A member whose innovations' variance is so many times the smallest one does not judge y."""
CLIPPED = 0.9733
"""Mean of min(x^2, 9) where x is normal with variance 1."""
CLOSE = 8.0
"""
Members whose log-likelihood is so far below the best one do not say whether a sample is likely,
and those so far below the best one of their colour do not tell the noise.
"""
SHORT_SHARE = 0.05
STEADY = 1.5
"""
If squared innovations over S are larger of late for every member that can judge, and squared
differences of y are too, the noise has grown.
"""
CALM_SAMPLES = 40.0
"""Until so many samples after that a sample judges the members only if one of them explains it."""
QUICK_SAMPLES = 30.0
"""It is averaged over so many samples then."""
LATTICE_STEPS = 30.0
"""The share of steps of y that are multiples of the quantum is averaged over so many."""
LATTICE_SHARE, NO_LATTICE = 0.9, 0.5
"""With a share above the first y is quantised; with one below the other the quantum is none."""
PASSED = 3.0
"""After more unlikely samples no member judges that was beyond the gate at the last likely one."""
HIDDEN = 4.0
"""Noise of so many times the variance of the error of rounding hides the quanta."""
ROUGH_SAMPLES = 100.0
"""Squared differences of y are averaged over so many samples."""
ROUGH = 2.0
"""The variance of the noise is at most so many times what they say."""


@compiled(forceinline=True)
def is_multiple(step: float, quantum: float, y: float) -> bool:
    """Return True if `step` is a multiple of `quantum`, up to the rounding of y to 32 bits."""
    tolerance = 1e-3 * quantum + 3e-7 * abs(y)
    return tolerance < 0.1 * quantum and abs(step - round(step / quantum) * quantum) <= tolerance


@compiled()
def follow_quantum(members: Members, memory: Floats, y: float) -> None:
    """
    Take a sample that is used: is the step to it a multiple of the quantum? (D 29).

    A step like the one before says nothing: so does y move at a constant speed. Another quantum is
    believed where it divides this one, or where this one is none.
    """
    step, quantum = abs(y - memory[Y]), memory[QUANTUM]
    if step <= 1e-12 * abs(y):
        return
    change = abs(members.rough[0, 2])  # from the step before, which may be 0
    goes_back = 1.0 if change > 1.5 * step else 0.0
    memory[GOES_BACK] += (goes_back - memory[GOES_BACK]) / LATTICE_STEPS
    fits = is_multiple(step, quantum, y)
    if not fits:
        fits = is_multiple(quantum, step, y)
        if fits or memory[LATTICE] < NO_LATTICE:
            memory[QUANTUM] = step
    if not fits:
        memory[LATTICE] -= memory[LATTICE] / LATTICE_STEPS
    elif change > 0.5 * memory[QUANTUM]:
        memory[LATTICE] += (1.0 - memory[LATTICE]) / LATTICE_STEPS


@compiled(forceinline=True)
def rounding(members: Members, memory: Floats) -> float:
    """Return the variance of the error of rounding; 0 if y is not quantised, or noise hides it."""
    quanta = memory[QUANTUM] ** 2 / 12.0
    hidden = HIDDEN * quanta < members.noise[SQUARE, 0]
    return 0.0 if hidden or memory[LATTICE] < LATTICE_SHARE else float(quanta)


@compiled()
def difference(members: Members, memory: Floats, y: float) -> tuple[float, float]:
    """
    Follow what the differences of y say that the noise of each colour is at most (D 29).

    White noise w adds C(2p, p) times its variance to that of a difference of order p. What y does
    besides adds to it, so that the smallest of the variances is an upper bound.

    Returns
    -------
    float
        Square of the difference of the order that bounds white noise, over its usual size.
    float
        The square of the highest difference, as a variance of white noise: of the order of the
        noise if noise is why y is off its prediction, and far less if d has moved it there.

    """
    last, orders = members.rough[0], members.rough.shape[1]
    value, binomial, least = y, 1.0, 1e-12 * memory[FIRST_NOISE]
    bound, ratio, highest = math.inf, 0.0, 0.0
    for p in range(orders):
        before, value_before = last[p], value
        last[p] = value
        value = value_before - before
        if p == 0:
            continue
        binomial *= (4.0 * p - 2.0) / p
        for c in range(COLOURS.size):
            white = value_before - members.rates[CORRELATION, FIRST[c]] * before
            r = white * white / (members.rough[1 + c, p] * binomial)
            if c == 0:
                highest = white * white / binomial
                if members.rough[1, p] < bound:
                    bound, ratio = members.rough[1, p], r
            grown = 1.0 + (min(r, HUBER * HUBER) / CLIPPED - 1.0) / ROUGH_SAMPLES
            members.rough[1 + c, p] = max(members.rough[1 + c, p] * grown, least)
    memory[ROUGHNESS] += SHORT_SHARE * (min(ratio, HUBER * HUBER) - memory[ROUGHNESS])
    return ratio, highest


@compiled()
def stamp_noise(members: Members, memory: Floats, h: float) -> float:
    """
    Follow how irregular the intervals are; return the variance of y if the stamps are why (D 29).

    Differences of y do not show that its stamps are wrong, but innovations do.
    """
    if memory[BEYOND] == 0.0:  # else the interval is that since the last sample taken
        if memory[INTERVAL] > 0.0:  # three stamps, one of them twice: 1 + 4 + 1
            change = (h - memory[INTERVAL]) ** 2 / (6.0 * h * memory[INTERVAL])
            memory[JITTER] += (change - memory[JITTER]) / ROUGH_SAMPLES
        memory[INTERVAL] = h
    return float(2.0 * memory[JITTER] * members.rough[1, 1])


@compiled(fastmath=FAST)
def knowing(members: Members, scratch: Scratch, s: Floats, likeliest: int) -> float:
    """
    Return the largest variance of the innovations with which a member can judge a sample.

    Members that have been found unlikely do not set it: without noise on y they expect innovations
    that are far too small. The likeliest one always can.
    """
    noise, less, spare = scratch.lines[0], scratch.lines[1], scratch.lines[2]
    fill(noise, members.noise[SQUARE])
    score = members.record[SCORE]
    for g in range(members.active):
        less[g] = -s[g] * noise[g] if score[g] > -CLOSE else -math.inf
    least = -largest_of(less, spare, members.active)
    return float(max(IGNORANT * least, s[likeliest] * noise[likeliest]))


@compiled()
def is_likely(
    members: Members, b: Floats, s: Floats, largest: float, beyond: float, gate: float
) -> bool:
    """
    Return True if a member that can judge the sample finds it likely (D 29).

    A member that is far off itself, or unlikely, would meet y by chance.

    Parameters
    ----------
    beyond : float
        Number of unlikely samples in a row before this one.

    """
    noise, late = members.noise[SQUARE], math.inf if beyond <= PASSED else 1.0
    for g in range(members.active):
        variance = s[g] * noise[COLOUR[g]]
        follows = members.record[FAR, g] < late
        judges = variance <= largest and members.record[SCORE, g] > -CLOSE
        if judges and follows and b[g] * b[g] <= gate * gate * variance:
            return True
    return False


@compiled()
def is_explained(members: Members, b: Floats, s: Floats) -> bool:
    """Return True if any member finds a sample usual, however unlikely the member itself is."""
    for g in range(members.active):
        if b[g] * b[g] <= HUBER * HUBER * s[g] * members.noise[SQUARE, COLOUR[g]]:
            return True
    return False


@compiled(fastmath=FAST)
def follow_noise(
    members: Members,
    scratch: Scratch,
    floor: float,
    s: Floats,
    largest: float,
    count: float,
    roughness: float,
    of_stamps: float,
) -> tuple[float, float]:
    """
    Follow the noise of y of each colour, by the innovations of its likeliest members (D 29).

    Parameters
    ----------
    floor : float
        The least that the variance of the noise can be.
    largest : float
        See `knowing`.
    count : float
        Number of samples to average over.
    roughness : float
        Squared differences of y over their usual size, of late.
    of_stamps : float
        See `stamp_noise`.

    Returns
    -------
    float
        How much larger than expected squared innovations have been of late, for every member, and
        squared differences too: more than 1 while the noise grows.
    float
        The least squared innovation, over its variance, of the members that can judge.

    """
    noise, score, short = members.noise, members.record[SCORE], members.record[SHORT]
    size, r, less, spare = (
        scratch.lines[0], scratch.lines[1], scratch.lines[2], scratch.lines[3]
    )  # fmt: skip
    best, weights, squares = scratch.lines[4], scratch.lines[5], scratch.lines[6]  # of colours
    weights[: COLOURS.size], squares[: COLOURS.size] = 0.0, 0.0
    best[0], best[1 : COLOURS.size] = largest_of(score, spare, HALF), -math.inf
    for g in range(HALF, members.active):
        best[COLOUR[g]] = max(best[COLOUR[g]], score[g])
    fill(less, noise[SQUARE])
    for g in range(members.active):
        size[g] = s[g] * less[g]
    for g in range(members.active):
        r[g] = min(scratch.b[g] * scratch.b[g] / size[g], HUBER * HUBER)
    for g in range(members.active):
        short[g] += SHORT_SHARE * (r[g] - short[g])
    for g in range(members.active):
        less[g] = -short[g] if size[g] <= largest else -math.inf
    least = min(roughness, -largest_of(less, spare, members.active))
    for g in range(members.active):
        less[g] = -r[g] if (size[g] <= largest) & (score[g] > -CLOSE) else -math.inf
    best_fit = -largest_of(less, spare, members.active)
    for g in range(members.active):
        off = score[g] - best[COLOUR[g]]
        if off > -CLOSE:
            weight = math.exp(off) if off < 0.0 else 1.0
            weights[COLOUR[g]] += weight
            squares[COLOUR[g]] += weight * r[g]
    if least > STEADY:  # every member that can judge says so, and the differences do
        count = min(count, QUICK_SAMPLES)
    for c in range(COLOURS.size if members.active > HALF else 1):
        ratio = squares[c] / weights[c] / CLIPPED
        noise[SQUARE, c] *= 1.0 + (ratio - 1.0) / count
        most = members.rough[1 + c, 1]
        for p in range(2, members.rough.shape[1]):
            most = min(most, members.rough[1 + c, p])
        noise[SQUARE, c] = max(min(noise[SQUARE, c], ROUGH * (most + of_stamps)), floor)
    return max(least, 1.0), best_fit
