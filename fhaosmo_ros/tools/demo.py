# SPDX-License-Identifier: Apache-2.0
"""The demonstration: plant and estimator as two processes over DDS, recorded and compared."""

import argparse
from collections.abc import Mapping, Sequence
from itertools import pairwise
import os
from pathlib import Path
import time
from typing import Any

from fhaosmo_ros.core.observer.observer import Observer
from fhaosmo_ros.core.online.estimator import OnlineEstimator
from fhaosmo_ros.core.parameters.errors import ConfigurationError
from fhaosmo_ros.core.parameters.files import load
from fhaosmo_ros.stop_signals import Stop, Stopped
from fhaosmo_ros.tools.bags.reader import BagReader
from fhaosmo_ros.tools.bags.writer import BagWriter
from fhaosmo_ros.tools.cli.command import output_at, progress, run_command, shipped
from fhaosmo_ros.tools.cli.processes import start_node
from fhaosmo_ros.tools.plot import Curves, metrics, read_curves, save_curves
from fhaosmo_ros.topics import TRUTH
import numpy as np

START = 2.0
"""Seconds of the start that the tables leave out."""
OTHERS: dict[str, dict[str, Any]] = {
    'fuzzy, the power held': {'gamma_rate': 0.0, 'gamma_leakage': 0.0},
    'self-tuning': {'gains': 'self_tuning'},
    'sign, gains of the paper': {
        'variant': 'sign', 'scheme': 'explicit', 'lambda': [15.0], 'alpha': [30.0],
        'epsilon': 0.025, 'noise_size': 0.0,
    },
}  # fmt: skip
"""Observers that go through the same y: how their parameters differ from those of the file."""
WORDS = """\
RMS: of the estimate; RMS error: of it minus the truth. Chatter: how much further the estimate
moves than the truth does (1: no chatter). The first observer ran live; the others went through
the same y afterwards, by the same code. Self-tuning is not the paper's observer: it is a bank of
Kalman filters that is told the model alone."""
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
    final = arguments.output or Path('demo_output') / time.strftime('%Y-%m-%d_%H-%M-%S')
    with output_at(final, arguments.force) as folder:
        folder.mkdir()
        noisy = arguments.params_file is None
        marks = _record(folder, parameters, arguments.duration, noisy, stop)
        if stop.is_set():
            print('stopped early: reporting what has been recorded')
        curves = observers(folder / 'bag', estimator)
        # In the row of d, what chatters would hide the run.
        errors_alone = [c._replace(names=[]) for c in curves[1:]]
        save_curves([curves[0], *errors_alone], folder / 'demo.png', marks)
        text = report(curves, marks)
        (folder / 'report.txt').write_text(text + '\n', encoding='utf-8')
        print(f'\n{text}\n')
        for line in (folder / 'estimator.log').read_text(encoding='utf-8').splitlines():
            if '[WARN]' in line or '[ERROR]' in line:
                print(line)
    print(f'figure:  {final / "demo.png"}\nbag:     {final / "bag"}')


def _record(
    folder: Path, parameters: Path, duration: float, noisy: bool, stop: Stop
) -> list[tuple[int, str]]:
    """Record a run; return when the plant changed (ns), and how."""
    # Here, so that --help needs no ROS.
    from fhaosmo_ros.nodes.recording import TopicRecorder

    compared = ['/y', *(f'/plant/{name}' for name in TRUTH), '/estimator/state']
    given = ('--ros-args', '--params-file', str(parameters))
    with (
        BagWriter(folder / 'bag') as bag,
        TopicRecorder(bag, ['/estimator', '/plant']) as recorder,
        # Together: Fast DDS finds a node that starts half a second after another one 3 s late. The
        # estimator ends first: else its log, which is shown, may say that y has no publisher.
        start_node(folder, 'plant', *given) as plant,
        start_node(folder, 'estimator', *given) as estimator,
    ):

        def check() -> None:
            estimator.check()
            plant.check()
            recorder.check()
            for topic in ('/y', '/estimator/state'):
                if recorder.node.count_publishers(topic) > 1:  # the bag would hold a mixture
                    raise ConfigurationError(
                        f'expected one publisher of {topic}, got another one on this host with '
                        f'ROS_DOMAIN_ID={os.environ["ROS_DOMAIN_ID"]}; set another ROS_DOMAIN_ID'
                    )

        deadline = time.monotonic() + START_DEADLINE
        print('waiting for the first estimate ...', flush=True)
        while not all(recorder.counts[topic] for topic in compared):
            check()
            if stop.wait(0.02):
                raise Stopped('before the first estimate, nothing written')
            if time.monotonic() > deadline:
                publishers = recorder.node.count_publishers
                raise ConfigurationError(f'waited {START_DEADLINE:g} s in vain for ' + ', '.join(
                    f'{topic} ({publishers(topic)} publishers)'
                    for topic in compared if not recorder.counts[topic]
                ))  # fmt: skip
        words, values = NOISE
        begin, elapsed = time.monotonic(), 0.0
        marks: list[tuple[int, str]] = []
        form = '{l_bar}{bar}| {n:.0f}/{total:.0f} s'
        with progress(total=duration, bar_format=form) as bar:
            while elapsed < duration and not stop.wait(0.1):
                check()
                elapsed = min(time.monotonic() - begin, duration)
                bar.update(elapsed - bar.n)
                due = noisy and not marks and elapsed >= NOISY_FROM * duration
                if due and recorder.set_parameters('/plant', values):
                    bar.write(f'{elapsed:4.1f} s: {words}')
                    marks.append((time.time_ns(), words))
        return marks


def observers(bag: Path, parameters: Mapping[str, Any]) -> list[Curves]:
    """
    Return the estimates of a run beside the truth, and d as `OTHERS` estimate it from the same y.

    An estimate is compared with the truth of the sample behind it (``~/stamp``), not with that of
    the moment at which it was published. There are no others if gains tune themselves.
    """
    (live,) = read_curves(bag, ['/estimator'], '/plant')
    if live.truth is None or not (known := np.isfinite(live.truth).all(axis=1)).any():
        raise ConfigurationError('the run ended before an estimate arrived beside its truth')
    live = live.part(known)._replace(label='this estimator, live')
    if parameters.get('gains') == 'self_tuning':
        return [live]
    with BagReader(bag) as reader:
        y = reader.samples('/y')
    of_d = live._replace(names=['d'], truth=live.truth[:, -1:], gamma=None, events=())
    rows = np.searchsorted(y.stamps, live.stamps).clip(max=len(y.stamps) - 1)
    runs = {
        name: OnlineEstimator({**parameters, **changes}).run(y.stamps, y.values)
        for name, changes in OTHERS.items()
    }
    return [live] + [
        of_d._replace(label=name, estimate=run.unknown_input[rows, np.newaxis])
        for name, run in runs.items()
    ]


def report(curves: list[Curves], marks: Sequence[tuple[int, str]]) -> str:
    """Return a table for the time after the start, and one from each of `marks` (ns) on."""
    origin = curves[0].stamps[0]
    t = (curves[0].stamps - origin) * 1e-9
    edges = [START, *((stamp - origin) * 1e-9 for stamp, _ in marks), np.inf]
    tables = []
    for begin, end in pairwise(edges):
        part = (t >= begin) & (t < end)
        if part.any():
            tables.append(metrics([c.part(part) for c in curves], f'from {begin:.0f} s'))
    tables = tables or [metrics(curves, 'from 0 s')]
    return '\n\n'.join([*tables, WORDS] if curves[1:] else tables)
