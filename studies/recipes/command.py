# SPDX-License-Identifier: Apache-2.0
"""
Measure a recipe: the usual peers, tuned with the truth, beside the self-tuning observer.

With --quick on two short simulations by this package, without recordings; writes nothing.
"""

import argparse
from pathlib import Path

from fhaosmo_ros.core.parameters.errors import ConfigurationError
from fhaosmo_ros.stop_signals import Stop
from fhaosmo_ros.tools.cli.command import run_command
from studies import evidence
from studies.harness import output, study
from studies.recipes import (
    encoder,
    figures,
    hidden_force,
    joint_torque,
    motor_load,
    sensor_bias,
    wind,
)
from studies.recipes.judging import judge, table

RECIPES = {
    'encoder': encoder, 'motor_load': motor_load, 'wind': wind, 'joint_torque': joint_torque,
    'sensor_bias': sensor_bias, 'hidden_force': hidden_force,
}  # fmt: skip
NAME = 'recipes'


def main(argv: list[str] | None = None) -> int:
    """Run the command; return 0, 2 for a bad argument or output, 130 if it was interrupted."""
    parser = study(NAME, __doc__)
    parser.add_argument('recipe', choices=RECIPES, help='which one to measure anew')
    needs = '; '.join(f'{name}: {r.DATA}' for name, r in RECIPES.items() if r.DATA)
    parser.add_argument('--data', type=Path, metavar='PATH', help=f'recordings ({needs})')
    return run_command(parser, argv, _measure)


def _measure(arguments: argparse.Namespace, stop: Stop) -> None:
    name, recipe = arguments.recipe, RECIPES[arguments.recipe]
    if recipe.DATA and not (arguments.quick or arguments.data):
        raise ConfigurationError(
            f'{name}: expected --data PATH ({recipe.DATA}), or --quick, got neither'
        )
    if arguments.data and not arguments.data.exists():
        raise ConfigurationError(f'--data: expected a path that exists, got {arguments.data}')
    with stop.raising():
        folds, remarks = (
            (recipe.short(), {}) if arguments.quick else recipe.conditions(arguments.data)
        )
        results = {condition: judge(recipe.METHODS, these) for condition, these in folds.items()}
        rows = table(name, results)
        for row in rows:
            print(f'{row["condition"]}: {row["method"]}: {row["error"]:.3g} {row["chosen"]}')
        print(', '.join(f'{quantity} {value:.4g}' for quantity, value in remarks.items()))
        if not arguments.quick:
            docs = output(arguments, NAME)
            others = [row for row in evidence.read(NAME, docs) if row['recipe'] != name]
            drawn = {f'recipe_{name}': figures.draw(recipe, folds, results)}
            evidence.publish(docs, {NAME: [*others, *rows]}, {}, drawn)
