# SPDX-License-Identifier: Apache-2.0
"""The paper's three findings as inequalities between numbers, and where they hold."""

from collections.abc import Callable
from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from studies.paper.cases import FREQUENCIES, joint, OBSERVERS, OURS, Score, score
from studies.paper.plant_and_observer import JointRun

LOW, HIGH = FREQUENCIES
VISIBLE = 0.005
"""High-passed RMS of the estimate of d from which chatter is visible: 5 % of d's amplitude."""
SMOOTH = 0.1
"""Fuzzy counts as free of chatter with at most this part of sign's high-passed RMS at 1e-5 s."""
BADLY = 2.0
"""Sign at 1e-3 s is bad if its RMS error is at least this many times that at 1e-5 s."""
MOVED = 0.01
"""Gamma counts as moving if it ends at least this far from where it began."""
WIDTHS = (
    0.01, 0.015, 0.02, 0.03, 0.05, 0.07, 0.1, 0.15, 0.2, 0.3, 0.5, 0.7,
    1.0, 1.5, 2.0, 3.0, 5.0, 7.0, 10.0,
)  # fmt: skip
"""Half-widths of the map, on both axes."""

FINE, COARSE, FUZZY, ADAPTIVE = OBSERVERS
DEFAULT_LAW = next(iter(OURS))
Scores = dict[tuple[str, float], Score]
"""By observer and angular frequency."""


class Verdict(NamedTuple):
    """
    One finding.

    Attributes
    ----------
    name, claim : str
    holds : bool
    numbers : str
        What decides.
    estimates : bool
        False if every observer that is judged has a larger RMS error of d than the estimate 0.

    """

    name: str
    claim: str
    holds: bool
    numbers: str
    estimates: bool

    @property
    def words(self) -> str:
        """Whether it holds, and what that is worth."""
        text = 'yes' if self.holds else 'no'
        return text if self.estimates else f'{text}, but no estimate'


def _estimates(*scores: Score) -> bool:
    return any(s['rms_d'] < s['true_d'] for s in scores)


@cache
def run(name: str, omega: float, solver: str) -> JointRun:
    """Simulate one of the observers, once: the figures show what the tables judge."""
    variant, step, changes = (OBSERVERS | OURS)[name]
    return joint(variant, omega, step, solver, **changes)


def verdicts(s: Scores) -> list[Verdict]:
    """Judge the findings F1, F2, F3 from the scores of one solver."""
    result = []
    for label, w in (('low', LOW), ('high', HIGH)):
        fine, coarse, fuzzy = s[FINE, w], s[COARSE, w], s[FUZZY, w]
        adaptive = s[ADAPTIVE, w]
        fine_hp, fuzzy_hp = fine['high_pass'], fuzzy['high_pass']
        result += [
            Verdict(
                f'F1a {label}',
                'sign at 1e-5 s chatters visibly',
                fine_hp >= VISIBLE,
                f'high-passed RMS {fine_hp:.1e} (visible from {VISIBLE:g}); '
                f'RMS of d {fine["rms_d"]:.3f}',
                _estimates(fine),
            ),
            Verdict(
                f'F1b {label}',
                'sign at 1e-3 s is bad',
                coarse['rms_d'] >= BADLY * fine['rms_d'],
                f'RMS of d {coarse["rms_d"]:.3f}, at 1e-5 s {fine["rms_d"]:.3f}',
                _estimates(coarse, fine),
            ),
            Verdict(
                f'F1c {label}',
                'fuzzy at 1e-3 s does not chatter',
                fuzzy_hp <= SMOOTH * fine_hp,
                f'high-passed RMS {fuzzy_hp:.1e}, sign at 1e-5 s {fine_hp:.1e}',
                _estimates(fuzzy, fine),
            ),
            Verdict(
                f'F3 {label}',
                'adaptation improves fuzzy, and γ moves',
                adaptive['rms_d'] < fuzzy['rms_d'] and abs(adaptive['gamma'] - 0.5) >= MOVED,
                f'RMS of d {adaptive["rms_d"]:.4f}, without {fuzzy["rms_d"]:.4f}; '
                f'γ ends at {adaptive["gamma"]:.3f}',
                _estimates(adaptive, fuzzy),
            ),
        ]
    fuzzy, fine = s[FUZZY, HIGH], s[FINE, HIGH]
    result.append(
        Verdict(
            'F2',
            'at the high frequency fuzzy is worse than sign',
            fuzzy['rms_d'] > fine['rms_d'],
            f'RMS of d {fuzzy["rms_d"]:.3f}, sign at 1e-5 s {fine["rms_d"]:.3f}',
            _estimates(fuzzy, fine),
        )
    )
    return sorted(result)


class WidthMap(NamedTuple):
    """
    Where the findings that depend on the half-widths hold.

    Attributes
    ----------
    widths : (K,) array
        Half-widths of level 1 (rows) and of the later levels (columns).
    holds : (3, K, K) array of bool
        F1c, F2, F3 (F1c and F3 at both frequencies).

    """

    widths: NDArray[np.float64]
    holds: NDArray[np.bool_]

    @property
    def region(self) -> NDArray[np.bool_]:
        """Where all hold."""
        return self.holds.all(axis=0)

    def deepest(self) -> tuple[float, float]:
        """
        Return the half-widths furthest inside the region, in cells to its border or the map's.

        Of several equally far inside, in order of level 1 and then of the later levels, the
        middle one. NaN if there is no region.
        """
        inside = np.pad(self.region, 1)
        depth = np.zeros(inside.shape, dtype=int)
        while inside.any():
            depth += inside
            shrunk = np.zeros_like(inside)
            shrunk[1:-1, 1:-1] = np.min(
                [np.roll(inside, (i, j), (0, 1)) for i in (-1, 0, 1) for j in (-1, 0, 1)], axis=0
            )[1:-1, 1:-1]
            inside = shrunk
        if not depth.any():
            return float('nan'), float('nan')
        ties = np.argwhere(depth == depth.max())
        i, j = ties[len(ties) // 2]
        return float(self.widths[i - 1]), float(self.widths[j - 1])


def width_map(
    signs: dict[float, Score], solver: str, every: int, tick: Callable[[], object]
) -> WidthMap:
    """
    Judge F1c, F2 and F3 at every pair of half-widths.

    Parameters
    ----------
    signs : dict
        Scores of sign at 1e-5 s by angular frequency; it knows no half-widths.
    every : int
        Take every `every`-th of `WIDTHS`.
    tick : callable
        Called after each row.

    """
    widths = np.array(WIDTHS[::every])
    holds = np.zeros((3, len(widths), len(widths)), dtype=bool)
    for i, first in enumerate(widths):
        for j, later in enumerate(widths):
            changes = {'fuzzy_widths': [first, later]}
            s: Scores = {(COARSE, w): signs[w] for w in FREQUENCIES}  # no part of the map
            s |= {(FINE, w): signs[w] for w in FREQUENCIES}
            for w in FREQUENCIES:
                for name in (FUZZY, ADAPTIVE):
                    variant, step, _ = OBSERVERS[name]
                    s[name, w] = score(joint(variant, w, step, solver, **changes))
            all_verdicts = verdicts(s)
            for k, part in enumerate(('F1c', 'F2', 'F3')):
                holds[k, i, j] = all(v.holds for v in all_verdicts if v.name.startswith(part))
        tick()
    return WidthMap(widths, holds)
