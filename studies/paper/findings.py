# SPDX-License-Identifier: Apache-2.0
"""The paper's three findings as inequalities between numbers, and where they hold."""

from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

from studies.evidence import markdown, Row
from studies.paper.cases import FREQUENCIES, OBSERVERS, Score, score, simulated
from studies.paper.plant_and_observer import HELD

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

FINE, COARSE, FUZZY, ADAPTIVE = list(OBSERVERS)[:4]
Scores = dict[tuple[str, float], Score]
"""By observer and angular frequency."""


class Verdict(NamedTuple):
    """One finding."""

    name: str
    claim: str
    holds: bool
    numbers: str
    """What decides."""
    estimates: bool
    """False if every observer that is judged has a larger RMS error of d than the estimate 0."""

    @property
    def words(self) -> str:
        """Whether it holds, and what that is worth."""
        text = 'yes' if self.holds else 'no'
        return f'**{text}**' if self.estimates else f'{text}, but no estimate'


def simulation(solver: str, name: str, omega: float) -> Row:
    """Return the line of one of the observers in the table of simulations."""
    case = {'solver': solver, 'observer': name, 'omega': omega}
    return case | score(simulated(name, omega, solver))


def scores_by_solver(rows: Iterable[Row]) -> dict[str, Scores]:
    """Return the lines of the table of simulations, by solver."""
    found: dict[str, Scores] = {}
    for row in rows:
        found.setdefault(row['solver'], {})[row['observer'], row['omega']] = row
    return found


def choose_solver(scores: dict[str, Scores]) -> str:
    """
    Return the solver that reproduces the paper best.

    Its figures show sign at 1e-5 s chattering around the truth: the one whose estimate of d is
    closest to it, over both frequencies. Solvers that hold the sign are closer, but they are not
    methods for the equations of the paper: they stand beside them.
    """
    return min(
        (solver for solver in scores if solver != HELD),
        key=lambda solver: sum(scores[solver][FINE, omega]['rms_d'] for omega in FREQUENCIES),
    )


def verdicts(s: Scores) -> list[Verdict]:
    """Judge the findings F1, F2, F3 from the scores of one solver."""
    found = []

    def judge(name: str, claim: str, holds: bool, numbers: str, *judged: Score) -> None:
        estimates = any(one['rms_d'] < one['true_d'] for one in judged)
        found.append(Verdict(name, claim, holds, numbers, estimates))

    for label, w in (('low', LOW), ('high', HIGH)):
        fine, coarse, fuzzy, adaptive = (s[name, w] for name in (FINE, COARSE, FUZZY, ADAPTIVE))
        chatter, smooth = fine['high_pass'], fuzzy['high_pass']
        judge(
            f'F1a {label}', 'sign at 1e-5 s chatters visibly', chatter >= VISIBLE,
            f'high-passed {chatter:.1e}; error {fine["rms_d"]:.3f}', fine,
        )  # fmt: skip
        judge(
            f'F1b {label}', 'sign at 1e-3 s is bad', coarse['rms_d'] >= BADLY * fine['rms_d'],
            f'error {coarse["rms_d"]:.3f}, at 1e-5 s {fine["rms_d"]:.3f}', coarse, fine,
        )  # fmt: skip
        judge(
            f'F1c {label}', 'fuzzy at 1e-3 s does not chatter', smooth <= SMOOTH * chatter,
            f'high-passed {smooth:.1e}, sign at 1e-5 s {chatter:.1e}', fuzzy, fine,
        )  # fmt: skip
        judge(
            f'F3 {label}', 'adaptation improves fuzzy, and γ moves',
            adaptive['rms_d'] < fuzzy['rms_d'] and abs(adaptive['gamma'] - 0.5) >= MOVED,
            f'error {adaptive["rms_d"]:.4f}, without {fuzzy["rms_d"]:.4f}; γ ends at '
            f'{adaptive["gamma"]:.3f}', adaptive, fuzzy,
        )  # fmt: skip
    judge(
        'F2', 'at the high frequency fuzzy is worse than sign', fuzzy['rms_d'] > fine['rms_d'],
        f'error {fuzzy["rms_d"]:.3f}, sign at 1e-5 s {fine["rms_d"]:.3f}', fuzzy, fine,
    )  # fmt: skip
    return sorted(found)


def texts(rows: Iterable[Row]) -> dict[str, str]:
    """Return the part of the page, from the table of simulations."""
    scores = scores_by_solver(rows)
    found = verdicts(scores[choose_solver(scores)])
    head = ['finding', 'claim', 'holds', 'numbers (RMS error of d; high-passed estimate)']
    return {'findings': markdown(head, [(v.name, v.claim, v.words, v.numbers) for v in found])}


def width_rows(
    first: float, widths: Sequence[float], signs: Mapping[float, Score], solver: str
) -> list[Row]:
    """
    Judge F1c, F2 and F3 at one half-width of level 1 and several of the later levels.

    `signs` has the scores of sign at 1e-5 s by angular frequency; it knows no half-widths.
    """
    rows = []
    for later in widths:
        s = {(name, w): signs[w] for name in (FINE, COARSE) for w in FREQUENCIES}
        for w in FREQUENCIES:
            for name in (FUZZY, ADAPTIVE):
                s[name, w] = score(simulated(name, w, solver, fuzzy_widths=[first, later]))
        judged = verdicts(s)
        holds = {
            part: float(all(v.holds for v in judged if v.name.startswith(part)))
            for part in ('F1c', 'F2', 'F3')
        }
        rows.append({'level 1': first, 'later levels': later} | holds)
    return rows
