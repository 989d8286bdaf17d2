# SPDX-License-Identifier: Apache-2.0
"""Where replayed estimates go: a bag, a CSV or an NPZ file, block by block."""

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
import csv
from pathlib import Path
from typing import Any, NamedTuple

from fhaosmo_ros.core.observer.estimates import Trajectory, TUNING
from fhaosmo_ros.core.online.events import described, Event
from fhaosmo_ros.core.parameters.files import dumps
from fhaosmo_ros.core.parameters.units import derivative_unit
from fhaosmo_ros.tools.bags.types import (
    diagnostics,
    labelled_array,
    LATCHED_QOS,
    serialise,
    with_numbers,
)
from fhaosmo_ros.tools.bags.writer import BagWriter
from fhaosmo_ros.topics import (
    ARRAY,
    DIAGNOSTICS,
    estimates_of,
    EVENT,
    FLOAT,
    PARAMETERS,
    STANDARD_DEVIATION,
    TEXT,
    TIME,
)
import numpy as np
from numpy.typing import NDArray


class Rows(NamedTuple):
    """Estimates of accepted samples."""

    times: NDArray[np.int64]  # (K,) stamps of the samples in the bag, in nanoseconds
    y: NDArray[np.float64]  # (K,)
    estimates: Trajectory  # `t` holds the stamps that dt came from, in nanoseconds
    active: NDArray[np.int64]  # (K,) 1 while an event lasts; empty where none are asked for
    events: list[tuple[int, Event]]  # those that begin or end, with their stamps in the bag


Sink = Callable[[Rows], None]
"""Takes estimates block by block."""


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


@contextmanager
def csv_sink(path: Path) -> Iterator[Sink]:
    """Write a table with a header line; its numbers read back as the same doubles."""
    with path.open('w', encoding='utf-8', newline='') as file:
        writer = csv.writer(file, lineterminator='\n')

        def write(rows: Rows) -> None:
            table = columns(rows)
            if not file.tell():
                writer.writerow(table)
            writer.writerows(zip(*(c.tolist() for c in table.values()), strict=True))

        yield write


@contextmanager
def npz_sink(path: Path) -> Iterator[Sink]:
    """Write arrays by name."""
    blocks: list[dict[str, NDArray]] = []
    yield lambda rows: blocks.append(columns(rows))
    names = blocks[0] if blocks else ()
    np.savez(path, **{name: np.concatenate([b[name] for b in blocks]) for name in names})


TABLES = {'.csv': csv_sink, '.npz': npz_sink}
"""Sinks that open a file, by its suffix."""


class BagSink:
    """
    The estimator's topics in an open bag: a message on each for every sample.

    All messages of a topic have the same length. So they are made a block at a time: the bytes of
    one, and behind them each sample's numbers.

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
        self._bag, self._name, self._order = bag, name, order
        self._parameters = dumps(parameters, name)
        self._has_parameters = False
        self._unit = derivative_unit(parameters.get('measurement_unit', ''), order)
        state = [f'z{i + 1}' for i in range(order)]
        labels = {
            'state': state, 'innovation': [f'eps{i + 1}' for i in range(levels)],
            STANDARD_DEVIATION: [*state, 'd'], 'tuning': TUNING,
        }  # fmt: skip
        empty = {
            FLOAT: lambda _: serialise(FLOAT, data=0.0),
            TIME: lambda _: serialise(TIME, sec=0, nanosec=0),
            ARRAY: lambda topic: labelled_array(labels[topic], np.zeros(len(labels[topic]))),
        }
        bag.add(f'{name}/{PARAMETERS}', TEXT, qos=[LATCHED_QOS])
        topics = estimates_of(parameters)
        for topic, kind in topics.items():
            bag.add(f'{name}/{topic}', kind)
        self._messages = {topic: empty[kind](topic) for topic, kind in topics.items()}

    def write(self, rows: Rows) -> None:
        """Append the messages of each sample, and those of events."""
        if not self._has_parameters:
            text = serialise(TEXT, data=self._parameters)
            self._bag.write(f'{self._name}/{PARAMETERS}', int(rows.times[0]), text)
            self._has_parameters = True
        e = rows.estimates
        stamp = np.column_stack(np.divmod(e.t, 1_000_000_000)).astype('<i4')
        numbers = {
            'gamma': e.gamma, STANDARD_DEVIATION: e.standard_deviation, 'tuning': e.tuning,
            'state': e.z, 'unknown_input': e.unknown_input, 'innovation': e.innovation,
            'stamp': stamp,
        }  # fmt: skip
        columns = [
            (f'{self._name}/{topic}', with_numbers(message, numbers[topic]))
            for topic, message in self._messages.items()
        ]
        self._bag.write_columns(rows.times, columns)
        for time, event in rows.events:
            topic = f'{self._name}/{EVENT}'
            self._bag.add(topic, DIAGNOSTICS, qos=[LATCHED_QOS])
            text, values = described(event, self._unit)
            name = f'{self._name.lstrip("/")}: event'
            message = diagnostics(event.stamp, event.begins, name, text, values)
            self._bag.write(topic, time, message)
