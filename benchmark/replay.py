# SPDX-License-Identifier: Apache-2.0
"""Replay of a recorded y, beside rosbags reading and deserialising the same bag."""

from pathlib import Path
import subprocess
import sys
from tempfile import TemporaryDirectory
from time import perf_counter

from fhaosmo_ros.tools.bags.mcap.chunks import DATA_AT, Records
from fhaosmo_ros.tools.bags.writer import BagWriter
import numpy as np
from rosbags.highlevel import AnyReader
from table import CannotMeasureError, Row
from tqdm import tqdm

SAMPLES = 1_000_000
BAR = 1.5
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
        memory = {'short': replay(short, folder / 'warm.npz')[1]}  # also compiles
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
    kind = np.dtype([
        ('code', 'u1'), ('size', '<u8'), ('channel', '<u2'), ('sequence', '<u4'),
        ('time', '<i8'), ('published', '<i8'), ('cdr', 'u1', 4), ('value', '<f8'),
    ])  # fmt: skip
    with BagWriter(path) as bag:
        channel = bag.add('/y', 'std_msgs/msg/Float64')
        for part in np.array_split(times, max(1, samples // 24_000)):
            data = np.zeros(len(part), dtype=kind)
            data['code'], data['size'], data['channel'] = 5, kind.itemsize - 9, channel
            data['time'] = data['published'] = part
            data['cdr'] = [0, 1, 0, 0]
            data['value'] = 0.2 + 0.1 * np.sin((part - times[0]) * 1e-9)
            starts = np.arange(len(part)) * kind.itemsize
            channels = np.full(len(part), channel)
            records = Records(part, channels, starts, starts + kind.itemsize)
            bag.write_chunk(data.view(np.uint8), records)
    assert kind.itemsize == DATA_AT + 12
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
