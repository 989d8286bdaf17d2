# SPDX-License-Identifier: Apache-2.0
"""Table, figure and results of a recipe, written into docs/."""

from collections.abc import Mapping
import math
from pathlib import Path
from types import ModuleType
from typing import Any

from fhaosmo_ros.tools.plot.figures import COLOURS, TRUTH
from matplotlib.figure import Figure
import numpy as np
from studies.document import refill
from studies.model import SELF_TUNING
from studies.recipes.judging import Fold, OURS, run

DOCS = Path(__file__).resolve().parents[2] / 'docs'
PART = 'results'
Results = Mapping[str, Mapping[str, Mapping[str, Any]]]
"""Of `judge`, by condition."""


def table(results: Results) -> str:
    """Return the errors as a table, and in a sentence who is best."""
    conditions = list(results)
    lines = [
        '| RMS error over the RMS of the truth | number chosen with the truth | '
        + ' | '.join(conditions) + ' |',
        '|---|---|' + '---|' * len(conditions),
    ]  # fmt: skip
    for name in results[conditions[0]]:
        rows = [results[condition][name] for condition in conditions]
        numbers = [number for row in rows for number in row['chosen']]
        chosen = f'{_range(numbers)} {rows[0]["unit"]}' if numbers else 'none'
        errors = ' | '.join(_number(row['error']) for row in rows)
        lines.append(f'| {name} | {chosen} | {errors} |')
    return '\n'.join([*lines, '', *(_verdict(c, results[c], len(results)) for c in conditions)])


def _number(x: float) -> str:
    return f'{x:#.3g}'


def _range(numbers: list[float]) -> str:
    low, high = f'{min(numbers):.3g}', f'{max(numbers):.3g}'
    return low if low == high else f'{low} to {high}'


def _verdict(condition: str, rows: Mapping[str, Mapping[str, Any]], count: int) -> str:
    best = min(rows, key=lambda name: rows[name]['error'])
    least = {True: math.inf, False: math.inf}
    for name, row in rows.items():
        tuned = not name.startswith(OURS)
        least[tuned] = min(least[tuned], row['error'])
    where = f'{condition}: ' if count > 1 else ''
    ratio = least[False] / least[True]
    return (
        f'- {where}the best is {best}. The self-tuning observer, which is told nothing but the '
        f'model, has {ratio:.2f} times the error of the best that was tuned with the truth.'
    )


def draw(recipe: ModuleType, folds: Mapping[str, list[Fold]], results: Results) -> Figure:
    """Draw estimates over time, the self-tuning one's error band, and the errors of all."""
    figure = Figure(figsize=(10.0, 4.4), layout='constrained')
    over_time, errors = figure.subplots(1, 2, width_ratios=(2.0, 1.0))
    condition = next(iter(folds))
    fold, scale = folds[condition][recipe.SHOWN_FOLD], recipe.SCALE
    r = fold.judged[0]
    part = (r.t - r.t[0] >= recipe.SHOWN[0]) & (r.t - r.t[0] <= recipe.SHOWN[1])
    over_time.plot(r.t[part], scale * r.d[part], **TRUTH)
    for k, (name, method) in enumerate(recipe.METHODS.items()):
        if name not in recipe.DRAWN:
            continue
        chosen = results[condition][name]['chosen']
        number = chosen[recipe.SHOWN_FOLD] if chosen else 0.0
        found = scale * method.estimate(fold.parameters, r, number)
        over_time.plot(r.t[part], found[part], color=COLOURS[k], lw=1.1, label=name)
        if name == OURS and recipe.BAND:
            width = 2.0 * abs(scale) * run(fold.parameters | SELF_TUNING, r).standard_deviation
            low, high = found - width[:, -1], found + width[:, -1]
            over_time.fill_between(
                r.t[part], low[part], high[part], color=COLOURS[k], alpha=0.2, lw=0.0,
                label='± 2 of its standard deviations',
            )  # fmt: skip
    low, high = np.percentile(scale * r.d[part], (0, 100))
    room = 0.6 * (high - low)
    over_time.set_ylim(low - 0.5 * room, high + room)
    over_time.set_xlabel('time [s]')
    over_time.set_ylabel(recipe.QUANTITY)
    over_time.set_title(r.name, fontsize='small')
    over_time.legend(fontsize='x-small', loc='upper left', ncols=2)
    width = 0.8 / len(results)
    for k, rows in enumerate(results.values()):
        place = np.arange(len(rows)) + k * width - 0.4 + width / 2.0
        colours = [COLOURS[j] for j in range(len(rows))]
        values = [row['error'] for row in rows.values()]
        bars = errors.barh(
            place, values, 0.9 * width, color=colours, alpha=1.0 - 0.45 * k / max(1, len(results))
        )
        where = f'  {list(results)[k]}' if len(results) > 1 else ''
        labels = [f'{_number(value)}{where}' for value in values]
        errors.bar_label(bars, labels, fontsize='x-small', padding=2)
    errors.set_yticks(np.arange(len(recipe.METHODS)), [_folded(n) for n in recipe.METHODS])
    errors.tick_params(axis='y', labelsize='x-small')
    errors.invert_yaxis()
    top = max(row['error'] for rows in results.values() for row in rows.values())
    errors.set_xlim(0.0, top * (2.5 if len(results) > 1 else 1.25))
    errors.set_xlabel('RMS error / RMS of the truth')
    for axes in (over_time, errors):
        axes.grid(alpha=0.3)
        axes.set_axisbelow(True)
    return figure


def _folded(name: str) -> str:
    return name.replace(', ', ',\n').replace(' less ', '\nless ')


def write(
    name: str, recipe: ModuleType, folds: Mapping[str, list[Fold]], results: Results,
    remarks: Mapping[str, float],
) -> list[Path]:  # fmt: skip
    """Write docs/`name`.md (its generated part), .png and .json; return their paths."""
    kept = {'errors': results, 'remarks': {k: float(f'{x:.4g}') for k, x in remarks.items()}}
    figure = draw(recipe, folds, results)
    return refill(DOCS / f'{name}.md', {PART: table(results)}, figure, kept)
