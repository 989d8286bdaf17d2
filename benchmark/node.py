# SPDX-License-Identifier: Apache-2.0
"""
CPU, lost samples and latency of an estimator beside a node that computes nothing; its start.

This file is also what stands around the estimator: `node.py source RATE JOINTS` publishes y at an
exact rate; sample k comes k periods after the first one, and a late one does not delay those
behind it. It begins once it has two subscribers, and says at its end how many it has published.

`node.py empty_node RATE JOINTS` has the estimator's subscription, timer and executor. It publishes
messages that were made once, and the stamp of the latest sample, from which latencies are
measured. What an estimator costs more than this is ours; what this costs is the middleware's. Of
both the topics in `OUTPUTS` are heard: an estimator publishes nothing else then.
"""

from contextlib import ExitStack
import math
import signal
import sys
import threading
from time import monotonic, sleep, time_ns
from typing import NamedTuple

from builtin_interfaces.msg import Time
from fhaosmo_ros.nodes.middleware.diagnostics import publish_diagnostics, Report
from fhaosmo_ros.nodes.middleware.endpoints import SENSOR_QOS, subscribe_with_info
from fhaosmo_ros.nodes.middleware.spin import Spinner
from live import Child, start_node, wait_until, Watch
import numpy as np
import rclpy
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from results import Row
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64
from tqdm import tqdm

BAR, JOINT_BAR, START_BAR = 1.2, 1.5, 2.0
WARM_UP = 1.5
HELD = 0.97  # a run counts for the ratio if each node published at this part of the rate at least
EMPTY, ESTIMATOR = 'empty_node', 'estimator'
OUTPUTS = {'unknown_input': Float64, 'stamp': Time}
SUBSCRIBERS = 2
SETTLE = 0.5
"""Seconds between the match as seen from here and the first sample: the other side's match."""


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

    share: float  # CPU time of the estimator over wall time
    ratio: float | None  # over that of the empty node; None if one was starved: that costs less
    sent: int  # samples that were published
    lost: int  # samples that the estimator has not taken
    latency: tuple[float, float]  # seconds from sample to its first estimate: median and 99 %


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
            with start_node(ESTIMATOR, '--ros-args', '-p', f'gains:={gains}') as node:
                found.append((node.wait_for('estimating'), node.cpu_seconds()))
        wall, processor = np.median(found, axis=0).tolist()
        note = f'{processor:.2g} s of CPU; {", ".join(f"{w:.2f}" for w, _ in found)}'
        rows.append(Row(f'estimator start, gains {gains}', wall, 's', START_BAR, note))
    return rows


def observe(case: Case, seconds: float) -> Run:
    """Start a source of y, an estimator and an empty node, both on the same samples."""
    given = ['--ros-args', '-p', f'gains:={case.gains}']
    given += ['-p', f'publish_rate:={case.out}' if case.out else 'publish_on:=sample']
    given += ['-p', 'channels:=[from_joint_names]'] if case.joints else []
    stamps = [f'/{name}/{"joint1/" * bool(case.joints)}stamp' for name in (ESTIMATOR, EMPTY)]
    with (
        Watch(topics(ESTIMATOR, case.joints) | topics(EMPTY, case.joints)) as watch,
        start_node(ESTIMATOR, *given) as ours,
        Child(EMPTY, __file__, EMPTY, str(case.out), str(case.joints)) as empty,
        ExitStack() as later,
    ):
        ours.wait_for('waiting' if case.joints else 'estimating')
        empty.wait_for('computing nothing')
        source = later.enter_context(
            Child('source', __file__, 'source', str(case.rate), str(case.joints))
        )
        source.wait_for('publishing')
        wait_until(lambda: all(watch.heard[t] for t in stamps), 'not all nodes published')
        sleep(WARM_UP)
        watch.forget()
        before, start = np.array([ours.cpu_seconds(), empty.cpu_seconds()]), monotonic()
        sleep(seconds)
        elapsed = monotonic() - start
        cpu = np.array([ours.cpu_seconds(), empty.cpu_seconds()]) - before
        asked = (case.out or case.rate) * elapsed
        held = min(len(watch.heard[t]) for t in stamps) >= HELD * asked
        heard = [(at, m.sec * 1_000_000_000 + m.nanosec) for at, m in watch.heard[stamps[0]]]
        source.interrupt()
        source.end()
        sent, ended = int(source.output().split()[-1]), time_ns()
        wait_until(lambda: watch.number(ESTIMATOR, 'received') > ended, 'no report at the end')
    published, measured = np.array(heard).T
    _, first = np.unique(measured, return_index=True)
    median, most = np.quantile(1e-9 * np.abs(published - measured)[first], [0.5, 0.99]).tolist()
    ratio = float(cpu[0] / cpu[1]) if held else None
    lost = sent - watch.number(ESTIMATOR, 'samples accepted', 'samples rejected')
    return Run(float(cpu[0]) / elapsed, ratio, sent, lost, (median, most))


def topics(node: str, joints: int) -> dict[str, type]:
    """Return the topics that are heard of a node with one y, or with some joints."""
    prefixes = [f'/{node}/joint{k + 1}' for k in range(joints)] or [f'/{node}']
    return {f'{prefix}/{name}': kind for prefix in prefixes for name, kind in OUTPUTS.items()}


def publish_samples(rate: float, joints: int, ended: threading.Event) -> None:
    """Publish y, or the positions of some joints, at a rate (Hz) until the end."""
    node = Node('source', start_parameter_services=False)
    names = [f'joint{k + 1}' for k in range(joints)]
    message = JointState(name=names, velocity=[0.0] * joints) if joints else Float64()
    publisher = node.create_publisher(type(message), 'joint_states' if joints else 'y', 10)
    while not ended.is_set() and publisher.get_subscription_count() < SUBSCRIBERS:
        sleep(0.02)
    sleep(SETTLE)
    print('publishing', flush=True)
    count, start = 0, monotonic()
    while not ended.is_set():
        sleep(max(0.0, start + count / rate - monotonic()))
        y = 0.2 + 0.1 * math.sin(count / rate)
        if joints:
            message.position = [y] * joints
            stamp = divmod(time_ns(), 1_000_000_000)
            message.header.stamp.sec, message.header.stamp.nanosec = stamp
        else:
            message.data = y
        publisher.publish(message)
        count += 1
    sleep(SETTLE)  # the last samples leave before their writer does
    print('published', count, flush=True)
    node.destroy_node()


class EmptyNode(Node):
    """Publishes zeros, and the stamp of the latest sample."""

    def __init__(self, rate: float, joints: int) -> None:
        super().__init__(EMPTY)
        self._latest = 0
        self._stamp = Time()
        self._outputs = [
            (self.create_publisher(kind, t, 10).publish, self._stamp if kind is Time else kind())
            for t, kind in topics(EMPTY, joints).items()
        ]
        self.values = {'diagnostics_period': 1.0, 'hardware_id': 'none'}
        publish_diagnostics(self, self._reports)
        self._each = not rate
        if rate:
            self._timer = self.create_timer(1.0 / rate, self._publish)
        kind, topic = (JointState, 'joint_states') if joints else (Float64, 'y')
        self._y = subscribe_with_info(self, kind, topic, self._on_sample, SENSOR_QOS)
        self.get_logger().info('computing nothing')

    def _on_sample(self, message: Float64 | JointState, info: dict[str, int]) -> None:
        self._latest = info['source_timestamp']
        if isinstance(message, JointState):
            stamp = message.header.stamp
            self._latest = stamp.sec * 1_000_000_000 + stamp.nanosec
        if self._each:
            self._publish()

    def _publish(self) -> None:
        if self._latest:
            self._stamp.sec, self._stamp.nanosec = divmod(self._latest, 1_000_000_000)
            for publish, message in self._outputs:
                publish(message)

    def _reports(self) -> list[Report]:
        """Return as many values as the estimator's reports have."""
        return [Report('input', {f'value {k}': 0 for k in range(31)})]


def main(what: str, rate: str, joints: str) -> None:
    """Run the source, or the empty node, until SIGINT."""
    ended = threading.Event()
    signal.signal(signal.SIGINT, lambda *_: ended.set())
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    if what == 'source':
        publish_samples(float(rate), int(joints), ended)
    else:
        with Spinner(EmptyNode(float(rate), int(joints)), on_end=ended.set):
            ended.wait()
    rclpy.try_shutdown()


if __name__ == '__main__':
    main(*sys.argv[1:])
