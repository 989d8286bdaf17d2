# SPDX-License-Identifier: Apache-2.0
"""
Where each quantity of the policy lives: an array of integers and one of floating-point numbers.

Times are in nanoseconds. `ints` begins with the settings, goes on with what is remembered, and
ends with the counters in the order of `Counters`. `reals` ends with two copies of an observer's
state (levels, then memory): a fresh one, and the one before the latest bridged gap.
"""

from fhaosmo_ros.core.counters import Counters
from fhaosmo_ros.core.tape import Floats, Ints
import numpy as np

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
COUNTERS = 30

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


def make_policy(levels: int, memory: int) -> tuple[Ints, Floats]:
    """Return the arrays for an observer whose level array and memory have these sizes."""
    ints = np.zeros(COUNTERS + len(Counters._fields), dtype=np.int64)
    return ints, np.zeros(STATES + 2 * (levels + memory))
