# SPDX-License-Identifier: Apache-2.0
"""The demonstration: plant and estimator as two processes over DDS, recorded and compared."""

import argparse
from collections.abc import Callable
import os
from pathlib import Path
import time

from fhaosmo_ros.core.observer.observer import Observer
from fhaosmo_ros.core.parameters.errors import ConfigurationError
from fhaosmo_ros.core.parameters.files import load
from fhaosmo_ros.nodes.recording import TopicRecorder
from fhaosmo_ros.stop_signals import Stop, Stopped
from fhaosmo_ros.tools.bags.writer import BagWriter
from fhaosmo_ros.tools.cli.command import Output, progress, run_command, shipped
from fhaosmo_ros.tools.cli.processes import Children
from fhaosmo_ros.tools.demo.report import others, read_run, table
from fhaosmo_ros.tools.plot.figures import save_curves
from fhaosmo_ros.topics import TRUTH

START_DEADLINE = 60.0
"""Seconds for a node to appear; it takes one or two where nothing else runs."""
NOISE = 'now with noise of 1e-4 on y', {'noise_std': 1e-4}
"""What happens to the plant of the shipped files: words, parameters."""
NOISY_FROM = 2.0 / 3.0
"""Part of the duration after which it does."""


def main(argv: list[str] | None = None) -> int:
    """Run the command; a run that Ctrl-C ends after the first estimate is reported, too."""
    parser = argparse.ArgumentParser(
        prog='demo', description='Run plant and estimator, record, report, draw a figure.'
    )
    add = parser.add_argument
    add('--duration', type=float, default=20.0, metavar='SECONDS', help='default: %(default)g')
    add(
        '--output', type=Path, metavar='FOLDER',
        help='new or empty folder for bag and figure (default: demo_output/TIME)',
    )  # fmt: skip
    add('--force', action='store_true', help='replace an output that exists')
    which = parser.add_mutually_exclusive_group()
    which.add_argument(
        '--params-file', type=Path, metavar='FILE',
        help='parameters of both nodes (default: the shipped config/demo.yaml, with noise on y in '
        'the last third)',
    )  # fmt: skip
    which.add_argument(
        '--self-tuning', action='store_true',
        help="the second engine instead of the paper's observer (config/self_tuning.yaml)",
    )  # fmt: skip
    return run_command(parser, argv, _demo)


def _demo(arguments: argparse.Namespace, stop: Stop) -> None:
    if not 1.0 <= arguments.duration <= 3600.0:
        raise ConfigurationError(
            f'--duration: expected 1 to 3600 seconds, got {arguments.duration:g}'
        )
    name = 'self_tuning' if arguments.self_tuning else 'demo'
    parameters = arguments.params_file or shipped(f'config/{name}.yaml')
    load(parameters, 'plant')
    estimator = load(parameters, 'estimator')
    Observer(estimator)
    # Apart from other people's robots, and from a second demonstration.
    os.environ.setdefault('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
    os.environ.setdefault('ROS_DOMAIN_ID', str(1 + os.getpid() % 100))
    print(
        f'plant and estimator with {parameters}, on this host only, '
        f'ROS_DOMAIN_ID={os.environ["ROS_DOMAIN_ID"]}'
    )
    default = Path('demo_output') / time.strftime('%Y-%m-%d_%H-%M-%S')
    with Output(arguments.output or default, arguments.force) as output:
        folder = output.path
        folder.mkdir()
        noisy = arguments.params_file is None
        marks = _record(folder, parameters, arguments.duration, noisy, stop)
        if stop.is_set():
            print('stopped early: reporting what has been recorded')
        run = read_run(folder / 'bag')
        compared = others(run, estimator)
        errors = {name: estimate - run.truth[:, -1] for name, estimate in compared.items()}
        if errors:
            errors['live'] = run.errors[:, -1]
        save_curves([run.curves], folder / 'demo.png', errors, marks)
        text = table(run, compared, marks)
        (folder / 'report.txt').write_text(text + '\n', encoding='utf-8')
        print(f'\n{text}\n')
        final = output.keep()
    print(f'figure:  {final / "demo.png"}\nbag:     {final / "bag"}')


def _record(
    folder: Path, parameters: Path, duration: float, noisy: bool, stop: Stop
) -> list[tuple[int, str]]:
    """Record a run; return when the plant changed (ns), and how."""
    compared = ['/y', *(f'/plant/{name}' for name in TRUTH), '/estimator/state']
    with (
        BagWriter(folder / 'bag') as bag,
        TopicRecorder(bag, ['/estimator', '/plant']) as recorder,
        Children(folder) as nodes,
    ):
        # Together: Fast DDS finds a node that starts half a second after another one 3 s late.
        for name in ('estimator', 'plant'):
            nodes.start_node(name, '--ros-args', '--params-file', str(parameters))

        def check() -> None:
            nodes.check()
            recorder.check()
            for topic in ('/y', '/estimator/state'):
                if recorder.node.count_publishers(topic) > 1:  # the bag would hold a mixture
                    raise ConfigurationError(
                        f'expected one publisher of {topic}, got another one on this host with '
                        f'ROS_DOMAIN_ID={os.environ["ROS_DOMAIN_ID"]}; set another ROS_DOMAIN_ID'
                    )

        deadline = time.monotonic() + START_DEADLINE
        print('waiting for the first estimate ...', flush=True)
        while not all(recorder.counts[topic] for topic in compared) or (
            noisy and not recorder.can_set_parameters('/plant')
        ):
            check()
            if stop.wait(0.02):
                raise Stopped('before the first estimate, nothing written')
            if time.monotonic() > deadline:
                raise ConfigurationError(
                    f'waited {START_DEADLINE:g} s for the first estimate in vain'
                )
        return _watch(recorder, check, duration, noisy, stop)


def _watch(
    recorder: TopicRecorder,
    check: Callable[[], None],
    duration: float,
    noisy: bool,
    stop: Stop,
) -> list[tuple[int, str]]:
    """Show a progress bar, and change the plant, until the time is over or the user stops it."""
    words, values = NOISE
    begin, elapsed = time.monotonic(), 0.0
    marks: list[tuple[int, str]] = []
    form = '{l_bar}{bar}| {n:.0f}/{total:.0f} s{postfix}'
    with progress(total=duration, unit='s', bar_format=form) as bar:
        while elapsed < duration and not stop.wait(0.1):
            check()
            elapsed = min(time.monotonic() - begin, duration)
            bar.set_postfix_str(f'{recorder.counts["/y"]} samples', refresh=False)
            bar.update(elapsed - bar.n)
            if noisy and not marks and elapsed >= NOISY_FROM * duration:
                bar.write(f'{elapsed:4.1f} s: {words}')
                marks.append((time.time_ns(), words))
                recorder.set_parameters('/plant', values)
    return marks
