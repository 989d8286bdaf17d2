# SPDX-License-Identifier: Apache-2.0
"""Bags of joint states: what commands for arms share, and external torques by the node's code."""

import argparse
from collections.abc import Iterator
import csv
from pathlib import Path
from typing import Any

from fhaosmo_ros.core.arm.arm import Arm, text_of
from fhaosmo_ros.core.parameters.arm import ARM_PARAMETERS
from fhaosmo_ros.core.parameters.errors import ConfigurationError
from fhaosmo_ros.core.parameters.files import load
from fhaosmo_ros.messages.joints import joint_sample
from fhaosmo_ros.stop_signals import Stop
from fhaosmo_ros.tools.bags.reader import BagReader
from fhaosmo_ros.tools.cli.command import (
    add_value_options,
    output_at,
    progress,
    run_command,
    values_of,
)

DESCRIPTION = '/robot_description'


def main(argv: list[str] | None = None) -> int:
    """Run the command; see `run_command`."""
    parser = argparse.ArgumentParser(
        prog='replay_arm',
        description='Estimate external torques from a bag of joint states, as the node arm would.',
    )
    parser.add_argument('bag', type=Path, help='folder of a bag, or its .mcap or .db3 file')
    add_options(parser, 'external_torque.csv', 'table to write')
    return run_command(parser, argv, _replay)


def add_options(parser: argparse.ArgumentParser, output: str, what: str) -> None:
    """Add what commands for arms share; `output` is the default of the file they write."""
    add, default = parser.add_argument, ' (default: %(default)s)'
    add('-o', '--output', type=Path, default=Path(output), metavar='FILE', help=what + default)
    add('--topic', default='/joint_states', help='topic of the joint states' + default)
    found = f'file of the robot (default: {DESCRIPTION} in the bag)'
    add('--robot', type=Path, metavar='URDF', help=found)
    add_value_options(parser, 'parameters of the node arm')
    add('--force', action='store_true', help='replace an output that exists')


def arm_parameters(arguments: argparse.Namespace) -> dict[str, Any]:
    """Return the parameters of an arm that files and -p set."""
    values: dict[str, Any] = {}
    for path in arguments.params_file:
        values |= load(path, 'arm', ARM_PARAMETERS)
    return values | ARM_PARAMETERS.coerce(values_of(arguments.param))


def description(reader: BagReader, arguments: argparse.Namespace) -> str:
    """Return the URDF: a file's, else the bag's."""
    if arguments.robot:
        return text_of(arguments.robot, '--robot: expected a URDF')
    found = {m.data for _, _, m in reader.read_all([DESCRIPTION])}
    if len(found) != 1:
        raise ConfigurationError(
            f'{arguments.bag}: expected one robot on {DESCRIPTION}, got '
            f'{"several" if found else "none"}; name its file by --robot URDF'
        )
    return str(found.pop())


def joint_samples(reader: BagReader, topic: str, arm: Arm) -> Iterator[tuple[int, list[Any]]]:
    """Yield each `joint_sample` that holds all joints; ConfigurationError if there is none."""
    found, problem, count = False, 'none', reader.count(topic)
    for _, _, message, _ in progress(
        reader.objects([topic]), total=count, unit='message', desc='read'
    ):
        try:
            yield joint_sample(message, arm)
            found = True
        except ConfigurationError as error:
            problem = str(error)
    if not found:
        expected = f'joint states of {", ".join(arm.joints)} in messages on {topic}'
        raise ConfigurationError(f'{reader.path}: expected {expected}, got {problem}')


def _replay(arguments: argparse.Namespace, stop: Stop) -> None:
    contacts, touched, doubt = 0, False, ''
    with stop.raising(), BagReader(arguments.bag) as reader:
        arm = Arm(description(reader, arguments), arm_parameters(arguments))
        with (
            output_at(arguments.output, arguments.force, arguments.bag) as path,
            path.open('w', newline='', encoding='utf-8') as file,
        ):
            table, deviations = csv.writer(file), [f'{name}_deviation' for name in arm.joints]
            table.writerow(['stamp_ns', *arm.joints, *deviations, 'log_odds', 'link'])
            for stamp, arrays in joint_samples(reader, arguments.topic, arm):
                found = arm.take(stamp, *arrays)
                doubt = arm.doubts.text or doubt
                if found is None:
                    continue
                contacts += found.contact and not touched
                touched = found.contact
                numbers = [f'{x:.9g}' for x in (*found.external_torque, *found.standard_deviation)]
                table.writerow([found.stamp, *numbers, f'{found.log_odds:.6g}', found.link])
    print(f'{arm.counters.pop("used", 0)} samples used, {contacts} contacts: {arguments.output}')
    for what, count in arm.counters.items():
        print(f'{what}: {count} samples')
    if doubt:
        print(doubt)
