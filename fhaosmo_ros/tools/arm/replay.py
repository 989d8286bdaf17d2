# SPDX-License-Identifier: Apache-2.0
"""Estimate external torques from a bag, by the code of the node."""

import argparse
from collections.abc import Iterable
import csv
from pathlib import Path
from typing import Any

from fhaosmo_ros.core.arm.arm import Arm
from fhaosmo_ros.stop_signals import Stop
from fhaosmo_ros.tools.arm import recording
from fhaosmo_ros.tools.bags.reader import BagReader
from fhaosmo_ros.tools.cli.command import output_at, run_command


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
    recording.add_arm_options(parser)
    return run_command(parser, argv, _replay)


def _replay(arguments: argparse.Namespace, stop: Stop) -> None:
    with stop.raising(), BagReader(arguments.bag) as reader:
        arm = Arm(recording.description(reader, arguments), recording.arm_parameters(arguments))
        samples = recording.joint_samples(reader, arguments.topic, arm)
        with output_at(arguments.output, arguments.force) as path:
            contacts = _write(arm, samples, path)
    used = arm.counters.pop('used', 0)
    print(f'{used} samples used, {contacts} contacts: {arguments.output}')
    for what, count in arm.counters.items():
        print(f'{what}: {count} samples')


def _write(arm: Arm, samples: Iterable[tuple[int, Any]], path: Path) -> int:
    """Write a line for each estimate; return how many contacts began."""
    contacts, touched, names = 0, False, arm.joints
    with path.open('w', newline='', encoding='utf-8') as file:
        table = csv.writer(file)
        table.writerow([
            'stamp_ns', *names, *(f'{name}_deviation' for name in names), 'log_odds', 'link',
        ])  # fmt: skip
        for stamp, arrays in samples:
            if (found := arm.take(stamp, *arrays)) is None:
                continue
            contacts += found.contact and not touched
            touched = found.contact
            numbers = *found.external_torque, *found.standard_deviation
            table.writerow([
                found.stamp, *(f'{x:.9g}' for x in numbers), f'{found.log_odds:.6g}', found.link,
            ])  # fmt: skip
    return contacts
