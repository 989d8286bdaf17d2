# SPDX-License-Identifier: Apache-2.0
"""A bag made of a table of numbers, so that a CSV file is replayed as any recording."""

from collections.abc import Sequence
from pathlib import Path

from fhaosmo_ros.core.parameters.errors import ConfigurationError
from fhaosmo_ros.tools.bags.types import serialise
from fhaosmo_ros.tools.bags.writer import BagWriter
from fhaosmo_ros.topics import FLOAT
import numpy as np

DELIMITERS = ',;\t'
LATEST = 9.2e9
"""Seconds; the largest stamp in nanoseconds is a little more."""


def bag_of_table(path: Path, wanted: str, used: Sequence[str], bag: Path) -> None:
    """
    Write the samples of a CSV file to a new bag, each with the time in its line as its stamp.

    They are Float64 on /y, and on topics of the known inputs' names: where an estimator looks for
    them of whose inputs nothing is said.

    The file has lines of numbers with commas, semicolons, tabs or spaces between them; an empty
    cell is a missing sample. Titles may stand in the first line; without them the columns are 1,
    2, ... `wanted` are the titles, separated by commas, of the time in seconds, of y and of the
    known inputs `used`; empty for the first columns.
    """
    names = ['the time', 'y', *used]
    with path.open(encoding='utf-8-sig', errors='replace') as file:
        lines = [line for line in file if line.strip()]
    first = lines[0] if lines else ''
    delimiter = next((mark for mark in DELIMITERS if mark in first), None)
    titles = [cell.strip(' "\n') for cell in first.lstrip('# ').split(delimiter)]
    try:  # a line of numbers has no titles
        titles = [str(k + 1) for k, _ in enumerate(map(_number, titles))]
    except ValueError:
        del lines[0]
    if not lines:
        raise ConfigurationError(f'{path}: expected lines of numbers, got none')
    columns = [title.strip() for title in wanted.split(',') if title.strip()]
    columns = columns or titles[: len(names)]
    if len(columns) != len(names) or not set(columns) <= set(titles):
        raise ConfigurationError(
            f'--columns: expected {len(names)} titles of {path}, which are {", ".join(titles)}: '
            f'of {", ".join(names)}, got {", ".join(columns)}'
        )
    places = [titles.index(title) for title in columns]
    try:
        t, *numbers = np.loadtxt(
            lines, delimiter=delimiter, usecols=places, converters=_number, ndmin=2, unpack=True
        )
    except ValueError as error:
        raise ConfigurationError(f'{path}: expected lines of numbers: {error}') from None
    bad = np.flatnonzero(~((t >= 0.0) & (t <= LATEST)))
    if len(bad):
        raise ConfigurationError(
            f'{path}: expected times of 0 to {LATEST:g} s, got {t[bad[0]]} in sample {bad[0]}, '
            'counted from 0'
        )
    stamps = np.round(t * 1e9).astype(np.int64).clip(1)  # 0 is a stamp that nobody filled
    with BagWriter(bag) as writer:
        for name, values in zip(names[1:], numbers, strict=True):
            writer.add(f'/{name}', FLOAT)
            writer.write_column(f'/{name}', stamps, serialise(FLOAT, data=0.0), values)


def _number(text: str) -> float:
    return float(text) if text.strip() else np.nan
