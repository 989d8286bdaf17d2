# SPDX-License-Identifier: Apache-2.0
"""Measure a recipe: the usual peers, tuned with the truth, beside the self-tuning observer."""

import argparse
from collections.abc import Mapping, Sequence
from pathlib import Path
import sys
from typing import Any

from fhaosmo_ros.core.parameters.errors import ConfigurationError
from fhaosmo_ros.tools.plot.figures import COLOURS, TRUTH
from matplotlib.axes import Axes
from matplotlib.figure import Figure
import numpy as np
from studies import evidence
from studies.evidence import Row
from studies.harness import Found, Results, run_study, SELF_TUNING
from studies.recipes import drone, encoder, hidden_force, joint_torque, motor_load
from studies.recipes.judging import Fold, Folds, judge, Judgements, OURS, Recipe, run

NAME = 'recipes'
RECIPES: dict[str, Recipe] = {
    'encoder': encoder.RECIPE, 'motor_load': motor_load.RECIPE, 'wind': drone.WIND,
    'joint_torque': joint_torque.RECIPE, 'sensor_bias': drone.BIAS,
    'hidden_force': hidden_force.RECIPE,
}  # fmt: skip
QUICK = 4
"""With --quick the best is chosen from every fourth number."""
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
    methods = {
        method: own._replace(numbers=own.numbers[:: QUICK if quick else 1])
        for method, own in recipe.methods.items()
    }
    found = results({
        (condition, method): (judge, methods[method], these)
        for condition, these in folds.items()
        for method in methods
    })  # fmt: skip
    judged = {c: {method: found[c, method] for method in methods} for c in folds}
    rows = [
        {'recipe': name, 'condition': condition, 'method': method} | row
        for condition, found in judged.items()
        for method, row in found.items()
    ]
    for row in rows:
        print(f'{row["condition"]}: {row["method"]}: {row["error"]:.3g} {row["chosen"]}')
    others = [row for row in evidence.read(NAME, arguments.output) if row['recipe'] != name]
    return Found({NAME: [*others, *rows]}, {}, {f'recipe_{name}': draw(recipe, folds, judged)})


def draw(recipe: Recipe, folds: Folds, results: Judgements) -> Figure:
    """Draw the first condition over time, and the errors of all methods in all conditions."""
    figure = Figure(figsize=(10.0, 4.4), layout='constrained')
    over_time, errors = figure.subplots(1, 2, width_ratios=(2.0, 1.0))
    condition = next(iter(folds))
    _estimates(over_time, recipe, folds[condition], results[condition])
    width = 0.8 / len(results)
    for k, (condition, found) in enumerate(results.items()):
        place = np.arange(len(found)) + k * width - 0.4 + width / 2.0
        values = [row['error'] for row in found.values()]
        bars = errors.barh(
            place, values, 0.9 * width, color=list(COLOURS[: len(found)]),
            alpha=1.0 - 0.45 * k / len(results),
        )  # fmt: skip
        where = f'  {condition}' if len(results) > 1 else ''
        labels = [f'{value:#.3g}{where}' for value in values]
        errors.bar_label(bars, labels, fontsize='x-small', padding=2)
    names = [name.replace(', ', ',\n').replace(' less ', '\nless ') for name in recipe.methods]
    errors.set_yticks(np.arange(len(names)), names)
    errors.tick_params(axis='y', labelsize='x-small')
    errors.invert_yaxis()
    top = max(row['error'] for found in results.values() for row in found.values())
    errors.set_xlim(0.0, top * (2.5 if len(results) > 1 else 1.25))
    errors.set_xlabel('RMS error / RMS of the truth')
    for axes in (over_time, errors):
        axes.grid(alpha=0.3)
        axes.set_axisbelow(True)
    return figure


def _estimates(
    axes: Axes, recipe: Recipe, folds: Sequence[Fold], results: Mapping[str, Row]
) -> None:
    """Draw the truth, the estimates of some methods, and the self-tuning one's error band."""
    fold, scale = folds[recipe.fold], recipe.scale
    r = fold.judged[0]
    part = (r.t - r.t[0] >= recipe.shown[0]) & (r.t - r.t[0] <= recipe.shown[1])
    axes.plot(r.t[part], scale * r.d[part], **TRUTH)
    for k, (name, method) in enumerate(recipe.methods.items()):
        if name not in recipe.drawn:
            continue
        chosen = results[name]['chosen'].split()
        number = float(chosen[recipe.fold]) if chosen else 0.0
        found = scale * method.estimate(fold.parameters, r, number)
        axes.plot(r.t[part], found[part], color=COLOURS[k], lw=1.1, label=name)
        if name == OURS and recipe.band:
            width = 2.0 * abs(scale) * run(fold.parameters | SELF_TUNING, r).standard_deviation
            low, high = found - width[:, -1], found + width[:, -1]
            axes.fill_between(
                r.t[part], low[part], high[part], color=COLOURS[k], alpha=0.2, lw=0.0,
                label='± 2 of its standard deviations',
            )  # fmt: skip
    low, high = np.percentile(scale * r.d[part], (0, 100))
    room = 0.6 * (high - low)
    axes.set_ylim(low - 0.5 * room, high + room)
    axes.set_xlabel('time [s]')
    axes.set_ylabel(recipe.quantity)
    axes.set_title(r.name, fontsize='small')
    axes.legend(fontsize='x-small', loc='upper left', ncols=2)


if __name__ == '__main__':
    sys.exit(run_study(NAME, __doc__, measure, options=OPTIONS))
