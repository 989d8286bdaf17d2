# SPDX-License-Identifier: Apache-2.0
"""
What an estimator remembers as named numbers, and these as one labelled vector for a topic.

In the vector an array has one entry for each of its numbers, labelled by the array's name and its
index from 1 on, such as ``z_hat1`` or ``covariance1_2``. Integers of 64 bits (stamps) do not fit
into a double: each has two entries, its upper and its lower half.
"""

from collections.abc import Mapping, Sequence
from enum import IntFlag
from functools import lru_cache
from numbers import Integral
import re
from typing import Any, NamedTuple

from fhaosmo_ros.core.parameters.errors import ConfigurationError
import numpy as np
from numpy.typing import ArrayLike, NDArray

VERSION = 8
"""Of the names."""
HEAD = ['version', 'flags', 'sec', 'nanosec']
HALF = 2**32
SECOND = 1_000_000_000
HALVES = ['_upper', '_lower']
LABEL = re.compile(r'(.*?)(_upper|_lower|\d+(?:_\d+)*|)', re.DOTALL)


class Flag(IntFlag):
    """What happened at the sample of a snapshot."""

    STARTED = 1
    """The estimator was reset before this sample, or it is the first one."""
    CHANGED = 2
    """Parameters changed after it."""
    RESET = 4
    """The estimator was reset after it."""


class Snapshot(NamedTuple):
    """What an estimator remembers after a sample."""

    stamp: int  # of the sample, in nanoseconds
    flags: Flag
    values: dict[str, Any]  # as `OnlineEstimator.state_dict` returns them


def pack(snapshot: Snapshot) -> tuple[list[str], NDArray[np.float64]]:
    """Return a snapshot as labels and a vector; the first entry is the version."""
    values = {name: value for name, value in snapshot.values.items() if name != 'version'}
    head = [VERSION, int(snapshot.flags), *divmod(snapshot.stamp, SECOND)]
    parts = [
        np.ravel(divmod(int(value), HALF) if isinstance(value, Integral) else value)
        for value in values.values()
    ]
    return HEAD + _labels(values), np.concatenate([head, *parts], dtype=np.float64)


def _labels(values: Mapping[str, Any]) -> list[str]:
    """Return a label for each entry of named numbers."""
    return _labels_of(tuple((k, np.shape(v), isinstance(v, Integral)) for k, v in values.items()))


@lru_cache(maxsize=64)
def _labels_of(shapes: tuple[tuple[str, tuple[int, ...], bool], ...]) -> list[str]:
    labels = []
    for name, shape, whole in shapes:
        ends = ('_'.join(str(k + 1) for k in index) for index in np.ndindex(shape))
        labels += [name + end for end in (HALVES if whole else ends)]
    return labels


def unpack(vector: ArrayLike, labels: Sequence[str]) -> Snapshot:
    """
    Return the snapshot in a vector.

    Raises
    ------
    ConfigurationError
        The entries are not those of an estimator of this version.

    """
    v = np.asarray(vector, dtype=np.float64)
    if v.shape != (len(labels),) or len(set(labels)) < len(labels):
        raise ConfigurationError(
            f'snapshot: expected entries of as many names, got {v.size} of {len(set(labels))}'
        )
    entries = dict(zip(labels, v.tolist(), strict=True))
    version, *head = (entries.pop(name, np.nan) for name in HEAD)
    if version != VERSION or not np.all(np.abs(head) < HALF):
        raise ConfigurationError(
            f'snapshot: expected version {VERSION}, and a stamp, got version {version:g}'
        )
    flags, second, nanosecond = map(int, head)
    parts: dict[str, dict[str, float]] = {}
    for label, number in entries.items():
        name, end = LABEL.fullmatch(label).groups()  # type: ignore[union-attr]  # all match
        parts.setdefault(name, {})[end] = number
    try:
        values = {name: _value(list(part), list(part.values())) for name, part in parts.items()}
    except (OverflowError, ValueError) as error:
        raise ConfigurationError(
            f'snapshot: expected numbers and whole arrays ({error})'
        ) from None
    if _labels(values) != list(entries):
        raise ConfigurationError('snapshot: expected all entries of each array, in their order')
    return Snapshot(second * SECOND + nanosecond, Flag(flags & 7), {'version': VERSION, **values})


def _value(ends: list[str], numbers: list[float]) -> Any:
    """Return what the entries of one name are, by the ends of their labels."""
    if ends == ['']:
        return numbers[0]
    if ends == HALVES:
        return int(numbers[0]) * HALF + int(numbers[1])
    return np.reshape(numbers, [int(k) for k in ends[-1].split('_')])
