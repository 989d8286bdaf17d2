# SPDX-License-Identifier: Apache-2.0
"""Find what the URDF of an arm does not say, from a recording of free motion."""

import argparse
from pathlib import Path
from typing import Any

from fhaosmo_ros.core.arm.arm import Arm, payload_of
from fhaosmo_ros.core.arm.calibration import Calibration
from fhaosmo_ros.core.arm.identification import Identified, identify, payload_of_motion
from fhaosmo_ros.core.arm.model import ArmModel
from fhaosmo_ros.core.parameters.arm import ARM_PARAMETERS
from fhaosmo_ros.core.parameters.errors import ConfigurationError
from fhaosmo_ros.stop_signals import Stop
from fhaosmo_ros.tools.arm.figure import torque_figure
from fhaosmo_ros.tools.arm.recording import (
    add_arm_options,
    arm_parameters,
    description,
    read_joints,
    Recorded,
)
from fhaosmo_ros.tools.bags.reader import BagReader
from fhaosmo_ros.tools.cli.command import Output, progress, run_command
import numpy as np

LEAST = 1.0
"""The least log-odds that count as contact, however quiet the recording is."""


def main(argv: list[str] | None = None) -> int:
    """Run the command; see `run_command`."""
    parser = argparse.ArgumentParser(
        prog='calibrate',
        description='Find inertia, friction, offsets and noise of an arm from a bag of joint '
        'states in which nothing touches it, and write them to a file for the node arm.',
    )
    parser.add_argument('--bag', type=Path, required=True, help='a minute of free motion')
    parser.add_argument(
        '-o', '--output', type=Path, default=Path('calibration.yaml'), metavar='FILE',
        help='file to write, with a figure beside it (default: %(default)s)',
    )  # fmt: skip
    parser.add_argument(
        '--payload', action='store_true',
        help='find the payload only; everything else is that of calibration_file',
    )  # fmt: skip
    add_arm_options(parser)
    return run_command(parser, argv, _calibrate)


def _calibrate(arguments: argparse.Namespace, stop: Stop) -> None:
    values = arm_parameters(arguments)
    parameters = ARM_PARAMETERS.complete(values)
    with stop.raising(), BagReader(arguments.bag) as reader:
        urdf = description(reader, arguments)
        model = ArmModel(
            urdf, joints=[n for n in parameters['joints'] if n], gravity=parameters['gravity'],
            payload=payload_of(parameters),
        )  # fmt: skip
        recorded = read_joints(reader, arguments.topic, model, with_velocity=False)
        effort = recorded.effort
        if parameters['effort'] == 'gravity_compensated':
            rest = np.zeros(len(model.joints))
            effort = effort + np.array([model.terms(q, rest).gravity for q in recorded.q])
        if arguments.payload:
            _payload(model, recorded, effort, values)
            return
        constants: Any = 1.0
        if parameters['effort'] == 'current':
            given = np.array(parameters['torque_constants'])
            constants = np.where(given == 1.0, 0.0, given)
        found = identify(model, recorded.t, recorded.q, effort, torque_constants=constants)
        calibration = found.calibration.changed(
            log_odds=_level(urdf, values, found.calibration, recorded)
        )
    print(_report(model, found))
    with Output(arguments.output, arguments.force) as output:
        output.path.write_text(calibration.dumps(), encoding='utf-8')
        print(f'\ncalibration: {output.keep()}')
    with Output(arguments.output.with_suffix('.png'), arguments.force) as output:
        torque_figure(model, found).savefig(output.path, dpi=110)
        print(f'figure:      {output.keep()}')


def _level(
    urdf: str, values: dict[str, Any], calibration: Calibration, recorded: Recorded
) -> float:
    """Return the log-odds of contact that this free motion reaches once a minute."""
    arm = Arm(urdf, {**values, 'measurement': 'position'}, calibration=calibration)
    odds = []
    for row in progress(
        zip(recorded.stamps, recorded.q, recorded.effort, strict=True),
        total=len(recorded.q), unit='sample', desc='false alarms',
    ):  # fmt: skip
        estimate = arm.take(int(row[0]), row[1], row[2])
        odds.append(-np.inf if estimate is None else estimate.log_odds)
    seconds = recorded.t.astype(int)
    peaks = np.sort([np.max(np.array(odds)[seconds == s]) for s in np.unique(seconds)])[::-1]
    return float(max(peaks[min(int(len(peaks) / 60.0), len(peaks) - 1)], LEAST))


def _payload(model: ArmModel, recorded: Recorded, effort: Any, values: dict[str, Any]) -> None:
    """Print the payload as a parameter."""
    if not values.get('calibration_file'):
        raise ConfigurationError(
            '--payload: expected -p calibration_file:=FILE of the arm without payload, got none'
        )
    path = Path(values['calibration_file'])
    calibration = Calibration.loads(path.read_text(encoding='utf-8')).of(model.joints)
    payload, before, after = payload_of_motion(model, recorded.t, recorded.q, effort, calibration)
    numbers = ', '.join(f'{x:.4g}' for x in (payload.mass, *payload.center))
    for name, b, a in zip(model.joints, before, after, strict=True):
        print(f'{name}: unexplained {b:.3g} N m without, {a:.3g} N m with the payload')
    print(f'\npayload: [{numbers}]    # kg and m, in the frame of {model.joints[-1]}')


def _report(model: ArmModel, found: Identified) -> str:
    """Return a table: what is left unexplained in parts that were held out."""
    width = max(map(len, model.joints))
    lines = [f'{"":{width}}   unexplained torque, N m (RMS, held out)',
             f'{"joint":{width}}{"URDF":>12}{"calibrated":>12}{"ratio":>8}']  # fmt: skip
    for name, before, after in zip(model.joints, found.before, found.after, strict=True):
        lines.append(f'{name:{width}}{before:12.3g}{after:12.3g}{after / before:8.2f}')
    return '\n'.join([*lines, *found.notes])
