# SPDX-License-Identifier: Apache-2.0
"""
Measure a recipe: the usual peers, tuned with the truth, beside the self-tuning observer.

With --quick on two short simulations by this package, without recordings.
"""

import argparse
from pathlib import Path
import sys
from typing import Any

from fhaosmo_ros.core.parameters.errors import ConfigurationError
from studies import evidence
from studies.harness import Found, Results, run_study
from studies.recipes import drone, encoder, hidden_force, joint_torque, motor_load
from studies.recipes.figures import draw
from studies.recipes.judging import judge, Recipe

NAME = 'recipes'
RECIPES: dict[str, Recipe] = {
    'encoder': encoder.RECIPE, 'motor_load': motor_load.RECIPE, 'wind': drone.WIND,
    'joint_torque': joint_torque.RECIPE, 'sensor_bias': drone.BIAS,
    'hidden_force': hidden_force.RECIPE,
}  # fmt: skip
NEEDS = '; '.join(f'{name}: {r.data}' for name, r in RECIPES.items() if r.data)
OPTIONS: tuple[tuple[str, dict[str, Any]], ...] = (
    ('recipe', {'choices': RECIPES, 'help': 'which one to measure anew'}),
    ('--data', {'type': Path, 'metavar': 'PATH', 'help': f'recordings ({NEEDS})'}),
)


def measure(arguments: argparse.Namespace, results: Results) -> Found:
    """Return the table with the lines of the recipe made anew, and its figure."""
    name, data, quick = arguments.recipe, arguments.data, arguments.quick
    recipe = RECIPES[name]
    if recipe.data and not (quick or data):
        raise ConfigurationError(
            f'{name}: expected --data PATH ({recipe.data}), or --quick, got neither'
        )
    if data and not data.exists():
        raise ConfigurationError(f'--data: expected a path that exists, got {data}')
    made = (recipe.short,) if quick else (recipe.conditions, data)
    folds = results({name: made})[name]
    found = results({
        (condition, method): (judge, recipe.methods[method], these)
        for condition, these in folds.items()
        for method in recipe.methods
    })  # fmt: skip
    judged = {c: {method: found[c, method] for method in recipe.methods} for c in folds}
    rows = [
        {'recipe': name, 'condition': condition, 'method': method} | row
        for condition, found in judged.items()
        for method, row in found.items()
    ]
    for row in rows:
        print(f'{row["condition"]}: {row["method"]}: {row["error"]:.3g} {row["chosen"]}')
    others = [row for row in evidence.read(NAME, arguments.output) if row['recipe'] != name]
    return Found({NAME: [*others, *rows]}, {}, {f'recipe_{name}': draw(recipe, folds, judged)})


if __name__ == '__main__':
    sys.exit(run_study(NAME, __doc__, measure, options=OPTIONS))
