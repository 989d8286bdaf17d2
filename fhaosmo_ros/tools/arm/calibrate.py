# SPDX-License-Identifier: Apache-2.0
"""Find what the URDF of an arm does not say, from a recording of free motion."""

import argparse
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from fhaosmo_ros.core.arm import identification
from fhaosmo_ros.core.arm.arm import Arm
from fhaosmo_ros.core.arm.model import Floats
from fhaosmo_ros.core.parameters.errors import ConfigurationError
from fhaosmo_ros.stop_signals import Stop
from fhaosmo_ros.tools.arm.replay import add_options, arm_parameters, description, joint_samples
from fhaosmo_ros.tools.bags.reader import BagReader
from fhaosmo_ros.tools.cli.command import output_at, run_command
from matplotlib.figure import Figure
import numpy as np

LEAST = 1.0  # log-odds that count as contact, at least, however quiet the recording is


def main(argv: list[str] | None = None) -> int:
    """Run the command; see `run_command`."""
    parser = argparse.ArgumentParser(
        prog='calibrate',
        description='Find inertia, friction, offsets and noise of an arm from a bag of joint '
        'states in which nothing touches it, and write them to a file for the node arm.',
    )
    parser.add_argument('--bag', type=Path, required=True, help='a minute of free motion')
    parser.add_argument(
        '--payload', action='store_true',
        help='find the payload only, and how much of the torque calibration_file explains',
    )  # fmt: skip
    add_options(parser, 'calibration.yaml', 'file to write, with a figure beside it')
    return run_command(parser, argv, _calibrate)


def _calibrate(arguments: argparse.Namespace, stop: Stop) -> None:
    values = arm_parameters(arguments)
    if arguments.payload and not values.get('calibration_file'):
        raise ConfigurationError(
            '--payload: expected -p calibration_file:=FILE of the arm without payload, got none'
        )
    with stop.raising(), BagReader(arguments.bag) as reader:
        urdf = description(reader, arguments)
        found_anew = {'payload': [0.0] * 4} if arguments.payload else {'calibration_file': ''}
        arm = Arm(urdf, values | found_anew)
        stamps, rows = zip(*joint_samples(reader, arguments.topic, arm), strict=True)
        when, samples = np.array(stamps), np.array(rows)
        steps = np.diff(when, prepend=when[0])
        back = steps < -1e9 * identification.GAP  # a clock that is set back is a gap of a second
        when += np.cumsum(np.where(back, 10**9 - steps, 0))
        newest = np.maximum.accumulate(np.concatenate([[0], when[:-1]]))
        good = np.isfinite(samples).all(axis=(1, 2)) & (when > newest)
        t = (when[good] - when[good][:1]) * 1e-9
        q, effort, *velocity = samples[good].swapaxes(0, 1)
        later, constants = t + arm.parameters['torque_delay'], arm.torque_constants
        torque = np.column_stack([np.interp(later, t, column) for column in effort.T])
        if arm.parameters['effort'] == 'current' and not arguments.payload:
            given = np.array(arm.parameters['torque_constants'])
            constants = np.where(given == 1.0, 0.0, constants)  # those that are to be found
        if arm.parameters['effort'] == 'gravity_compensated':
            gravity = np.array([arm.model.terms(row, 0.0 * row).gravity for row in q])
            torque += gravity / constants
        if arguments.payload:
            known = replace(arm.calibration, torque_constants=constants)
            payload, *left = identification.payload_of_motion(arm.model, t, q, torque, known)
            print(_table(arm.joints, 'without', 'with payload', *left))
            numbers = ', '.join(f'{x:.4g}' for x in payload)
            print(f'\npayload: [{numbers}]    # kg and m, in the frame of {arm.joints[-1]}')
            return
        found = identification.identify(arm.model, t, q, torque, torque_constants=constants)
        # What the node says of this motion without calibration, of a wrong sign say.
        told = {'torque_constants': found.calibration.torque_constants}
        alone = Arm(urdf, values | found_anew | told)
        alone.run(t, q, effort, *velocity)
        if alone.doubts.text and not alone.doubts.mild:
            raise ConfigurationError(f'recording: by the URDF alone, {alone.doubts.text}')
        # The log-odds of contact that this free motion reaches once a minute.
        free = Arm(urdf, values, calibration=found.calibration)
        odds = np.nan_to_num(free.run(t, q, effort, *velocity).log_odds, nan=-np.inf)
        seconds = t.astype(int)
        peaks = np.sort([np.max(odds[seconds == s]) for s in np.unique(seconds)])[::-1]
        level = max(float(peaks[len(peaks) // 60]), LEAST)
    print('In parts of the recording that were held out:')
    print(_table(arm.joints, 'URDF', 'calibrated', found.before, found.after))
    unused = [f'{what}: {n} samples' for what, n in free.counters.items() if what != 'used']
    doubt = [f'By the URDF alone: {alone.doubts.text}'] if alone.doubts.text else []
    print(*found.notes, *unused, *doubt, sep='\n')
    with output_at(arguments.output, arguments.force, arguments.bag) as path:
        text = replace(found.calibration, log_odds=level).dumps()
        path.write_text(text, encoding='utf-8')
    print(f'calibration: {arguments.output}')
    figure = arguments.output.with_suffix('.png')
    with output_at(figure, arguments.force) as path:
        _figure(arm.joints, found).savefig(path, dpi=110)
    print(f'figure:      {figure}')


def _table(joints: Sequence[str], without: str, with_: str, *left: Floats) -> str:
    """Return what is left unexplained of the joints' torques, without and with what was found."""
    width = max(map(len, joints))
    lines = [f'{"":{width}}   unexplained torque, N m (RMS)',
             f'{"joint":{width}}{without:>12}{with_:>14}{"ratio":>8}']  # fmt: skip
    for name, before, after in zip(joints, *left, strict=True):
        lines.append(f'{name:{width}}{before:12.3g}{after:14.3g}{after / before:8.2f}')
    return '\n'.join(lines)


def _figure(joints: Sequence[str], found: identification.Identified) -> Figure:
    """Draw the measured torque of each joint, and what URDF and calibration say of it."""
    n, t = len(joints), found.t - found.t[0]
    figure = Figure((10.0, 1.3 * n + 1.0), layout='constrained')
    rows = figure.subplots(n, 1, sharex=True, squeeze=False)[:, 0]
    for j, (axes, name) in enumerate(zip(rows, joints, strict=True)):
        axes.plot(t, found.by_urdf[:, j], color='tab:gray', lw=0.8, label='URDF')
        axes.plot(t, found.torque[:, j], color='black', lw=1.2, label='measured')
        axes.plot(t, found.by_calibration[:, j], color='tab:orange', lw=0.8, label='calibrated')
        whole = axes.get_xaxis_transform()
        axes.fill_between(t, 0, 1, found.held_out, transform=whole, fc='0.92', label='held out')
        axes.set_title(f'{name}, N m', fontsize='small', loc='left')
    rows[0].legend(ncols=4, fontsize='small', loc='upper right')
    rows[-1].set_xlabel('time, s')
    figure.suptitle('Torque in free motion')
    return figure
