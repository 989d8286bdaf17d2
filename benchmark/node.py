# SPDX-License-Identifier: Apache-2.0
"""CPU, lost samples and latency of an estimator beside a node that computes nothing; its start."""

from time import monotonic, sleep, time_ns
from typing import NamedTuple

from fhaosmo_ros.topics import TIME
from live import Children, wait_until, Watch
import numpy as np
from results import Row
from tqdm import tqdm

BAR, JOINT_BAR, START_BAR = 1.2, 1.5, 2.0
WARM_UP = 1.5
HELD = 0.97
"""A run counts for the ratio if each node published at this part of the rate at least."""
AROUND, EMPTY, ESTIMATOR = 'benchmark/around.py', 'empty_node', 'estimator'
START = ('-m', 'fhaosmo_ros', 'estimator', '--ros-args', '-p')


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
    """What one node did in one run."""

    cpu: float
    """CPU time over wall time."""
    held: float
    """Publications over those that the timer was to make: a starved node does, and costs, less."""
    sent: int
    """Samples that were published."""
    taken: int
    """Samples that the node has taken."""
    latency: tuple[float, float]
    """Seconds from a sample's publication to its first estimate: median and 99 %."""


def measure(quick: bool) -> list[Row]:
    """Return the ratios of CPU, the samples lost, and the latencies."""
    seconds, repetitions = (2.0, 1) if quick else (8.0, 3)
    rows: list[Row] = []
    for case in tqdm(CASES[:1] if quick else CASES, desc='node', unit='case', leave=False):
        runs = [observe(case, seconds) for _ in range(repetitions)]
        ours = [run[ESTIMATOR] for run in runs]
        ratios = [
            run[ESTIMATOR].cpu / run[EMPTY].cpu
            for run in runs
            if min(f.held for f in run.values()) >= HELD
        ]
        note = ', '.join(f'{r:.2f}' for r in ratios) or 'a node was starved in every run'
        share = f'{np.median([f.cpu for f in ours]):.1%} of a core; ratios {note}'
        lost, sent = sum(f.sent - f.taken for f in ours), sum(f.sent for f in ours)
        latency = 1e3 * np.median([f.latency for f in ours], axis=0)
        rows += [
            Row(
                f'CPU, estimator / empty node, {case.title}',
                float(np.median(ratios)) if ratios else None, '', case.bar, share,
            ),
            Row(
                f'samples lost, {case.title}', float(lost), '', 0.0,
                f'of {sent:,}, over {repetitions} runs',
            ),
            Row(f'latency, median, {case.title}', float(latency[0]), 'ms'),
            Row(f'latency, 99 %, {case.title}', float(latency[1]), 'ms'),
        ]  # fmt: skip
    return rows


def startup(quick: bool) -> list[Row]:
    """Return the seconds from the start of an estimator to its first word."""
    rows = []
    for gains in ('fixed', 'self_tuning'):
        found = []
        for _ in range(1 if quick else 5):
            with Children() as children:
                node = children.start(ESTIMATOR, *START, f'gains:={gains}')
                found.append((node.wait_for('estimating'), node.cpu_seconds()))
        wall, processor = np.median(found, axis=0).tolist()
        note = f'{processor:.2g} s of CPU; {", ".join(f"{w:.2f}" for w, _ in found)}'
        rows.append(Row(f'estimator start, gains {gains}', wall, 's', START_BAR, note))
    return rows


def observe(case: Case, seconds: float) -> dict[str, Figures]:
    """Start a source of y, an estimator and an empty node, both on the same samples."""
    estimator = [*START, f'gains:={case.gains}']
    estimator += ['-p', f'publish_rate:={case.out}' if case.out else 'publish_on:=sample']
    estimator += ['-p', 'channels:=[from_joint_names]'] if case.joints else []
    joints, joint = ('--joints', str(case.joints)), '/joint1' if case.joints else ''
    watched = {name: f'/{name}{joint}/stamp' for name in (ESTIMATOR, EMPTY)}
    with Children() as children, Watch(dict.fromkeys(watched.values(), TIME)) as watch:
        nodes = {
            ESTIMATOR: children.start(ESTIMATOR, *estimator),
            EMPTY: children.start(EMPTY, AROUND, EMPTY, '--rate', str(case.out), *joints),
        }
        nodes[ESTIMATOR].wait_for('waiting' if case.joints else 'estimating')
        nodes[EMPTY].wait_for('computing nothing')
        source = children.start('source', AROUND, 'source', '--rate', str(case.rate), *joints)
        source.wait_for('publishing')
        wait_until(lambda: all(map(watch.count, watched.values())), 'not all nodes published')
        sleep(WARM_UP)
        watch.forget()
        before, start = {name: node.cpu_seconds() for name, node in nodes.items()}, monotonic()
        sleep(seconds)
        elapsed = monotonic() - start
        cpu = {name: (n.cpu_seconds() - before[name]) / elapsed for name, n in nodes.items()}
        asked = (case.out or case.rate) * elapsed
        held = {name: watch.count(topic) / asked for name, topic in watched.items()}
        latency = {name: _latency(*watch.series(topic)) for name, topic in watched.items()}
        source.interrupt()
        source.end()
        sent, ended = int(source.output().split()[-1]), time_ns()
        wait_until(
            lambda: all(watch.reported(name, 'received') > ended for name in nodes),
            'not all nodes reported at the end',
        )
        return {
            name: Figures(cpu[name], held[name], sent, watch.taken(name), latency[name])
            for name in nodes
        }


def _latency(published: np.ndarray, stamps: np.ndarray) -> tuple[float, float]:
    """Return median and 99 % of the time from a sample to the first estimate with its stamp."""
    _, first = np.unique(stamps, return_index=True)
    median, most = np.quantile(1e-9 * np.abs(published - stamps)[first], [0.5, 0.99])
    return float(median), float(most)
