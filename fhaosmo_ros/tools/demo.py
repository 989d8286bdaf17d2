# SPDX-License-Identifier: Apache-2.0
"""The demonstration: plant and estimator as two processes over DDS, recorded and judged."""

import argparse
from collections.abc import Callable
import os
from pathlib import Path
import time

from fhaosmo_ros.core.errors import ConfigurationError
from fhaosmo_ros.core.parameter_file import load
from fhaosmo_ros.nodes.recorder import Recorder
from fhaosmo_ros.nodes.topics import LATCHED, RUN_TOPICS, type_name
from fhaosmo_ros.stop_signals import Stop
from fhaosmo_ros.tools.bag_writer import BagWriter
from fhaosmo_ros.tools.bags import LATCHED_QOS, OFFERED_QOS
from fhaosmo_ros.tools.command import Interrupted, run_command
from fhaosmo_ros.tools.figures import save_run
from fhaosmo_ros.tools.output import OutputFolder
from fhaosmo_ros.tools.processes import Children
from fhaosmo_ros.tools.run_report import read_run, table
from fhaosmo_ros.tools.share import shipped
from tqdm import tqdm

START_DEADLINE = 90.0
"""Seconds for a node to appear: the very first start compiles."""


def main(argv: list[str] | None = None) -> int:
    """
    Run the demonstration.

    Returns
    -------
    int
        0 if there is a report (also of a run that Ctrl-C ended early), 130 if it was interrupted
        before, 2 for a bad configuration.

    """
    return run_command(_parser(), argv, _demo)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog='demo', description='Run plant and estimator, record, report, draw a figure.'
    )
    parser.add_argument(
        '--duration', type=float, default=20.0, metavar='SECONDS', help='default: %(default)g'
    )
    parser.add_argument(
        '--output', type=Path, metavar='FOLDER',
        help='new or empty folder for bag and figure (default: demo_output/TIME)',
    )  # fmt: skip
    parser.add_argument(
        '--params-file', type=Path, metavar='FILE',
        help='parameters of both nodes (default: the shipped config/demo.yaml)',
    )  # fmt: skip
    return parser


def _demo(arguments: argparse.Namespace, stop: Stop) -> None:
    if not 1.0 <= arguments.duration <= 3600.0:
        raise ConfigurationError(
            f'--duration: expected 1 to 3600 seconds, got {arguments.duration:g}'
        )
    parameters = arguments.params_file or shipped('config/demo.yaml')
    for node in ('plant', 'estimator'):
        load(parameters, node)
    _keep_to_this_host()
    print(
        f'plant and estimator with {parameters}, on this host only, '
        f'ROS_DOMAIN_ID={os.environ["ROS_DOMAIN_ID"]}'
    )
    with OutputFolder(arguments.output or _default_output()) as folder:
        _record(folder.path, parameters, arguments.duration, stop)
        if stop.is_set():
            print('stopped early: reporting what has been recorded')
        run = read_run(folder.path / 'bag')
        save_run(run, folder.path / 'demo.png')
        text = table(run)
        (folder.path / 'report.txt').write_text(text + '\n', encoding='utf-8')
        print(f'\n{text}\n')
        final = folder.keep()
    print(f'figure:  {final / "demo.png"}\nbag:     {final / "bag"}')


def _keep_to_this_host() -> None:
    """Keep the demonstration away from other people's robots, and from a second demonstration."""
    os.environ.setdefault('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
    os.environ.setdefault('ROS_DOMAIN_ID', str(1 + os.getpid() % 100))


def _default_output() -> Path:
    return Path('demo_output') / time.strftime('%Y-%m-%d_%H-%M-%S')


def _record(folder: Path, parameters: Path, duration: float, stop: Stop) -> None:
    with (
        BagWriter(folder / 'bag') as bag,
        Recorder(RUN_TOPICS, bag.write, LATCHED) as recorder,
        Children(folder) as nodes,
    ):
        for topic, kind in RUN_TOPICS.items():
            qos = LATCHED_QOS if topic in LATCHED else OFFERED_QOS
            bag.add(topic, type_name(kind), qos=[qos])
        options = ('--ros-args', '--params-file', str(parameters))
        nodes.start_node('estimator', *options)
        _wait(
            'the estimator (the first start compiles, some 10 s)',
            lambda: recorder.publishers('/estimator/state') and recorder.subscribers('/y') >= 2,
            nodes, stop,
        )  # fmt: skip
        nodes.start_node('plant', *options)
        _wait('the first estimate', lambda: recorder.counts['/estimator/state'], nodes, stop)
        _watch(recorder, nodes, duration, stop)


def _wait(what: str, ready: Callable[[], object], nodes: Children, stop: Stop) -> None:
    deadline = time.monotonic() + START_DEADLINE
    print(f'waiting for {what} ...', flush=True)
    while not ready():
        nodes.check()
        if stop.wait(0.02):
            raise Interrupted('before the first estimate, nothing written')
        if time.monotonic() > deadline:
            raise ConfigurationError(f'waited {START_DEADLINE:g} s for {what}, in vain')


def _watch(recorder: Recorder, nodes: Children, duration: float, stop: Stop) -> None:
    """Show a progress bar until the time is over or the user has seen enough."""
    begin = time.monotonic()
    with tqdm(
        total=duration, unit='s', bar_format='{l_bar}{bar}| {n:.0f}/{total:.0f} s{postfix}'
    ) as bar:
        while not stop.wait(0.1):
            nodes.check()
            elapsed = min(time.monotonic() - begin, duration)
            bar.set_postfix_str(f'{recorder.counts["/y"]} samples', refresh=False)
            bar.update(elapsed - bar.n)
            if elapsed >= duration:
                return
