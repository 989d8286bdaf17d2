# SPDX-License-Identifier: Apache-2.0
"""Where replayed estimates go: a bag, a CSV or an NPZ file, block by block."""

from collections.abc import Mapping
from itertools import groupby
from pathlib import Path
import shutil
from typing import Any, NamedTuple, Protocol
import zipfile

from fhaosmo_ros.core.observer import Trajectory
from fhaosmo_ros.core.parameter_file import dumps
from fhaosmo_ros.tools.bag_writer import BagWriter
from fhaosmo_ros.tools.bags import labelled_array, LATCHED_QOS, serialise
from fhaosmo_ros.tools.chunks import DATA_AT, MESSAGE, Records
from fhaosmo_ros.tools.recorded_parameters import TOPIC as PARAMETERS
from fhaosmo_ros.tools.recorded_parameters import TYPE as TEXT
import numpy as np
from numpy.typing import NDArray

try:
    import orjson
except ModuleNotFoundError:  # rosdep does not bring it: slower then
    orjson = None

FLOAT, ARRAY = 'std_msgs/msg/Float64', 'std_msgs/msg/Float64MultiArray'
TOPICS = {
    'state': ARRAY, 'unknown_input': FLOAT, 'gamma': FLOAT, 'innovation': ARRAY,
    'stamp': 'builtin_interfaces/msg/Time',
}  # fmt: skip
"""The estimator's topics below its name, in the order in which it publishes them."""


class Rows(NamedTuple):
    """
    Estimates of accepted samples.

    Attributes
    ----------
    times : (K,) array of int
        Stamps of the samples in the bag, in nanoseconds.
    y : (K,) array
    estimates : Trajectory
        ``t`` holds the stamps that dt came from, in nanoseconds.

    """

    times: NDArray[np.int64]
    y: NDArray[np.float64]
    estimates: Trajectory


class Sink(Protocol):
    """Takes estimates block by block."""

    def write(self, rows: Rows) -> None:
        """Append."""

    def close(self) -> None:
        """Complete the output."""


def columns(rows: Rows) -> dict[str, NDArray]:
    """Return one array for each column of a table of estimates."""
    e = rows.estimates
    result = {'stamp_ns': e.t, 'bag_time_ns': rows.times, 'y': rows.y}
    result |= {f'z{i + 1}': e.z[:, i] for i in range(e.z.shape[1])}
    result |= {'unknown_input': e.unknown_input, 'gamma': e.gamma}
    result |= {f'eps{i + 1}': e.innovation[:, i] for i in range(e.innovation.shape[1])}
    return result | {'status': e.status, 'open_levels': e.open_levels}


class CsvSink:
    """Writes a table with a header line; numbers read back as the same doubles."""

    def __init__(self, path: Path) -> None:
        self._file = path.open('wb')
        self._began = False

    def write(self, rows: Rows) -> None:
        """Append a line for each sample."""
        table = columns(rows)
        if not self._began:
            self._file.write(','.join(table).encode() + b'\n')
            self._began = True
        # Neighbours of one type together: the fewer pieces a line is made of, the faster.
        groups = [list(group) for _, group in groupby(table.values(), lambda c: c.dtype)]
        pieces = [_lines(np.column_stack(group)) for group in groups]
        self._file.write(b'\n'.join(map(b','.join, zip(*pieces, strict=True))) + b'\n')

    def close(self) -> None:
        """Complete the file."""
        self._file.close()


def _lines(array: NDArray) -> list[bytes]:
    """Return the rows of an array, numbers divided by commas, each as short as it can be."""
    if orjson is None:
        return [','.join(map(repr, row)).encode() for row in array.tolist()]
    text = orjson.dumps(np.ascontiguousarray(array), option=orjson.OPT_SERIALIZE_NUMPY)
    return text[2:-2].split(b'],[')  # JSON: [[1.0,2.0],[3.0,4.0]]


class NpzSink:
    """Writes arrays by name; they grow on disk, not in memory."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._parts = path.with_name('columns')
        self._parts.mkdir()
        self._kinds: dict[str, np.dtype] = {}
        self._count = 0

    def write(self, rows: Rows) -> None:
        """Append to every array."""
        for name, column in columns(rows).items():
            self._kinds[name] = column.dtype
            with (self._parts / name).open('ab') as file:
                file.write(np.ascontiguousarray(column).tobytes())
        self._count += len(rows.y)

    def close(self) -> None:
        """Collect the arrays in one file."""
        with zipfile.ZipFile(self._path, 'w', allowZip64=True) as archive:
            for name, kind in self._kinds.items():
                header = {
                    'descr': np.lib.format.dtype_to_descr(kind),
                    'fortran_order': False,
                    'shape': (self._count,),
                }
                with (
                    archive.open(f'{name}.npy', 'w', force_zip64=True) as out,
                    (self._parts / name).open('rb') as part,
                ):
                    np.lib.format.write_array_header_1_0(out, header)
                    shutil.copyfileobj(part, out, 1 << 20)
        shutil.rmtree(self._parts)


class BagSink:
    """
    Adds the estimator's topics to an open bag, a message of each for every sample.

    Parameters
    ----------
    bag : BagWriter
    name : str
        What stands before the topics.
    order, levels : int
        Numbers of states and of innovations.
    parameters : mapping
        What the estimates are made with; told once, as the node does.

    """

    def __init__(
        self, bag: BagWriter, name: str, order: int, levels: int, parameters: Mapping[str, Any]
    ) -> None:
        self._bag = bag
        self._parameters = f'{name}/{PARAMETERS}', dumps(parameters, name)
        bag.add(self._parameters[0], TEXT, qos=[LATCHED_QOS])
        self._told = False
        ids = [bag.add(f'{name}/{topic}', kind) for topic, kind in TOPICS.items()]
        state = [f'z{i + 1}' for i in range(order)]
        innovation = [f'eps{i + 1}' for i in range(levels)]
        number = serialise(FLOAT, data=0.0)
        # Each message, and how many of its last bytes are the numbers.
        self._messages = [
            (labelled_array(state, np.zeros(order)), 8 * order),
            (number, 8), (number, 8),
            (labelled_array(innovation, np.zeros(levels)), 8 * levels),
            (serialise('builtin_interfaces/msg/Time', sec=0, nanosec=0), 8),
        ]  # fmt: skip
        self._ids = np.array(ids, dtype=np.int64)
        sizes = [DATA_AT + len(message) for message, _ in self._messages]
        self._ends = np.cumsum(sizes)
        self._starts = self._ends - sizes
        self._template = self._make_template(ids)

    def _make_template(self, ids: list[int]) -> NDArray[np.uint8]:
        """Return the records of one sample with zeros for its stamp and its numbers."""
        out = b''
        for channel, (message, _) in zip(ids, self._messages, strict=True):
            out += bytes([MESSAGE]) + (DATA_AT - 9 + len(message)).to_bytes(8, 'little')
            out += channel.to_bytes(2, 'little') + bytes(DATA_AT - 11) + message
        return np.frombuffer(out, dtype=np.uint8)

    def write(self, rows: Rows) -> None:
        """Append the messages of each sample."""
        if not self._told:
            topic, text = self._parameters
            self._bag.write(topic, int(rows.times[0]), serialise(TEXT, data=text))
            self._told = True
        e = rows.estimates
        seconds, rest = np.divmod(e.t, 1_000_000_000)
        numbers = [
            e.z, e.unknown_input, e.gamma, e.innovation,
            np.column_stack([seconds, rest]).astype('<i4'),
        ]  # fmt: skip
        count = len(rows.times)
        data = np.tile(self._template, (count, 1))
        times = _bytes(rows.times.astype('<i8'), count)
        for start, end, (_, size), values in zip(
            self._starts, self._ends, self._messages, numbers, strict=True
        ):
            data[:, start + DATA_AT - 16 : start + DATA_AT - 8] = times
            data[:, start + DATA_AT - 8 : start + DATA_AT] = times
            data[:, end - size : end] = _bytes(values, count)
        if self._bag.takes_chunks:
            shift = np.arange(count)[:, np.newaxis] * self._template.size
            self._bag.write_chunk(data.reshape(-1), Records(
                np.repeat(rows.times, len(self._ids)), np.tile(self._ids, count),
                (shift + self._starts).reshape(-1), (shift + self._ends).reshape(-1),
            ))  # fmt: skip
            return
        text, width = data.tobytes(), self._template.size
        places = list(zip(self._starts.tolist(), self._ends.tolist(), strict=True))
        self._bag.write_many(
            self._ids.tolist() * count,
            np.repeat(rows.times, len(self._ids)).tolist(),
            [
                text[at + start + DATA_AT : at + end]
                for at in range(0, count * width, width)
                for start, end in places
            ],
        )

    def close(self) -> None:
        """Leave the bag open: it is its owner's."""


def _bytes(values: NDArray, count: int) -> NDArray[np.uint8]:
    """Return the bytes of each row."""
    rows = np.ascontiguousarray(values).reshape(count, -1)
    return rows.view(np.uint8).reshape(count, -1)
