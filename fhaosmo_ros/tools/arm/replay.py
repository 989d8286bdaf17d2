# SPDX-License-Identifier: Apache-2.0
"""Estimate external torques from a bag, by the code of the node."""

import argparse
import csv
from pathlib import Path

from fhaosmo_ros.core.arm.arm import Arm
from fhaosmo_ros.stop_signals import Stop
from fhaosmo_ros.tools.arm.recording import (
    add_arm_options,
    arm_parameters,
    description,
    read_joints,
)
from fhaosmo_ros.tools.bags.reader import BagReader
from fhaosmo_ros.tools.cli.command import Output, progress, run_command
import numpy as np


def main(argv: list[str] | None = None) -> int:
    """Run the command; see `run_command`."""
    parser = argparse.ArgumentParser(
        prog='replay_arm',
        description='Estimate external torques from a bag of joint states, as the node arm would.',
    )
    parser.add_argument('bag', type=Path, help='folder of a bag, or its .mcap or .db3 file')
    parser.add_argument(
        '-o', '--output', type=Path, default=Path('external_torque.csv'), metavar='FILE',
        help='table to write (default: %(default)s)',
    )  # fmt: skip
    add_arm_options(parser)
    return run_command(parser, argv, _replay)


def _replay(arguments: argparse.Namespace, stop: Stop) -> None:
    with stop.raising(), BagReader(arguments.bag) as reader:
        arm = Arm(description(reader, arguments), arm_parameters(arguments))
        with_velocity = arm.parameters['measurement'] == 'velocity'
        recorded = read_joints(reader, arguments.topic, arm.model, with_velocity)
        with Output(arguments.output, arguments.force) as output:
            with output.path.open('w', newline='', encoding='utf-8') as file:
                contacts = _write(arm, recorded, file)
            print(f'{arm.counters["used"]} samples used, {contacts} contacts: {output.keep()}')
    for what, count in arm.counters.items():
        if what != 'used':
            print(f'{what}: {count} samples')


def _write(arm, recorded, file) -> int:
    """Write a line for each estimate; return how many contacts began."""
    table, contacts, touched = csv.writer(file), 0, False
    names = arm.joints
    table.writerow([
        'stamp_ns', *names, *(f'{name}_deviation' for name in names), 'log_odds', 'link',
    ])  # fmt: skip
    velocities = recorded.velocity if recorded.velocity is not None else recorded.q
    for stamp, q, effort, velocity in progress(
        zip(recorded.stamps, recorded.q, recorded.effort, velocities, strict=True),
        total=len(recorded.q), unit='sample', desc='replay',
    ):  # fmt: skip
        found = arm.take(int(stamp), q, effort, velocity)
        if found is None:
            continue
        contacts += found.contact and not touched
        touched = found.contact
        numbers = np.concatenate([found.external_torque, found.standard_deviation])
        table.writerow([
            found.stamp, *(f'{x:.9g}' for x in numbers), f'{found.log_odds:.6g}', found.link,
        ])  # fmt: skip
    return contacts
