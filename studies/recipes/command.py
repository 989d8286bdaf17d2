# SPDX-License-Identifier: Apache-2.0
"""Measure a recipe: the usual peers, tuned with the truth, beside the self-tuning observer."""

import argparse
from pathlib import Path

from fhaosmo_ros.core.parameters.errors import ConfigurationError
from fhaosmo_ros.stop_signals import Stop
from fhaosmo_ros.tools.cli.command import run_command
from studies.recipes import (
    encoder,
    hidden_force,
    joint_torque,
    motor_load,
    page,
    sensor_bias,
    wind,
)
from studies.recipes.judging import judge

RECIPES = {
    'encoder': encoder,
    'motor_load': motor_load,
    'wind': wind,
    'joint_torque': joint_torque,
    'sensor_bias': sensor_bias,
    'hidden_force': hidden_force,
}


def main(argv: list[str] | None = None) -> int:
    """Run the command; return 0, 2 for a bad argument or output, 130 if it was interrupted."""
    return run_command(_parser(), argv, _measure)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog='recipes', description=__doc__)
    parser.add_argument('recipe', choices=RECIPES, help='which page of docs/ to make anew')
    needs = '; '.join(f'{name}: {r.DATA}' for name, r in RECIPES.items() if r.DATA)
    parser.add_argument('--data', type=Path, metavar='PATH', help=f'recordings ({needs})')
    parser.add_argument(
        '--short',
        action='store_true',
        help='two short simulations by this package, without recordings; writes nothing',
    )
    return parser


def _measure(arguments: argparse.Namespace, stop: Stop) -> None:
    recipe = RECIPES[arguments.recipe]
    if recipe.DATA and not (arguments.short or arguments.data):
        raise ConfigurationError(
            f'{arguments.recipe}: expected --data PATH ({recipe.DATA}), or --short, got neither'
        )
    if arguments.data and not arguments.data.exists():
        raise ConfigurationError(f'--data: expected a path that exists, got {arguments.data}')
    with stop.raising():
        if arguments.short:
            folds, remarks = recipe.short(), {}
        else:
            folds, remarks = recipe.conditions(arguments.data)
        results = {name: judge(recipe.METHODS, these) for name, these in folds.items()}
        print(page.table(results))
        print(', '.join(f'{name} {value:.4g}' for name, value in remarks.items()))
        if not arguments.short:
            for path in page.write(arguments.recipe, recipe, folds, results, remarks):
                print(path)
