# SPDX-License-Identifier: Apache-2.0
"""Compare the observer with what people would use instead, all tuned by the same rules."""

import argparse
from collections.abc import Callable, Iterable
import sys
from typing import NamedTuple

from matplotlib.figure import Figure
from studies import evidence
from studies.comparison import methods
from studies.comparison.cells import evaluate, JUMPS, methods_for, PLANTS, sensors
from studies.comparison.methods import KINDS, LINEAR, METHODS
from studies.comparison.tuning import mean
from studies.evidence import markdown, Row
from studies.harness import Found, Results, run_study

NAME = 'comparison'
FULL, QUICK = (4, 200), (1, 15)  # recordings that tune a method, and trials
STYLES = {
    methods.USUAL: evidence.USUAL, methods.ROBUST: evidence.ROBUST,
    methods.SLIDING: evidence.OTHER, methods.PAPER: evidence.GREY, methods.OURS: evidence.TUNED,
    methods.SELF_TUNING: evidence.SELF,
}  # fmt: skip
CLOSE = 0.05  # errors within this part of another one count as equal


class Cell(NamedTuple):
    """Plant, kind of d, standard deviation of the noise on y, samples a second, timing."""

    plant: str
    d: str
    noise: float
    rate: float
    timing: str

    @property
    def jumps(self) -> bool:
        """True for a d that jumps."""
        return self.d in JUMPS


Chosen = dict[Cell, dict[str, float]]  # errors of d by cell and kind of method

GROUPS = {
    'd without jumps': (True, False), 'd with jumps': (True, True),
    'no noise, without jumps': (False, False), 'no noise, with jumps': (False, True),
}  # fmt: skip
"""Whether there is noise, and whether d jumps."""


def best_of_kinds(rows: Iterable[Row]) -> Chosen:
    """Return for each cell the method of each kind whose error in training is smallest."""
    chosen: Chosen = {}
    for row in sorted(rows, key=lambda row: row['training']):
        errors = chosen.setdefault(Cell(*(row[name] for name in Cell._fields)), {})
        errors.setdefault(METHODS[row['method']].kind, row['error'])
    return chosen


def ratios(chosen: Chosen, kind: str, about: Callable[[Cell], bool]) -> list[float]:
    """Return the errors of d over those of the best linear filter, of the cells with both."""
    both = [errors for cell, errors in chosen.items() if about(cell) and kind in errors]
    return [errors[kind] / errors[LINEAR] for errors in both]


def texts(rows: Iterable[Row]) -> dict[str, str]:
    """Return the part of the page: ratios by kind and group, and how often a kind is the best."""
    chosen, lines = best_of_kinds(rows), []

    def spread(values: list[float]) -> str:  # geometric mean, and the largest
        return f'{number(mean(values))} ({number(max(values))})' if values else ''

    for kind in KINDS:
        parts = [
            ratios(chosen, kind, lambda c, group=group: (c.noise > 0.0, c.jumps) == group)
            for group in GROUPS.values()
        ]
        best = sum(
            kind in errors and errors[kind] <= (1.0 + CLOSE) * min(errors.values())
            for errors in chosen.values()
        )
        shown = ['1' if kind == LINEAR else spread(part) for part in parts]
        lines.append([kind, *shown, f'{best} of {len(chosen)}'])
    head = ['', *GROUPS, f'at most {100.0 * CLOSE:g} % behind the best']
    return {'summary': markdown(head, lines)}


def number(x: float) -> str:
    """Return a number as text."""
    if not x < 1e6:
        return '∞'
    if x >= 100.0:
        return f'{x:.3g}' if x < 1e4 else f'{x:.0e}'
    return f'{x:.2g}' if x < 0.1 else f'{x:.2f}'


def draw(chosen: Chosen, jumps: bool) -> Figure:
    """Draw each kind's error over that of the best linear filter, for d with or without jumps."""
    groups: dict[str, dict[str, list[Cell]]] = {case.text: {} for case in PLANTS.values()}
    for c in sorted(chosen, key=lambda c: (c.timing != 'even', c.timing, -c.rate, c.noise)):
        if c.jumps == jumps:
            rate = '1 kHz' if c.rate == 1000.0 else f'{c.rate:g} Hz'
            timing = '' if c.timing == 'even' else f', {c.timing}'
            row = f'{rate}{timing}, {f"noise {c.noise:g}" if c.noise else "no noise"}'
            groups[PLANTS[c.plant].text].setdefault(row, []).append(c)
    panels = {
        plant: {
            text: {
                kind: mean(values)
                for kind in STYLES
                if (values := ratios(chosen, kind, cells.__contains__))
            }
            for text, cells in rows.items()
        }
        for plant, rows in groups.items()
        if rows
    }
    with_jumps = 'with' if jumps else 'without'
    text = f'd {with_jumps} jumps: error of d over that of the best linear filter'
    return evidence.draw_ratios(panels, STYLES, text)


def measure(arguments: argparse.Namespace, results: Results) -> Found:
    """Return a line for each cell and method."""
    quick = arguments.quick
    training, trials = QUICK if quick else FULL
    found = results({
        (sensor, name): (evaluate, sensor, name, training, trials)
        for sensor in sensors(quick)
        for name in methods_for(sensor)
    })  # fmt: skip
    rows = evidence.rounded(
        Cell(s.plant, d, s.noise, s.rate, s.timing)._asdict()
        | {'method': name, 'training': tuned.value, 'error': error}
        for (s, name), (tuned, errors) in found.items()
        for d, error in zip(s.disturbances, errors, strict=True)
    )
    chosen = best_of_kinds(rows)
    drawn = {'comparison_smooth': draw(chosen, False), 'comparison_jumps': draw(chosen, True)}
    return Found({NAME: rows}, texts(rows), drawn)


if __name__ == '__main__':
    sys.exit(run_study(NAME, __doc__, measure))
