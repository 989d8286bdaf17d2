# SPDX-License-Identifier: Apache-2.0
"""Replay of a recorded y, beside rosbags reading and deserialising the same bag."""

from pathlib import Path
import subprocess
import sys
from tempfile import TemporaryDirectory
from time import perf_counter

from fhaosmo_ros.tools.bags.types import serialise
from fhaosmo_ros.tools.bags.writer import BagWriter
from fhaosmo_ros.topics import FLOAT
import numpy as np
from results import CannotMeasureError, Row
from rosbags.highlevel import AnyReader
from tqdm import tqdm

SAMPLES = 1_000_000
BAR = 2.5


def measure(quick: bool) -> list[Row]:
    """Return the ratio of times of a replay to a bag."""
    samples, rounds = (50_000, 1) if quick else (SAMPLES, 3)
    times = np.empty((rounds, 2))
    with TemporaryDirectory() as name:
        bag = make_bag(Path(name) / 'bag', samples)
        for k in tqdm(range(rounds), desc='replay', unit='run', leave=False):
            times[k] = replay(bag, Path(name) / 'out'), read_by_rosbags(bag)
    ours, theirs = np.median(times, axis=0).tolist()
    note = f'{samples:,} Float64, a process with its start: {ours:.2f} / {theirs:.2f} s'
    bar = None if quick else BAR
    return [Row('replay to a bag / rosbags reads', ours / theirs, '', bar, note)]


def make_bag(path: Path, samples: int) -> Path:
    """Write y at 1 kHz."""
    times = 10**18 + np.arange(samples) * 1_000_000
    values = 0.2 + 0.1 * np.sin(1e-3 * np.arange(samples))
    with BagWriter(path) as bag:
        bag.add('/y', FLOAT)
        for time, value in zip(times.tolist(), values.tolist(), strict=True):
            bag.write('/y', time, serialise(FLOAT, data=value))
    return path


def read_by_rosbags(bag: Path) -> float:
    """Return the seconds that rosbags takes to iterate and deserialise."""
    start = perf_counter()
    with AnyReader([bag]) as reader:
        for connection, _, data in reader.messages():
            reader.deserialize(data, connection.msgtype)
    return perf_counter() - start


def replay(bag: Path, out: Path) -> float:
    """Return the seconds that a replay takes, with its process's start."""
    start = perf_counter()
    done = subprocess.run(
        [sys.executable, '-m', 'fhaosmo_ros', 'replay', str(bag), '-o', str(out), '--force'],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    if done.returncode:
        raise CannotMeasureError(f'replay failed: {done.stderr.strip().splitlines()[-1]}')
    return perf_counter() - start
