# SPDX-License-Identifier: Apache-2.0
"""
What happens when in a soak, from a seed.

A soak is a row of cycles: faults, then rest, in whose last part the estimate is judged. The first
cycle is without faults: caches fill, and the others are compared with it.
"""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

CYCLE = 20.0
FAULTS = (0.5, 11.0)
"""When in a cycle faults begin."""
RESTORE = 12.0
"""When in a cycle the parameters are put back."""
JUDGED = (15.0, 19.5)
"""The part of a cycle in which the estimate must be right."""
PAUSE = (0.2, 1.2)
"""Shortest and longest time between two faults, in seconds."""

STREAM = {
    'nan': (1, 20),
    'infinity': (1, 20),
    'spike': (1, 3),
    'duplicate': (1, 50),
    'stuck': (5, 100),
    'burst': (2, 40),
    'short gap': (2, 100),
    'long gap': (300, 600),
    'publisher restart': (1, 1),
}
"""Faults of y, with the smallest and largest number of samples that each concerns."""
CALLS = ('good parameters', 'bad parameters', 'reset')
"""What a client does meanwhile."""


class Event(NamedTuple):
    """
    A fault.

    Attributes
    ----------
    time : float
        Seconds since the start.
    kind : str
    size : int
        Samples concerned.

    """

    time: float
    kind: str
    size: int


def schedule(seed: int, seconds: float) -> list[Event]:
    """Return all events of a soak, in order; every kind comes up before one comes up again."""
    generator = np.random.default_rng(seed)
    kinds = _shuffled(generator)
    events = []
    for start in np.arange(CYCLE, seconds - CYCLE + 1.0, CYCLE).tolist():
        time = start + FAULTS[0]
        while time < start + FAULTS[1]:
            kind = next(kinds)
            low, high = STREAM.get(kind, (1, 1))
            events.append(Event(time, kind, int(generator.integers(low, high + 1))))
            time += float(generator.uniform(*PAUSE))
    return events


def _shuffled(generator: np.random.Generator) -> Iterator[str]:
    kinds = [*STREAM, *CALLS]
    while True:
        yield from (kinds[k] for k in generator.permutation(len(kinds)))
