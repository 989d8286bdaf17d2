# SPDX-License-Identifier: Apache-2.0
"""The generated parts of docs/comparison.md, as Markdown."""

from collections.abc import Callable, Iterable
import math

from studies.comparison.cells import MORE
from studies.comparison.evaluation import METHODS
from studies.comparison.methods.linear import LINEAR_LIMIT
from studies.comparison.methods.method import KINDS, LINEAR, OURS, SELF_TUNING
from studies.comparison.results import Cell, Chosen, Results, Table
from studies.comparison.scores import mean, Scores
from studies.comparison.verdicts import KALMAN, Verdict, verdicts

RIVALS = KINDS[1:]
"""Kinds that are shown relative to the linear filter."""
CLOSE = 0.05
"""Errors within this part of another one count as equal."""
LOSSES = 6
"""Cells that are shown of each observer of ours."""
GROUPS: dict[str, Callable[[Cell], bool]] = {
    'd without jumps': lambda c: c.sensor.noise > 0.0 and not c.kind.jumps,
    'd with jumps': lambda c: c.sensor.noise > 0.0 and c.kind.jumps,
    'no noise, without jumps': lambda c: c.sensor.noise == 0.0 and not c.kind.jumps,
    'no noise, with jumps': lambda c: c.sensor.noise == 0.0 and c.kind.jumps,
}
MEASURES: dict[str, Callable[[Scores], float]] = {
    'errors of z2 .. zn over the RMS of each': lambda s: s.states,
    'chatter: high-passed error of d over the RMS of d': lambda s: s.chatter,
    'settling time [s], median': lambda s: s.settling,
}


def texts(results: Results) -> dict[str, str]:
    """Return all generated parts by name."""
    table, chosen = results.table(list(METHODS)), results.best_of_kinds()
    return {
        'setup': _setup(results),
        'summary': _summary(chosen),
        'shapes': _shapes(chosen),
        'losses': _losses(chosen),
        'methods': _methods(results, table, chosen),
        'verdicts': verdict_table(verdicts(table)),
        'bound': _bound(results, table),
        'limit': _limit(table),
        'others': _others(chosen),
        'errors': _errors(chosen),
    }


def number(x: float) -> str:
    """Return a number as text."""
    if not x < 1e6:
        return '∞'
    if x >= 100.0:
        return f'{x:.3g}' if x < 1e4 else f'{x:.0e}'
    return f'{x:.2g}' if x < 0.1 else f'{x:.2f}'


def ratios(chosen: Chosen, kind: str, about: Callable[[Cell], bool]) -> dict[Cell, float]:
    """Return the error of d over that of the best linear filter, of the cells with both."""
    return {
        cell: row[kind][1].d / row[LINEAR][1].d
        for cell, row in chosen.items()
        if about(cell) and kind in row
    }


def sampling(cell: Cell) -> str:
    """Return rate and timing in words."""
    s = cell.sensor
    rate = '1 kHz' if s.rate == 1000.0 else f'{s.rate:g} Hz'
    return rate if s.timing == 'even' else f'{rate}, {s.timing}'


def _table(head: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    head = list(head)
    lines = [head, ['---'] * len(head), *rows]
    return '\n'.join('| ' + ' | '.join(line) + ' |' for line in lines)


def _names(cell: Cell) -> list[str]:
    return [cell.plant, cell.disturbance, sampling(cell), f'{cell.sensor.noise:g}']


HEAD = ['plant', 'd', 'sampling', 'noise']


def _setup(results: Results) -> str:
    cells = results.table(list(METHODS))
    sensors = {cell.sensor for cell in cells}
    return (
        f'{len(cells)} cells, {len(sensors)} tunings of each method; each tuning: '
        f'{results.trials} trials on {results.training} recordings of 20 s '
        f'({MORE * results.training} at 100 Hz; half as many without any noise).'
    )


def _spread(values: dict[Cell, float]) -> str:
    """Return a geometric mean and the largest value."""
    if not values:
        return ''
    return f'{number(mean(values.values()))} ({number(max(values.values()))})'


def _summary(chosen: Chosen) -> str:
    """Return the ratios of each kind in each group, and how often it is as good as the best."""
    rows = []
    for kind in KINDS:
        parts = [ratios(chosen, kind, about) for about in GROUPS.values()]
        best = sum(
            kind in row and row[kind][1].d <= (1.0 + CLOSE) * min(s.d for _, s in row.values())
            for row in chosen.values()
        )
        shown = ['1'] * len(parts) if kind == LINEAR else [_spread(part) for part in parts]
        rows.append([kind, *shown, f'{best} of {len(chosen)}'])
    return _table(['', *GROUPS, f'at most {100.0 * CLOSE:g} % behind the best'], rows)


def _shapes(chosen: Chosen) -> str:
    """Return the ratios with noise for each shape of d."""
    rows = []
    for shape in dict.fromkeys(cell.disturbance for cell in chosen):
        cells = [c for c in chosen if c.disturbance == shape and c.sensor.noise > 0.0]
        if cells:
            kept = set(cells)
            shown = [
                number(mean(r.values()))
                for kind in RIVALS
                if (r := ratios(chosen, kind, kept.__contains__))
            ]
            linear = number(mean(chosen[c][LINEAR][1].d for c in cells))
            words = ['yes' if flag else 'no' for flag in (cells[0].kind.jumps, cells[0].kind.seen)]
            rows.append([shape, *words, str(len(cells)), linear, *shown])
    return _table(['d', 'jumps', 'seen in tuning', 'cells', f'{LINEAR}: error', *RIVALS], rows)


def _losses(chosen: Chosen) -> str:
    """Return the cells with noise in which our observers are most behind the best other kind."""
    rows = []
    for kind in (OURS, SELF_TUNING):
        behind = {}
        for cell, row in chosen.items():
            if cell.sensor.noise == 0.0:
                continue
            others = {k: v for k, v in row.items() if k not in (OURS, SELF_TUNING)}
            best = min(others, key=lambda k, others=others: others[k][1].d)
            behind[cell] = (row[kind][1].d / others[best][1].d, row[kind][1].d, others[best])
        for cell in sorted(behind, key=lambda c: -behind[c][0])[:LOSSES]:
            ratio, error, (name, scores) = behind[cell]
            rows.append([kind, *_names(cell), *map(number, (error, scores.d, ratio)), name])
    return _table(['', *HEAD, 'error', 'best other', 'ratio', 'which'], rows)


def _methods(results: Results, table: Table, chosen: Chosen) -> str:
    """Return what each method is, what a sample costs, and the ratios in each group."""
    rows = []
    for name, method in METHODS.items():
        if name not in results.seconds:
            continue
        means = []
        for about in GROUPS.values():
            found = [
                scores[name].d / chosen[cell][LINEAR][1].d
                for cell, scores in table.items()
                if name in scores and about(cell)
            ]
            means.append(number(mean(found)) if found else '')
        microseconds = f'{results.seconds[name] * 1e6:.2g}'
        rows.append([name, method.kind, method.text, microseconds, *means])
    return _table(['method', 'kind', 'what it is', 'µs a sample', *GROUPS], rows)


def verdict_table(judged: list[Verdict]) -> str:
    """Return how the bars came out."""
    rows = []
    for v in judged:
        if not v.ratios:
            rows.append([v.bar.claim, '', 'no cell', '', ''])
            continue
        worst = max(v.ratios, key=v.ratios.__getitem__)
        holds = '**yes**' if len(v.reached) == len(v.ratios) else '**no**'
        rows.append(
            [
                v.bar.claim,
                holds,
                f'{len(v.reached)} of {len(v.ratios)}',
                number(mean(v.ratios.values())),
                f'{number(v.ratios[worst])} ({", ".join(_names(worst))})',
            ]
        )
    head = ['bar: our error of d', 'reached', 'cells', 'ratio, geometric mean', 'worst']
    return _table(head, rows)


def _limit(table: Table) -> str:
    """Return our error over that of our linear limit, by the kind of sampling."""
    found: dict[str, list[float]] = {}
    for cell, scores in table.items():
        noise = 'none' if cell.sensor.noise == 0.0 else 'Gaussian'
        kind = f'{cell.sensor.timing}, noise: {noise}'
        found.setdefault(kind, []).append(scores[OURS].d / scores[LINEAR_LIMIT].d)
    rows = [
        [kind, str(len(r)), *map(number, (mean(r), min(r), max(r)))] for kind, r in found.items()
    ]
    return _table(['sampling', 'cells', 'geometric mean', 'least', 'most'], rows)


def _bound(results: Results, table: Table) -> str:
    """Return the lower bound on the error for steps, beside the errors."""
    rows = []
    for cell, scores in table.items():
        known = results.bounds.get(cell.sensor)
        if known is not None and cell.disturbance == 'steps':
            errors = [scores[name].d for name in (KALMAN, OURS, SELF_TUNING)]
            rows.append([*_names(cell)[2:], *map(number, (*errors, known, known / errors[0]))])
    return _table(
        ['sampling', 'noise', KALMAN, OURS, SELF_TUNING, 'bound', f'bound over {KALMAN}'], rows
    )


def _others(chosen: Chosen) -> str:
    """Return the other measures of the cells with noise, for each kind and each sort of d."""
    rows = []
    for title, read in MEASURES.items():
        for group in list(GROUPS)[:2]:
            cells = [c for c in chosen if GROUPS[group](c)]
            shown = []
            for kind in KINDS:
                found = sorted(read(chosen[c][kind][1]) for c in cells if kind in chosen[c])
                middle = found[len(found) // 2] if found else math.inf
                shown.append(number(middle))
            rows.append([title, group, *shown])
    return _table(['median over the cells', '', *KINDS], rows)


def _errors(chosen: Chosen) -> str:
    """Return the errors of all cells, with the smallest in bold."""
    rows = []
    for cell, row in chosen.items():
        best = min(s.d for _, s in row.values())
        shown = []
        for kind in KINDS:
            text = number(row[kind][1].d) if kind in row else ''
            shown.append(f'**{text}**' if text == number(best) else text)
        rows.append([*_names(cell), row[LINEAR][0], *shown])
    return _table([*HEAD, 'best linear filter', *KINDS], rows)
