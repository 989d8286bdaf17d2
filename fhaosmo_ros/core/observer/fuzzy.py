# SPDX-License-Identifier: Apache-2.0
"""
From the paper's rule bases to curves psi that a step reads in constant time.

psi_1 has 5 terms (NB NS ZR PS PB), psi_2 and psi_3 have 7 (NBB .. PBB); rule k maps term k of the
input to term k of the output (paper, section 3). scikit-fuzzy makes the membership functions and
the centroid; this is the only module that imports it, and only where a curve is not kept beside
the machine code yet, because importing it takes longer than reading a curve. Input and output
universes are [-1, 1]; a half-width scales the input, so that a width can change without a new
inference.
"""

from functools import lru_cache

from fhaosmo_ros.core.compiled.cache import kept
from fhaosmo_ros.core.parameters.errors import ConfigurationError
import numpy as np
from numpy.typing import NDArray

TERMS = {5: ('NB', 'NS', 'ZR', 'PS', 'PB'), 7: ('NBB', 'NB', 'NS', 'ZR', 'PS', 'PB', 'PBB')}
KNOTS = 193
"""Samples of a curve on [0, 1]: halves, thirds and quarters, where it has corners, are knots."""
UNIVERSE = np.linspace(-1.0, 1.0, 2049)
"""Output universe; its grid holds every peak of 5 terms, and 0 and +-1 of 7."""

Curve = NDArray[np.float64]


def terms_of_level(level: int) -> int:
    """Return how many terms the rule base of a level (1-based) has."""
    return 5 if level == 1 else 7


def memberships(universe: Curve, terms: int, shape: str) -> Curve:
    """
    Return the membership functions of evenly spaced terms on [-1, 1].

    Parameters
    ----------
    universe : (K,) array
        Where to evaluate them, within [-1, 1].
    terms : int
        5 or 7.
    shape : {'triangle', 'gaussian'}
        Triangles reach 0 at their neighbours' peaks; bells cross there neighbours at 1/2.

    Returns
    -------
    (terms, K) array
        One row a term, from the most negative to the most positive.

    """
    import skfuzzy

    peaks = np.linspace(-1.0, 1.0, terms)
    gap = peaks[1] - peaks[0]
    if shape == 'triangle':
        rows = [skfuzzy.trimf(universe, [c - gap, c, c + gap]) for c in peaks]
    elif shape == 'gaussian':
        sigma = gap / (2.0 * np.sqrt(2.0 * np.log(2.0)))
        rows = [skfuzzy.gaussmf(universe, c, sigma) for c in peaks]
    else:
        raise ConfigurationError(
            f"parameter 'fuzzy_shape': expected triangle or gaussian, got {shape!r}"
        )
    return np.array(rows)


def infer(x: float, terms: int, shape: str) -> float:
    """
    Mamdani inference with rule k: term k -> term k; minimum, maximum, centroid.

    Parameters
    ----------
    x : float
        Input within [-1, 1].

    Returns
    -------
    float
        The crisp output, not normalised.

    """
    import skfuzzy

    activation = memberships(np.array([x]), terms, shape)
    clipped = np.minimum(activation, _output_terms(terms, shape))
    return float(skfuzzy.defuzz(UNIVERSE, clipped.max(axis=0), 'centroid'))


@lru_cache(maxsize=32)
def curve(terms: int, shape: str, normalise: bool) -> Curve:
    """
    Return psi at `KNOTS` evenly spaced points of [0, 1] (it is odd), read-only.

    Parameters
    ----------
    normalise : bool
        Scale the curve to end at 1. The centroid alone ends at about 0.83 (5 terms).

    Returns
    -------
    (KNOTS,) array
        0 at 0, non-decreasing.

    """
    psi = kept(f'centroid_{terms}_{shape}', lambda: _centroid(terms, shape))
    if normalise:
        psi /= psi[-1]
    psi.flags.writeable = False
    return psi


def _centroid(terms: int, shape: str) -> Curve:
    psi = np.array([infer(x, terms, shape) for x in np.linspace(0.0, 1.0, KNOTS)])
    psi[0] = 0.0  # the rules are symmetric; the centroid leaves rounding errors
    return psi


@lru_cache(maxsize=8)
def _output_terms(terms: int, shape: str) -> Curve:
    return memberships(UNIVERSE, terms, shape)
