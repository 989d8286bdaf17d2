# SPDX-License-Identifier: Apache-2.0
"""The bars that our observer has to reach, as inequalities between numbers."""

from collections.abc import Callable
from typing import NamedTuple

from studies.comparison.evaluation import METHODS
from studies.comparison.methods.linear import LINEAR_LIMIT
from studies.comparison.methods.method import LINEAR, OURS, USUAL
from studies.comparison.results import Cell, Table
from studies.comparison.scores import Scores

KALMAN = 'Kalman'
PEERS = [name for name, m in METHODS.items() if m.kind in (LINEAR, USUAL) and name != LINEAR_LIMIT]
"""The linear filters with a name of their own."""


class Bar(NamedTuple):
    """
    A bar: our RMS error of d over a rival's, at most `limit`, in every cell that it is about.

    Attributes
    ----------
    claim : str
    limit : float
    about : callable
        True for a cell that the bar is about.
    rival : callable
        From a cell's scores to the error that ours is compared with.

    """

    claim: str
    limit: float
    about: Callable[[Cell], bool]
    rival: Callable[[dict[str, Scores]], float]


def _kalman(scores: dict[str, Scores]) -> float:
    return scores[KALMAN].d


def _best_linear(scores: dict[str, Scores]) -> float:
    return min(scores[name].d for name in PEERS if name in scores)


BARS = (
    Bar(
        'without noise, at most a tenth of the best linear peer',
        0.1,
        lambda c: c.sensor.noise == 0.0,
        _best_linear,
    ),
    Bar(
        "with noise, on the paper's plant, at most 1.0 times the tuned Kalman filter",
        1.0,
        lambda c: c.sensor.noise > 0.0 and c.sensor.plant == 'paper',
        _kalman,
    ),
    Bar(
        "with noise, on the paper's plant and steps, at most 0.8 times the tuned Kalman filter",
        0.8,
        lambda c: c.sensor.noise > 0.0 and c.sensor.plant == 'paper' and c.disturbance == 'steps',
        _kalman,
    ),
)


class Verdict(NamedTuple):
    """How a bar came out: the ratio in each cell that it is about."""

    bar: Bar
    ratios: dict[Cell, float]

    @property
    def reached(self) -> list[Cell]:
        """Return the cells in which it is reached."""
        return [cell for cell, ratio in self.ratios.items() if ratio <= self.bar.limit]


def verdicts(table: Table) -> list[Verdict]:
    """Judge the bars."""
    return [
        Verdict(
            bar,
            {
                cell: scores[OURS].d / bar.rival(scores)
                for cell, scores in table.items()
                if bar.about(cell)
            },
        )
        for bar in BARS
    ]
