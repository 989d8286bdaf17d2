# SPDX-License-Identifier: Apache-2.0
"""
All that an estimator remembers beside its observer's state: one layout, and snapshots of it.

`Policy` holds an array of integers and one of floating-point numbers. Times are in nanoseconds.
``ints`` begins with the settings, goes on with what is remembered, and ends with the counters in
the order of `Counters`. ``reals`` goes on with two copies of an observer's state (levels, then
memory), a fresh one and the one before the latest bridged gap, and ends with the past of the
known inputs where y is known later than they are (see delay.py).

A snapshot is one labelled vector, enough to go on exactly where the estimator was. Integers of 64
bits (stamps) do not fit into a double: each stands in two, its upper and its lower half.
"""

from collections.abc import Sequence
from enum import IntFlag
import re
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
DELAY = 8  # of y
LAG = 9  # how much later than the inputs y is known: measurement_delay - input_delay
TO_NOW = 10  # 1: estimates are carried over the delay
FILTERED = 11  # 1: estimates are z_hat
FROZEN = 12  # 1: gamma is held
# Remembered
VALID = 13  # 1: there is an estimate, of the time STAMP
STAMP = 14  # of the sample behind it
TIMED = 15  # 0: the next sample's stamp is of another clock
LATEST = 16  # time up to which the observer has been stepped
NOW = 17  # the clock that counts nominal periods
TICK = 18  # CLOCK: latest clock reading
TICK_LENGTH = 19  # from the reading before it
TICK_COUNT = 20  # samples at it
SPACING = 21  # of samples at one reading, in parts of a ns, see clock.py; 0: not known yet
PLACED = 22  # where the latest one was put
HELD = 23  # 1: a sample far away waits for the next one's word
HELD_STAMP = 24
BRIDGED = 25  # 1: the latest sample ended a bridged gap
BEFORE = 26  # LATEST before that gap
SPIKES = 27  # rejected by the gate, in a row
SEEN = 28  # time of the latest sample, used or not
CHANGED = 29  # since when y is what it is
STUCK = 30  # 1: it is stuck
LOST = 31  # 1: eps_1 is above epsilon, or steps fail
LOST_SINCE = 32
INTERVALS = 33  # number of intervals in the mean, up to WINDOW
EVENT = 34  # what the detector of events is doing, see events.py
EVENT_SINCE = 35  # since when; LATEST of the first sample of an event
EVENT_STAMP = 36  # the stamp of that sample
EVENT_TIME = 37  # LATEST of the sample it has taken last
PHASE = 38  # CLOCK: time of the first sample at that reading
TICKS = 39  # ticks that the line through them remembers; 0: no line; < 0: none for so long
DEVIATION = 40  # running mean of how far ticks are off it
PACE = 41  # interval of the times that follow the line, in the parts of SPACING
FITTED = 42  # latest tick that was on the line
REPEATS = 43  # samples in a row that repeat the one before
HELD_FOR = 44  # how many of them there usually are
REGULAR = 45  # evidence that y's sensor holds each value for so long
HOLDS = 46  # 1: it does
NAMES = {v: k for k, v in dict(globals()).items() if k.isupper() and isinstance(v, int)}
"""Names of these integers by index: they label the entries of a snapshot."""
COUNTERS = 47
"""Index of the first counter."""

(
    ACCEPTED, REJECTED_MEASUREMENTS, REJECTED_SPIKES, REJECTED_STUCK_, REJECTED_STEPS,
    DUPLICATE_STAMPS, BACKWARD_STAMPS, ZERO_STAMPS, FAR_STAMPS, REJECTED_INPUTS,
    GAPS, SUB_STEPS, WITHDRAWN_GAPS, SPREAD_STAMPS, BURSTS, SPIKES_BELIEVED, STUCK_EVENTS,
    RESTARTS_FORWARD, RESTARTS_BACKWARD, DIVERGENCES, JUMPS,
) = range(COUNTERS, COUNTERS + len(Counters._fields))  # fmt: skip

GATE = 0
LIMIT = 1
EPSILON = 2
INTERVAL = 3  # running mean of dt, ns
JITTER = 4  # running mean of its deviation, ns
HELD_Y = 5
EVENT_MEAN = 6  # running mean of d, for events of its change
EVENT_DEVIATION = 7  # standard deviation that events are judged by
SAMPLE = 8  # the latest y, used or not
CHANGE = 9  # by what it last differed from the one before
REPEATED = 10  # the y that has repeated itself last
ELSEWHERE = 11  # of the values of y, of late, the share that repeat themselves, another one each
STATES = 12  # two copies of a state begin here


class Policy(NamedTuple):
    """
    Settings and memory of the policy.

    Attributes
    ----------
    ints : (NOMINAL .. DIVERGENCES,) array
    reals : (GATE .., two states, past inputs) array

    """

    ints: Ints
    reals: Floats


class EstimatorArrays(NamedTuple):
    """All that one compiled estimator works on."""

    law: arrays.Law
    work: arrays.Work
    state: arrays.State
    policy: Policy


def make_policy(state: arrays.State, past: Floats) -> Policy:
    """Return the policy's arrays for such a state, and for the past of the inputs."""
    ints = np.zeros(COUNTERS + len(Counters._fields), dtype=np.int64)
    states = np.zeros(STATES + 2 * (state.levels.size + state.memory.size))
    return Policy(ints, np.concatenate([states, past]))


HALF = 2**32
SECOND = 1_000_000_000
HEAD = ['flags', 'sec', 'nanosec']
INTEGERS = range(FROZEN, COUNTERS)
"""What of the policy's integers a snapshot holds: neither settings nor counters."""
LABELS_OF_REALS = [
    'interval', 'jitter', 'held_y', 'event_mean', 'event_deviation', 'sample', 'change',
    'repeated', 'elsewhere',
]  # fmt: skip
LABELS_OF_ROWS = ['z_hat', 'z_tilde', 'z_hat_sensitivity', 'z_tilde_sensitivity']
LABELS_OF_MEMORY = [
    'gamma', 'y', 'pending', 'wait', 'scale', 'saturated', 'beyond', 'settled', 'period', 'spread',
    'upset', 'offset', 'jumps', 'first_miss', 'miss', 'watched', 'drift', 'usual', 'samples',
    'far_sign', 'quantum', 'lattice', 'moving', 'unsettled', 'steady_period', 'flow_period',
    'first_noise', 'likeliest', 'calm', 'growing', 'farthest', 'narrowed', 'one_sided',
    'recent', 'roughness', 'last_interval', 'stamp_jitter', 'turns', 'told', 'uneven',
    'first_rough', 'active', 'goes_back',
]  # fmt: skip
"""Labels of a snapshot's entries: they are in bags, so they stay as they are."""
MISSING = {'scale': 1.0, 'spread': 1.0, 'before_scale': 1.0, 'before_spread': 1.0}
"""What an older version did not remember and is not 0."""


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
    reals : (7,) array
        Of `Policy.reals`.
    before, now : ((4 + N) N + MEMORY,) arrays
        The observer's state (levels, then memory) before the latest bridged gap, and its state.
    u : (m,) array
        Known inputs.
    past : (P,) array
        Of the known inputs, see delay.py; empty where it does not matter.
    members : (M,) array
        Of a self-tuning observer; empty for another.

    """

    integers: NDArray[np.int64]
    reals: NDArray[np.float64]
    before: NDArray[np.float64]
    now: NDArray[np.float64]
    u: NDArray[np.float64]
    past: NDArray[np.float64]
    members: NDArray[np.float64]


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


def labels(
    levels: int, inputs: Sequence[str] = ('u',), past: int = 0, members: int = 0
) -> list[str]:
    """
    Return a name for each entry of the vector of an estimator.

    Parameters
    ----------
    levels : int
    inputs : sequence of str
        Names of the known inputs.
    past, members : int
        Lengths of `Memory.past` and `Memory.members`.

    """
    integers = [f'{NAMES[k].lower()}_{half}' for k in INTEGERS for half in ('upper', 'lower')]
    rows = [f'{row}{i + 1}' for row in LABELS_OF_ROWS for i in range(levels)]
    rows += [f'covariance{i + 1}_{j + 1}' for i in range(levels) for j in range(levels)]
    state = [*rows, *LABELS_OF_MEMORY]
    before = (f'before_{name}' for name in state)
    of_past = (f'past{k + 1}' for k in range(past))
    of_inputs = (name if name == 'u' else f'u_{name}' for name in inputs)
    of_members = (f'm{k + 1}' for k in range(members))
    known = [*HEAD, *integers, *LABELS_OF_REALS, *before, *state, *of_inputs, *of_past]
    return [*known, *of_members]


def pack(snapshot: Snapshot) -> NDArray[np.float64]:
    """Return a snapshot as a vector."""
    memory = snapshot.memory
    halves = np.column_stack(np.divmod(memory.integers, HALF)).ravel()
    head: Sequence[int] = [int(snapshot.flags), *divmod(snapshot.stamp, SECOND)]
    return np.concatenate(
        [head, halves, *memory[1:]],
        dtype=np.float64,
    )


def unpack(vector: ArrayLike, names: Sequence[str]) -> Snapshot:
    """
    Return the snapshot in a vector.

    Parameters
    ----------
    vector : (K,) array
    names : sequence of str
        Name of each entry, as `labels` returns them. What an older version did not remember, and
        so has no entry, is 0, or as in `MISSING`.

    Raises
    ------
    ValueError
        The entries are not those of an estimator of this version, or of an older one.

    """
    v = np.asarray(vector, dtype=np.float64)
    if v.shape != (len(names),):
        raise ValueError(f'a snapshot with {len(names)} names can not have {v.size} entries')
    entries = dict(zip(names, v.tolist(), strict=True))
    levels = sum(re.fullmatch('z_hat[0-9]+', name) is not None for name in names)
    inputs = [name.removeprefix('u_') for name in names if name == 'u' or name.startswith('u_')]
    past = sum(re.fullmatch('past[0-9]+', name) is not None for name in names)
    members = sum(re.fullmatch('m[0-9]+', name) is not None for name in names)
    known = labels(levels, inputs, past, members)
    allowed = set(known)
    unknown = [name for name in names if name not in allowed]
    if unknown or not levels or len(entries) < len(v):
        raise ValueError(f'a snapshot can not have the entries {", ".join(unknown) or names}')
    v = np.array([entries.get(name, MISSING.get(name, 0.0)) for name in known])
    size = (arrays.ROWS + levels) * levels + arrays.MEMORY
    counts = [len(HEAD), 2 * len(INTEGERS), len(LABELS_OF_REALS), size, size, len(inputs)]
    counts += [past, members]
    head, halves, reals, *rest = np.split(v, np.cumsum(counts)[:-1])
    upper, lower = halves.reshape(-1, 2).T
    integers = upper.astype(np.int64) * HALF + lower.astype(np.int64)
    memory = Memory(integers, reals, *rest)
    return Snapshot(int(head[1]) * SECOND + int(head[2]), Flag(int(head[0])), memory)
