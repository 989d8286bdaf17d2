# SPDX-License-Identifier: Apache-2.0
"""
All that an estimator remembers as one labelled vector: enough to go on exactly where it was.

Integers of 64 bits (stamps) do not fit into a double: each stands in two, its upper and its lower
half.
"""

from collections.abc import Sequence
from enum import IntFlag
from typing import NamedTuple

from fhaosmo_ros.core import layout
from fhaosmo_ros.core import policy_layout as at
import numpy as np
from numpy.typing import ArrayLike, NDArray

HALF = 2**32
SECOND = 1_000_000_000
HEAD = ['flags', 'sec', 'nanosec']
INTEGERS = range(at.FROZEN, at.COUNTERS)
"""What of the policy's integers is remembered: neither settings nor counters."""
REALS = ['interval', 'jitter', 'held_y']
ROWS = ['z_hat', 'z_tilde', 'z_hat_sensitivity', 'z_tilde_sensitivity']
SCALARS = ['gamma', 'y', 'pending', 'wait']


class Flag(IntFlag):
    """What happened at the sample of a snapshot."""

    STARTED = 1
    """The estimator was reset before this sample, or it is the first one."""
    CHANGED = 2
    """Parameters changed after it."""
    RESET = 4
    """The estimator was reset after it."""


class Memory(NamedTuple):
    """
    What an estimator remembers.

    Attributes
    ----------
    integers : (len(INTEGERS),) array
        See `policy_layout`.
    reals : (3,) array
        See `policy_layout`.
    before, now : (4N + 3,) arrays
        The observer's state (levels, then memory) before the latest bridged gap, and its state.
    u : float
        Known input.

    """

    integers: NDArray[np.int64]
    reals: NDArray[np.float64]
    before: NDArray[np.float64]
    now: NDArray[np.float64]
    u: float


class Snapshot(NamedTuple):
    """
    What an estimator remembers after a sample.

    Attributes
    ----------
    stamp : int
        Stamp of the sample, in nanoseconds.
    flags : Flag
    memory : Memory

    """

    stamp: int
    flags: Flag
    memory: Memory


def labels(levels: int) -> list[str]:
    """Return a name for each entry of the vector of an observer with that many levels."""
    names = {value: name for name, value in vars(at).items() if name.isupper()
             and isinstance(value, int) and value in INTEGERS}  # fmt: skip
    integers = [f'{names[k].lower()}_{half}' for k in INTEGERS for half in ('upper', 'lower')]
    rows = [f'{row}{i + 1}' for row in ROWS for i in range(levels)]
    state = [*rows, *SCALARS]
    return [*HEAD, *integers, *REALS, *(f'before_{name}' for name in state), *state, 'u']


def pack(snapshot: Snapshot) -> NDArray[np.float64]:
    """Return a snapshot as a vector."""
    memory = snapshot.memory
    halves = np.column_stack(np.divmod(memory.integers, HALF)).ravel()
    head: Sequence[int] = [int(snapshot.flags), *divmod(snapshot.stamp, SECOND)]
    return np.concatenate(
        [head, halves, memory.reals, memory.before, memory.now, [memory.u]], dtype=np.float64
    )


def unpack(vector: ArrayLike) -> Snapshot:
    """
    Return the snapshot in a vector.

    Raises
    ------
    ValueError
        Its length is that of no estimator.

    """
    v = np.asarray(vector, dtype=np.float64)
    halves = 2 * len(INTEGERS)
    begin = len(HEAD) + halves + len(REALS)
    size, odd = divmod(len(v) - begin - 1, 2)
    if v.ndim != 1 or odd or size <= layout.SCALARS or (size - layout.SCALARS) % layout.ROWS:
        raise ValueError(f'a snapshot can not have {v.size} entries')
    upper, lower = v[len(HEAD) : len(HEAD) + halves].reshape(-1, 2).T
    integers = upper.astype(np.int64) * HALF + lower.astype(np.int64)
    memory = Memory(
        integers, v[begin - len(REALS) : begin].copy(), v[begin : begin + size].copy(),
        v[begin + size : begin + 2 * size].copy(), float(v[-1]),
    )  # fmt: skip
    return Snapshot(int(v[1]) * SECOND + int(v[2]), Flag(int(v[0])), memory)
