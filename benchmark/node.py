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


class Run(NamedTuple):
    """What was seen in one run."""

    share: float
    """CPU time of the estimator over wall time."""
    ratio: float | None
    """CPU over that of the empty node; None if one was starved, which then costs less."""
    sent: int
    """Samples that were published."""
    lost: int
    """Samples that the estimator has not taken."""
    latency: tuple[float, float]
    """Seconds from a sample's publication to its first estimate: median and 99 %."""


def measure(quick: bool) -> list[Row]:
    """Return the ratios of CPU, the samples lost, and the latencies."""
    seconds, repetitions = (2.0, 1) if quick else (8.0, 3)
    rows: list[Row] = []
    for case in tqdm(CASES[:1] if quick else CASES, desc='node', unit='case', leave=False):
        runs = [observe(case, seconds) for _ in range(repetitions)]
        shares, ratios, sent, lost, latencies = zip(*runs, strict=True)
        ratios = [ratio for ratio in ratios if ratio is not None]
        note = ', '.join(f'{r:.2f}' for r in ratios) or 'a node was starved in every run'
        note = f'{np.median(shares):.1%} of a core; ratios {note}'
        value = float(np.median(ratios)) if ratios else None
        median, most = 1e3 * np.median(latencies, axis=0)
        of = f'of {sum(sent):,}, over {repetitions} runs'
        rows += [
            Row(f'CPU, estimator / empty node, {case.title}', value, '', case.bar, note),
            Row(f'samples lost, {case.title}', float(sum(lost)), '', 0.0, of),
            Row(f'latency, median, {case.title}', float(median), 'ms'),
            Row(f'latency, 99 %, {case.title}', float(most), 'ms'),
        ]
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


def observe(case: Case, seconds: float) -> Run:
    """Start a source of y, an estimator and an empty node, both on the same samples."""
    estimator = [*START, f'gains:={case.gains}']
    estimator += ['-p', f'publish_rate:={case.out}' if case.out else 'publish_on:=sample']
    estimator += ['-p', 'channels:=[from_joint_names]'] if case.joints else []
    joints, joint = ('--joints', str(case.joints)), '/joint1' if case.joints else ''
    watched = [f'/{name}{joint}/stamp' for name in (ESTIMATOR, EMPTY)]
    with Children() as children, Watch(dict.fromkeys(watched, TIME)) as watch:
        ours = children.start(ESTIMATOR, *estimator)
        empty = children.start(EMPTY, AROUND, EMPTY, '--rate', str(case.out), *joints)
        ours.wait_for('waiting' if case.joints else 'estimating')
        empty.wait_for('computing nothing')
        source = children.start('source', AROUND, 'source', '--rate', str(case.rate), *joints)
        source.wait_for('publishing')
        wait_until(lambda: all(map(watch.count, watched)), 'not all nodes published')
        sleep(WARM_UP)
        watch.forget()
        before, start = np.array([ours.cpu_seconds(), empty.cpu_seconds()]), monotonic()
        sleep(seconds)
        elapsed = monotonic() - start
        cpu = np.array([ours.cpu_seconds(), empty.cpu_seconds()]) - before
        asked = (case.out or case.rate) * elapsed
        held = min(map(watch.count, watched)) >= HELD * asked
        published, stamps = watch.series(watched[0])
        source.interrupt()
        source.end()
        sent, ended = int(source.output().split()[-1]), time_ns()
        wait_until(lambda: watch.reported(ESTIMATOR, 'received') > ended, 'no report at the end')
    _, first = np.unique(stamps, return_index=True)
    median, most = np.quantile(1e-9 * np.abs(published - stamps)[first], [0.5, 0.99]).tolist()
    ratio = float(cpu[0] / cpu[1]) if held else None
    share, lost = float(cpu[0]) / elapsed, sent - watch.taken(ESTIMATOR)
    return Run(share, ratio, sent, lost, (median, most))
