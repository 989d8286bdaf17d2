# SPDX-License-Identifier: Apache-2.0
"""Replay of a recorded y at 1 kHz, beside rosbags reading and deserialising the same bag."""

from pathlib import Path
import subprocess
import sys
from tempfile import TemporaryDirectory
from time import perf_counter

from fhaosmo_ros.tools.bags.types import serialise
from fhaosmo_ros.tools.bags.writer import BagWriter
from fhaosmo_ros.topics import FLOAT
import numpy as np
from results import Row
from rosbags.highlevel import AnyReader

SAMPLES, BAR = 1_000_000, 2.5


def measure(quick: bool) -> list[Row]:
    """Return the ratio of times of a replay to a bag, with its process's start."""
    samples, rounds = (50_000, 1) if quick else (SAMPLES, 3)
    times = []
    with TemporaryDirectory() as folder:
        path, out = Path(folder) / 'bag', Path(folder) / 'out'
        with BagWriter(path) as bag:
            bag.add('/y', FLOAT)
            for k, value in enumerate((0.2 + 0.1 * np.sin(1e-3 * np.arange(samples))).tolist()):
                bag.write('/y', 10**18 + k * 1_000_000, serialise(FLOAT, data=value))
        command = [sys.executable, '-m', 'fhaosmo_ros', 'replay', path, '-o', out, '--force']
        for _ in range(rounds):
            start = perf_counter()
            subprocess.run(command, stdout=subprocess.DEVNULL, check=True)
            middle = perf_counter()
            with AnyReader([path]) as reader:
                for connection, _, data in reader.messages():
                    reader.deserialize(data, connection.msgtype)
            times.append((middle - start, perf_counter() - middle))
    ours, theirs = np.median(times, axis=0).tolist()
    note = f'{samples:,} Float64, a process with its start: {ours:.2f} / {theirs:.2f} s'
    return [Row('replay to a bag / rosbags reads', ours / theirs, '', BAR, note)]
