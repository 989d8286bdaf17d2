# SPDX-License-Identifier: Apache-2.0
"""Joint states and the robot's description out of a bag or a table, as arrays."""

import argparse
from pathlib import Path
from typing import Any, NamedTuple

from fhaosmo_ros.core.arm.model import ArmModel
from fhaosmo_ros.core.parameters.arm import ARM_PARAMETERS
from fhaosmo_ros.core.parameters.declaration import suggestion
from fhaosmo_ros.core.parameters.errors import ConfigurationError
from fhaosmo_ros.core.parameters.files import load
from fhaosmo_ros.tools.bags.reader import BagReader
from fhaosmo_ros.tools.cli.command import progress
from fhaosmo_ros.tools.cli.options import add_value_options, assigned
import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
JOINT_STATES, DESCRIPTION = '/joint_states', '/robot_description'


class Recorded(NamedTuple):
    """Joint states in the order of the arm's joints, K rows."""

    stamps: NDArray[np.int64]  # (K,) ns
    q: Floats  # (K, n)
    effort: Floats  # (K, n)
    velocity: Floats | None  # (K, n)

    @property
    def t(self) -> Floats:
        """Seconds since the first sample."""
        return np.asarray((self.stamps - self.stamps[0]) * 1e-9)


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
    return values | assigned(arguments.param, ARM_PARAMETERS)


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


def read_joints(reader: BagReader, topic: str, model: ArmModel, with_velocity: bool) -> Recorded:
    """
    Return the samples that hold all joints of the arm.

    Raises
    ------
    ConfigurationError
        No message has all joints, with positions and efforts.

    """
    if not reader.count(topic):
        raise ConfigurationError(f'{reader.path}: expected messages on {topic}, got none')
    stamps, rows, names = [], [], ()
    order: list[int] | None = None
    lacking = ''
    for _, _, message, _ in progress(
        reader.objects([topic]), total=reader.count(topic), unit='message', desc='read'
    ):
        if tuple(message.name) != names:
            names = tuple(message.name)
            missing = [name for name in model.joints if name not in names]
            order = None if missing else [names.index(name) for name in model.joints]
            if missing:
                lacking = f'without {missing[0]}{suggestion(missing[0], names)}'
        if order is None:
            continue
        parts = [message.position, message.effort, *[message.velocity] * with_velocity]
        if any(len(part) != len(names) for part in parts):
            lacking = 'without a position, effort or velocity for each name'
            continue
        header = message.header.stamp
        stamps.append(header.sec * 1_000_000_000 + header.nanosec)
        rows.append([part[order] for part in parts])
    if not rows:
        raise ConfigurationError(
            f'{reader.path}: expected joint states of {", ".join(model.joints)} on {topic}, got '
            f'messages {lacking}'
        )
    when, samples = np.array(stamps), np.array(rows, dtype=np.float64)
    good = np.isfinite(samples).all(axis=(1, 2)) & (when > np.maximum.accumulate(
        np.concatenate([[0], when[:-1]])
    ))  # fmt: skip
    when, samples = when[good], samples[good]
    velocity = samples[:, 2] if with_velocity else None
    return Recorded(when, samples[:, 0], samples[:, 1], velocity)
