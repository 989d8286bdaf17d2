# SPDX-License-Identifier: Apache-2.0
"""Where replayed estimates go: a bag, a CSV or an NPZ file, block by block."""

from collections.abc import Mapping
from itertools import groupby
from pathlib import Path
import shutil
from typing import Any, NamedTuple, Protocol
import zipfile

from fhaosmo_ros.core.observer.estimates import Trajectory
from fhaosmo_ros.core.observer.self_tuning.members import TUNING
from fhaosmo_ros.core.online.events import described, Event
from fhaosmo_ros.core.parameters.files import dumps
from fhaosmo_ros.core.parameters.units import derivative_unit
from fhaosmo_ros.tools.bags.mcap.chunks import DATA_AT, MESSAGE, Records
from fhaosmo_ros.tools.bags.types import diagnostics, labelled_array, LATCHED_QOS, serialise
from fhaosmo_ros.tools.bags.writer import BagWriter
from fhaosmo_ros.topics import (
    DIAGNOSTICS,
    ESTIMATES,
    EVENT,
    FLOAT,
    PARAMETERS,
    SELF_TUNED,
    TEXT,
    TIME,
)
import numpy as np
from numpy.typing import NDArray

try:
    import orjson
except ModuleNotFoundError:  # rosdep has no key for it; without it, CSV takes longer
    orjson = None


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
    active : (K,) array of int
        1 while an event lasts; empty where none are asked for.
    events : list of (int, Event)
        Those that begin or end, with their stamps in the bag.

    """

    times: NDArray[np.int64]
    y: NDArray[np.float64]
    estimates: Trajectory
    active: NDArray[np.int64]
    events: list[tuple[int, Event]]


class Sink(Protocol):
    """A kind of output that takes estimates block by block."""

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
    if e.standard_deviation.shape[1]:
        names = [*(f'z{i + 1}' for i in range(e.z.shape[1])), 'unknown_input']
        result |= {f'std_{name}': e.standard_deviation[:, i] for i, name in enumerate(names)}
        result |= {f'tuning_{name}': e.tuning[:, i] for i, name in enumerate(TUNING)}
    if len(rows.active):
        result['event'] = rows.active
    return result | {'status': e.status, 'open_levels': e.open_levels}


class CsvSink:
    """A table with a header line; its numbers read back as the same doubles."""

    def __init__(self, path: Path) -> None:
        self._file = path.open('wb')
        self._began = False

    def write(self, rows: Rows) -> None:
        """Append a line for each sample."""
        table = columns(rows)
        if not self._began:
            self._file.write(','.join(table).encode() + b'\n')
            self._began = True
        # Neighbouring columns of one type are formatted together: fewer pieces a line are faster.
        groups = [list(group) for _, group in groupby(table.values(), lambda c: c.dtype)]
        pieces = [_lines(np.column_stack(group)) for group in groups]
        self._file.write(b'\n'.join(map(b','.join, zip(*pieces, strict=True))) + b'\n')

    def close(self) -> None:
        """Complete the file."""
        self._file.close()


def _lines(array: NDArray) -> list[bytes]:
    """Return the rows of an array: numbers in their shortest form, separated by commas."""
    if orjson is None or not np.isfinite(array).all():  # JSON has no infinity
        return [','.join(map(repr, row)).encode() for row in array.tolist()]
    text = orjson.dumps(np.ascontiguousarray(array), option=orjson.OPT_SERIALIZE_NUMPY)
    return text[2:-2].split(b'],[')  # JSON: [[1.0,2.0],[3.0,4.0]]


class NpzSink:
    """Arrays by name; until it is closed, each grows in a file of its own, not in memory."""

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
    The estimator's topics in an open bag: a message on each for every sample.

    rosbags writes about 160,000 messages a second: 30 microseconds for the five of a sample. All
    messages of a topic have the same length, so the records of one sample are made once, and
    copied for each sample with its stamp and its numbers.

    Parameters
    ----------
    bag : BagWriter
    name : str
        Name below which the topics go.
    order, levels : int
        Numbers of states and of innovations.
    parameters : mapping
        Parameters of the estimates; written once, as the node publishes them.

    """

    def __init__(
        self, bag: BagWriter, name: str, order: int, levels: int, parameters: Mapping[str, Any]
    ) -> None:
        self._bag = bag
        self._parameters = f'{name}/{PARAMETERS}', dumps(parameters, name)
        bag.add(self._parameters[0], TEXT, qos=[LATCHED_QOS])
        self._has_parameters = False
        self._name = name
        self._unit = derivative_unit(parameters.get('measurement_unit', ''), order)
        self._events = ''
        tuned = parameters['gains'] == 'self_tuning'
        topics = ESTIMATES | (SELF_TUNED if tuned else {})
        ids = [bag.add(f'{name}/{topic}', kind) for topic, kind in topics.items()]
        state = [f'z{i + 1}' for i in range(order)]
        innovation = [f'eps{i + 1}' for i in range(levels)]
        number = serialise(FLOAT, data=0.0)
        # Each message, and how many bytes at its end are the numbers.
        self._messages = [
            (labelled_array(state, np.zeros(order)), 8 * order),
            (number, 8),
            (number, 8),
            (labelled_array(innovation, np.zeros(levels)), 8 * levels),
            (serialise(TIME, sec=0, nanosec=0), 8),
        ]
        if tuned:
            for labels in [*state, 'd'], TUNING:
                message = labelled_array(labels, np.zeros(len(labels)))
                self._messages.append((message, 8 * len(labels)))
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
        """Append the messages of each sample, and those of events."""
        self._write_estimates(rows)
        for time, event in rows.events:
            if not self._events:
                self._events = f'{self._name}/{EVENT}'
                self._bag.add(self._events, DIAGNOSTICS, qos=[LATCHED_QOS])
            text, values = described(event, self._unit)
            name = f'{self._name.lstrip("/")}: event'
            self._bag.write(
                self._events, time, diagnostics(event.stamp, event.begins, name, text, values)
            )

    def _write_estimates(self, rows: Rows) -> None:
        if not self._has_parameters:
            topic, text = self._parameters
            self._bag.write(topic, int(rows.times[0]), serialise(TEXT, data=text))
            self._has_parameters = True
        e = rows.estimates
        seconds, rest = np.divmod(e.t, 1_000_000_000)
        numbers = [
            e.z,
            e.unknown_input,
            e.gamma,
            e.innovation,
            np.column_stack([seconds, rest]).astype('<i4'),
        ]
        if e.standard_deviation.shape[1]:
            numbers += [e.standard_deviation, e.tuning]
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
            self._bag.write_chunk(
                data.reshape(-1),
                Records(
                    np.repeat(rows.times, len(self._ids)),
                    np.tile(self._ids, count),
                    (shift + self._starts).reshape(-1),
                    (shift + self._ends).reshape(-1),
                ),
            )
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
        """Do nothing: who opened the bag closes it."""


def _bytes(values: NDArray, count: int) -> NDArray[np.uint8]:
    """Return the bytes of each row."""
    rows = np.ascontiguousarray(values).reshape(count, -1)
    return rows.view(np.uint8).reshape(count, -1)
