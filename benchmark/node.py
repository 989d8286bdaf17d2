# SPDX-License-Identifier: Apache-2.0
"""CPU, lost samples and latency of an estimator beside a node that computes nothing; its start."""

from collections.abc import Callable
import importlib.util
import os
from time import monotonic, sleep, time_ns
from typing import NamedTuple

from children import Child, Children
import numpy as np
from results import CannotMeasureError, Row
from tqdm import tqdm

BAR, JOINT_BAR, START_BAR = 1.2, 1.5, 2.0
WARM_UP = 1.5
HELD = 0.97
"""A run counts for the ratio if each node published at this part of the rate at least."""
MATCHED = 30.0
"""Seconds that discovery may take."""
EMPTY, ESTIMATOR = 'empty_node', 'estimator'


class Case(NamedTuple):
    """Rates of y and of the estimates (Hz; 0: on each sample), joints, gains, the bar of CPU."""

    rate: float
    out: float
    joints: int = 0
    gains: str = 'fixed'
    bar: float | None = None

    @property
    def title(self) -> str:
        """What is measured, in words."""
        y = f'{self.joints} joints' if self.joints else 'y'
        out = f'{self.out:g} Hz' if self.out else 'on samples'
        gains = ', self-tuning' if self.gains == 'self_tuning' else ''
        return f'{y} {self.rate:g} Hz, estimates {out}{gains}'


CASES = (
    Case(1000.0, 1000.0, bar=BAR),
    Case(1000.0, 100.0, bar=BAR),
    Case(1000.0, 0.0, bar=BAR),
    Case(100.0, 100.0),
    Case(1000.0, 100.0, joints=7, bar=JOINT_BAR),
    Case(1000.0, 100.0, gains='self_tuning'),
)


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
    latency : (float, float)
        Median and 99 %, in seconds.

    """

    cpu: float
    held: float
    sent: int
    taken: int
    latency: tuple[float, float]


def measure(quick: bool) -> list[Row]:
    """Return the ratios of CPU, the samples lost, and the latencies."""
    isolate()
    seconds, repetitions = (2.0, 1) if quick else (8.0, 3)
    rows: list[Row] = []
    for case in tqdm(CASES[:1] if quick else CASES, desc='node', unit='case', leave=False):
        runs = [observe(case, seconds) for _ in range(repetitions)]
        ratios = [
            run[ESTIMATOR].cpu / run[EMPTY].cpu
            for run in runs
            if min(f.held for f in run.values()) >= HELD
        ]
        ours = [run[ESTIMATOR] for run in runs]
        note = ', '.join(f'{r:.2f}' for r in ratios) or 'a node was starved in every run'
        share = f'{np.median([f.cpu for f in ours]):.1%} of a core; '
        ratio = float(np.median(ratios)) if ratios else None
        lost, sent = sum(f.sent - f.taken for f in ours), sum(f.sent for f in ours)
        of = f'of {sent:,}, over {repetitions} runs'
        rows.append(Row(f'CPU, estimator / empty node, {case.title}', ratio, '', case.bar,
                        f'{share}ratios {note}'))  # fmt: skip
        rows.append(Row(f'samples lost, {case.title}', float(lost), '', 0.0, of))
        for name, k in (('median', 0), ('99 %', 1)):
            latency = 1e3 * float(np.median([f.latency[k] for f in ours]))
            rows.append(Row(f'latency, {name}, {case.title}', latency, 'ms'))
    return rows


def startup(quick: bool) -> list[Row]:
    """Return the seconds from the start of an estimator to its first word."""
    isolate()
    rows = []
    for gains in ('fixed', 'self_tuning'):
        found = []
        for _ in range(1 if quick else 5):
            with Children() as children:
                node = children.start(
                    ESTIMATOR, '-m', 'fhaosmo_ros', 'estimator', '--ros-args',
                    '-p', f'gains:={gains}',
                )  # fmt: skip
                found.append((node.wait_for('estimating'), node.cpu_seconds()))
        wall, processor = np.median(found, axis=0).tolist()
        note = f'{processor:.2g} s of CPU; {", ".join(f"{w:.2f}" for w, _ in found)}'
        rows.append(Row(f'estimator start, gains {gains}', wall, 's', START_BAR, note))
    return rows


def isolate() -> None:
    """Keep what we start away from other ROS systems; raise if there is no ROS."""
    if importlib.util.find_spec('rclpy') is None:
        raise CannotMeasureError('no rclpy in this Python: start it with make bench')
    os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'
    os.environ['ROS_DOMAIN_ID'] = str(1 + os.getpid() % 19)  # the tests use those from 20 on


def observe(case: Case, seconds: float) -> dict[str, Figures]:
    """Start a source of y, an estimator and an empty node, both on the same samples."""
    from fhaosmo_ros.topics import TIME  # needs ROS
    from watch import Watch

    joints = str(case.joints)
    estimator = ['-m', 'fhaosmo_ros', 'estimator', '--ros-args', '-p', f'gains:={case.gains}']
    estimator += ['-p', f'publish_rate:={case.out}' if case.out else 'publish_on:=sample']
    estimator += ['-p', 'channels:=[from_joint_names]'] if case.joints else []
    empty = ['benchmark/empty_node.py', '--rate', str(case.out), '--joints', joints]
    joint = '/joint1' if case.joints else ''
    watched = {name: f'/{name}{joint}/stamp' for name in (ESTIMATOR, EMPTY)}
    with Children() as children, Watch(dict.fromkeys(watched.values(), TIME)) as watch:
        nodes = {
            ESTIMATOR: children.start(ESTIMATOR, *estimator),
            EMPTY: children.start(EMPTY, *empty),
        }
        nodes[ESTIMATOR].wait_for('waiting' if case.joints else 'estimating')
        nodes[EMPTY].wait_for('computing nothing')
        source = children.start(
            'source', 'benchmark/source.py', '--rate', str(case.rate), '--joints', joints,
            '--subscribers', '2',
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
        asked = (case.out or case.rate) * elapsed
        held = {name: watch.count(topic) / asked for name, topic in watched.items()}
        latency = {name: _latency(*watch.series(topic)) for name, topic in watched.items()}
        sent, ended = _end(source), time_ns()
        for name in nodes:
            wait_until(lambda name=name: watch.reported_after(name, ended), f'no report of {name}')
        return {
            name: Figures(used[name] / elapsed, held[name], sent, watch.taken(name), latency[name])
            for name in nodes
        }


def _latency(published: np.ndarray, stamps: np.ndarray) -> tuple[float, float]:
    """Return the time (s) from a sample's publication to its first estimate: median, 99 %."""
    _, first = np.unique(stamps, return_index=True)
    median, most = np.quantile(1e-9 * np.abs(published - stamps)[first], [0.5, 0.99])
    return float(median), float(most)


def _end(source: Child) -> int:
    """End the source and return how many samples it has published."""
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
