# SPDX-License-Identifier: Apache-2.0
"""
An estimator's whole state as one labelled vector: enough to go on exactly where it was.

| entries | |
|---|---|
| flags | `Flag`: why there is a snapshot |
| sec, nanosec | stamp of the sample that the state follows; exact, each in a double of its own |
| intervals, interval, jitter | `OnlineEstimator.timing` |
| levels | `layout`'s level array, row by row |
| memory | `layout`'s array beside it |
"""

from enum import IntFlag
from typing import NamedTuple

from fhaosmo_ros.core import layout
from fhaosmo_ros.core.observer import ObserverState
import numpy as np
from numpy.typing import ArrayLike, NDArray

SECOND = 1_000_000_000
HEAD = ['flags', 'sec', 'nanosec', 'intervals', 'interval', 'jitter']
ROW_NAMES = ['z_hat', 'z_tilde', 'z_hat_sensitivity', 'z_tilde_sensitivity']
MEMORY_NAMES = ['gamma', 'y', 'pending']


class Flag(IntFlag):
    """What happened at the sample of a snapshot."""

    STARTED = 1
    """The observer started from this sample."""
    CHANGED = 2
    """It is the first sample taken with parameters, or a freeze, that were changed live."""
    FROZEN = 4
    """gamma is held."""


class Snapshot(NamedTuple):
    """
    The state after a sample.

    Attributes
    ----------
    stamp : int
        Stamp of the sample, in nanoseconds.
    flags : Flag
    timing : (3,) array
        See `OnlineEstimator.timing`.
    state : ObserverState

    """

    stamp: int
    flags: Flag
    timing: NDArray[np.float64]
    state: ObserverState


def labels(levels: int) -> list[str]:
    """Return a name for each entry of the vector of an observer with that many levels."""
    rows = [f'{row}{i + 1}' for row in ROW_NAMES for i in range(levels)]
    return [*HEAD, *rows, *MEMORY_NAMES]


def pack(snapshot: Snapshot) -> NDArray[np.float64]:
    """Return a snapshot as a vector."""
    head = [int(snapshot.flags), *divmod(snapshot.stamp, SECOND)]
    state = snapshot.state
    return np.concatenate([head, snapshot.timing, state.levels.ravel(), state.memory])


def unpack(vector: ArrayLike) -> Snapshot:
    """
    Return the snapshot in a vector.

    Raises
    ------
    ValueError
        Its length is that of no observer.

    """
    v = np.asarray(vector, dtype=np.float64)
    levels = v[len(HEAD) : len(v) - layout.SCALARS]
    if v.ndim != 1 or not len(levels) or len(levels) % layout.ROWS:
        raise ValueError(f'a snapshot can not have {v.size} entries')
    state = ObserverState(levels.reshape(layout.ROWS, -1).copy(), v[-layout.SCALARS :].copy())
    stamp = int(v[1]) * SECOND + int(v[2])
    return Snapshot(stamp, Flag(int(v[0])), v[3 : len(HEAD)].copy(), state)
