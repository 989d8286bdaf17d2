# SPDX-License-Identifier: Apache-2.0
"""CPU, lost samples, jitter and latency of an estimator beside a node that computes nothing."""

from collections import defaultdict
from collections.abc import Callable
import importlib.util
import os
from time import monotonic, process_time, sleep, time_ns
from typing import NamedTuple

from children import Child, Children
from fhaosmo_ros.core.online.estimator import OnlineEstimator
import numpy as np
from table import CannotMeasureError, Row, Table
from tqdm import tqdm

BAR = 1.2
GOAL = 1000.0
"""Rate in Hz of the bars."""
CASES = (
    (100.0, 100.0), (100.0, 0.0), (500.0, 500.0), (1000.0, 100.0), (1000.0, 1000.0),
    (1000.0, 0.0), (2000.0, 2000.0),
)  # fmt: skip
"""Rates of y and of the estimates; 0: publish_on is sample."""
JOINTS = 7
JOINT_CASES = ((500.0, 100.0), (1000.0, 100.0))
JOINT_BAR = 1.3
WARM_UP = 1.5
HELD = 0.97
"""A run counts for the ratio if each node published at this part of the rate at least."""
MATCHED = 30.0
"""Seconds that discovery may take."""
ON_SAMPLES = ('-p', 'publish_on:=sample')
COMMANDS = {
    'estimator': ('-m', 'fhaosmo_ros', 'estimator', '--ros-args'),
    'self_tuning': (
        '-m', 'fhaosmo_ros', 'estimator', '--ros-args', '-r', '__node:=self_tuning',
        '-p', 'gains:=self_tuning',
    ),
    'empty_node': ('benchmark/empty_node.py',),
    'plain': ('benchmark/empty_node.py', '--plain'),
}  # fmt: skip
TITLES = {
    'estimator': 'estimator', 'self_tuning': 'self-tuning', 'empty_node': 'empty',
    'plain': 'empty, rclpy.spin',
}  # fmt: skip
ESTIMATORS = 'estimator', 'self_tuning'
SELF_TUNING = {'gains': 'self_tuning'}
JITTER = 1e-4
"""Of the stamps that a self-tuning step is timed at, in seconds."""
HEADER = (
    'y Hz', 'out Hz', 'held', 'node', 'CPU %', 'lost', 'of',
    'jitter p50', 'p99', 'max', 'latency p50', 'p99', 'max ms',
)  # fmt: skip


class Figures(NamedTuple):
    """
    What one node did in one run.

    Attributes
    ----------
    cpu : float
        CPU time over wall time.
    held : float
        Publications over those that the timer was to make: a starved node does, and costs, less.
    sent, taken : int
        Samples that were published, and that the node has taken.
    times : (6,) tuple
        Jitter and latency: median, 99 % and largest, in seconds.

    """

    cpu: float
    held: float
    sent: int
    taken: int
    times: tuple[float, ...]


def measure(quick: bool) -> list[Row | Table]:
    """Return the ratios of CPU, the samples lost, and a table of everything."""
    isolate()
    seconds, repetitions = (2.0, 1) if quick else (8.0, 3)
    cases = [(*rates, ('estimator', 'empty_node')) for rates in CASES]
    if quick:
        cases = [(GOAL, GOAL, ('estimator', 'empty_node'))]
    else:
        cases.append((GOAL, GOAL, ('plain', 'empty_node')))
    runs: dict[tuple[float, float, str], list[Figures]] = defaultdict(list)
    ratios: dict[tuple[float, float], list[float]] = defaultdict(list)
    plan = [(case, k) for k in range(repetitions) for case in cases]
    for (rate, out, names), k in tqdm(plan, desc='rates', unit='run', leave=False):
        figures = observe(rate, out, names if k % 2 == 0 else names[::-1], seconds)
        if 'plain' in names:
            runs[rate, out, 'plain'].append(figures['plain'])
            continue
        for name in names:
            runs[rate, out, name].append(figures[name])
        ratio = figures['estimator'].cpu / figures['empty_node'].cpu
        if min(f.held for f in figures.values()) >= HELD:
            ratios[rate, out].append(ratio)
        else:
            tqdm.write(f'rates: left out a run, {_rate(out)}, in which a node was starved')
    rows = [
        _ratio(
            f'CPU, estimator / empty node, y {rate:g} Hz, estimates {_rate(out)}',
            ratios[rate, out],
            BAR if rate == GOAL else None,
        )
        for rate, out, names in cases
        if 'plain' not in names
    ]
    lost = sum(f.sent - f.taken for f in runs[GOAL, GOAL, 'estimator'])
    sent = sum(f.sent for f in runs[GOAL, GOAL, 'estimator'])
    note = f'of {sent:,}, over {repetitions} runs'
    rows.append(Row(f'samples lost at {GOAL:g} Hz', lost, bar=0.0, note=note))
    return [*rows, _table(runs, seconds, repetitions)]


def isolate() -> None:
    """Keep what we start away from other ROS systems; raise if there is no ROS."""
    if importlib.util.find_spec('rclpy') is None:
        raise CannotMeasureError('no rclpy in this Python: start it with make bench')
    os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'
    os.environ['ROS_DOMAIN_ID'] = str(1 + os.getpid() % 19)  # the tests use those from 20 on


def joints(quick: bool) -> list[Row | Table]:
    """Return the same of an estimator of seven joints of one JointState."""
    isolate()
    seconds, repetitions = (2.0, 1) if quick else (8.0, 3)
    names = ('estimator', 'empty_node')
    rows: list[Row | Table] = []
    runs: dict[tuple[float, float, str], list[Figures]] = defaultdict(list)
    for rate, out in JOINT_CASES:
        ratios = []
        for k in tqdm(range(repetitions), desc=f'joints {rate:g} Hz', unit='run', leave=False):
            figures = observe(rate, out, names if k % 2 == 0 else names[::-1], seconds, JOINTS)
            for name in names:
                runs[rate, out, name].append(figures[name])
            if min(f.held for f in figures.values()) >= HELD:
                ratios.append(figures['estimator'].cpu / figures['empty_node'].cpu)
        title = f'CPU, estimator / empty node, {JOINTS} joints {rate:g} Hz, estimates {out:g} Hz'
        rows.append(_ratio(title, ratios, JOINT_BAR))
        lost = sum(f.sent - f.taken for f in runs[rate, out, 'estimator'])
        sent = sum(f.sent for f in runs[rate, out, 'estimator'])
        rows.append(Row(f'messages lost, {JOINTS} joints {rate:g} Hz', lost, bar=0.0,
                        note=f'of {sent:,}, over {repetitions} runs'))  # fmt: skip
    return [*rows, _table(runs, seconds, repetitions)]


def self_tuning(quick: bool) -> list[Row | Table]:
    """Return the CPU of a self-tuning estimator over that of an empty node and its steps."""
    isolate()
    seconds, repetitions = (2.0, 1) if quick else (8.0, 3)
    names = ('self_tuning', 'empty_node')
    rows: list[Row | Table] = []
    runs: dict[tuple[float, float, str], list[Figures]] = defaultdict(list)
    steps: list[float] = []
    for out in (GOAL, 100.0):
        ratios = []
        for k in tqdm(range(repetitions), desc=f'self-tuning {out:g} Hz', unit='run', leave=False):
            figures = observe(GOAL, out, names if k % 2 == 0 else names[::-1], seconds)
            steps.append(_step_seconds(seconds))
            for name in names:
                runs[GOAL, out, name].append(figures[name])
            if min(f.held for f in figures.values()) >= HELD:
                expected = figures['empty_node'].cpu + GOAL * steps[-1]
                ratios.append(figures['self_tuning'].cpu / expected)
        title = f'CPU, self-tuning / (empty node + steps), y {GOAL:g} Hz, estimates {out:g} Hz'
        rows.append(_ratio(title, ratios, BAR))
        lost = sum(f.sent - f.taken for f in runs[GOAL, out, 'self_tuning'])
        sent = sum(f.sent for f in runs[GOAL, out, 'self_tuning'])
        rows.append(Row(f'samples lost, self-tuning, estimates {out:g} Hz', lost, bar=0.0,
                        note=f'of {sent:,}, over {repetitions} runs'))  # fmt: skip
    note = f'{", ".join(f"{1e6 * s:.1f}" for s in steps)}; one after each run, of a replay'
    rows.append(Row('step, self-tuning', 1e6 * float(np.median(steps)), 'us', note=note))
    return [*rows, _table(runs, seconds, repetitions)]


def _step_seconds(seconds: float) -> float:
    """Return the CPU time of a self-tuning step, at stamps that jitter as the source's do."""
    t = np.arange(round(seconds * GOAL)) / GOAL
    stamps = np.sort(t + JITTER * np.abs(np.random.default_rng(0).standard_normal(len(t))))
    stamps, y = np.round((1.0 + stamps) * 1e9).astype(np.int64), 0.2 + 0.1 * np.sin(t)
    OnlineEstimator(SELF_TUNING).run(stamps[:100], y[:100])  # loads the machine code
    estimator = OnlineEstimator(SELF_TUNING)
    begin = process_time()
    estimator.run(stamps, y)
    return (process_time() - begin) / len(y)


def _arguments(name: str, out: float, joints: int) -> list[str]:
    """Return the command of a node that publishes at a rate, 0 for on samples."""
    words = list(COMMANDS[name])
    if name in ESTIMATORS:
        words += ['-p', f'publish_rate:={out}'] if out else ON_SAMPLES
        words += ['-p', 'channels:=[from_joint_names]'] if joints else []
    else:
        words += ['--rate', str(out)] + (['--joints', str(joints)] if joints else [])
    return words


def observe(
    rate: float, out: float, names: tuple[str, ...], seconds: float, joints: int = 0
) -> dict[str, Figures]:
    """Start a source of y and the named nodes, all on the same samples, for `seconds`."""
    from watch import Watch  # needs ROS

    watched = {name: f'{name}/joint1' if joints else name for name in names}
    ready = 'waiting' if joints else 'estimating'
    with Children() as children, Watch(sorted(watched.values())) as watch:
        nodes = {name: children.start(name, *_arguments(name, out, joints)) for name in names}
        for name, node in nodes.items():
            node.wait_for(ready if name in ESTIMATORS else 'computing nothing')
        source = children.start(
            'source', 'benchmark/source.py', '--rate', str(rate), '--joints', str(joints),
            '--subscribers', str(len(nodes)),
        )  # fmt: skip
        source.wait_for('publishing')
        for topic in watched.values():
            wait_until(lambda topic=topic: watch.count(topic), f'no stamp of {topic}')
        sleep(WARM_UP)
        watch.forget()
        before, start = {name: node.cpu_seconds() for name, node in nodes.items()}, monotonic()
        sleep(seconds)
        elapsed = monotonic() - start
        used = {name: node.cpu_seconds() - before[name] for name, node in nodes.items()}
        asked = out or rate
        held = {name: watch.count(watched[name]) / (asked * elapsed) for name in names}
        times = {
            name: (*watch.jitter(topic, asked), *watch.latency(topic))
            for name, topic in watched.items()
        }
        sent = end_source(source)
        ended, taken = time_ns(), {}
        for name in names:
            wait_until(lambda name=name: watch.report(name)[0] > ended, f'no report of {name}')
            taken[name] = watch.report(name)[1]
    return {
        name: Figures(used[name] / elapsed, held[name], sent, taken[name], times[name])
        for name in names
    }


def end_source(source: Child) -> int:
    """End the source and return how many samples it has published on each topic."""
    source.interrupt()
    source.end()
    return int(source.output().split()[-1])


def wait_until(condition: Callable[[], bool], complaint: str) -> None:
    """Wait for a condition; raise with a complaint if it does not come."""
    deadline = monotonic() + MATCHED
    while not condition():
        if monotonic() > deadline:
            raise CannotMeasureError(f'{complaint} within {MATCHED:g} s')
        sleep(0.02)


def _ratio(title: str, ratios: list[float], bar: float | None) -> Row:
    return Row(
        title,
        float(np.median(ratios)) if ratios else None,
        bar=bar,
        note=(
            f'ratios {", ".join(f"{r:.2f}" for r in ratios)}'
            if ratios
            else 'in every run a node was starved: the machine is too busy'
        ),
    )


def _rate(out: float) -> str:
    return f'{out:g} Hz' if out else 'on samples'


def _table(
    runs: dict[tuple[float, float, str], list[Figures]], seconds: float, repetitions: int
) -> Table:
    lines = []
    for (rate, out, name), figures in runs.items():
        times = np.median([f.times for f in figures], axis=0)
        times[[2, 5]] = np.max([f.times for f in figures], axis=0)[[2, 5]]
        lines.append((
            f'{rate:g}', f'{out:g}' if out else 'sample',
            f'{np.median([f.held for f in figures]):.0%}', TITLES[name],
            f'{100.0 * np.median([f.cpu for f in figures]):.1f}',
            f'{sum(f.sent - f.taken for f in figures)}', f'{sum(f.sent for f in figures):,}',
            *(f'{1e3 * t:.3f}' for t in times),
        ))  # fmt: skip
    title = (
        f'y from a source of its own; nodes on the same samples at the same time; {repetitions} '
        f'runs of {seconds:g} s: medians, sums of lost, largest of max. Held: estimates published '
        'of those asked for. Jitter: deviation of the time between two publications. Latency: '
        'from publication of y to that of the first estimate that contains it, waiting for the '
        'timer included.'
    )
    return Table(title, HEADER, lines)
