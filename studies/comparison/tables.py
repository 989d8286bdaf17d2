# SPDX-License-Identifier: Apache-2.0
"""The generated parts of docs/comparison.md, as Markdown."""

from collections.abc import Callable, Iterable
from itertools import groupby
import math
from statistics import geometric_mean

from studies.comparison.cells import MORE
from studies.comparison.evaluation import METHODS
from studies.comparison.methods.linear import LINEAR_LIMIT
from studies.comparison.methods.ours import OURS
from studies.comparison.results import Cell, Results, Table
from studies.comparison.scores import Scores
from studies.comparison.verdicts import KALMAN, Verdict, verdicts

USELESS = 1.0
"""From here on an estimate of d is no better than 0."""
FIGURES = {
    'verdicts': ["![Our error over the rival's, for each bar and cell](comparison/ratios.svg)"],
    'rms_d': [
        '![Error of d against the noise](comparison/noise.svg)',
        '![True and estimated d](comparison/estimates.svg)',
    ],
}
"""Figures below the generated parts."""
MEASURES: dict[str, tuple[str, Callable[[Scores], float]]] = {
    'rms_d': ('RMS error of d over the RMS of d', lambda s: s.d),
    'rms_states': ('RMS errors of z2 .. zn over the RMS of each', lambda s: s.states),
    'settling': ('settling time [s]', lambda s: s.settling),
    'chatter': ('chatter: high-passed error of d over the RMS of d', lambda s: s.chatter),
}


def texts(results: Results) -> dict[str, str]:
    """Return all generated parts by name."""
    table = results.table(list(METHODS))
    judged = verdicts(table)
    parts = {
        'setup': _setup(results),
        'methods': _methods(results, table),
        'verdicts': verdict_table(judged),
        'better': _better(table),
        'limit': _limit(table),
        'bound': _bound(results, table),
        'ratios': _ratios(judged),
    }
    return parts | {name: _scores(table, title, read) for name, (title, read) in MEASURES.items()}


def _table(head: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    head = list(head)
    lines = [head, ['---'] * len(head), *rows]
    return '\n'.join('| ' + ' | '.join(line) + ' |' for line in lines)


def _number(x: float) -> str:
    if not math.isfinite(x):
        return '∞'
    if x >= 100.0:
        return f'{x:.3g}' if x < 1e4 else f'{x:.0e}'
    return f'{x:.2g}' if x < 0.1 else f'{x:.2f}'


def _names(cell: Cell) -> list[str]:
    s = cell.sensor
    rate = '1 kHz' if s.rate == 1000.0 else f'{s.rate:g} Hz'
    timing = '' if s.timing == 'even' else f', {s.timing}'
    return [cell.plant, cell.disturbance, rate + timing, f'{s.noise:g}']


HEAD = ['plant', 'd', 'sampling', 'noise']


def _setup(results: Results) -> str:
    cells = results.table(list(METHODS))
    sensors = {cell.sensor for cell in cells}
    return (
        f'{len(cells)} cells, {len(sensors)} tunings of each method; each tuning: '
        f'{results.trials} trials on {results.training} recordings of 20 s '
        f'({MORE * results.training} at 100 Hz; half as many without any noise).'
    )


def _methods(results: Results, table: Table) -> str:
    """Return what each method is, how often it is best, and what a sample costs."""
    wins = dict.fromkeys(METHODS, 0)
    for scores in table.values():
        wins[_best(scores, lambda s: s.d)] += 1
    rows = []
    for name, method in METHODS.items():
        if name not in results.seconds:
            continue
        space = next(len(e.tuned.values) for e in results.entries if e.method == name)
        rows.append(
            [name, method.text, str(space), str(wins[name]), f'{results.seconds[name] * 1e9:.0f}']
        )
    head = ['method', 'what it is', 'tuned parameters', 'cells won', 'time a sample [ns]']
    return _table(head, rows)


def _best(scores: dict[str, Scores], read: Callable[[Scores], float]) -> str:
    return min(scores, key=lambda name: read(scores[name]))


def _scores(table: Table, title: str, read: Callable[[Scores], float]) -> str:
    """Return one measure of all cells, with the best of each in bold."""
    names = [name for name in METHODS if any(name in s for s in table.values())]
    rows = []
    for cell, scores in table.items():
        best = min((read(s) for s in scores.values()), default=math.inf)
        shown = []
        for name in names:
            text = _number(read(scores[name])) if name in scores else ''
            marked = name in scores and text == _number(best) and math.isfinite(best)
            shown.append(f'**{text}**' if marked else text)
        rows.append([*_names(cell), *shown])
    return f'Shown: {title}.\n\n' + _table([*HEAD, *names], rows)


def verdict_table(judged: list[Verdict]) -> str:
    """Return how the bars came out."""
    rows = []
    for v in judged:
        if not v.ratios:
            rows.append([v.bar.claim, '', 'no cell', '', ''])
            continue
        worst = max(v.ratios, key=v.ratios.__getitem__)
        middle = geometric_mean(v.ratios.values())
        holds = '**yes**' if len(v.reached) == len(v.ratios) else '**no**'
        rows.append(
            [
                v.bar.claim,
                holds,
                f'{len(v.reached)} of {len(v.ratios)}',
                _number(middle),
                f'{_number(v.ratios[worst])} ({", ".join(_names(worst)[1:])})',
            ]
        )
    head = ['bar: our RMS error of d', 'reached', 'cells', 'ratio, geometric mean', 'worst']
    return _table(head, rows)


def _limit(table: Table) -> str:
    """Return our error over that of our linear limit, by the kind of sampling."""
    ratios: dict[str, list[float]] = {}
    for cell, scores in table.items():
        if LINEAR_LIMIT in scores and scores[LINEAR_LIMIT].d > 0.0:
            noise = 'none' if cell.sensor.noise == 0.0 else 'Gaussian'
            kind = f'{cell.sensor.timing}, noise: {noise}'
            ratios.setdefault(kind, []).append(scores[OURS].d / scores[LINEAR_LIMIT].d)
    rows = [
        [kind, str(len(r)), _number(geometric_mean(r)), _number(min(r)), _number(max(r))]
        for kind, r in ratios.items()
    ]
    return _table(['sampling', 'cells', 'geometric mean', 'least', 'most'], rows)


def _bound(results: Results, table: Table) -> str:
    """Return the lower bound on the error for steps, relative to the tuned Kalman filter."""
    rows = []
    for cell, scores in table.items():
        known = results.bounds.get(cell.sensor)
        if known is not None:
            kalman, ours = scores[KALMAN].d, scores[OURS].d
            rows.append(
                [
                    *_names(cell)[2:],
                    *map(_number, (kalman, ours, known, ours / kalman, known / kalman)),
                ]
            )
    head = ['sampling', 'noise', 'Kalman', 'ours', 'bound', 'ours over Kalman']
    return _table([*head, 'bound over Kalman'], rows)


def _ratios(judged: list[Verdict]) -> str:
    """Return our error over the rival's, cell by cell."""
    blocks = []
    for v in judged:
        rows = [
            [*_names(cell), f'**{_number(r)}**' if r <= v.bar.limit else _number(r)]
            for cell, r in v.ratios.items()
        ]
        blocks.append(
            f'{v.bar.claim[0].upper()}{v.bar.claim[1:]}:\n\n' + _table([*HEAD, 'ratio'], rows)
        )
    return '\n\n'.join(blocks)


def _better(table: Table) -> str:
    """Return, in words, where another method is better than ours."""
    lines = []
    beaten = {
        cell: _best(scores, lambda s: s.d)
        for cell, scores in table.items()
        if _best(scores, lambda s: s.d) != OURS
    }
    lines.append(
        f'Ours has the smallest RMS error of d in {len(table) - len(beaten)} of {len(table)} '
        f'cells. In the other {len(beaten)}, by how much the best method is better (its error '
        'over ours):'
    )
    lines.append('')
    groups = groupby(beaten, key=lambda c: (c.plant, c.disturbance))
    rows = []
    for (plant, disturbance), cells in groups:
        for cell in cells:
            scores, name = table[cell], beaten[cell]
            ratio = scores[name].d / scores[OURS].d
            note = ' (all useless)' if scores[name].d >= USELESS else ''
            rows.append([plant, disturbance, *_names(cell)[2:], name, f'{_number(ratio)}{note}'])
    lines.append(_table([*HEAD, 'best', 'its error over ours'], rows))
    return '\n'.join(lines)
