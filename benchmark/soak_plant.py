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
from collections.abc import Iterator
import json
import signal
import sys
import threading
from time import monotonic
from typing import NamedTuple

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

READY = 'injecting'
TOPIC = 'faulty_y'
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
    """
    What stands between a plant and its topic.

    Parameters
    ----------
    node : Node
        Owns the publisher.
    seed : int
    seconds : float
        Arguments of `schedule`; its time begins with the first sample.

    """

    def __init__(self, node: Node, seed: int, seconds: float) -> None:
        self.counts: Counter[str] = Counter()
        self._node = node
        self._events = [e for e in schedule(seed, seconds) if e.kind in STREAM][::-1]
        self._active: dict[str, int] = {}
        self._held: list[float] = []
        self._last = 0.0
        self._origin: float | None = None
        self._matched: float | None = None
        self._publisher = node.create_publisher(Float64, TOPIC, 10)

    def pass_on(self, message: Float64) -> None:
        """Publish what faults leave, or make, of a sample."""
        if not self._is_matched():
            self.counts['held back for discovery'] += 1
            return
        if self._origin is None:
            self._origin = monotonic()
            print(READY, flush=True)
        now = monotonic() - self._origin
        while self._events and self._events[-1].time <= now:
            event = self._events.pop()
            self._active[event.kind] = event.size
            self.counts[f'event: {event.kind}'] += 1
        for y in self._faulty(message.data):
            self._publisher.publish(Float64(data=y))
            self.counts['published'] += 1

    def _is_matched(self) -> bool:
        """Return True once a new publisher has had its subscriber for a while."""
        if self._matched is None and self._publisher.get_subscription_count():
            self._matched = monotonic()
        return self._matched is not None and monotonic() - self._matched > SETTLE

    def _faulty(self, y: float) -> Iterator[float]:
        """Return what is published in place of `y`."""
        if self._take('publisher restart'):
            self._node.destroy_publisher(self._publisher)
            self._publisher = self._node.create_publisher(Float64, TOPIC, 10)
            self._matched = None
            self.counts['held back for discovery'] += 1
            return
        if self._take('short gap') or self._take('long gap'):
            self.counts['dropped'] += 1
            return
        if self._take('stuck'):
            y = self._last
        self._last = y
        if self._take('nan'):
            y = float('nan')
        elif self._take('infinity'):
            y = float('inf')
        elif self._take('spike'):
            y += SPIKE
        if self._take('burst'):
            self._held.append(y)
            return
        yield from self._held
        self._held.clear()
        yield y
        if self._take('duplicate'):
            yield y

    def _take(self, kind: str) -> bool:
        """Return True, and count one, while a fault lasts."""
        if not self._active.get(kind):
            return False
        self._active[kind] -= 1
        self.counts[kind] += 1
        return True


class FaultyPlant(PlantNode):
    """A plant whose y goes through faults; arguments of `Faults`."""

    def __init__(self, seed: int, seconds: float) -> None:
        super().__init__()
        self.faults = Faults(self, seed, seconds)
        self._publish_y = self.faults.pass_on


def main() -> None:
    """Run until SIGINT, then print the counts as one line of JSON; end with the second SIGINT."""
    parser = argparse.ArgumentParser(description='A plant that injects faults into y.')
    parser.add_argument('--seed', type=int, default=1)
    parser.add_argument('--seconds', type=float, default=120.0)
    arguments, rest = parser.parse_known_args()
    ended = threading.Event()
    signal.signal(signal.SIGINT, lambda *_: ended.set())
    rclpy.init(args=[sys.argv[0], *rest], signal_handler_options=SignalHandlerOptions.NO)
    node = FaultyPlant(arguments.seed, arguments.seconds)
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
