# SPDX-License-Identifier: Apache-2.0
"""Where replayed estimates go: a bag, a CSV or an NPZ file, block by block."""

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
import csv
from pathlib import Path
from typing import Any, NamedTuple

from fhaosmo_ros import topics
from fhaosmo_ros.core.observer.estimates import Trajectory, TUNING
from fhaosmo_ros.core.observer.observer import Observer
from fhaosmo_ros.core.online.events import described, Event
from fhaosmo_ros.core.parameters.files import dumps
from fhaosmo_ros.core.parameters.units import derivative_unit
from fhaosmo_ros.tools.bags import types
from fhaosmo_ros.tools.bags.reader import BagReader
from fhaosmo_ros.tools.bags.writer import BagWriter
import numpy as np
from numpy.typing import NDArray


class Rows(NamedTuple):
    """Estimates of accepted samples."""

    times: NDArray[np.int64]  # (K,) stamps of the samples in the bag, in nanoseconds
    y: NDArray[np.float64]  # (K,)
    estimates: Trajectory  # `t` in nanoseconds
    active: NDArray[np.int8]  # (K,) 1 while an event lasts; empty where none are asked for
    events: list[tuple[int, Event]]  # those that begin or end, with their stamps in the bag


Sink = Callable[[Rows], None]
"""Takes estimates block by block."""


def columns(rows: Rows) -> dict[str, NDArray]:
    """Return one array for each column of a table of estimates."""
    e = rows.estimates
    states = {f'z{i + 1}': column for i, column in enumerate(e.z.T)}
    result = {'stamp_ns': e.t, 'bag_time_ns': rows.times, 'y': rows.y, **states}
    result |= {'unknown_input': e.unknown_input, 'gamma': e.gamma}
    result |= {f'eps{i + 1}': column for i, column in enumerate(e.innovation.T)}
    # With fixed gains these two have no columns.
    names = [f'std_{name}' for name in (*states, 'unknown_input')]
    result |= zip(names, e.standard_deviation.T, strict=False)
    result |= zip([f'tuning_{name}' for name in TUNING], e.tuning.T, strict=False)
    if len(rows.active):
        result['event'] = rows.active.astype(np.int64)
    return result | {'status': e.status, 'open_levels': e.open_levels}


@contextmanager
def csv_sink(path: Path, *_: object) -> Iterator[Sink]:
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
def npz_sink(path: Path, *_: object) -> Iterator[Sink]:
    """Write arrays by name."""
    blocks: list[dict[str, NDArray]] = []
    yield lambda rows: blocks.append(columns(rows))
    names = blocks[0] if blocks else ()
    np.savez(path, **{name: np.concatenate([b[name] for b in blocks]) for name in names})


TABLES = {'.csv': csv_sink, '.npz': npz_sink}
"""Sinks that open a file, by its suffix; they take what follows the path in `bag_sink`, too."""


@contextmanager
def bag_sink(
    path: Path,
    reader: BagReader,
    name: str,
    observer: Observer,
    parameters: Mapping[str, Any],
    begin: int,
) -> Iterator[Sink]:
    """
    Write a bag: a copy of another one, and the estimator's topics with a message for every sample.

    The topics go below `name`; the parameters are written at the time `begin` (ns), as the node
    publishes them. All messages of a topic have the same length. So they are made a block at a
    time: the bytes of one, and behind them each sample's numbers.
    """
    unit = derivative_unit(parameters['measurement_unit'], observer.order)
    state = [f'z{i + 1}' for i in range(observer.order)]
    labels = {
        'state': state, 'innovation': [f'eps{i + 1}' for i in range(observer.levels)],
        topics.STANDARD_DEVIATION: [*state, 'd'], 'tuning': TUNING,
    }  # fmt: skip
    empty = {}
    with BagWriter(path) as bag:
        bag.add(f'{name}/{topics.PARAMETERS}', topics.TEXT, qos=[types.LATCHED_QOS])
        text = types.serialise(topics.TEXT, data=dumps(parameters, name))
        bag.write(f'{name}/{topics.PARAMETERS}', begin, text)
        for topic, kind in topics.estimates_of(parameters).items():
            bag.add(f'{name}/{topic}', kind)
            if kind == topics.ARRAY:
                empty[topic] = types.labelled_array(labels[topic], np.zeros(len(labels[topic])))
            else:
                fields = {'sec': 0, 'nanosec': 0} if kind == topics.TIME else {'data': 0.0}
                empty[topic] = types.serialise(kind, **fields)
        bag.copy(reader)

        def write(rows: Rows) -> None:
            e = rows.estimates
            stamps = np.column_stack(np.divmod(e.t, 1_000_000_000)).astype('<i4')
            found = {**e._asdict(), 'state': e.z, 'stamp': stamps}  # others have their own names
            for topic, message in empty.items():
                bag.write_column(f'{name}/{topic}', rows.times, message, found[topic])
            for time, event in rows.events:
                bag.add(f'{name}/{topics.EVENT}', topics.DIAGNOSTICS, qos=[types.LATCHED_QOS])
                status = f'{name.lstrip("/")}: event'
                message = types.diagnostics(
                    event.stamp, event.begins, status, *described(event, unit)
                )
                bag.write(f'{name}/{topics.EVENT}', time, message)

        yield write
