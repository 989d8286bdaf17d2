# SPDX-License-Identifier: Apache-2.0
"""
The plant of a soak, with faults on its topic ``faulty_y``; counts what it does.

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
from typing import Any

from fhaosmo_ros.nodes.middleware.arguments import read_arguments
from fhaosmo_ros.nodes.middleware.spin import Spinner
from fhaosmo_ros.nodes.plant import PlantNode
import numpy as np
import rclpy
from rclpy.signals import SignalHandlerOptions
from std_msgs.msg import Float64

CYCLE = 20.0
"""Seconds: faults, then rest. The first cycle has no faults: caches fill."""
FAULTS = (0.5, 11.0)
"""When in a cycle faults begin."""
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


def schedule(seed: int) -> Iterator[tuple[float, str, int]]:
    """
    Yield the seconds since the start, the kind of each fault or call, and its samples.

    Every kind comes up before one comes up again.
    """
    random, kinds, start = np.random.default_rng(seed), list[str](), 0.0
    while start := start + CYCLE:
        time = start + FAULTS[0]
        while time < start + FAULTS[1]:
            kinds = kinds or random.permutation([*STREAM, *CALLS]).tolist()
            kind = kinds.pop()
            low, high = STREAM.get(kind, (1, 1))
            yield time, kind, int(random.integers(low, high + 1))
            time += float(random.uniform(*PAUSE))


class FaultyPlant(PlantNode):
    """A plant whose y goes through faults; their time begins with the first sample."""

    def __init__(self, given: dict[str, Any], seed: int) -> None:
        super().__init__(given)
        self.counts: Counter[str] = Counter()
        self._left: Counter[str] = Counter()  # samples by fault
        self._events = (event for event in schedule(seed) if event[1] in STREAM)
        self._next = next(self._events)
        self._held: list[float] = []  # of a burst
        self._last = self._first_sample = self._matched = 0.0
        self._faulty_y = self.create_publisher(Float64, 'faulty_y', 10)
        self._publish_y = self._pass_on

    def _pass_on(self, message: Float64) -> None:
        """Publish what faults leave, or make, of a sample."""
        now = monotonic()
        if not self._matched and self._faulty_y.get_subscription_count():
            self._matched = now
        if not self._matched or now - self._matched < SETTLE:
            return
        if not self._first_sample:
            self._first_sample = now
            print('injecting', flush=True)
        while self._next[0] <= now - self._first_sample:
            _, kind, self._left[kind] = self._next
            self._next = next(self._events)
        for y in self._faulty(message.data):
            self._faulty_y.publish(Float64(data=y))
            self.counts['published'] += 1

    def _faulty(self, y: float) -> list[float]:
        """Return what is published in place of `y`."""
        if self._take('publisher restart'):
            self.destroy_publisher(self._faulty_y)
            self._faulty_y = self.create_publisher(Float64, 'faulty_y', 10)
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
        lasts = self._left[kind] > 0
        self._left[kind] -= lasts
        self.counts[kind] += lasts
        return lasts


def main() -> None:
    """Run until SIGINT, then print the counts as one line of JSON; end with the second SIGINT."""
    parser = argparse.ArgumentParser(description='A plant that injects faults into y.')
    parser.add_argument('--seed', type=int, default=1)
    arguments, rest = parser.parse_known_args()
    ended = threading.Event()
    signal.signal(signal.SIGINT, lambda *_: ended.set())
    given, _, rest = read_arguments('plant', rest)
    rclpy.init(args=[sys.argv[0], *rest], signal_handler_options=SignalHandlerOptions.NO)
    node = FaultyPlant(given, arguments.seed)
    with Spinner(node, on_end=ended.set) as spinner:
        ended.wait()
    if spinner.error:
        raise spinner.error
    ended.clear()
    print(json.dumps(node.counts), flush=True)
    ended.wait()  # the last samples are taken before their writer leaves
    node.destroy_node()
    rclpy.try_shutdown()


if __name__ == '__main__':
    main()
