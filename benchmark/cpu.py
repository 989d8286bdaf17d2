# SPDX-License-Identifier: Apache-2.0
"""CPU of a started estimator over that of a node that computes nothing, on the same samples."""

from collections import defaultdict
import importlib.util
import os
from time import monotonic, sleep
from typing import NamedTuple

from children import Children
import numpy as np
from table import CannotMeasureError, Row
from tqdm import tqdm

BAR = 1.3
RATES = (100, 1000)
MATCHED = 20.0
"""Seconds that discovery may take."""
HELD = 0.98
"""A node that gets less than this part of the samples is not measured fairly."""


class Window(NamedTuple):
    """
    CPU of both nodes over the same seconds.

    Attributes
    ----------
    estimator, empty : float
        CPU time over wall time.
    rates : (2,) tuple
        Samples a second that each has taken.

    """

    estimator: float
    empty: float
    rates: tuple[float, float]


def measure(quick: bool) -> list[Row]:
    """Return the ratios of CPU at both publish rates, and over plain rclpy.spin."""
    isolate()
    seconds, repetitions = (2.0, 1) if quick else (10.0, 4)
    cases = [(rate, False) for rate in RATES] + [(RATES[0], True)]
    windows: dict[tuple[int, bool], list[Window]] = defaultdict(list)
    plan = [(case, k) for k in range(repetitions) for case in cases if k < 2 or not case[1]]
    for (rate, plain), k in tqdm(plan, desc='cpu', unit='run', leave=False):
        window = observe(rate, plain, seconds, estimator_first=k % 2 == 0)
        if min(window.rates) < 1000.0 * HELD:
            rates = ' and '.join(f'{rate:.0f} Hz' for rate in window.rates)
            tqdm.write(f'cpu: of 1000 Hz the estimator and the empty node took {rates}')
        windows[rate, plain].append(window)
    return [_row(rate, plain, windows[rate, plain]) for rate, plain in cases]


def isolate() -> None:
    """Keep what we start away from other ROS systems; raise if there is no ROS."""
    if importlib.util.find_spec('rclpy') is None:
        raise CannotMeasureError('no rclpy in this Python: start it with make bench')
    os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'
    os.environ['ROS_DOMAIN_ID'] = str(1 + os.getpid() % 100)


def observe(rate: int, plain: bool, seconds: float, estimator_first: bool) -> Window:
    """Start plant, estimator and empty node, and measure the last two over `seconds`."""
    from heartbeat import Heartbeat  # needs ROS

    commands = {
        'estimator': (
            '-m', 'fhaosmo_ros', 'estimator', '--ros-args', '-p', f'publish_rate:={rate}.0',
        ),
        'empty_node': (
            'benchmark/empty_node.py', '--rate', str(rate), *(['--plain'] if plain else []),
        ),
    }  # fmt: skip
    ready = {'estimator': 'estimating', 'empty_node': 'computing nothing'}
    names = sorted(commands, reverse=estimator_first)
    with Children() as children, Heartbeat() as heartbeat:
        plant = children.start('plant', '-m', 'fhaosmo_ros', 'plant')
        nodes = {name: children.start(name, *commands[name]) for name in names}
        plant.wait_for('simulating')
        for name, node in nodes.items():
            node.wait_for(ready[name])
        deadline = monotonic() + MATCHED
        while not all(heartbeat.samples(name) for name in commands):
            if monotonic() > deadline:
                raise CannotMeasureError(f'the nodes did not get samples within {MATCHED:g} s')
            sleep(0.05)
        sleep(min(2.0, seconds / 4))  # warm-up
        heartbeat.forget()
        before, start = {name: nodes[name].cpu_seconds() for name in commands}, monotonic()
        sleep(seconds)
        after, elapsed = (
            {name: nodes[name].cpu_seconds() for name in commands},
            monotonic() - start,
        )
        used = [(after[name] - before[name]) / elapsed for name in commands]
        return Window(
            used[0], used[1], (heartbeat.rate('estimator'), heartbeat.rate('empty_node'))
        )


def _row(rate: int, plain: bool, windows: list[Window]) -> Row:
    ratios = [w.estimator / w.empty for w in windows]
    ours, empty = (np.median([w[k] for w in windows]) for k in range(2))
    other = 'empty node in plain rclpy.spin' if plain else 'empty node'
    note = (
        f'y at 1 kHz, estimates at {rate} Hz: {ours:.1%} / {empty:.1%} CPU; '
        f'ratios {", ".join(f"{r:.2f}" for r in ratios)}'
    )
    return Row(
        f'CPU, estimator / {other}, {rate} Hz', float(np.median(ratios)),
        bar=None if plain else BAR, note=note,
    )  # fmt: skip
