# SPDX-License-Identifier: Apache-2.0
"""
From fuzzy systems, the paper's or the user's, to curves psi that a step reads in constant time.

A system is one text of `fuzzy_systems`, a level each (`read_system`). The default is the paper's:
psi_1 has 5 terms (NB NS ZR PS PB), psi_2 and psi_3 have 7 (NBB .. PBB); rule k maps term k of the
input to term k of the output (paper, section 3). Input and output universes are [-1, 1]; a
half-width scales the input, so that a width can change without a new inference.
"""

from collections.abc import Callable, Mapping, Sequence
from functools import lru_cache
from itertools import pairwise
from typing import Any, NamedTuple

from fhaosmo_ros.core.parameters.declaration import shown
from fhaosmo_ros.core.parameters.errors import ConfigurationError
import numpy as np
from numpy.typing import NDArray

SHAPES: dict[str, Callable[[Any], Any]] = {
    'triangle': lambda off: np.clip(1.0 - off, 0.0, 1.0),
    'trapezoid': lambda off: np.clip(1.5 - 2.0 * off, 0.0, 1.0),
    'gaussian': lambda off: 0.5 ** np.square(2.0 * off),
}
"""Membership by the distance from a term's peak, in parts of that to its neighbour's."""
CLAUSES = 'terms', 'input', 'output', 'rules', 'curve'
SINGLETON = 'singleton'
"""Terms of the output may also be points."""
MOST_TERMS = 99
LEAST_GAP = 0.001
"""Between two peaks; about the spacing of the output universe."""
KNOTS = 193
"""Samples of a curve on [0, 1]: halves, thirds and quarters, where it has corners, are knots."""
UNIVERSE = np.linspace(-1.0, 1.0, 2049)
"""Output universe; its grid holds every peak of 5 terms, and 0 and +-1 of 7."""
SMALL = 1e-6
"""The grid of the output universe can not tell less; a smaller psi(1) is 0."""

Curve = NDArray[np.float64]


class Terms(NamedTuple):
    """Membership functions on [-1, 1], from the most negative term to the most positive one."""

    shape: str  # one of `SHAPES`, or `SINGLETON`
    peaks: tuple[float, ...]  # ascending


class FuzzySystem(NamedTuple):
    """A fuzzy inference system with one input and one output."""

    inputs: Terms
    outputs: Terms
    rules: tuple[int, ...]  # rule k maps input term k to output term rules[k], both from 0 on


def read_system(text: str) -> FuzzySystem | Curve:
    """
    Read the text of a system, or the samples of a curve, as docs/mathematics.md explains them.

    Peaks and rules have to be their own mirror images: psi is odd. Raises ConfigurationError for
    a text that is no system.
    """
    clauses: dict[str, list[str]] = {}
    for clause in text.split(';'):
        name, *values = clause.replace(',', ' ').split() or ['']
        if name not in CLAUSES or name in clauses:
            raise _refused(text, f'clauses {", ".join(CLAUSES)}, each once', repr(name))
        clauses[name] = values
    if 'curve' in clauses:
        if len(clauses) > 1:
            raise _refused(text, 'curve by itself', ', '.join(clauses))
        samples = np.array(_numbers(text, clauses['curve']))
        if len(samples) < 2 or samples[0] != 0.0:
            raise _refused(text, '2 samples or more, the first one 0', shown(samples))
        return samples
    if 'terms' in clauses and {'input', 'output'} <= clauses.keys():
        raise _refused(text, 'terms, or input and output', ', '.join(clauses))
    common = clauses.get('terms')
    sides = [clauses.get(side, common) for side in ('input', 'output')]
    if sides[0] is None:
        raise _refused(text, 'terms, input or curve', ', '.join(clauses))
    inputs = _terms(text, sides[0], [*SHAPES])
    outputs = _terms(text, sides[1] or sides[0], (*SHAPES, SINGLETON))
    count, most = len(inputs.peaks), len(outputs.peaks)
    numbers: Sequence[float] = range(1, count + 1)
    if 'rules' in clauses:
        numbers = _numbers(text, clauses['rules'])
    elif count != most:
        allowed = 'rules where input and output have not the same number of terms'
        raise _refused(text, allowed, f'{count} and {most} terms')
    if len(numbers) != count or not all(k in range(1, most + 1) for k in numbers):
        allowed = f'{count} rules, each an output term from 1 to {most}'
        raise _refused(text, allowed, shown(numbers))
    rules = tuple(int(k) - 1 for k in numbers)
    for what, row in ('peaks', inputs.peaks), ('peaks', outputs.peaks), ('rules', numbers):
        sums = np.add(row, row[::-1])
        if np.any(sums != (most + 1 if row is numbers else 0.0)):
            raise _refused(text, f'an odd curve, from {what} that are mirrored', shown(row))
    return FuzzySystem(inputs, outputs, rules)


def _refused(text: str, allowed: str, got: str) -> ConfigurationError:
    return ConfigurationError(
        f"parameter 'fuzzy_systems': expected {allowed}, got {got} in {shown(text)}"
    )


def _numbers(text: str, words: Sequence[str]) -> list[float]:
    try:
        numbers = [float(word) for word in words]
    except ValueError:
        numbers = []
    if not numbers or not np.all(np.isfinite(numbers)):
        raise _refused(text, 'numbers', shown(' '.join(words)))
    return numbers


def _terms(text: str, words: Sequence[str], shapes: Sequence[str]) -> Terms:
    shape = shapes[0]
    if words and words[0][:1].isalpha():
        shape, *words = words
    if shape not in shapes:
        raise _refused(text, f'a shape of {", ".join(shapes)}', repr(shape))
    numbers = _numbers(text, words)
    if len(numbers) == 1:
        count = numbers[0]
        if count not in range(3, MOST_TERMS + 1, 2):
            raise _refused(text, f'an odd number of terms, 3 to {MOST_TERMS}', f'{count:g}')
        half = np.linspace(0.0, 1.0, (int(count) + 1) // 2).tolist()
        return Terms(shape, (*(-c for c in half[:0:-1]), *half))
    apart = min(high - low for low, high in pairwise(numbers))
    within = -1.0 <= numbers[0] <= numbers[-1] <= 1.0
    if not (apart >= LEAST_GAP and within and len(numbers) <= MOST_TERMS):
        allowed = (
            f'2 to {MOST_TERMS} peaks within [-1, 1], each {LEAST_GAP} or more above the last'
        )
        raise _refused(text, allowed, shown(numbers))
    return Terms(shape, tuple(numbers))


def memberships(universe: Curve, terms: Terms) -> Curve:
    """
    Return the membership functions of terms, not singletons, at K points of [-1, 1]: a row a term.

    A triangle reaches 0 at its neighbours' peaks; a trapezoid is 1 over half of that; trapezoids
    and bells cross their neighbours at 1/2. The outermost terms are 1 beyond their peaks.
    """
    peaks = np.array(terms.peaks)[:, np.newaxis]
    gaps, off = np.diff(peaks, axis=0), universe - peaks
    left, right = np.vstack([gaps[:1], gaps]), np.vstack([gaps, gaps[-1:]])
    rows: Curve = SHAPES[terms.shape](np.abs(off) / np.where(off < 0.0, left, right))
    rows[0][universe < peaks[0]] = 1.0
    rows[-1][universe > peaks[-1]] = 1.0
    return rows


def infer(x: Curve, system: FuzzySystem) -> Curve:
    """
    Return the crisp outputs, not normalised, of K inputs within [-1, 1].

    Mamdani inference: minimum, maximum, centroid; of singletons their weighted mean.
    """
    activations, rules = memberships(x, system.inputs), list(system.rules)
    if system.outputs.shape == SINGLETON:
        peaks = np.array(system.outputs.peaks)[rules]
        return np.asarray(peaks @ activations / activations.sum(axis=0))
    outputs = memberships(UNIVERSE, system.outputs)[rules]
    y = np.array([np.minimum(a[:, None], outputs).max(axis=0) for a in activations.T])
    begin, step, left, right = UNIVERSE[:-1], np.diff(UNIVERSE), y[:, :-1], y[:, 1:]
    areas = 0.5 * step * (left + right)  # below the line through the points
    moments = begin * areas + step**2 * (left + 2.0 * right) / 6.0
    return np.asarray(moments.sum(axis=1) / areas.sum(axis=1))


@lru_cache(maxsize=32)
def curve(text: str) -> Curve:
    """
    Return psi of a text at `KNOTS` evenly spaced points of [0, 1] (it is odd), read-only.

    It is 0 at 0, does not fall, and is 1 at 1: a centroid alone ends at about 0.83 (5 terms),
    which would cut every gain. Raises ConfigurationError where that can't be.
    """
    x, system = np.linspace(0.0, 1.0, KNOTS), read_system(text)
    if isinstance(system, FuzzySystem):
        psi = infer(x, system)
        psi[0] = 0.0  # an odd curve is 0 there; the inference leaves rounding errors
        # What falls by less than the grid of the output universe can tell does not fall.
        level = np.maximum.accumulate(psi)
        psi = np.where(level - psi < SMALL, level, psi)
    else:
        psi = np.interp(x, np.linspace(0.0, 1.0, len(system)), system)
    k = int(np.diff(psi).argmin())
    if psi[k + 1] < psi[k]:
        got = f'psi({x[k]:.3g}) = {psi[k]:.4g}, psi({x[k + 1]:.3g}) = {psi[k + 1]:.4g}'
        raise _refused(text, 'a curve that does not fall', got)
    if not SMALL < psi[-1] <= 1.0:
        got = f'psi(1) = {psi[-1]:.4g}'
        raise _refused(text, 'a curve that ends above 0 and at most at 1', got)
    psi /= psi[-1]
    psi.flags.writeable = False
    return psi


def curves(parameters: Mapping[str, Any], levels: int) -> Curve:
    """Return psi of each level, (N, KNOTS), as `fuzzy_systems` among the parameters says."""
    texts = parameters['fuzzy_systems']
    return np.array([curve(of_level(texts, i)) for i in range(levels)])


def of_level(values: Sequence[Any], level: int) -> Any:
    """Return what a list says for a level (0-based): its last value serves those that follow."""
    return values[min(level, len(values) - 1)]
