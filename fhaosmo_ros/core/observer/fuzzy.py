# SPDX-License-Identifier: Apache-2.0
"""
Curves psi that a step reads in constant time, of the paper's fuzzy systems or by their samples.

A text of `fuzzy_systems`, for each level, says which. The default is the paper's: psi_1 has 5
terms, psi_2 and psi_3 have 7, evenly over [-1, 1]; rule k maps term k of the input to term k of
the output (paper, section 3). A half-width scales the input, so that it can change without a new
inference.
"""

from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import Any

from fhaosmo_ros.core.parameters.declaration import shown
from fhaosmo_ros.core.parameters.errors import ConfigurationError
import numpy as np
from numpy.typing import NDArray

SHAPES = {'triangle': (1.0, 0.0), 'trapezoid': (0.75, 0.25), 'gaussian': (0.5, 0.0)}
"""Where membership is 0 and 1 (a bell's: 1/2 and 1), in parts of the way to the next peak."""
MOST_TERMS = 99
KNOTS = 193
"""Samples of a curve on [0, 1]: halves, thirds and quarters, where it has corners, are knots."""
UNIVERSE = np.linspace(-1.0, 1.0, 2049)
"""Output universe; its grid holds every peak of 5 terms, and 0 and +-1 of 7."""
SMALL = 1e-6
"""The grid of the output universe can not tell less; a smaller psi(1) is 0."""

Curve = NDArray[np.float64]


def memberships(universe: Curve, shape: str, count: int) -> Curve:
    """
    Return the membership functions of terms that divide [-1, 1] evenly, a row for each.

    A triangle reaches 0 at its neighbours' peaks; a trapezoid is 1 over half of that; trapezoids
    and bells cross their neighbours at 1/2.
    """
    peaks = np.linspace(-1.0, 1.0, count)[:, np.newaxis]
    gap, off = peaks[1] - peaks[0], universe - peaks
    if shape == 'gaussian':
        sigma = gap / (2.0 * np.sqrt(2.0 * np.log(2.0)))
        return np.asarray(np.exp(-(off**2) / (2.0 * sigma**2)))
    foot, shoulder = (peaks + part * np.copysign(gap, off) for part in SHAPES[shape])
    return np.asarray(np.clip((universe - foot) / (shoulder - foot), 0.0, 1.0))


def infer(x: Curve, shape: str, count: int) -> Curve:
    """Mamdani inference for inputs (K,) in [-1, 1]: minimum, maximum, centroid."""
    outputs = memberships(UNIVERSE, shape, count)
    activations = memberships(x, shape, count).T
    return np.array([_centroid(np.minimum(a[:, None], outputs).max(axis=0)) for a in activations])


def _centroid(y: Curve) -> Any:
    """Return the centroid of the region below a line through points over `UNIVERSE`."""
    begin, step, left, right = UNIVERSE[:-1], np.diff(UNIVERSE), y[:-1], y[1:]
    with np.errstate(invalid='ignore'):  # 0 / 0 where the region has no height
        middle = 2.0 / 3.0 * step * (right + 0.5 * left) / (left + right) + begin
    cases = [left == right, left == 0.0, right == 0.0]
    exact = [0.5 * (begin + UNIVERSE[1:]), 2.0 / 3.0 * step + begin, 1.0 / 3.0 * step + begin]
    middle = np.select(cases, exact, middle)
    area = np.where(left == right, step * left, 0.5 * step * (left + right))
    return np.cumsum(middle * area)[-1] / np.cumsum(area)[-1]


@lru_cache(maxsize=32)
def curve(text: str) -> Curve:
    """
    Return psi at `KNOTS` evenly spaced points of [0, 1] (it is odd), read-only.

    Parameters
    ----------
    text : str
        ``terms [SHAPE] P`` for P terms, as a triangle where no shape of `SHAPES` is named, or
        ``curve 0 v1 v2 ..`` for evenly spaced samples of psi over [0, 1].

    Returns
    -------
    (KNOTS,) array
        0 at 0, non-decreasing, 1 at 1: a centroid alone ends at about 0.83 (5 terms), which would
        cut every gain.

    Raises
    ------
    ConfigurationError
        The text is neither, or its curve falls, stays 0, or leaves [-1, 1].

    """
    grid = np.linspace(0.0, 1.0, KNOTS)
    kind, *words = text.replace(',', ' ').split() or ['']
    shape = words.pop(0) if kind == 'terms' and words and words[0][0].isalpha() else 'triangle'
    if kind not in ('terms', 'curve'):
        raise _refused(text, f'terms [{"|".join(SHAPES)}] P, or curve 0 v1 v2 ..', repr(kind))
    if shape not in SHAPES:
        raise _refused(text, f'a shape of {", ".join(SHAPES)}', repr(shape))
    try:
        numbers = [float(word) for word in words]
    except ValueError:
        numbers = []
    if not numbers or not np.isfinite(numbers).all():
        raise _refused(text, 'numbers', shown(' '.join(words)))
    if kind == 'curve':
        if len(numbers) < 2 or numbers[0] != 0.0:
            raise _refused(text, '2 samples or more, the first one 0', shown(numbers))
        psi = np.interp(grid, np.linspace(0.0, 1.0, len(numbers)), numbers)
    elif len(numbers) > 1 or numbers[0] not in range(3, MOST_TERMS + 1, 2):
        got = ' '.join(f'{number:g}' for number in numbers)
        raise _refused(text, f'an odd number of terms, 3 to {MOST_TERMS}', shown(got))
    else:
        psi = infer(grid, shape, int(numbers[0]))
        psi[0] = 0.0  # an odd curve is 0 there; the inference leaves rounding errors
        # What falls by less than the grid of the output universe can tell does not fall.
        level = np.maximum.accumulate(psi)
        psi = np.where(level - psi < SMALL, level, psi)
    k = int(np.diff(psi).argmin())
    if psi[k + 1] < psi[k]:
        where = [f'psi({j / (KNOTS - 1):.3g}) = {psi[j]:.4g}' for j in (k, k + 1)]
        raise _refused(text, 'a curve that does not fall', ', '.join(where))
    if not SMALL < psi[-1] <= 1.0:
        got = f'psi(1) = {psi[-1]:.4g}'
        raise _refused(text, 'a curve that ends above 0 and at most at 1', got)
    psi /= psi[-1]
    psi.flags.writeable = False
    return np.asarray(psi)


def curves(parameters: Mapping[str, Any], levels: int) -> Curve:
    """Return psi of each level, (N, KNOTS), as `fuzzy_systems` among the parameters says."""
    texts = parameters['fuzzy_systems']
    return np.array([curve(of_level(texts, i)) for i in range(levels)])


def of_level(values: Sequence[Any], level: int) -> Any:
    """Return what a list says for a level (0-based): its last value serves those that follow."""
    return values[min(level, len(values) - 1)]


def _refused(text: str, allowed: str, got: str) -> ConfigurationError:
    return ConfigurationError(
        f"parameter 'fuzzy_systems': expected {allowed}, got {got} in {shown(text)}"
    )
