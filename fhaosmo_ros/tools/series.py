# SPDX-License-Identifier: Apache-2.0
"""Topics read whole."""

from pathlib import Path
from typing import Any, NamedTuple

from fhaosmo_ros.tools.bag_reader import BagReader
import numpy as np
from numpy.typing import NDArray


class Series(NamedTuple):
    """
    A topic's messages as arrays.

    Attributes
    ----------
    stamps : (K,) array of int
        Stamps in nanoseconds.
    values : (K,) or (K, n) array
        Numbers of a Float64, a Float64MultiArray, or a Time (in nanoseconds, as integers).
    labels : list of str
        Names of the n columns, where the messages have a label.

    """

    stamps: NDArray[np.int64]
    values: NDArray[Any]
    labels: list[str]


def messages(path: Path, topic: str) -> list[tuple[int, Any]]:
    """Return a topic's stamps (ns) and messages; for topics with few of them."""
    with BagReader(path) as reader:
        return [(stamp, message) for _, stamp, message in reader.few([topic])]


def series(path: Path, topic: str) -> Series:
    """Read a topic of numbers; empty arrays if it has no message."""
    with BagReader(path) as reader:
        if not reader.count(topic):
            return Series(np.zeros(0, np.int64), np.zeros(0), [])
        first = reader.first(topic)
        if hasattr(first, 'nanosec'):
            stamps, seconds = _read(reader, topic, 'sec')
            _, rest = _read(reader, topic, 'nanosec')
            values = seconds.astype(np.int64) * 1_000_000_000 + rest.astype(np.int64)
            return Series(stamps, values, [])
        if not hasattr(first, 'layout'):
            return Series(*_read(reader, topic, 'data'), [])
        width = len(first.data)
        stamps, values = _read(reader, topic, 'data[0]', width)
        labels = first.layout.dim[0].label.split(',') if first.layout.dim else []
        return Series(stamps, values.reshape(-1, width), labels)


def _read(
    reader: BagReader, topic: str, field: str, width: int = 1
) -> tuple[NDArray[np.int64], NDArray[Any]]:
    blocks = list(reader.blocks(topic, reader.field(topic, field), width=width))
    times, _, values = (np.concatenate(part) for part in zip(*blocks, strict=True))
    return times, values
