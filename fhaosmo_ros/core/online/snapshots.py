# SPDX-License-Identifier: Apache-2.0
"""
What an estimator remembers as named numbers, and these as one labelled vector for a topic.

The label of a number is its name, that of an array has the shape behind it, such as ``z_hat:4`` or
``covariance:4x4``. Integers of 64 bits (stamps) do not fit into a double: such a one, labelled
``stamp:integer``, has two entries, its upper and its lower half.
"""

from collections.abc import Mapping, Sequence
from enum import IntFlag
import math
from numbers import Integral
from typing import Any, NamedTuple

from fhaosmo_ros.core.observer.numbers import checked
from fhaosmo_ros.core.parameters.errors import ConfigurationError
import numpy as np
from numpy.typing import ArrayLike, NDArray

VERSION = 13
"""Of the names."""
HALF = 2**32
INTEGER = 'integer'


class Flag(IntFlag):
    """What happened at the sample of a snapshot."""

    STARTED = 1  # the estimator was reset before it, or it is the first one
    CHANGED = 2  # parameters changed after it
    RESET = 4  # the estimator was reset after it


class Snapshot(NamedTuple):
    """What an estimator remembers after a sample."""

    stamp: int  # of the sample, in nanoseconds
    flags: Flag
    values: dict[str, Any]  # as `OnlineEstimator.state_dict` returns them


def pack(flags: Flag, values: Mapping[str, Any]) -> tuple[list[str], NDArray[np.float64]]:
    """Return a snapshot as labels and a vector; the first entry is the version."""
    labels, parts = [], []
    for name, value in {**values, 'version': float(VERSION), 'flags': int(flags)}.items():
        whole = isinstance(value, Integral)
        shape = INTEGER if whole else 'x'.join(map(str, np.shape(value)))
        labels.append(f'{name}:{shape}' if shape else name)
        parts.append(np.ravel(divmod(int(value), HALF) if whole else value))
    return labels, np.concatenate(parts, dtype=np.float64)


def unpack(vector: ArrayLike, labels: Sequence[str]) -> Snapshot:
    """
    Return the snapshot in a vector.

    Raises
    ------
    ConfigurationError
        The entries are not those of an estimator of this version.

    """
    entries = np.ravel(np.asarray(vector, dtype=np.float64))
    values: dict[str, Any] = {}
    begin = 0
    try:
        for label in labels:
            name, _, shape = label.partition(':')
            sizes = [2] if shape == INTEGER else [int(size) for size in shape.split('x') if size]
            begin, first = begin + math.prod(sizes), begin
            values[name] = entries[first:begin].reshape(sizes)
            if shape == INTEGER:
                upper, lower = map(int, values[name])
                values[name] = upper * HALF + lower
    except (OverflowError, ValueError) as error:
        raise ConfigurationError(
            f'snapshot: expected numbers and whole arrays ({error})'
        ) from None
    if begin != entries.size or len(values) != len(labels):
        raise ConfigurationError(
            f'snapshot: expected {begin} entries of {len(labels)} names, got {entries.size} of '
            f'{len(values)}'
        )
    version = values.pop('version', math.nan)
    if not np.array_equal(version, VERSION):
        raise ConfigurationError(f'snapshot: expected version {VERSION}, got version {version}')
    head = checked(values, {'flags': 0, 'stamp': 0})
    flags = Flag(head['flags'] & 7)
    return Snapshot(head['stamp'], flags, {**values, 'version': VERSION})
