# SPDX-License-Identifier: Apache-2.0
"""
An arm that is hit by a ball, leans on a wall and is pushed slowly, over the middleware.

MuJoCo makes the recording of a KUKA iiwa; one process publishes it on /joint_states as it would
come from the robot, another one is the node arm, and what it says is recorded and compared.
"""

import argparse
import os
from pathlib import Path
import sys
import time

from fhaosmo_ros.core.arm.model import ArmModel
from fhaosmo_ros.core.parameters.errors import ConfigurationError
from fhaosmo_ros.nodes.recording import TopicRecorder
from fhaosmo_ros.stop_signals import Stop, Stopped
from fhaosmo_ros.tools.bags.reader import BagReader
from fhaosmo_ros.tools.bags.types import header, serialise
from fhaosmo_ros.tools.bags.writer import BagWriter
from fhaosmo_ros.tools.cli.command import output_at, progress, run_command
from fhaosmo_ros.tools.cli.processes import Child, start_node
from matplotlib.figure import Figure
import numpy as np
from studies.arm.peers import classical, momentum
from studies.arm.world import rmse, simulate, Touched, urdf_of
from studies.harness import Floats

ROBOT, SEED, DURATION = 'iiwa', 10, 16.0
BALLS, PUSH = (2.5, 13.0), 9.5  # s, when a ball is thrown, and when the slow push begins
GAIN = 50.0  # 1/s, of the classical observer: a usual one
FIRST = 10**9  # ns, stamp of the first sample
TORQUE, EVENT = '/arm/external_torque', '/arm/event'
Events = list[tuple[float, str]]  # seconds and link of contacts
SHOWN = (0, 1, 3)  # joints in the figure


def main(argv: list[str] | None = None) -> int:
    """Run the command; see `run_command`."""
    parser = argparse.ArgumentParser(prog='demo-arm', description=__doc__)
    parser.add_argument(
        '--output', type=Path, metavar='FOLDER', help='(default: demo_output/TIME)'
    )
    parser.add_argument('--force', action='store_true', help='replace an output that exists')
    return run_command(parser, argv, _demo)


def _demo(arguments: argparse.Namespace, stop: Stop) -> None:
    os.environ.setdefault('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
    os.environ.setdefault('ROS_DOMAIN_ID', str(1 + os.getpid() % 100))
    print(f'on this host only, ROS_DOMAIN_ID={os.environ["ROS_DOMAIN_ID"]}; simulating ...')
    urdf = urdf_of(ROBOT)
    model = ArmModel(urdf)
    world = simulate(urdf, model, DURATION, SEED, wall=True, balls=BALLS, push=PUSH)
    final = arguments.output or Path('demo_output') / time.strftime('%Y-%m-%d_%H-%M-%S')
    with output_at(final, arguments.force) as folder:
        folder.mkdir()
        (folder / 'robot.urdf').write_text(urdf, encoding='utf-8')
        _write(folder / 'robot', model, world)
        _run(folder, stop)
        torque, events = _read(folder / 'bag', world)
        by_gain = classical(momentum(model, world, by_position=True), {'gain': GAIN})
        text = _table(world, torque, by_gain, events)
        (folder / 'report.txt').write_text(text + '\n', encoding='utf-8')
        _figure(world, torque, by_gain, events).savefig(folder / 'demo_arm.png', dpi=110)
    print(f'\n{text}\n\nfigure: {final / "demo_arm.png"}')


def _write(path: Path, model: ArmModel, world: Touched) -> None:
    """Write the joint states as a bag to publish."""
    with BagWriter(path) as bag:
        bag.add('/joint_states', 'sensor_msgs/msg/JointState')
        for k, moment in enumerate(world.t):
            stamp = FIRST + round(moment * 1e9)
            bag.write('/joint_states', stamp, serialise(
                'sensor_msgs/msg/JointState',
                header=header(stamp), name=list(model.joints), position=world.q[k],
                velocity=world.velocity[k], effort=world.torque[k],
            ))  # fmt: skip


def _run(folder: Path, stop: Stop) -> None:
    """Let the robot and the node run, and record what the node says."""
    with (
        BagWriter(folder / 'bag') as bag,
        TopicRecorder(bag, topics=(TORQUE, EVENT)) as recorder,
        # The encoders' steps, and what the torque sensors' data sheet would say.
        start_node(
            folder, 'arm', '--ros-args', '-p', f'robot_description_file:={folder / "robot.urdf"}',
            '-p', 'publish_rate:=1000.0',
        ) as node,
        Child(
            folder / 'robot.log', '-m', 'fhaosmo_ros', 'play', str(folder / 'robot')
        ) as robot,
    ):  # fmt: skip
        begin, count = time.monotonic(), 0
        form = '{l_bar}{bar}| {n:.0f}/{total:.0f} s'
        with progress(total=DURATION, unit='s', bar_format=form) as bar:
            while count < 1 or recorder.counts[TORQUE] != count:
                count = recorder.counts[TORQUE]
                node.check()
                recorder.check()
                if not count:
                    robot.check()
                    if time.monotonic() - begin > 60.0:
                        raise ConfigurationError('waited 60 s for the first estimate in vain')
                bar.update(min(count * 1e-3, DURATION) - bar.n)
                if stop.wait(1.0):
                    raise Stopped


def _read(path: Path, world: Touched) -> tuple[Floats, Events]:
    """Return the external torque at each sample (NaN where none came), and contacts that began."""
    torque, events = np.full(world.truth.shape, np.nan), []
    with BagReader(path) as reader:
        for topic, _, message, _ in reader.objects([TORQUE, EVENT]):
            stamp = message.header.stamp
            t = stamp.sec + stamp.nanosec * 1e-9 - FIRST * 1e-9
            if topic == TORQUE:
                torque[min(round(t * 1e3), len(torque) - 1)] = message.effort
            elif message.status[0].values:
                link = {v.key: v.value for v in message.status[0].values}['link']
                if message.status[0].level:
                    events.append((t, link))
                elif events:  # its end, where the link is better known
                    events[-1] = events[-1][0], link
    return torque, events


def _kind(moment: float) -> str:
    """Return what touched the arm in a contact that began then."""
    if any(0.0 <= moment - ball < 0.5 for ball in BALLS):
        return 'ball'
    return 'slow push' if 0.0 <= moment - PUSH < 1.5 else 'wall'


def _table(world: Touched, torque: Floats, by_gain: Floats, events: Events) -> str:
    """Return errors, and when each contact was told."""
    known = np.isfinite(torque).all(axis=1)
    lines = [
        f'samples estimated: {known.sum()} of {len(known) - 1}', '',
        'error of the external torque, RMS, sum of all joints',
    ]  # fmt: skip
    nothing = np.zeros_like(world.truth)
    names = ('arm', f'classical, {GAIN:g}/s', '(no estimate)')
    for name, estimate in zip(names, (torque, by_gain, nothing), strict=True):
        value = rmse(world, np.where(known[:, np.newaxis], estimate, world.truth))
        lines.append(f'  {name:18}{value:6.2f} N m')
    lines += ['', 'contact      told after   most likely at']
    for moment in (world.t[k] for k, *_ in world.begins):
        later = [(t, link) for t, link in events if -0.01 <= t - moment < 1.0]
        said = f'{(later[0][0] - moment) * 1e3:7.0f} ms   {later[0][1]}' if later else 'not told'
        lines.append(f'{_kind(moment):12}{said}')
    return '\n'.join(lines)


def _figure(world: Touched, torque: Floats, by_gain: Floats, events: Events) -> Figure:
    """Draw the external torque of some joints, and the contacts that were told."""
    figure = Figure((10.0, 7.0), layout='constrained')
    rows = figure.subplots(len(SHOWN), 1, sharex=True)
    touched = np.linalg.norm(world.truth, axis=1) > 0.05
    for axes, j in zip(rows, SHOWN, strict=True):
        axes.fill_between(
            world.t, 0, 1, where=touched, transform=axes.get_xaxis_transform(), color='0.9',
            label='touched',
        )  # fmt: skip
        for estimate, colour, width, label in (
            (by_gain, 'tab:blue', 0.6, 'classical observer'),
            (world.truth, 'black', 1.6, 'truth'), (torque, 'tab:orange', 1.0, 'arm'),
        ):  # fmt: skip
            axes.plot(world.t, estimate[:, j], color=colour, lw=width, label=label)
        low, high = world.truth[:, j].min(), world.truth[:, j].max()
        margin = 0.25 * (high - low)
        axes.set(ylim=(low - margin, high + margin), ylabel='N m')
        axes.set_title(f'External torque of joint {j + 1}', fontsize='medium', loc='left')
        for k, (t, _) in enumerate(events):
            label = '' if k else 'contact told'
            axes.axvline(t, color='tab:red', lw=0.8, ls=':', label=label)
    for k, *_ in world.begins:
        rows[0].annotate(
            _kind(world.t[k]), (world.t[k], 1.0), xycoords=('data', 'axes fraction'),
            xytext=(2, -12), textcoords='offset points', fontsize='small',
        )  # fmt: skip
    figure.legend(*rows[0].get_legend_handles_labels(), ncols=5, loc='outside upper right')
    rows[-1].set_xlabel('time, s')
    return figure


if __name__ == '__main__':
    sys.exit(main())
