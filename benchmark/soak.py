# SPDX-License-Identifier: Apache-2.0
"""
Feed an estimator for a long time, with faults, and say what grew, drifted or got lost.

`make soak MINUTES=30`. Exit code 0 if everything held, 1 if not, 130 after Ctrl-C. Samples have
the time of y in their headers, and the estimator hears them reliably, also those of a publisher
that it has just found: a busy machine delays them and no more.
"""

import argparse
from collections import Counter
from collections.abc import Iterator
import math
import os
from pathlib import Path
import sys
from time import monotonic, sleep, time_ns
from typing import Any

from fhaosmo_ros.core import Plant
from fhaosmo_ros.core.parameters.files import load
from fhaosmo_ros.core.parameters.tables import ESTIMATOR_PARAMETERS, PLANT_NODE_PARAMETERS
from fhaosmo_ros.nodes.middleware.messages import time_message
from fhaosmo_ros.stop_signals import Stop
from fhaosmo_ros.tools.cli.command import run_command
from geometry_msgs.msg import PointStamped
from live import PATIENCE, ROOT, start_node, wait_until, Watch
import numpy as np
from rclpy.duration import Duration
from rclpy.parameter import Parameter
from rclpy.parameter_client import AsyncParameterClient
from rclpy.qos import DurabilityPolicy, QoSProfile
from results import render, Row
from scipy.stats import theilslopes
from sensor_msgs.msg import JointState
from std_srvs.srv import Trigger
from tqdm import tqdm

FILE = 'benchmark/soak.yaml'
PARAMETERS = ESTIMATOR_PARAMETERS.complete(load(ROOT / FILE, 'estimator'))
OF_PLANT = PLANT_NODE_PARAMETERS.complete(load(ROOT / FILE, 'plant'))
RATE = round(OF_PLANT['sample_rate'])
ESTIMATES = '/estimator/joint_states'  # with stamp, z1, z2 and d
QOS = QoSProfile(depth=10 * RATE, durability=DurabilityPolicy.TRANSIENT_LOCAL)
CYCLE, FAULTS, RESTORE, JUDGED = 20.0, (0.5, 11.0), 12.0, 15.0
"""
Seconds of a cycle, and when in it faults begin, parameters are put back, and the estimate must be
right from. The first cycle has one fault, and is not judged: caches fill.
"""
LONG_BURST = 1.0, 'burst', 8 * RATE
"""
The fault of the first cycle. The memory that a queue of samples takes stays with the middleware
and with Python, for the next one, and on a busy machine a long one comes sooner or later: so the
longest one comes before memory is judged.
"""
PAUSE = (0.2, 1.2)  # shortest and longest time between two faults (s)
STREAM = {
    'nan': (1, 20), 'infinity': (1, 20), 'spike': (1, 3), 'duplicate': (1, 50), 'stuck': (5, 100),
    'burst': (2, 40), 'short gap': (2, 100), 'long gap': (300, 600), 'publisher restart': (1, 1),
}  # fmt: skip
"""Faults of y, with the smallest and largest number of samples that each concerns."""
GOOD, BAD, BASE, RESET = 'good parameters', 'bad parameters', 'parameters put back', 'reset'
SETS: dict[str, tuple[dict[str, Any], ...]] = {
    GOOD: (
        {'variant': 'sign'}, {'variant': 'fuzzy'}, {'scheme': 'explicit', 'variant': 'fuzzy'},
        {'lambda': [15.0], 'alpha': [30.0]}, {'epsilon': 0.5}, {'publish_rate': 250.0},
        {'estimate_from': 'filtered'}, {'gamma_rate': 4.0, 'gamma_min': 0.4},
    ),
    BAD: (
        {'variant': 'fuzy'}, {'lambda': [-1.0]}, {'alpha': [1.0, 2.0]}, {'epsilon': math.nan},
        {'gamma_min': 0.9, 'gamma_initial': 0.2}, {'order': 7}, {'no_such_parameter': 1.0},
    ),
}  # fmt: skip
SETS[BASE] = ({name: PARAMETERS[name] for changes in SETS[GOOD] for name in changes},)
MEMORY, DRIFT, ERROR, GROWTH = 2.0, 0.02, 0.05, 0.01
"""
What the estimator's memory may grow by (MB); gamma, from the first to the last third; the largest
median error of d of a cycle (half of d's amplitude), and what it may grow by.
"""


def schedule(seed: int) -> Iterator[tuple[float, str, int]]:
    """
    Yield the seconds since the start, the kind of each fault or call, and its samples.

    Every kind comes up before one comes up again.
    """
    yield LONG_BURST
    random, kinds, start = np.random.default_rng(seed), list[str](), 0.0
    while start := start + CYCLE:
        time = start + FAULTS[0]
        while time < start + FAULTS[1]:
            kinds = kinds or random.permutation([*STREAM, GOOD, BAD, RESET]).tolist()
            kind = kinds.pop()
            low, high = STREAM.get(kind, (1, 1))
            yield time, kind, int(random.integers(low, high + 1))
            time += float(random.uniform(*PAUSE))
        yield start + RESTORE, BASE, 1


class Feed:
    """Publishes y with faults, and calls the estimator; `counts` says how often."""

    def __init__(self, watch: Watch, seed: int) -> None:
        self.counts: Counter[str] = Counter()
        self._node, self._calls = watch.node, []
        self._left: Counter[str] = Counter()  # samples by fault
        self._events = schedule(seed)
        self._next = next(self._events)
        self._held: list[PointStamped] = []  # of a burst
        self._last = 0.0
        self._parameters = AsyncParameterClient(self._node, '/estimator')
        self._reset = self._node.create_client(Trigger, '/estimator/reset')
        wait_until(self._parameters.services_are_ready, 'the estimator offers no parameters')
        self._publisher = self._node.create_publisher(PointStamped, 'y', QOS)

    def pass_on(self, t: float, stamp: int, y: float) -> None:
        """Publish what faults leave, or make, of a sample; `t` seconds after the start."""
        while self._next[0] <= t:
            _, kind, count = self._next
            self._next = next(self._events)
            if kind in STREAM:
                self._left[kind] = count
            else:
                self._call(kind)
        for message in self._faulty(stamp, y):
            self._publisher.publish(message)
            self.counts['published'] += 1

    def _faulty(self, stamp: int, y: float) -> list[PointStamped]:
        """Return what is published in place of `y`."""
        if self._take('publisher restart'):
            self._publisher.wait_for_all_acked(Duration(seconds=PATIENCE))
            self._node.destroy_publisher(self._publisher)
            self._publisher = self._node.create_publisher(PointStamped, 'y', QOS)
        if self._take('short gap') or self._take('long gap'):
            return []
        self._last = y = self._last if self._take('stuck') else y
        for kind, value in (('nan', math.nan), ('infinity', math.inf), ('spike', y + 1e3)):
            y = value if self._take(kind) else y
        message = PointStamped()
        message.header.stamp, message.point.x = time_message(stamp), y
        if self._take('burst'):
            self._held.append(message)
            return []
        found, self._held = [*self._held, message], []
        return [*found, message] if self._take('duplicate') else found

    def _take(self, kind: str) -> bool:
        """Return True, and count one, while a fault lasts."""
        lasts = self._left[kind] > 0
        self._left[kind] -= lasts
        self.counts[kind] += lasts
        return lasts

    def _call(self, kind: str) -> None:
        """Make the next call of a kind; its answer comes later."""
        if kind == RESET:
            future = self._reset.call_async(Trigger.Request())
            self._calls.append((future, lambda answer: answer.success))
        else:
            values = SETS[kind][self.counts[kind] % len(SETS[kind])]
            changes = [Parameter(name, value=value) for name, value in values.items()]
            future = self._parameters.set_parameters_atomically(changes)
            right = kind != BAD
            self._calls.append((future, lambda answer: answer.result.successful == right))
        self.counts[kind] += 1

    def wrong(self) -> int:
        """Return how many calls were answered wrongly, or not at all."""
        return sum(not (call.done() and right(call.result())) for call, right in self._calls)


class Seen:
    """What was seen of the estimator, by cycle."""

    def __init__(self, cycles: int) -> None:
        self.errors: list[list[float]] = [[] for _ in range(cycles)]  # of d, late in each
        self.gamma: list[float] = []
        self.memory: list[float] = []  # MB
        self.not_finite = 0  # estimates with a NaN or an infinity

    def judge(self, watch: Watch, plant: Plant, begin: int) -> None:
        """Judge the estimates that have come; on a busy machine those of the cycle before, too."""
        heard = watch.heard[ESTIMATES]
        watch.forget()
        for _, m in heard:
            self.not_finite += not np.isfinite([*m.position, *m.velocity, *m.effort]).all()
            t = 1e-9 * (m.header.stamp.sec * 10**9 + m.header.stamp.nanosec - begin)
            cycle, phase = divmod(t, CYCLE)
            if phase >= JUDGED:
                self.errors[int(cycle)].append(abs(m.effort[0] - plant.unknown_input(t)))


def soak(seed: int, minutes: float, output: Path) -> bool:
    """Run once, write and print the verdict; return whether everything held."""
    cycles, given = round(60.0 * minutes / CYCLE), ('--ros-args', '--params-file', FILE)
    plant, seen = Plant(OF_PLANT), Seen(cycles)
    with Watch({ESTIMATES: JointState}) as watch, start_node('estimator', *given) as estimator:
        estimator.wait_for('estimating')
        feed = Feed(watch, seed)
        begin, start = time_ns(), monotonic()
        for cycle in tqdm(range(cycles), desc='soak', unit='cycle'):
            for t in CYCLE * cycle + np.arange(round(CYCLE * RATE)) / RATE:
                sleep(max(0.0, start + t - monotonic()))
                feed.pass_on(t, begin + round(1e9 * t), plant.sample(t).y)
            estimator.check()
            seen.judge(watch, plant, begin)
            seen.gamma.append(float(watch.reports['estimator']['gamma']))
            seen.memory.append(estimator.resident_megabytes())
        deadline = monotonic() + PATIENCE
        while unaccounted(feed, watch) and monotonic() < deadline:
            sleep(0.1)
        seen.judge(watch, plant, begin)
    rows = verdict(seen, feed, watch)
    said = ', '.join(f'{n:,} {k}' for k, n in sorted(feed.counts.items()))
    load = f'{os.cpu_count()} cores, load {os.getloadavg()[1]:.1f}'
    text = f'{minutes:g} minutes, seed {seed}, {load}: {said}\n\n{render(rows)}\n'
    output.mkdir(parents=True, exist_ok=True)
    (output / 'soak.txt').write_text(text)
    missed = [row.name for row in rows if row.missed]
    print(text, f'FAILED: {"; ".join(missed)}' if missed else 'passed', sep='\n')
    return not missed


def unaccounted(feed: Feed, watch: Watch) -> int:
    """Return how many samples were published that the estimator has neither taken nor missed."""
    known = watch.number('estimator', 'samples accepted', 'samples rejected', 'samples lost')
    return abs(feed.counts['published'] - known)


def verdict(seen: Seen, feed: Feed, watch: Watch) -> list[Row]:
    """Return one row for each thing that a soak may fail on; the first cycle is for warming up."""
    error = np.array([np.median(errors) for errors in seen.errors[1:]])
    gamma, memory = seen.gamma[1:], seen.memory[1:]
    growth = float(theilslopes(memory).slope * (len(memory) - 1))  # the median of all slopes
    thirds = [[np.median(x) for x in np.array_split(y, 3)] for y in (error, gamma)]
    lost, made = watch.number('estimator', 'samples lost'), feed.counts
    calls = ', '.join(f'{made[kind]} {kind}' for kind in (*SETS, RESET))
    return [
        Row('memory of estimator, growth', growth, 'MB', MEMORY,
            f'{memory[0]:.1f} to {memory[-1]:.1f} MB'),
        Row('samples unaccounted for', unaccounted(feed, watch), '', 0.0,
            f'of {made["published"]:,}'),
        Row('samples lost, by sequence number', lost, '', 0.0),
        Row('estimates that are not finite', seen.not_finite, '', 0.0),
        *(
            Row(f'{name}, from the first to the last third', abs(y[-1] - y[0]), '', bar,
                f'{y[0]:.2g} to {y[-1]:.4g}')
            for name, y, bar in zip(('error of d', 'gamma'), thirds, (GROWTH, DRIFT), strict=True)
        ),
        Row('error of d, worst cycle', error.max(), '', ERROR, f'median {np.median(error):.2g}'),
        Row('wrong answers to calls', feed.wrong(), '', 0.0, calls),
    ]  # fmt: skip


def main() -> int:
    """Run, print the verdict; see the top of this file for the exit code."""
    parser = argparse.ArgumentParser(prog='make soak', description='Run for long, with faults.')
    parser.add_argument('--minutes', type=float, default=2.0, help='at least 2')
    parser.add_argument('--seed', type=int, default=1, help='of the schedule of faults')
    parser.add_argument('--output', type=Path, default=Path('soak_output'), help='folder')

    def body(arguments: argparse.Namespace, stop: Stop) -> int:
        if arguments.minutes < 2.0:
            parser.error(f'argument --minutes: expected at least 2, got {arguments.minutes:g}')
        with stop.raising():
            return 0 if soak(arguments.seed, arguments.minutes, arguments.output) else 1

    return run_command(parser, None, body)


if __name__ == '__main__':
    sys.exit(main())
