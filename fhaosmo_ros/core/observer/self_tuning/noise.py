# SPDX-License-Identifier: Apache-2.0
"""The noise of y, its quantum, and whether a sample is likely (D 29)."""

import math

from fhaosmo_ros.core.compiled.cache import compiled
from fhaosmo_ros.core.model.bytecode import Floats
from fhaosmo_ros.core.observer.arrays import QUANTUM, REPEATED, Y
from fhaosmo_ros.core.observer.covariance import GATE
from fhaosmo_ros.core.observer.self_tuning.filters import HUBER
from fhaosmo_ros.core.observer.self_tuning.members import (
    COLOUR,
    COLOURS,
    COUNT,
    Members,
    ORDERS,
    SCORE,
    SHORT,
    SQUARE,
)
import numpy as np

IGNORANT = 9.0
"""A member whose innovations' variance is so many times the smallest one does not judge y."""
CLIPPED = 0.9733
"""Mean of min(x^2, 9) where x is normal with variance 1."""
CLOSE = 8.0
"""Members whose log-likelihood is so far below the best of their colour do not tell the noise."""
SHORT_SHARE = 0.05
STEADY = 1.5
"""If squared innovations over S are larger of late for every member, the noise has grown."""
QUICK_SAMPLES = 30.0
"""It is averaged over so many samples then."""
SAME_LOW, SAME_HIGH = 0.3, 0.7
"""Shares of repeated samples between which y passes from noisy to quantised."""
SAME_SAMPLES = 300.0


@compiled()
def find_quantum(members: Members, memory: Floats, y: float) -> float:
    """
    Follow the quantum of y; return the half-width of the zone in which y says nothing (D 29).

    The zone is 0 unless samples repeat, which noise of the size of the quantum prevents.
    """
    step = abs(y - memory[Y])
    if step > 1e-12 * abs(y) and (memory[QUANTUM] == 0.0 or step < memory[QUANTUM]):
        memory[QUANTUM] = step
    repeats = 1.0 if step == 0.0 else 0.0
    memory[REPEATED] += (repeats - memory[REPEATED]) / SAME_SAMPLES
    share = min(max((memory[REPEATED] - SAME_LOW) / (SAME_HIGH - SAME_LOW), 0.0), 1.0)
    least = share * memory[QUANTUM] ** 2 / 12.0
    for c in range(COLOURS.size):
        square = max(members.noise[SQUARE, c], least * (1.0 - COLOURS[c] ** 2))
        members.noise[SQUARE, c] = square
    return float(0.5 * share * memory[QUANTUM])


@compiled()
def knowing(members: Members, s: Floats) -> float:
    """Return the largest variance of the innovations with which a member can judge a sample."""
    noise, least = members.noise[SQUARE], math.inf
    for k in range(ORDERS):
        for g in range(COUNT):
            least = min(least, s[k, g] * noise[COLOUR[g]])
    return IGNORANT * least


@compiled()
def is_likely(members: Members, b: Floats, s: Floats, largest: float) -> bool:
    """Return True if a member that can judge the sample finds it likely (D 29)."""
    noise = members.noise[SQUARE]
    for k in range(ORDERS):
        for g in range(COUNT):
            variance = s[k, g] * noise[COLOUR[g]]
            if variance <= largest and b[k, g] * b[k, g] <= GATE * GATE * variance:
                return True
    return False


@compiled()
def follow_noise(members: Members, b: Floats, s: Floats, largest: float, count: float) -> float:
    """
    Follow the noise of y of each colour, by the innovations of its likeliest members (D 29).

    Parameters
    ----------
    largest : float
        See `knowing`.
    count : float
        Number of samples to average over.

    Returns
    -------
    float
        How much larger than expected squared innovations have been of late, for every member:
        more than 1 while the noise grows.

    """
    record, noise = members.record, members.noise
    weights, squares, least = np.zeros(COLOURS.size), np.zeros(COLOURS.size), math.inf
    best = np.full(COLOURS.size, -math.inf)
    for k in range(ORDERS):
        for g in range(COUNT):
            best[COLOUR[g]] = max(best[COLOUR[g]], record[SCORE, k, g])
    for k in range(ORDERS):
        for g in range(COUNT):
            r = b[k, g] * b[k, g] / (s[k, g] * noise[SQUARE, COLOUR[g]])
            r = min(r, HUBER * HUBER)
            record[SHORT, k, g] += SHORT_SHARE * (r - record[SHORT, k, g])
            if s[k, g] * noise[SQUARE, COLOUR[g]] <= largest:
                least = min(least, record[SHORT, k, g])
            below = record[SCORE, k, g] - best[COLOUR[g]]
            if below > -CLOSE:
                share = math.exp(below)
                weights[COLOUR[g]] += share
                squares[COLOUR[g]] += share * r
    if least > STEADY:  # every member that can judge says so: the noise has grown
        count = min(count, QUICK_SAMPLES)
    for c in range(COLOURS.size):
        ratio = squares[c] / weights[c] / CLIPPED
        noise[SQUARE, c] *= 1.0 + (ratio - 1.0) / count
    return max(least, 1.0)
