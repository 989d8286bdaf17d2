# SPDX-License-Identifier: Apache-2.0
"""
All that an estimator remembers beside its observer's state: one layout, and snapshots of it.

`Policy` holds an array of integers and one of floating-point numbers. Times are in nanoseconds.
``ints`` begins with the settings, goes on with what is remembered, and ends with the counters in
the order of `Counters`. ``reals`` ends with two copies of an observer's state (levels, then
memory): a fresh one, and the one before the latest bridged gap.

A snapshot is one labelled vector, enough to go on exactly where the estimator was. Integers of 64
bits (stamps) do not fit into a double: each stands in two, its upper and its lower half.
"""

from collections.abc import Sequence
from enum import IntFlag
from typing import NamedTuple

from fhaosmo_ros.core.model.bytecode import Floats, Ints
from fhaosmo_ros.core.observer import arrays
from fhaosmo_ros.core.online.counters import Counters
import numpy as np
from numpy.typing import ArrayLike, NDArray

# Settings
NOMINAL = 0  # 1: dt is PERIOD
CLOCK = 1  # 1: stamps are the node clock's at reception
PERIOD = 2
MAX_GAP = 3
MAX_STEP = 4  # 0: twice the mean interval
GATE_SAMPLES = 5
STUCK_TIME = 6
DIVERGENCE_TIME = 7
FROZEN = 8  # 1: gamma is held
# Remembered
VALID = 9  # 1: there is an estimate
STAMP = 10  # of the sample behind it
TIMED = 11  # 0: the next sample's stamp is of another clock
LATEST = 12  # time up to which the observer has been stepped
NOW = 13  # the clock that counts nominal periods
TICK = 14  # CLOCK: latest clock reading
TICK_LENGTH = 15  # from the reading before it
TICK_COUNT = 16  # samples at it
SPACING = 17  # of samples at one reading; 0: not known yet
PLACED = 18  # where the latest one was put
HELD = 19  # 1: a sample far away waits for the next one's word
HELD_STAMP = 20
BRIDGED = 21  # 1: the latest sample ended a bridged gap
BEFORE = 22  # LATEST before that gap
SPIKES = 23  # rejected by the gate, in a row
SEEN = 24  # time of the latest sample, used or not
CHANGED = 25  # since when y is what it is
STUCK = 26  # 1: it is stuck
LOST = 27  # 1: eps_1 is above epsilon, or steps fail
LOST_SINCE = 28
INTERVALS = 29  # number of intervals in the mean, up to WINDOW
NAMES = {v: k for k, v in dict(globals()).items() if k.isupper() and isinstance(v, int)}
"""Names of these integers by index: they label the entries of a snapshot."""
COUNTERS = 30
"""Index of the first counter."""

(
    ACCEPTED, REJECTED_MEASUREMENTS, REJECTED_SPIKES, REJECTED_STUCK_, REJECTED_STEPS,
    DUPLICATE_STAMPS, BACKWARD_STAMPS, ZERO_STAMPS, FAR_STAMPS, REJECTED_INPUTS,
    GAPS, SUB_STEPS, WITHDRAWN_GAPS, SPREAD_STAMPS, BURSTS, SPIKES_BELIEVED, STUCK_EVENTS,
    RESTARTS_FORWARD, RESTARTS_BACKWARD, DIVERGENCES,
) = range(COUNTERS, COUNTERS + len(Counters._fields))  # fmt: skip

GATE = 0
LIMIT = 1
EPSILON = 2
INTERVAL = 3  # running mean of dt, ns
JITTER = 4  # running mean of its deviation, ns
HELD_Y = 5
STATES = 6  # two copies of a state begin here


class Policy(NamedTuple):
    """
    Settings and memory of the policy.

    Attributes
    ----------
    ints : (NOMINAL .. DIVERGENCES,) array
    reals : (GATE .., two states) array

    """

    ints: Ints
    reals: Floats


class EstimatorArrays(NamedTuple):
    """All that one compiled estimator works on."""

    law: arrays.Law
    work: arrays.Work
    state: arrays.State
    policy: Policy


def make_policy(state: arrays.State) -> Policy:
    """Return the policy's arrays for an observer with such a state."""
    ints = np.zeros(COUNTERS + len(Counters._fields), dtype=np.int64)
    return Policy(ints, np.zeros(STATES + 2 * (state.levels.size + state.memory.size)))


HALF = 2**32
SECOND = 1_000_000_000
HEAD = ['flags', 'sec', 'nanosec']
INTEGERS = range(FROZEN, COUNTERS)
"""What of the policy's integers a snapshot holds: neither settings nor counters."""
LABELS_OF_REALS = ['interval', 'jitter', 'held_y']
LABELS_OF_ROWS = ['z_hat', 'z_tilde', 'z_hat_sensitivity', 'z_tilde_sensitivity']
LABELS_OF_MEMORY = [
    'gamma', 'y', 'pending', 'wait', 'scale', 'saturated', 'beyond', 'settled', 'period', 'spread',
]  # fmt: skip
"""Labels of a snapshot's entries: they are in bags, so they stay as they are."""
OLD_MEMORY = 4
"""Entries of the memory in snapshots that have no covariance and nothing after `wait`."""


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
        Of `Policy.ints`.
    reals : (3,) array
        Of `Policy.reals`.
    before, now : ((4 + N) N + 10,) arrays
        The observer's state (levels, then memory) before the latest bridged gap, and its state.
        Of an older version 4N + 4 numbers, without the covariance; see `completed`.
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
    integers = [f'{NAMES[k].lower()}_{half}' for k in INTEGERS for half in ('upper', 'lower')]
    rows = [f'{row}{i + 1}' for row in LABELS_OF_ROWS for i in range(levels)]
    rows += [f'covariance{i + 1}_{j + 1}' for i in range(levels) for j in range(levels)]
    state = [*rows, *LABELS_OF_MEMORY]
    before = (f'before_{name}' for name in state)
    return [*HEAD, *integers, *LABELS_OF_REALS, *before, *state, 'u']


def _levels(size: int) -> int:
    """Return the number of levels of a state of so many numbers, 0 if there is none."""
    for levels in range(1, 17):
        if size == (arrays.ROWS + levels) * levels + arrays.MEMORY:
            return levels
        if size == arrays.ROWS * levels + OLD_MEMORY:  # never that of a newer one: a multiple of 4
            return levels
    return 0


def completed(state: NDArray[np.float64], fresh: NDArray[np.float64]) -> NDArray[np.float64]:
    """
    Return an observer's state as this version remembers it.

    Parameters
    ----------
    state : array
        As in `Memory`, of this version or an older one.
    fresh : array
        That of a fresh observer, which has what an older version did not remember.

    """
    levels = arrays.ROWS * _levels(len(fresh))
    if len(state) != levels + OLD_MEMORY:
        return state
    result = fresh.copy()
    result[:levels] = state[:levels]
    begin = len(fresh) - arrays.MEMORY
    result[begin : begin + OLD_MEMORY] = state[levels:]
    return result


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
    begin = len(HEAD) + halves + len(LABELS_OF_REALS)
    size, odd = divmod(len(v) - begin - 1, 2)
    if v.ndim != 1 or odd or not _levels(size):
        raise ValueError(f'a snapshot can not have {v.size} entries')
    upper, lower = v[len(HEAD) : len(HEAD) + halves].reshape(-1, 2).T
    integers = upper.astype(np.int64) * HALF + lower.astype(np.int64)
    memory = Memory(
        integers, v[begin - len(LABELS_OF_REALS) : begin].copy(), v[begin : begin + size].copy(),
        v[begin + size : begin + 2 * size].copy(), float(v[-1]),
    )  # fmt: skip
    return Snapshot(int(v[1]) * SECOND + int(v[2]), Flag(int(v[0])), memory)
