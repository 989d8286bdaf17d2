# SPDX-License-Identifier: Apache-2.0
"""The demonstration: plant and estimator as two processes over DDS, recorded and compared."""

import argparse
from collections.abc import Mapping, Sequence
from itertools import pairwise
import os
from pathlib import Path
import time
from typing import Any, NamedTuple

from fhaosmo_ros.core.observer.observer import Observer
from fhaosmo_ros.core.online.estimator import OnlineEstimator
from fhaosmo_ros.core.parameters.errors import ConfigurationError
from fhaosmo_ros.core.parameters.files import load
from fhaosmo_ros.core.simulation.metrics import chatter, rms
from fhaosmo_ros.stop_signals import Stop, Stopped
from fhaosmo_ros.tools.bags.topics import Series, series
from fhaosmo_ros.tools.bags.writer import BagWriter
from fhaosmo_ros.tools.cli.command import Output, progress, run_command, shipped
from fhaosmo_ros.tools.cli.processes import start_node
from fhaosmo_ros.tools.plot.curves import Curves, read_curves
from fhaosmo_ros.tools.plot.figures import save_curves
from fhaosmo_ros.topics import TRUTH
import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
START = 2.0
"""Seconds of the start that the table leaves out."""
OTHERS: dict[str, dict[str, Any]] = {
    'sign, gains of the paper': {
        'variant': 'sign', 'scheme': 'explicit', 'lambda': [15.0], 'alpha': [30.0],
        'epsilon': 0.025, 'noise_size': 0.0,
    },
    'fuzzy, the power held': {'gamma_rate': 0.0, 'gamma_leakage': 0.0},
    'self-tuning': {'gains': 'self_tuning'},
}  # fmt: skip
"""Observers that go through the same y: how their parameters differ from those of the file."""
WORDS = """
Error: RMS of the estimate of d minus d. Chatter: how much further the estimate moves than d does
(1: no chatter). The first observer ran live; the others went through the same y afterwards, by
the same code. Self-tuning is not the paper's observer: it is a bank of Kalman filters that is told
the model alone.
"""
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
        errors = {name: estimate - run.curves.truth[:, -1] for name, estimate in compared.items()}
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
    # Here, so that --help needs no ROS.
    from fhaosmo_ros.nodes.recording import TopicRecorder

    compared = ['/y', *(f'/plant/{name}' for name in TRUTH), '/estimator/state']
    given = ('--ros-args', '--params-file', str(parameters))
    with (
        BagWriter(folder / 'bag') as bag,
        TopicRecorder(bag, ['/estimator', '/plant']) as recorder,
        # Together: Fast DDS finds a node that starts half a second after another one 3 s late.
        start_node(folder, 'estimator', *given) as estimator,
        start_node(folder, 'plant', *given) as plant,
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
        words, values = NOISE
        begin, elapsed = time.monotonic(), 0.0
        marks: list[tuple[int, str]] = []
        form = '{l_bar}{bar}| {n:.0f}/{total:.0f} s'
        with progress(total=duration, bar_format=form) as bar:
            while elapsed < duration and not stop.wait(0.1):
                check()
                elapsed = min(time.monotonic() - begin, duration)
                bar.update(elapsed - bar.n)
                if noisy and not marks and elapsed >= NOISY_FROM * duration:
                    bar.write(f'{elapsed:4.1f} s: {words}')
                    marks.append((time.time_ns(), words))
                    recorder.set_parameters('/plant', values)
        return marks


class Run(NamedTuple):
    """A recorded run: estimates beside the truth at the sample that each was computed from."""

    curves: Curves  # of K estimates whose truth is known
    y: Series  # all samples
    rows: NDArray[np.int64]  # (K,) the sample behind each estimate

    @property
    def t(self) -> Floats:
        """Seconds since the first estimate."""
        return np.asarray((self.curves.stamps - self.curves.stamps[0]) * 1e-9)

    @property
    def errors(self) -> Floats:
        """Errors of states and d, (K, n + 1)."""
        return self.curves.estimate - self.curves.truth


def read_run(bag: Path) -> Run:
    """
    Read the bag of a demonstration.

    Each estimate is compared with the truth of the sample behind it (``~/stamp``), not with that
    of the moment at which it was published.

    Raises
    ------
    ConfigurationError
        The bag holds no estimate with its truth.

    """
    (curves,) = read_curves(bag, ['/estimator'], '/plant')
    if curves.truth is None or not (known := np.isfinite(curves.truth).all(axis=1)).any():
        raise ConfigurationError('the run ended before an estimate arrived beside its truth')
    curves = curves.part(known)._replace(label='estimated live')
    y = series(bag, '/y')
    rows = np.searchsorted(y.stamps, curves.stamps).clip(max=len(y.stamps) - 1)
    return Run(curves, y, rows)


def others(run: Run, parameters: Mapping[str, Any]) -> dict[str, Floats]:
    """Return d as `OTHERS` estimate it from the same samples; nothing if gains tune themselves."""
    if parameters.get('gains') == 'self_tuning':
        return {}
    return {
        name: OnlineEstimator({**parameters, **changes})
        .run(run.y.stamps, run.y.values.ravel())
        .unknown_input[run.rows]
        for name, changes in OTHERS.items()
    }


def table(run: Run, compared: Mapping[str, Floats], marks: Sequence[tuple[int, str]]) -> str:
    """
    Return a report: how each observer estimates d, then states and samples.

    `marks` says when something changed (stamps in ns), and what.
    """
    t, d = run.t, run.curves.truth[:, -1]
    edges = [START, *((stamp - run.curves.stamps[0]) * 1e-9 for stamp, _ in marks), np.inf]
    parts = {begin: (t >= begin) & (t < end) for begin, end in pairwise(edges)}
    parts = {begin: part for begin, part in parts.items() if part.any()} or {0.0: t >= 0.0}
    estimates = {'this estimator, live': run.curves.estimate[:, -1], **compared}
    width = max(map(len, estimates))
    lines = [
        f'{"d":{width}}' + ''.join(f'{f"from {begin:.0f} s":>20}' for begin in parts),
        f'{"":{width}}' + f'{"error":>12}{"chatter":>8}' * len(parts),
    ]
    for name, estimate in estimates.items():
        lines.append(f'{name:{width}}' + ''.join(
            f' {rms((estimate - d)[part]):11.2g} {chatter(estimate[part], d[part]):7.3g}'
            for part in parts.values()
        ))  # fmt: skip
    sizes = ''.join(f'{rms(d[part]):12.2g}{"":8}' for part in parts.values())
    lines.append(f'{"RMS of d itself":{width}}{sizes}'.rstrip())
    if compared:
        lines.append(WORDS.rstrip())
    begin = min(parts)
    late = run.errors[t >= begin]
    errors = [f'{name} {rms(late[:, k]):.2g}' for k, name in enumerate(run.curves.names[:-1])]
    rate = 1e9 / np.mean(np.diff(run.y.stamps))
    return '\n'.join([
        *lines, '', f'RMS errors of the states from {begin:.0f} s on: {", ".join(errors)}',
        f'samples: {len(run.y.stamps)}, {rate:.1f} a second',
    ])  # fmt: skip
