# SPDX-License-Identifier: Apache-2.0
"""Joint states and the robot's description out of a bag."""

import argparse
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from fhaosmo_ros.core.arm.arm import Arm
from fhaosmo_ros.core.parameters.arm import ARM_PARAMETERS
from fhaosmo_ros.core.parameters.errors import ConfigurationError
from fhaosmo_ros.core.parameters.files import load
from fhaosmo_ros.messages.joints import joint_sample
from fhaosmo_ros.tools.bags.reader import BagReader
from fhaosmo_ros.tools.cli.command import add_value_options, progress, values_of
import numpy as np
from numpy.typing import NDArray

JOINT_STATES, DESCRIPTION = '/joint_states', '/robot_description'


def add_arm_options(parser: argparse.ArgumentParser) -> None:
    """Add what the commands for arms share."""
    add = parser.add_argument
    add('--topic', default=JOINT_STATES, help='topic of the joint states (default: %(default)s)')
    add(
        '--robot', type=Path, metavar='URDF',
        help=f'file of the robot (default: {DESCRIPTION} in the bag)',
    )  # fmt: skip
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
        return str(arguments.robot.read_text(encoding='utf-8'))
    found = {m.data for _, _, m in reader.read_all([DESCRIPTION])}
    if len(found) != 1:
        what = 'several' if found else 'none'
        raise ConfigurationError(
            f'{arguments.bag}: expected one robot on {DESCRIPTION}, got {what}; name its file by '
            '--robot URDF'
        )
    return str(found.pop())


def joint_samples(
    reader: BagReader, topic: str, arm: Arm
) -> Iterator[tuple[int, list[NDArray[np.float64]]]]:
    """
    Yield the samples that hold all joints; see `joint_sample`.

    Raise ConfigurationError if there are none.
    """
    found, problem = False, 'none'
    for _, _, message, _ in progress(
        reader.objects([topic]), total=reader.count(topic), unit='message', desc='read'
    ):
        try:
            yield joint_sample(message, arm)
            found = True
        except ConfigurationError as error:
            problem = str(error)
    if not found:
        expected = f'joint states of {", ".join(arm.joints)} in messages on {topic}'
        raise ConfigurationError(f'{reader.path}: expected {expected}, got {problem}')
