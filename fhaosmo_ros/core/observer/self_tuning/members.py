# SPDX-License-Identifier: Apache-2.0
"""
The members of the self-tuning observer: which they are, and where they lie in memory (D 26).

A member is an observer with its own model of d (D 17: k = 0, 1 or 2 derivatives, intensity q,
decay kappa) and of the noise (white, or coloured: v_j = a v_{j-1} + w_j). Members of the same k
form an array, the slowest first. Arrays have one column a member, so that a step of all members is
a few loops that the compiler turns into vector instructions.

The members lie in the rows of ``State.levels`` behind the covariance, one array after the other.
"""

import math
from typing import NamedTuple

from fhaosmo_ros.core.compiled.cache import compiled
from fhaosmo_ros.core.model.bytecode import Floats
import numpy as np
from numpy.typing import NDArray

ORDERS = 3
"""Members have k = 0, 1, 2 derivatives of d."""
BANDS = 15
"""Bandwidths of the members of each k."""
SLOWEST, QUICKEST = 6e-4, 3.0
"""Their range, in rad a sample."""
COLOURS = np.array([0.0, 0.7, 0.92, 0.98])
"""Correlations a of the noise of neighbouring samples."""
KINDS = np.array([(0, 0.1), (0, 0.5), (0, 1.5), *((c, 0.1) for c in range(1, len(COLOURS)))])
"""Members of each bandwidth omega: index of the colour, and kappa / omega."""
IN_BAND = len(KINDS)
FIRST = np.searchsorted(KINDS[:, 0], np.arange(len(COLOURS)))
"""The first of each colour."""
COUNT = BANDS * IN_BAND
"""Members of each k."""
STEP_OF_BANDS = (QUICKEST / SLOWEST) ** (1.0 / (BANDS - 1))
BANDWIDTHS = np.repeat(np.geomspace(SLOWEST, QUICKEST, BANDS), IN_BAND)
"""omega of each member, in rad a sample."""
COLOUR = np.tile(KINDS[:, 0], BANDS).astype(np.int64)
RATIO = np.tile(KINDS[:, 1], BANDS)
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
WEIGHT, SCORE, VARIANCE, LOG_VARIANCE, RESIDUAL, FAR, SHORT, INTENSITY, PRIOR = range(9)
"""
Planes of `Members.record`: weights; log-likelihoods relative to the best; variances S of the
innovations over that of the noise, and their logarithms; last residuals of y; samples in a row
beyond the gate; short means of squared innovations; intensities q; scores without samples.
"""
PLANES = 9
SQUARE, USED = range(2)
"""Rows of `Members.noise`: variance of the noise of each colour, and the one that P counts on."""


OfEach = tuple[Floats, Floats, Floats]
"""An array for each k."""


class Members(NamedTuple):
    """
    The arrays of the members, as views on ``State.levels``.

    Attributes
    ----------
    rates : (4, COUNT) array
    noise : (2, colours) array
    rough : (1 + colours, n + 2) array
        Differences of y at the last sample, of order 0 to n + 1, and for each colour what those
        of order 1 to n + 1 say that the variance of the noise is at most.
    record : (PLANES, ORDERS, COUNT) array
    flow : (N, N) array
        Derivative of the prediction to the next sample.
    recent : (WINDOW,) array
        Innovations of the last samples over their standard deviations, of one member (D 35).
    watch : (2,) array
        Which member that is, and how many samples ago ``before[0]`` was.
    before : (2, ORDERS, COUNT) array
        Scores of two earlier samples, `WINDOW` apart.
    x : tuple of (n + 1 + k, COUNT) arrays
        Estimates of z, d and its derivatives, of the members with k = 0, 1, 2.
    p : tuple of ((n + 1 + k) (n + 2 + k) / 2, COUNT) arrays
        Upper triangles of their covariances, row by row.
    gain : tuple of (n + 1 + k, COUNT) arrays

    """

    rates: Floats
    noise: Floats
    rough: Floats
    record: Floats
    flow: Floats
    recent: Floats
    watch: Floats
    before: Floats
    x: OfEach
    p: OfEach
    gain: OfEach


def size_of(order: int) -> int:
    """Return how many numbers the members of a model with n = `order` states need."""
    total = 4 * COUNT + 2 * len(COLOURS) + PLANES * ORDERS * COUNT + (order + ORDERS) ** 2
    total += (1 + len(COLOURS)) * (order + 2) + WINDOW + 2 + 2 * ORDERS * COUNT
    for k in range(ORDERS):
        d = order + 1 + k
        total += (2 * d + d * (d + 1) // 2) * COUNT
    return total


def rows_of(order: int) -> int:
    """Return how many rows of N = n + 3 numbers hold the members."""
    return -(-size_of(order) // (order + ORDERS))


@compiled(forceinline=True)
def grid(flat: Floats, at: int, rows: int, columns: int) -> Floats:
    """Return the array of `rows` rows that begins at `at`."""
    return flat[at : at + rows * columns].reshape((rows, columns))


@compiled(forceinline=True)
def of_states(flat: Floats, at: int, d: int, columns: int) -> OfEach:
    """Return arrays of d, d + 1 and d + 2 rows, one behind the other."""
    second, third = at + d * columns, at + (2 * d + 1) * columns
    return (
        grid(flat, at, d, columns),
        grid(flat, second, d + 1, columns),
        grid(flat, third, d + 2, columns),
    )


@compiled(forceinline=True)
def of_pairs(flat: Floats, at: int, d: int, columns: int) -> OfEach:
    """Return arrays of a row for each pair of d, d + 1 and d + 2 states, as `of_states` does."""
    size = d * (d + 1) // 2
    second, third = at + size * columns, at + (2 * size + d + 1) * columns
    return (
        grid(flat, at, size, columns),
        grid(flat, second, size + d + 1, columns),
        grid(flat, third, size + 2 * d + 3, columns),
    )


@compiled(forceinline=True)
def members_in(rows: Floats, n: int) -> Members:
    """Return the members' arrays in the rows that hold them."""
    flat, c, colours, levels, d = rows.ravel(), COUNT, COLOURS.size, n + ORDERS, n + 2
    rates, at = grid(flat, 0, 4, c), 4 * c
    noise = flat[at : at + 2 * colours].reshape((2, colours))
    at += 2 * colours
    rough = flat[at : at + (1 + colours) * d].reshape((1 + colours, d))
    at += (1 + colours) * d
    record = flat[at : at + PLANES * ORDERS * c].reshape((PLANES, ORDERS, c))
    at += PLANES * ORDERS * c
    flow = flat[at : at + levels * levels].reshape((levels, levels))
    at += levels * levels
    recent, watch = flat[at : at + WINDOW], flat[at + WINDOW : at + WINDOW + 2]
    at += WINDOW + 2
    before = flat[at : at + 2 * ORDERS * c].reshape((2, ORDERS, c))
    at += 2 * ORDERS * c
    d = n + 1
    states, pairs = 3 * d + 3, 3 * d * (d + 1) // 2 + 3 * d + 4
    x = of_states(flat, at, d, c)
    p = of_pairs(flat, at + states * c, d, c)
    gain = of_states(flat, at + (states + pairs) * c, d, c)
    return Members(rates, noise, rough, record, flow, recent, watch, before, x, p, gain)


class Scratch(NamedTuple):
    """
    Memory that a step needs for itself, behind the other rows of ``Work.x``.

    Attributes
    ----------
    lines : (7, COUNT) array
    b, s : (ORDERS, COUNT) arrays
        Innovations, and their variances over that of the noise.
    x : tuple of arrays
        Predictions of the members' estimates.
    rest : array
        For what belongs to members that move.

    """

    lines: Floats
    b: Floats
    s: Floats
    x: OfEach
    rest: Floats


LINES = 7


def scratch_rows(order: int) -> int:
    """Return how many rows of N = n + 3 numbers a step needs for itself."""
    d = order + ORDERS
    moving: int = moving_size.py_func(order)  # type: ignore[attr-defined]
    total = LINES + 2 * ORDERS + 3 * d + moving + d * d + (order + 1) * ORDERS
    return -(-total * COUNT // d)


@compiled(forceinline=True)
def moving_size(n: int) -> int:
    """Return how many numbers the gains and covariances of a column are."""
    d = n + 1
    return 3 * d + 3 + 3 * d * (d + 1) // 2 + 3 * d + 4


@compiled(forceinline=True)
def scratch_in(rows: Floats, n: int) -> Scratch:
    """Return the memory of a step in the rows that hold it."""
    flat, c = rows.ravel(), COUNT
    lines, at = grid(flat, 0, LINES, c), LINES * c
    b, s = grid(flat, at, ORDERS, c), grid(flat, at + ORDERS * c, ORDERS, c)
    at += 2 * ORDERS * c
    x = of_states(flat, at, n + 1, c)
    return Scratch(lines, b, s, x, flat[at + (3 * n + 6) * c :])


@compiled(forceinline=True)
def repeat(values: Floats) -> None:
    """Give the members of all bands the values of the first."""
    for g in range(IN_BAND, COUNT):
        values[g] = values[g - IN_BAND]


@compiled(forceinline=True)
def fill(values: Floats, of_colours: Floats) -> None:
    """Write for each member of a k the value of its colour."""
    for g in range(IN_BAND):
        values[g] = of_colours[COLOUR[g]]
    repeat(values)


@compiled(forceinline=True)
def put(members: Members, n: int, k: int, g: int, estimate: Floats) -> None:
    """Put a member to an estimate of z, d, d' and d''; its own states are (D + kappa)^j d."""
    x, kappa = members.x[k], members.rates[KAPPA, g]
    for i in range(n + 1):
        x[i, g] = estimate[i]
    if k > 0:
        x[n + 1, g] = estimate[n + 1] + kappa * estimate[n]
    if k > 1:
        x[n + 2, g] = estimate[n + 2] + kappa * (2.0 * estimate[n + 1] + kappa * estimate[n])


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
    derivatives : (3,) array
        Shares of the models of d with 0, 1 and 2 derivatives.

    """

    noise: float
    correlation: float
    bandwidth: float
    derivatives: NDArray[np.float64]

    @classmethod
    def of(cls, found: NDArray[np.float64]) -> 'Tuning':
        """Return what the six numbers mean that `TUNING` names."""
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
    for g in range(IN_BAND):  # the members of a kind differ in their bandwidths alone
        of_kind = 0.0
        for k in range(ORDERS):
            for band in range(BANDS):
                w = weight[k, band * IN_BAND + g]
                of_kind += w
                bands += w * band
                found[3 + k] += w
        a = rates[CORRELATION, g]
        variance += of_kind * members.noise[SQUARE, COLOUR[g]] / (1.0 - a * a)
        correlation += of_kind * a
    found[0], found[1] = math.sqrt(variance), correlation
    found[2] = rates[KAPPA, 0] / RATIO[0] * math.exp(bands * math.log(STEP_OF_BANDS))
