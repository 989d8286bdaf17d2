# SPDX-License-Identifier: Apache-2.0
"""
CPU, lost samples and latency of our nodes beside one that computes nothing; an estimator's start.

This file is also what stands around the node: `node.py source NODE RATE JOINTS` publishes y, or
the joint states of a robot arm in free motion, at an exact rate: a late sample does not delay
those behind it. It begins once it has two subscribers, and says at its end how many it has sent.

`node.py empty_node NODE RATE JOINTS` has the node's subscription, timer and executor. It publishes
messages that were made once, and the stamp of the latest sample, from which latencies are
measured: what this costs is the middleware's. Of both the topics in `OUTPUTS` are heard.
"""

from contextlib import ExitStack
from pathlib import Path
import signal
import sys
from tempfile import TemporaryDirectory
import threading
from time import monotonic, sleep, time_ns
from typing import NamedTuple

from builtin_interfaces.msg import Time
from fhaosmo_ros.core.arm.model import ArmModel
from fhaosmo_ros.nodes.middleware.diagnostics import publish_diagnostics, Report
from fhaosmo_ros.nodes.middleware.endpoints import SENSOR_QOS, subscribe_with_info
from fhaosmo_ros.nodes.middleware.messages import time_message
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

BAR, JOINT_BAR, START_BAR, ARM_BAR, ARM_LATENCY_BAR = 1.2, 1.5, 2.0, 0.25, 2.0
WARM_UP = 1.5
HELD = 0.97  # a run counts for the ratio if each node published at this part of the rate at least
EMPTY, ESTIMATOR, ARM = 'empty_node', 'estimator', 'arm'
OUTPUTS = {
    ESTIMATOR: {'unknown_input': Float64, 'stamp': Time}, ARM: {'external_torque': JointState}
}  # fmt: skip
SUBSCRIBERS = 2
SETTLE = 0.5
"""Seconds between the match as seen from here and the first sample: the other side's match."""


class Case(NamedTuple):
    """Rates of y and estimates (Hz; 0: on each sample), joints, gains, bar of CPU, and node."""

    rate: float
    out: float
    joints: int = 0
    gains: str = 'fixed'
    bar: float | None = None
    node: str = ESTIMATOR

    @property
    def title(self) -> str:
        """What is measured, in words."""
        y = f'{self.joints} joints' if self.joints else 'y'
        y = f'an arm of {y}' if self.node == ARM else y
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
    Case(1000.0, 250.0, joints=7, node=ARM),
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
        longer = 2.5 if case.node == ARM else 1.0  # 60,000 samples in all
        runs = [observe(case, longer * seconds) for _ in range(repetitions)]
        shares, ratios, sent, lost, latencies = zip(*runs, strict=True)
        ratios = [ratio for ratio in ratios if ratio is not None]
        note = ', '.join(f'{r:.2f}' for r in ratios) or 'a node was starved in every run'
        note = f'{np.median(shares):.1%} of a core; ratios {note}'
        value = float(np.median(ratios)) if ratios else None
        median, most = 1e3 * np.median(latencies, axis=0)
        of = f'of {sum(sent):,}, over {repetitions} runs'
        rows += [
            Row(f'CPU, {case.node} / empty node, {case.title}', value, '', case.bar, note),
            Row(f'samples lost, {case.title}', float(sum(lost)), '', 0.0, of),
            Row(f'latency, median, {case.title}', float(median), 'ms'),
            Row(f'latency, 99 %, {case.title}', float(most), 'ms'),
        ]
        if case.node == ARM:
            share = float(np.median(shares))
            rows[-1] = rows[-1]._replace(bar=ARM_LATENCY_BAR)
            rows.append(Row(f'share of a core, {case.title}', share, '', ARM_BAR))
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
    """Start a source of y, our node and an empty one, both on the same samples."""
    out = f'publish_rate:={case.out}' if case.out else 'publish_on:=sample'
    given, node, n = ['--ros-args', '-p', out], case.node, case.joints
    if node == ESTIMATOR:
        given += ['-p', f'gains:={case.gains}']
        given += ['-p', 'channels:=[from_joint_names]'] if n else []
    ours_heard, empty_heard = topics(node, node, n), topics(node, EMPTY, n)
    # The last topic of the first channel has the stamps of samples in it.
    stamps = [list(heard)[len(OUTPUTS[node]) - 1] for heard in (ours_heard, empty_heard)]
    with (
        TemporaryDirectory() as folder,
        Watch(ours_heard | empty_heard) as watch,
        ExitStack() as later,
    ):
        if node == ARM:
            robot = Path(folder, 'robot.urdf')
            robot.write_text(urdf(n), encoding='utf-8')
            given += ['-p', f'robot_description_file:={robot}']
        ours = later.enter_context(start_node(node, *given))
        empty = later.enter_context(Child(EMPTY, __file__, EMPTY, node, str(case.out), str(n)))
        ours.wait_for('waiting' if n and node == ESTIMATOR else 'estimating')
        empty.wait_for('computing nothing')
        source = later.enter_context(
            Child('source', __file__, 'source', node, str(case.rate), str(n))
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
        heard = [(at, nanoseconds(m)) for at, m in watch.heard[stamps[0]]]
        source.interrupt()
        source.wait(5.0)
        sent, ended = int(source.output().split()[-1]), time_ns()
        wait_until(lambda: watch.number(node, 'received') > ended, 'no report at the end')
    published, measured = np.array(heard).T
    _, first = np.unique(measured, return_index=True)
    median, most = np.quantile(1e-9 * np.abs(published - measured)[first], [0.5, 0.99]).tolist()
    ratio = float(cpu[0] / cpu[1]) if held else None
    lost = sent - watch.number(node, 'samples accepted', 'samples rejected', 'samples used')
    lost -= node == ARM  # counts from the second sample on
    return Run(float(cpu[0]) / elapsed, ratio, sent, lost, (median, most))


def topics(node: str, name: str, joints: int) -> dict[str, type]:
    """Return the topics that are heard of a node, or of `name` that takes its place."""
    names = names_of(joints) if node == ESTIMATOR else []
    prefixes = [f'/{name}/{own}' for own in names] or [f'/{name}']
    return {f'{prefix}/{own}': kind for prefix in prefixes for own, kind in OUTPUTS[node].items()}


def names_of(joints: int) -> list[str]:
    """Return the names of joints."""
    return [f'joint{k + 1}' for k in range(joints)]


def nanoseconds(message: Time | JointState) -> int:
    """Return the time that a message is, or that is in its header."""
    time = message if isinstance(message, Time) else message.header.stamp
    return int(time.sec * 1_000_000_000 + time.nanosec)


def urdf(joints: int) -> str:
    """Return a robot arm: rods of 0.3 m and 2 kg whose axes point up and aside by turns."""
    parts = ['<robot name="arm"><link name="link0"/>']
    for k, name in enumerate(names_of(joints)):
        parts.append(
            f'<joint name="{name}" type="continuous"><origin xyz="0 0 {0.3 * (k > 0)}"/>'
            f'<parent link="link{k}"/><child link="link{k + 1}"/><axis xyz="0 {k % 2} {1 - k % 2}"'
            f'/></joint><link name="link{k + 1}"><inertial><origin xyz="0 0 0.15"/><mass value="2"'
            '/><inertia ixx="0.02" iyy="0.02" izz="0.002" ixy="0" ixz="0" iyz="0"/></inertial>'
            '</link>'
        )
    return ''.join([*parts, '</robot>'])


def motion(node: str, rate: float, joints: int) -> list[tuple[list[float], list[float]]]:
    """Return positions, and efforts of an arm (else none), of one turn of slow sines."""
    angle = np.arange(0.0, 2.0 * np.pi, 1.0 / rate)[:, np.newaxis] + np.arange(joints or 1)
    q, efforts = 0.2 + 0.1 * np.sin(angle), np.zeros((len(angle), 0))
    if node == ARM:
        model = ArmModel(urdf(joints))
        rows = zip(q, 0.1 * np.cos(angle), -0.1 * np.sin(angle), strict=True)
        efforts = np.array([model.regressor(*row) @ model.inertial.ravel() for row in rows])
    return list(zip(q.tolist(), efforts.tolist(), strict=True))


def publish_samples(of: str, rate: float, joints: int, ended: threading.Event) -> None:
    """Publish y, or the states of some joints, for a node at a rate (Hz) until the end."""
    node, rows = Node('source', start_parameter_services=False), motion(of, rate, joints)
    message = JointState(name=names_of(joints)) if joints else Float64()
    publisher = node.create_publisher(type(message), 'joint_states' if joints else 'y', 10)
    while not ended.is_set() and publisher.get_subscription_count() < SUBSCRIBERS:
        sleep(0.02)
    sleep(SETTLE)
    if joints:  # an estimator makes channels of these names before the first sample
        publisher.publish(message)
        sleep(SETTLE)
    print('publishing', flush=True)
    count, start = 0, monotonic()
    while not ended.is_set():
        sleep(max(0.0, start + count / rate - monotonic()))
        q, efforts = rows[count % len(rows)]
        if joints:
            message.position, message.effort = q, efforts
            time_message(time_ns(), message.header.stamp)
        else:
            message.data = q[0]
        publisher.publish(message)
        count += 1
    sleep(SETTLE)  # the last samples leave before their writer does
    print('published', count, flush=True)
    node.destroy_node()


class EmptyNode(Node):
    """Publishes zeros, and the stamp of the latest sample."""

    def __init__(self, node: str, rate: float, joints: int) -> None:
        super().__init__(EMPTY)
        self._latest = 0
        state = JointState(name=names_of(joints), effort=[0.0] * joints)
        made = {Time: Time(), JointState: state, Float64: Float64()}
        self._outputs = [
            (self.create_publisher(kind, topic, 10).publish, made[kind])
            for topic, kind in topics(node, EMPTY, joints).items()
        ]
        self._stamp = state.header.stamp if node == ARM else made[Time]
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
            self._latest = nanoseconds(message)
        if self._each:
            self._publish()

    def _publish(self) -> None:
        if self._latest:
            time_message(self._latest, self._stamp)
            for publish, message in self._outputs:
                publish(message)

    def _reports(self) -> list[Report]:
        """Return as many values as the estimator's reports have."""
        return [Report('input', {f'value {k}': 0 for k in range(31)})]


def main(what: str, node: str, rate: str, joints: str) -> None:
    """Run the source, or the empty node, until SIGINT."""
    ended = threading.Event()
    signal.signal(signal.SIGINT, lambda *_: ended.set())
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    if what == 'source':
        publish_samples(node, float(rate), int(joints), ended)
    else:
        with Spinner(EmptyNode(node, float(rate), int(joints)), on_end=ended.set):
            ended.wait()
    rclpy.try_shutdown()


if __name__ == '__main__':
    main(*sys.argv[1:])
