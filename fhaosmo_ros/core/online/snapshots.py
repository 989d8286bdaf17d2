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
import math
from numbers import Integral
import re
from typing import Any, NamedTuple

from fhaosmo_ros.core.parameters.errors import ConfigurationError
import numpy as np
from numpy.typing import ArrayLike, NDArray

VERSION = 4
"""Of the names."""
HEAD = ['version', 'flags', 'sec', 'nanosec']
HALF = 2**32
SECOND = 1_000_000_000
INDEX = re.compile(r'(.*?)(\d{1,6}(?:_\d{1,6})*)')


class Flag(IntFlag):
    """What happened at the sample of a snapshot."""

    STARTED = 1
    """The estimator was reset before this sample, or it is the first one."""
    CHANGED = 2
    """Parameters changed after it."""
    RESET = 4
    """The estimator was reset after it."""


class Snapshot(NamedTuple):
    """
    What an estimator remembers after a sample.

    Attributes
    ----------
    stamp : int
        Stamp of the sample, in nanoseconds.
    flags : Flag
    values : dict
        As `OnlineEstimator.state_dict` returns them.

    """

    stamp: int
    flags: Flag
    values: dict[str, Any]


def pack(snapshot: Snapshot) -> tuple[list[str], NDArray[np.float64]]:
    """Return a snapshot as labels and a vector; the first entry is the version."""
    values = {name: value for name, value in snapshot.values.items() if name != 'version'}
    head = [VERSION, int(snapshot.flags), *divmod(snapshot.stamp, SECOND)]
    whole = [isinstance(value, Integral) for value in values.values()]
    parts = [
        np.ravel(divmod(int(value), HALF) if is_whole else value)
        for value, is_whole in zip(values.values(), whole, strict=True)
    ]
    shapes = tuple(zip(values, map(np.shape, values.values()), whole, strict=True))
    return _labels(shapes), np.concatenate([head, *parts], dtype=np.float64)


@lru_cache(maxsize=64)
def _labels(shapes: tuple[tuple[str, tuple[int, ...], bool], ...]) -> list[str]:
    """Return a label for each entry of numbers with these names and shapes, integers or not."""
    labels = list(HEAD)
    for name, shape, whole in shapes:
        ends = ('_'.join(str(k + 1) for k in index) for index in np.ndindex(shape))
        labels += [name + end for end in (('_upper', '_lower') if whole else ends)]
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
    values = {'version': VERSION, **_values(entries)}
    return Snapshot(second * SECOND + nanosecond, Flag(flags & 7), values)


def _values(entries: Mapping[str, float]) -> dict[str, Any]:
    """Return numbers and arrays by name."""
    values: dict[str, Any] = {}
    parts: dict[str, dict[tuple[int, ...], float]] = {}
    for label, number in entries.items():
        name, _, half = label.rpartition('_')
        match = INDEX.fullmatch(label)
        if half in ('upper', 'lower') and {f'{name}_upper', f'{name}_lower'} <= entries.keys():
            upper, lower = entries[f'{name}_upper'], entries[f'{name}_lower']
            if not (abs(upper) <= HALF and 0.0 <= lower < HALF):
                raise ConfigurationError(f"snapshot: '{name}': expected an integer")
            values[name] = int(upper) * HALF + int(lower)
        elif match is None:
            values[label] = number
        else:
            place = tuple(int(k) - 1 for k in match[2].split('_'))
            parts.setdefault(match[1], {})[place] = number
    for name, part in parts.items():
        shape = tuple(1 + max(places) for places in zip(*part, strict=False))
        if math.prod(shape) != len(part) or sorted(part) != list(np.ndindex(shape)):
            raise ConfigurationError(f"snapshot: '{name}': expected all entries of an array")
        values[name] = np.array([part[place] for place in sorted(part)]).reshape(shape)
    return values
