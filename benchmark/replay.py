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
from rosbags.highlevel import AnyReader
from table import CannotMeasureError, Row
from tqdm import tqdm

SAMPLES = 1_000_000
BAR = 2.5
MEMORY_BAR = 1.25
REPLAY = """
import resource, sys
from fhaosmo_ros.tools.replay.command import main
code = main(sys.argv[1:])
print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, file=sys.stderr)
sys.exit(code)
"""


def measure(quick: bool) -> list[Row]:
    """Return the ratio of times for each output, and that of memory for a longer bag."""
    samples, rounds = (50_000, 1) if quick else (SAMPLES, 3)
    outputs = {'a bag': 'out', 'NPZ': 'out.npz', 'CSV': 'out.csv'}
    times: dict[str, list[float]] = {name: [] for name in ('rosbags', *outputs)}
    with (
        TemporaryDirectory() as name,
        tqdm(
            total=rounds * (1 + len(outputs)) + 2, desc='replay', unit='run', leave=False
        ) as progress,
    ):
        folder = Path(name)
        bag = make_bag(folder / 'bag', samples)
        short = make_bag(folder / 'short', samples // 10)
        memory = {'short': replay(short, folder / 'warm.npz')[1]}
        progress.update()
        for _ in range(rounds):
            times['rosbags'].append(read_by_rosbags(bag))
            progress.update()
            for kind, path in outputs.items():
                seconds, memory[kind] = replay(bag, folder / path)
                times[kind].append(seconds)
                progress.update()
    base = float(np.median(times['rosbags']))
    rows = []
    for kind in outputs:
        seconds = float(np.median(times[kind]))
        note = f'{samples:,} Float64, a process with its start: {seconds:.2f} / {base:.2f} s'
        bar = BAR if kind == 'a bag' and not quick else None
        rows.append(Row(f'replay to {kind} / rosbags reads', seconds / base, bar=bar, note=note))
    note = f'{memory["NPZ"] / 1024:.0f} / {memory["short"] / 1024:.0f} MB'
    rows.append(Row(
        'memory, bag ten times as long', memory['NPZ'] / memory['short'],
        bar=None if quick else MEMORY_BAR, note=note,
    ))  # fmt: skip
    return rows


def make_bag(path: Path, samples: int) -> Path:
    """Write y at 1 kHz, in chunks of about a megabyte."""
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


def replay(bag: Path, out: Path) -> tuple[float, int]:
    """Return the seconds that a replay takes, with its process's start, and its memory (KB)."""
    start = perf_counter()
    done = subprocess.run(
        [sys.executable, '-c', REPLAY, str(bag), '-o', str(out), '--force'],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    if done.returncode:
        raise CannotMeasureError(f'replay failed: {done.stderr.strip().splitlines()[-1]}')
    return perf_counter() - start, int(done.stderr.split()[-1])
