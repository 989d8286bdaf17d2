# SPDX-License-Identifier: Apache-2.0
"""
The plant of a soak, with the faults of a schedule on its topic ``faulty_y``; counts what it does.

A soak is a row of cycles: faults, then rest, in whose last part the estimate is judged. The first
cycle is without faults: caches fill, and the others are compared with it.

Not a node between plant and estimator: that would stamp y anew, and on a busy machine the jitter
of one more hop makes an error in d that hides the drift which a soak is to find.
"""

import argparse
from collections import Counter
import json
import signal
import sys
import threading
from time import monotonic
from typing import Any, NamedTuple

from fhaosmo_ros.nodes.middleware.arguments import read_arguments
from fhaosmo_ros.nodes.middleware.spin import Spinner
from fhaosmo_ros.nodes.plant import PlantNode
import numpy as np
import rclpy
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from std_msgs.msg import Float64

CYCLE = 20.0
FAULTS, RESTORE, JUDGED = (0.5, 11.0), 12.0, (15.0, 19.5)
"""In a cycle: when faults begin, when parameters are put back, when the estimate must be right."""
PAUSE = (0.2, 1.2)
"""Shortest and longest time between two faults, in seconds."""
STREAM = {
    'nan': (1, 20), 'infinity': (1, 20), 'spike': (1, 3), 'duplicate': (1, 50), 'stuck': (5, 100),
    'burst': (2, 40), 'short gap': (2, 100), 'long gap': (300, 600), 'publisher restart': (1, 1),
}  # fmt: skip
"""Faults of y, with the smallest and largest number of samples that each concerns."""
CALLS = ('good parameters', 'bad parameters', 'reset')
"""What a client does meanwhile."""
SPIKE = 1e3
SETTLE = 0.5
"""Seconds from the match of a new publisher, as seen from here, to its first sample."""


class Event(NamedTuple):
    """A fault: seconds since the start, what it is, how many samples it concerns."""

    time: float
    kind: str
    size: int


def schedule(seed: int, seconds: float) -> list[Event]:
    """Return all events of a soak, in order; every kind comes up before one comes up again."""
    generator = np.random.default_rng(seed)
    events, kinds = [], list[str]()
    for start in np.arange(CYCLE, seconds - CYCLE + 1.0, CYCLE).tolist():
        time = start + FAULTS[0]
        while time < start + FAULTS[1]:
            kinds = kinds or generator.permutation([*STREAM, *CALLS]).tolist()
            kind = kinds.pop()
            low, high = STREAM.get(kind, (1, 1))
            events.append(Event(time, kind, int(generator.integers(low, high + 1))))
            time += float(generator.uniform(*PAUSE))
    return events


class Faults:
    """What stands between a node's y and its topic; its time begins with the first sample."""

    def __init__(self, node: Node, events: list[Event]) -> None:
        self.counts: Counter[str] = Counter()
        self._node, self._events = node, [e for e in events if e.kind in STREAM][::-1]
        self._active: Counter[str] = Counter()  # samples left by fault
        self._held: list[float] = []  # of a burst
        self._last = 0.0
        self._origin = 0.0
        self._publisher = node.create_publisher(Float64, 'faulty_y', 10)
        self._matched = 0.0  # when the publisher got its subscriber

    def pass_on(self, message: Float64) -> None:
        """Publish what faults leave, or make, of a sample."""
        if not self._matched and self._publisher.get_subscription_count():
            self._matched = monotonic()
        if not self._matched or monotonic() - self._matched < SETTLE:
            return
        if not self._origin:
            self._origin = monotonic()
            print('injecting', flush=True)
        while self._events and self._events[-1].time <= monotonic() - self._origin:
            event = self._events.pop()
            self._active[event.kind] = event.size
        for y in self._faulty(message.data):
            self._publisher.publish(Float64(data=y))
            self.counts['published'] += 1

    def _faulty(self, y: float) -> list[float]:
        """Return what is published in place of `y`."""
        if self._take('publisher restart'):
            self._node.destroy_publisher(self._publisher)
            self._publisher = self._node.create_publisher(Float64, 'faulty_y', 10)
            self._matched = 0.0
            return []
        if self._take('short gap') or self._take('long gap'):
            return []
        self._last = y = self._last if self._take('stuck') else y
        if self._take('nan'):
            y = float('nan')
        elif self._take('infinity'):
            y = float('inf')
        elif self._take('spike'):
            y += SPIKE
        if self._take('burst'):
            self._held.append(y)
            return []
        found = [*self._held, y]
        self._held.clear()
        return [*found, y] if self._take('duplicate') else found

    def _take(self, kind: str) -> bool:
        """Return True, and count one, while a fault lasts."""
        lasts = self._active[kind] > 0
        self._active[kind] -= lasts
        self.counts[kind] += lasts
        return lasts


class FaultyPlant(PlantNode):
    """A plant whose y goes through faults."""

    def __init__(self, given: dict[str, Any], events: list[Event]) -> None:
        super().__init__(given)
        self.faults = Faults(self, events)
        self._publish_y = self.faults.pass_on


def main() -> None:
    """Run until SIGINT, then print the counts as one line of JSON; end with the second SIGINT."""
    parser = argparse.ArgumentParser(description='A plant that injects faults into y.')
    parser.add_argument('--seed', type=int, default=1)
    parser.add_argument('--seconds', type=float, default=120.0)
    arguments, rest = parser.parse_known_args()
    ended = threading.Event()
    signal.signal(signal.SIGINT, lambda *_: ended.set())
    given, _, rest = read_arguments('plant', rest)
    rclpy.init(args=[sys.argv[0], *rest], signal_handler_options=SignalHandlerOptions.NO)
    node = FaultyPlant(given, schedule(arguments.seed, arguments.seconds))
    with Spinner(node, on_end=ended.set) as spinner:
        ended.wait()
    if spinner.error:
        raise spinner.error
    ended.clear()
    print(json.dumps(node.faults.counts), flush=True)
    ended.wait()  # the last samples are taken before their writer leaves
    node.destroy_node()
    rclpy.try_shutdown()


if __name__ == '__main__':
    main()
