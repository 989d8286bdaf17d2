# SPDX-License-Identifier: Apache-2.0
"""The generated parts of docs/paper.md, as Markdown."""

from collections.abc import Iterable

from studies.paper.beyond import LongRun, Row, WORSE
from studies.paper.cases import OBSERVERS, OURS, Score
from studies.paper.curves import CurveRow, SYSTEMS
from studies.paper.findings import (
    ADAPTIVE,
    COARSE,
    DEFAULT_LAW,
    FINE,
    FUZZY,
    Scores,
    verdicts,
    WidthMap,
)
from studies.paper.plant_and_observer import SOLVERS

RMS_HEAD = '| RMS z1 | RMS z2 | RMS z3 | RMS d | settles [s] | variation | high-passed |'


def _table(head: str, rows: Iterable[str]) -> str:
    return '\n'.join([head, '|---' * (head.count('|') - 1) + '|', *rows])


def _number(x: float) -> str:
    if x == float('inf'):
        return 'never'
    return f'{x:.2e}' if abs(x) < 0.001 or abs(x) >= 1e4 else f'{x:.3g}'


def _cells(s: Score) -> str:
    keys = ('rms_z1', 'rms_z2', 'rms_z3', 'rms_d', 'settling', 'variation', 'high_pass')
    return ' | '.join(_number(s[key]) for key in keys)


def observers_table(scores: dict[str, Scores]) -> str:
    """Return the scores of the observers, by frequency and solver."""
    rows = [
        f'| {name} | {omega:g} | {solver} | {_cells(by_case[name, omega])} |'
        for name, case in (OBSERVERS | OURS).items()
        for solver, by_case in scores.items()
        if case.variant == 'sign' or not SOLVERS[solver].holds_sign
        for omega in sorted({w for _, w in by_case})
    ]
    return _table(f'| observer | ω [rad/s] | solver {RMS_HEAD}', rows)


def findings_table(scores: dict[str, Scores], default: str) -> str:
    """Return the verdicts: the numbers of the default solver, and what the others say."""
    by_solver = {solver: verdicts(s) for solver, s in scores.items()}
    rows = []
    for k, verdict in enumerate(by_solver[default]):
        said: dict[str, list[str]] = {}
        for solver, others in by_solver.items():
            if solver != default:
                said.setdefault(others[k].words, []).append(solver)
        others = '; '.join(f'{", ".join(names)}: {words}' for words, names in said.items())
        holds = f'**{verdict.words}**' if verdict.estimates else verdict.words
        rows.append(
            f'| {verdict.name} | {verdict.claim} | {holds} | {verdict.numbers} | {others} |'
        )
    return _table(f'| finding | claim | holds ({default}) | numbers | other solvers |', rows)


def bar_table(scores: dict[str, Scores]) -> str:
    """Return how adaptation compares with none, in every cell of the four observers' table."""
    rows = []
    for solver, s in scores.items():
        if SOLVERS[solver].holds_sign:
            continue  # there is no sign in these
        for omega in sorted({w for _, w in s}):
            paper, default = (
                s[name, omega]['rms_d'] / s[FUZZY, omega]['rms_d']
                for name in (ADAPTIVE, DEFAULT_LAW)
            )
            bar = 'yes' if default <= WORSE else 'no'
            rows.append(f'| {solver} | {omega:g} | {paper:.3f} | {default:.3f} | {bar} |')
    return _table(
        "| solver | ω [rad/s] | the paper's law / γ = 1/2 | default law / γ = 1/2 "
        '| default within the bar |',
        rows,
    )


def solver_table(scores: dict[str, Scores], default: str) -> str:
    """Return how sign depends on the solver."""
    rows = [
        f'| {name} | {solver}{" (default)" if solver == default else ""} | {omega:g} | '
        f'{_number(s["rms_d"])} | {s["rms_d"] / s["true_d"]:.2f} | {_number(s["bias_d"])} | '
        f'{_number(s["variation"])} | {_number(s["high_pass"])} |'
        for name in (FINE, COARSE)
        for solver, by_case in scores.items()
        for omega in sorted({w for _, w in by_case})
        for s in (by_case[name, omega],)
    ]
    return _table(
        '| observer | solver | ω [rad/s] | RMS d | the same / RMS of d itself '
        '| mean error of d | variation | high-passed |',
        rows,
    )


def map_text(widths: WidthMap, preset: list[float], every: int) -> str:
    """Return what the search found, and whether the preset lies inside."""
    count, total = int(widths.region.sum()), widths.region.size
    first, later = widths.deepest()
    lines = [
        f'- cells searched: {total}; all three findings hold in {count}',
        f'- furthest inside the region: level 1 at {first:g}, later levels at {later:g}',
        f'- in `config/paper.yaml`: {", ".join(f"{w:g}" for w in preset)}',
    ]
    parts = ', '.join(
        f'{name} in {int(widths.holds[k].sum())}' for k, name in enumerate(('F1c', 'F2', 'F3'))
    )
    lines.append(f'- each alone: {parts}')
    if every > 1:
        lines.append(f'- coarse: every {every}th half-width only')
    return '\n'.join(lines)


def beyond_table(rows: Iterable[Row]) -> str:
    """Return the scores of sampled observers."""
    return _table(
        f'| observer | scheme | step [s] | ω [rad/s] | noise on y {RMS_HEAD}',
        (
            f'| {r.name} | {r.scheme} | {r.step:g} | {r.omega:g} | {r.noise:g} | '
            f'{_cells(r.score)} |'
            for r in rows
        ),
    )


def long_table(runs: Iterable[LongRun]) -> str:
    """Return how gamma and the estimate of d fare over a long time."""
    rows = []
    for r in runs:
        first, last = r.rms_d[0], r.rms_d[-1]
        better = 'yes' if last <= first else 'no'
        bar = 'yes' if last <= WORSE * r.fixed else 'no'
        rows.append(
            f'| {r.gains} | {r.law} | {r.scheme} | {r.omega:g} | {r.noise:g} | {r.gamma[0]:.3f} | '
            f'{r.gamma[-1]:.3f} | {_number(first)} | {_number(last)} | {_number(r.fixed)} | '
            f'{better} | {bar} |'
        )
    return _table(
        '| gains | law of γ | scheme | ω [rad/s] | noise on y | γ after the first 100 s '
        '| γ at the end | RMS d, first 100 s | RMS d, last 100 s | the same, γ = 1/2 '
        '| last no worse than first | within 5 % of γ = 1/2 |',
        rows,
    )


def protection_table(runs: Iterable[LongRun]) -> str:
    """Return what each protection of gamma does by itself."""
    rows = [
        f'| {r.law} | {r.omega:g} | {r.noise:g} | {r.gamma[-1]:.3f} | {_number(r.rms_d[-1])} | '
        f'{r.rms_d[-1] / r.fixed:.3f} |'
        for r in runs
    ]
    return _table(
        '| law of γ | ω [rad/s] | noise on y | γ at the end | RMS d at the end '
        '| the same / that of γ = 1/2 |',
        rows,
    )


def curves_table(rows: Iterable[CurveRow]) -> str:
    """Return the RMS errors of d by fuzzy system."""
    names = ' | '.join(SYSTEMS)
    return _table(
        f'| gains | d | {names} |',
        (f'| {r.gains} | {r.signal} | {" | ".join(_number(x) for x in r.rms_d)} |' for r in rows),
    )


def dead_zone_table(runs: Iterable[LongRun]) -> str:
    """Return the worse ratio to gamma = 1/2 of both schemes, by dead zone and frequency."""
    by_cell: dict[tuple[str, float], list[LongRun]] = {}
    for r in runs:
        by_cell.setdefault((r.law, r.omega), []).append(r)
    zones = list(dict.fromkeys(zone for zone, _ in by_cell))
    frequencies = list(dict.fromkeys(omega for _, omega in by_cell))
    rows = []
    for zone in zones:
        cells = []
        for omega in frequencies:
            found = by_cell[zone, omega]
            ratio = max(r.rms_d[-1] / r.fixed for r in found)
            met = ratio <= WORSE and all(r.rms_d[-1] <= r.rms_d[0] for r in found)
            cells.append(f'{ratio:.3f}' if met else f'**{ratio:.3f}**')
        rows.append(f'| {zone} | {" | ".join(cells)} |')
    return _table(f'| dead zone | {" | ".join(f"ω = {w:g}" for w in frequencies)} |', rows)
