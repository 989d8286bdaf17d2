# SPDX-License-Identifier: Apache-2.0
"""
The members of the self-tuning observer: which they are, and where they lie in memory (D 26).

A member is an observer with its own model of d (D 17: k = 0 to 3 derivatives, intensity q,
decay kappa) and of the noise (white, or coloured: v_j = a v_{j-1} + w_j). All have N = n + 4
states, of which those of derivatives that a model does not have stay 0. Arrays have one column a
member, so that a step of all members is a few long loops that the compiler turns into vector
instructions. Members with white noise come first, from the quickest to the slowest; those with
coloured noise follow from the slowest to the quickest: where only slow members' covariances move,
theirs are neighbours.

The members lie in the rows of ``State.levels`` behind the covariance, one array after the other.
"""

import math
from typing import NamedTuple

from fhaosmo_ros.core.compiled.cache import compiled
from fhaosmo_ros.core.compiled.unowned_arrays import doubles_at
from fhaosmo_ros.core.model.bytecode import Floats
import numpy as np
from numpy.typing import NDArray

ORDERS = 4
"""Members have k = 0, 1, 2, 3 derivatives of d."""
BANDS = 15
"""Bandwidths omega of the members of each k."""
SLOWEST, QUICKEST = 6e-4, 3.0
"""Their range, in rad a sample."""
DECAYS = np.array([[0.1, 0.6], [0.1, 1.5]])
"""
kappa / omega of the members of every second bandwidth, and of the others; with coloured noise it
is the first of two.
"""
COLOURS = np.array([0.0, 0.75, 0.92, 0.98])
"""Correlations a of the noise of neighbouring samples; the first is white noise."""
COLOURED = np.array([[1, 3], [1, 2]])
"""Which of these the members with coloured noise have, by bandwidths as `DECAYS`."""
KINDS = len(DECAYS[0])
"""Members of each bandwidth and k in each half: kappa differs, or the colour."""
IN_BAND = ORDERS * KINDS
HALF = BANDS * IN_BAND
"""Members with white noise, and with coloured noise."""
COUNT = 2 * HALF
STEP_OF_BANDS = (QUICKEST / SLOWEST) ** (1.0 / (BANDS - 1))
BAND = np.repeat(np.append(np.arange(BANDS)[::-1], np.arange(BANDS)), IN_BAND)
"""Number of each member's bandwidth, from the slowest."""
BANDWIDTHS = np.geomspace(SLOWEST, QUICKEST, BANDS)[BAND]
"""omega of each member, in rad a sample."""
ORDER = np.tile(np.repeat(np.arange(ORDERS), KINDS), 2 * BANDS)
"""k of each member."""
KIND = np.tile(np.arange(KINDS), COUNT // KINDS)
IS_WHITE = np.arange(COUNT) < HALF
COLOUR = np.where(IS_WHITE, 0, COLOURED[BAND % 2, KIND])
RATIO = DECAYS[BAND % 2, np.where(IS_WHITE, KIND, 0)]
"""kappa / omega of each member."""
FIRST = np.array([np.argmax(c == COLOUR) for c in range(len(COLOURS))])
"""The first member of each colour."""
WHITE = HALF - IN_BAND * (1 + BAND) + KINDS * ORDER
"""The first member with white noise of each member's bandwidth and k; it has the least kappa."""
LONGEST = 13
"""Largest number of states and known chains: order 12 and d."""
FACTORIALS = np.array([math.factorial(i) for i in range(2 * LONGEST + 8)], dtype=np.float64)
WINDOW = 32
"""A jump of y is looked for in so many samples (D 35)."""
FIRST_SAMPLES = 50
"""So many samples tell the period and the noise before the members begin."""

FAST = {'contract', 'nnan', 'nsz', 'reassoc'}
"""Sums may be taken in any order, so that the compiler makes vector instructions of them."""

KAPPA, TAU, CORRELATION, DECAYED = range(4)
"""Rows of `Members.rates`: kappa, correlation time of the noise, a and exp(-kappa h) for h."""
WEIGHT, SCORE, VARIANCE, LOG_VARIANCE, RESIDUAL, FAR, SHORT, PRIOR = range(8)
"""
Rows of `Members.record`: weights; log-likelihoods relative to the best; variances S of the
innovations over that of the noise, and their logarithms; last residuals of y; samples in a row
beyond the gate; short means of squared innovations; scores without samples.
"""
RECORDS = 8
SQUARE, USED = range(2)
"""Rows of `Members.noise`: variance of the noise of each colour, and the one that P counts on."""


class Members(NamedTuple):
    """
    The arrays of the members, as views on ``State.levels``.

    Attributes
    ----------
    active : int
        How many take part: all, or those with white noise where y is quantised.
    rates : (4, COUNT) array
    noise : (2, colours) array
    rough : (1 + colours, n + 2) array
        Differences of y at the last sample, of order 0 to n + 1, and for each colour what those
        of order 1 to n + 1 say that the variance of the noise is at most.
    record : (RECORDS, COUNT) array
    drive : (ORDERS, COUNT) array
        Intensities q, each in the row of the member's k; 0 elsewhere.
    flow : (N, N) array
        Derivative of the prediction to the next sample.
    recent : (WINDOW,) array
        Innovations of the last samples over their standard deviations, of one member (D 35).
    watch : (2,) array
        Which member that is, and how many samples ago ``before[0]`` was.
    before : (2, COUNT) array
        Scores of two earlier samples, `WINDOW` apart.
    x, gain : (N, COUNT) arrays
        Estimates of z, d and (D + kappa)^j d; and by what an innovation corrects them.
    p : (N (N + 1) / 2, COUNT) array
        Upper triangles of their covariances, row by row.

    """

    active: int
    rates: Floats
    noise: Floats
    rough: Floats
    record: Floats
    drive: Floats
    flow: Floats
    recent: Floats
    watch: Floats
    before: Floats
    x: Floats
    p: Floats
    gain: Floats


def size_of(order: int) -> int:
    """Return how many numbers the members of a model with n = `order` states need."""
    d = order + ORDERS
    columns = 4 + RECORDS + ORDERS + 2 + 2 * d + d * (d + 1) // 2
    total = columns * COUNT + 2 * len(COLOURS) + d * d + WINDOW + 2
    return total + (1 + len(COLOURS)) * (order + 2)


def rows_of(order: int) -> int:
    """Return how many rows of N numbers hold the members."""
    return -(-size_of(order) // (order + ORDERS))


@compiled(forceinline=True)
def grid(address: int, at: int, rows: int) -> Floats:
    """Return the array of `rows` rows of COUNT columns, `at` numbers behind an address."""
    array: Floats = doubles_at(address + 8 * at, (rows, COUNT))
    return array


@compiled(forceinline=True)
def members_in(rows: Floats, n: int, active: int) -> Members:
    """Return the members' arrays in the rows that hold them, which the caller keeps alive."""
    address, c, colours, d = rows.ctypes.data, COUNT, COLOURS.size, n + ORDERS
    rates, at = grid(address, 0, 4), 4 * c
    record, at = grid(address, at, RECORDS), at + RECORDS * c
    drive, at = grid(address, at, ORDERS), at + ORDERS * c
    before, at = grid(address, at, 2), at + 2 * c
    x, at = grid(address, at, d), at + d * c
    gain, at = grid(address, at, d), at + d * c
    p, at = grid(address, at, d * (d + 1) // 2), at + d * (d + 1) // 2 * c
    address += 8 * at
    noise, address = doubles_at(address, (2, colours)), address + 16 * colours
    rough, address = (
        doubles_at(address, (1 + colours, n + 2)), address + 8 * (1 + colours) * (n + 2)
    )  # fmt: skip
    flow, address = doubles_at(address, (d, d)), address + 8 * d * d
    recent, watch = doubles_at(address, WINDOW), doubles_at(address + 8 * WINDOW, 2)
    return Members(
        active, rates, noise, rough, record, drive, flow, recent, watch, before, x, p, gain
    )


class Scratch(NamedTuple):
    """
    Memory that a step needs for itself, behind the other rows of ``Work.x``.

    Attributes
    ----------
    lines : (LINES, COUNT) array
    b, s : (COUNT,) arrays
        Innovations, and their variances over that of the noise.
    x, gain, p : arrays
        Predictions of the members' estimates and covariances, and P C'.
    product : (N N, COUNT) array
        A P, row by row.
    chain : ((ORDERS - 1) n, COUNT) array
        By what d, (D + kappa) d and (D + kappa)^2 d act on each z.
    q : array
        What the intensities add to predicted covariances.
    holds : (5,) array
        Of which interval, intensities (two) and columns (first, last) `q` is.

    """

    lines: Floats
    b: Floats
    s: Floats
    x: Floats
    gain: Floats
    p: Floats
    product: Floats
    chain: Floats
    q: Floats
    holds: Floats


LINES = 7


def scratch_rows(order: int) -> int:
    """Return how many rows of N numbers a step needs for itself."""
    d = order + ORDERS
    columns = LINES + 2 + 2 * d + d * (d + 1) + d * d + (ORDERS - 1) * order
    return -(-(columns * COUNT + 5) // d)


@compiled(forceinline=True)
def scratch_in(rows: Floats, n: int) -> Scratch:
    """Return the memory of a step in the rows that hold it, which the caller keeps alive."""
    address, c, d = rows.ctypes.data, COUNT, n + ORDERS
    lines, at = grid(address, 0, LINES), LINES * c
    b, s = doubles_at(address + 8 * at, c), doubles_at(address + 8 * (at + c), c)
    at += 2 * c
    x, at = grid(address, at, d), at + d * c
    gain, at = grid(address, at, d), at + d * c
    p, at = grid(address, at, d * (d + 1) // 2), at + d * (d + 1) // 2 * c
    product, at = grid(address, at, d * d), at + d * d * c
    chain, at = grid(address, at, (ORDERS - 1) * n), at + (ORDERS - 1) * n * c
    q, at = grid(address, at, d * (d + 1) // 2), at + d * (d + 1) // 2 * c
    return Scratch(lines, b, s, x, gain, p, product, chain, q, doubles_at(address + 8 * at, 5))


@compiled(forceinline=True, fastmath=FAST)
def fill(values: Floats, of_colours: Floats) -> None:
    """Write for each member the value of its colour."""
    for g in range(HALF):
        values[g] = of_colours[0]
    for g in range(HALF, HALF + 2 * IN_BAND):
        values[g] = of_colours[COLOUR[g]]
    for g in range(HALF + 2 * IN_BAND, COUNT):
        values[g] = values[g - 2 * IN_BAND]


@compiled(fastmath=FAST)
def largest_of(values: Floats, spare: Floats, count: int) -> float:
    """
    Return the largest of the first `count` values.

    By halves: the compiler makes no vector instructions of a loop over the largest one so far.
    """
    half = (count + 1) // 2
    for g in range(count - half):
        spare[g] = max(values[g], values[half + g])
    for g in range(count - half, half):
        spare[g] = values[g]
    while half > 1:
        count, half = half, (half + 1) // 2
        for g in range(count - half):
            spare[g] = max(spare[g], spare[half + g])
    return float(spare[0])


@compiled(forceinline=True)
def by_binomials(chain: Floats, more: float) -> None:
    """Turn (D + c)^j d, j = 0, 1, .., into (D + c + more)^j d, in place."""
    for first in range(1, chain.size):
        for j in range(chain.size - 1, first - 1, -1):
            chain[j] += more * chain[j - 1]


@compiled(forceinline=True)
def put(members: Members, n: int, g: int, estimate: Floats) -> None:
    """Put a member to an estimate of z, d, d', ..; its own states are (D + kappa)^j d."""
    x = members.x
    for i in range(n + ORDERS):
        x[i, g] = estimate[i]
    by_binomials(x[n:, g], members.rates[KAPPA, g])
    for i in range(n + 1 + ORDER[g], n + ORDERS):
        x[i, g] = 0.0


class Tuning(NamedTuple):
    """
    What a self-tuning observer has found.

    Attributes
    ----------
    noise : float
        Standard deviation of the noise on y (unit of y).
    correlation : float
        Correlation of the noise of neighbouring samples; 0 for white noise.
    bandwidth : float
        How fast d is followed, in rad/s.
    derivatives : (4,) array
        Shares of the models of d with 0 to 3 derivatives.

    """

    noise: float
    correlation: float
    bandwidth: float
    derivatives: NDArray[np.float64]

    @classmethod
    def of(cls, found: NDArray[np.float64]) -> 'Tuning':
        """Return what the numbers mean that `TUNING` names."""
        noise, correlation, bandwidth = found[:3].tolist()
        return cls(noise, correlation, bandwidth, found[3:])


TUNING = ['noise', 'correlation', 'bandwidth', *(f'derivatives{k}' for k in range(ORDERS))]
"""Names of these numbers, in the order in which `find_tuning` writes them."""


@compiled(fastmath=FAST)
def find_tuning(members: Members, found: Floats) -> None:
    """Write what the members say to `found`, as `TUNING` names it."""
    weight, rates = members.record[WEIGHT], members.rates
    variance = correlation = bands = 0.0
    found[3:] = 0.0
    for g in range(COUNT):
        w, a = weight[g], rates[CORRELATION, g]
        variance += w * members.noise[SQUARE, COLOUR[g]] / (1.0 - a * a)
        correlation += w * a
        bands += w * BAND[g]
        found[3 + ORDER[g]] += w
    found[0], found[1] = math.sqrt(variance), correlation
    slowest = rates[KAPPA, HALF] / RATIO[HALF]
    found[2] = slowest * math.exp(bands * math.log(STEP_OF_BANDS))
