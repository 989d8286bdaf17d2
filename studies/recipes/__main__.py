# SPDX-License-Identifier: Apache-2.0
"""Measure a recipe: the usual peers, tuned with the truth, beside the self-tuning observer."""

import argparse
from collections.abc import Mapping
from pathlib import Path
import sys
from typing import Any

from fhaosmo_ros.core import ConfigurationError
from fhaosmo_ros.tools.plot import COLOURS, draw_band, TRUE_STYLE
from matplotlib.axes import Axes
from matplotlib.figure import Figure
import numpy as np
from studies import evidence
from studies.evidence import Row
from studies.harness import Found, observed, Results, run_study, SELF_TUNING
from studies.recipes import encoder, hidden_force, joint_torque, motor_load
from studies.recipes.judging import Fold, Folds, judge, OURS, Recipe

NAME = 'recipes'
RECIPES: dict[str, Recipe] = {
    'encoder': encoder.RECIPE, 'motor_load': motor_load.RECIPE,
    'joint_torque': joint_torque.RECIPE, 'hidden_force': hidden_force.RECIPE,
}  # fmt: skip
QUICK = 4  # with --quick the best is chosen from every fourth number
NEEDS = '; '.join(f'{name}: {r.data}' for name, r in RECIPES.items() if r.data)
OPTIONS: tuple[tuple[str, dict[str, Any]], ...] = (
    ('recipe', {'choices': RECIPES, 'help': 'which one to measure anew'}),
    ('--data', {'type': Path, 'metavar': 'PATH', 'help': f'recordings ({NEEDS})'}),
)


def measure(arguments: argparse.Namespace, results: Results) -> Found:
    """Return the table with the lines of the recipe made anew, and its figure."""
    name, data, quick = arguments.recipe, arguments.data, arguments.quick
    recipe = RECIPES[name]
    if recipe.data and not data:
        raise ConfigurationError(f'{name}: expected --data PATH ({recipe.data}), got none')
    if data and not data.exists():
        raise ConfigurationError(f'--data: expected a path that exists, got {data}')
    folds = results({name: (recipe.conditions, data)})[name]
    every = QUICK if quick else 1
    keys = [(condition, method) for condition in folds for method in recipe.methods]
    methods = {m: x._replace(numbers=x.numbers[::every]) for m, x in recipe.methods.items()}
    found = results({(c, m): (judge, methods[m], folds[c]) for c, m in keys})
    rows = [{'recipe': name, 'condition': c, 'method': m} | found[c, m] for c, m in keys]
    for row in rows:
        print(f'{row["condition"]}: {row["method"]}: {row["error"]:.3g} {row["chosen"]}')
    others = [row for row in evidence.read(NAME, arguments.output) if row['recipe'] != name]
    judged = {c: {m: found[c, m] for m in recipe.methods} for c in folds}
    return Found({NAME: [*others, *rows]}, {}, {f'recipe_{name}': draw(recipe, folds, judged)})


def draw(recipe: Recipe, folds: Folds, judged: Mapping[str, Mapping[str, Row]]) -> Figure:
    """Draw the first condition over time, and the errors of all methods in all conditions."""
    figure = Figure(figsize=(10.0, 4.4), layout='constrained')
    over_time, errors = figure.subplots(1, 2, width_ratios=(2.0, 1.0))
    condition, several = next(iter(folds)), len(judged) > 1
    _estimates(over_time, recipe, folds[condition][recipe.fold], judged[condition])
    width = 0.8 / len(judged)
    for k, (condition, rows) in enumerate(judged.items()):
        place = np.arange(len(rows)) + k * width - 0.4 + width / 2.0
        values = [row['error'] for row in rows.values()]
        bars = errors.barh(
            place, values, 0.9 * width, color=list(COLOURS[: len(rows)]),
            alpha=1.0 - 0.45 * k / len(judged),
        )  # fmt: skip
        labels = [f'{value:#.3g}{f"  {condition}" if several else ""}' for value in values]
        errors.bar_label(bars, labels, fontsize='x-small', padding=2)
    names = [name.replace(', ', ',\n').replace(' less ', '\nless ') for name in recipe.methods]
    errors.set_yticks(np.arange(len(names)), names)
    errors.tick_params(axis='y', labelsize='x-small')
    errors.invert_yaxis()
    top = max(row['error'] for rows in judged.values() for row in rows.values())
    errors.set(xlim=(0.0, top * (2.5 if several else 1.25)), xlabel='RMS error / RMS of the truth')
    for axes in (over_time, errors):
        axes.grid(alpha=0.3)
        axes.set_axisbelow(True)
    return figure


def _estimates(axes: Axes, recipe: Recipe, fold: Fold, rows: Mapping[str, Row]) -> None:
    """Draw the truth, the estimates of some methods, and the self-tuning one's error band."""
    r, scale = fold.judged[0], recipe.scale
    part = (r.t - r.t[0] >= recipe.shown[0]) & (r.t - r.t[0] <= recipe.shown[1])
    axes.plot(r.t[part], scale * r.d[part], **TRUE_STYLE)
    for colour, (name, method) in zip(COLOURS, recipe.methods.items(), strict=False):
        if name not in recipe.drawn:
            continue
        chosen = rows[name]['chosen'].split()
        number = float(chosen[recipe.fold]) if chosen else 0.0
        found = scale * method.estimate(fold.parameters, r, number)[part]
        axes.plot(r.t[part], found, color=colour, lw=1.1, label=name)
        if name == OURS and recipe.band:
            tuned = observed(fold.parameters | SELF_TUNING, r)
            deviation = tuned.standard_deviation[part, -1]
            draw_band(axes, r.t[part], found, abs(scale) * deviation, colour)
    low, high = np.percentile(scale * r.d[part], (0, 100))
    room = 0.6 * (high - low)
    axes.set(xlabel='time [s]', ylabel=recipe.quantity, ylim=(low - 0.5 * room, high + room))
    axes.set_title(r.name, fontsize='small')
    axes.legend(fontsize='x-small', loc='upper left', ncols=2)


if __name__ == '__main__':
    sys.exit(run_study(NAME, __doc__, measure, options=OPTIONS))
