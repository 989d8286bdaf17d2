# SPDX-License-Identifier: Apache-2.0
"""
What the compiled observer works on, and where each quantity lives.

Compiled functions take bundles of arrays: `Law` (a configuration), `Work` (scratch memory) and
`State` (what the observer remembers).

Rows of ``State.levels`` and ``Work.x``, column i - 1 for level i:

| row | symbol | unit |
|---|---|---|
| HAT | filtered estimate z_hat_i | of z_i |
| TILDE | internal state z_tilde_{i+1}; theta at the last level | of z_{i+1} |
| HAT_SENSITIVITY | p_i = d z_hat_i / d gamma; self-tuning: `MODEL` | of z_i |
| TILDE_SENSITIVITY | q_i = d z_tilde_{i+1} / d gamma | of z_{i+1} |
| COVARIANCE .. | covariance P of the errors, N rows; not used without `noise_size` | product |

Entries of ``State.memory``:

| index | symbol | unit |
|---|---|---|
| GAMMA | adaptive power gamma | 1 |
| Y | last accepted sample of y, NaN before the first | of y |
| PENDING | time of rejected samples, to be added to the next step | s |
| WAIT | time for which the innovations have yet to stay small before gamma leaks | s |
| SCALE | factor s of the half-widths and of the injections (D 22) | 1 |
| SATURATED | samples in a row with |eps_1| beyond all half-widths | 1 |
| BEYOND | samples in a row that are too far from the prediction to be likely | 1 |
| SETTLED | 1: the gains are the tuned ones; else minus the time since the start, or 0 | s |
| PERIOD | running mean of the intervals between samples | s |
| SPREAD | size of the innovations over that expected, at least 1 (D 21) | 1 |
| UPSET | time for which gamma has yet to rest after |eps_1| > w_1 (D 8) | s |
| UPSET | self-tuning: 1 at a sample that tells that y has jumped (D 35) | 1 |
| OFFSET | what y is more than z_1, since a jump that the model contradicts (D 23) | of y |
| JUMPS | sum of the jumps of y, 0 once it is back (D 23) | of y |
| FIRST_MISS, MISS | first and last prediction error of the unlikely samples in a row | of y |
| WATCHED | samples for which it has yet to be watched whether only y jumped (D 23) | 1 |
| DRIFT | sum of the recent prediction errors over their usual size, while watched | 1 |
| USUAL | running median of sqrt(L) (D 8) | of the innovations |
| SAMPLES | self-tuning: samples gathered; more than FIRST_SAMPLES once the members run | 1 |
| FAR_SIGN | sign of the last innovation that was too far off for every member | 1 |
| QUANTUM | step of y of which the others may be multiples | of y |
| LATTICE | of late, the share of the steps of y that are | 1 |
| GOES_BACK | of late, the share of the steps of y that go back at once | 1 |
| MOVING | members of each half whose covariances move | 1 |
| ACTIVE | members that take part; 0 before the members have begun | 1 |
| UNSETTLED | time since they began to | s |
| STEADY_PERIOD, FLOW_PERIOD | interval that the covariances, and the flow, are those of | s |
| FIRST_NOISE | variance of the noise when the members began | of y^2 |
| LIKELIEST | the likeliest member | 1 |
| CALM | samples since the noise has grown | 1 |
| GROWING | unlikely samples in a row that are farther and farther off, without being noise | 1 |
| FIRST_OFF | how far off the first of the unlikely samples in a row was | of y |
| UNEVEN | mean square of the highest difference of y in these samples | of y, squared |
| FIRST_ROUGH | what ROUGHNESS was before the first of them | 1 |
| NARROWED | by what the limit of the influence of innovations is below `HUBER` (D 32) | 1 |
| ONE_SIDED | samples in a row beyond that limit on one side; below 0 on the lower | 1 |
| RECENT | samples left that count as part of a jump of d (D 33) | 1 |
| ROUGHNESS | short mean of the squared differences of y, over their usual size | 1 |
| INTERVAL | last interval between two samples that were taken | s |
| JITTER | variance of the stamps of late, over the square of the interval | 1 |
| TOLD | the member whose model a smoother goes by | 1 |
| TURNS | of late, the share of samples that were unlikely, on a new side, not rough | 1 |
"""

from typing import NamedTuple

from fhaosmo_ros.core.compiled.cache import compiled
from fhaosmo_ros.core.compiled.unowned_arrays import (
    doubles_at,
    integers_of,
    line_at,
    plane_at,
)
from fhaosmo_ros.core.model.bytecode import Bytecode, Floats, Ints
from fhaosmo_ros.core.observer.self_tuning.members import ORDERS, scratch_rows
import numpy as np

RATES, STEADY, FRESH, SINGLE = range(4)
"""Parts of `Law.chances`, of N rows each; the single rows behind them begin at the last."""
INVERSE_STEADY, FIRST_HAT, FIRST_TILDE, TUNED_OVER_KALMAN, NEXT_SIZE = range(5)
SINGLES = 5
"""Single rows of `Law.chances`."""
HAT, TILDE, HAT_SENSITIVITY, TILDE_SENSITIVITY, COVARIANCE = range(5)
ROWS = 4
"""Number of rows before the covariance."""
MODEL = HAT_SENSITIVITY
NOISE, DRIVE, LOSS, DERIVATIVES = range(4)
"""
Columns of `MODEL`, the likeliest model of d, 0 before the members have begun: the variance of the
noise, if it were white; q, kappa and k of D 26, the last one k - 3 where d has jumped (D 33).
"""
GAMMA, Y, PENDING, WAIT, SCALE, SATURATED, BEYOND, SETTLED, PERIOD, SPREAD, UPSET = range(11)
OFFSET, JUMPS, FIRST_MISS, MISS, WATCHED, DRIFT, USUAL = range(11, 18)
SAMPLES, FAR_SIGN, QUANTUM, LATTICE, MOVING, UNSETTLED, STEADY_PERIOD = range(18, 25)
FLOW_PERIOD, FIRST_NOISE, LIKELIEST, CALM, GROWING, FIRST_OFF = range(25, 31)
NARROWED, ONE_SIDED, RECENT, ROUGHNESS, INTERVAL, JITTER, TURNS, TOLD, UNEVEN = range(31, 40)
FIRST_ROUGH, ACTIVE, GOES_BACK, MEMORY = range(40, 44)

SIGN, IMPLICIT, ADAPTIVE, FROM_MEASUREMENT, LEVANT, PREDICTING, SENSITIVE, SCHEDULED = range(8)
SELF_TUNING, LINEAR, STEP_AT, TABLE_AT = range(8, 12)
FLAGS = 12
"""
Number of flags of a law: 0 or 1 each. IMPLICIT: a step uses the sample at its end. The last two
are addresses, of the self-tuning step and of the table of arrays that it works on.
"""
LAMBDA, ALPHA, INVERSE_WIDTH, DECAY = range(4)
GAINS = 4
"""
Number of rows of gains. INVERSE_WIDTH is 1 / half-width. DECAY is that of the internal state, 0
except for those that stand for the unknown input and its derivatives.
"""
EPSILON, GAMMA_INITIAL, RATE, MIN, MAX, DEAD_ZONE, LEAKAGE, DELAY = range(8)
PREDICTION_STEP, CORRECTION_PERIOD, WIDEST, RELAXATION = range(8, 12)
VARIANCE, INTENSITY, FASTEST, STEADY_VARIANCE = range(12, 16)
FORGETTING, SLIDER, LEAST_NOISE = range(16, 19)
SCALARS = 19
"""Number of scalars of a law."""
RESTART, TELL, JUMP = 0.0, -1.0, -2.0
"""What the self-tuning step is called for, in place of an interval, when not for a step."""

NEWTON_STEPS = 60
NEWTON_TOLERANCE = 3e-8
"""Relative change that ends the iteration; its square, about 1e-15, is the error that is left."""
TINY = 1e-300
"""Innovations below this are taken for 0: their powers would underflow."""


def part(index: int, levels: int) -> slice:
    """Return the rows of one of the parts `RATES` .. `FRESH` of `Law.chances`."""
    return slice(index * levels, (index + 1) * levels)


class Law(NamedTuple):
    """
    What the compiled functions read of a configuration.

    Attributes
    ----------
    flags : (FLAGS,) array
        `SIGN` .. `TABLE_AT`.
    gains : (GAINS, N) array
        `LAMBDA` .. `DECAY` of each level.
    curves : (N, K) array
        psi of each level at K points of [0, half-width].
    scalars : (SCALARS,) array
        `EPSILON` .. `STEADY_VARIANCE`.
    chances : (3N + 5, N) array
        What the covariance is computed from, with `noise_size` (D 20): the rates A of the model,
        linearised at rest; the steady covariance of the errors of predictions; that of the errors
        of a fresh observer; and five rows: one over the first of the steady covariance (0 where
        that is not positive), first estimates, first internal states, the tuned corrections of a
        small innovation over those of the Kalman filter, and the sizes of z_2 .. z_n, d.
    model : Bytecode
        Phi_1 .. Phi_n, and the model of the unknown input behind them (D 17).

    """

    flags: Ints
    gains: Floats
    curves: Floats
    scalars: Floats
    chances: Floats
    model: Bytecode


class Work(NamedTuple):
    """
    Scratch memory of the compiled functions.

    Attributes
    ----------
    x : (4 + N, N) array
        The levels while a step changes them.
    stack : (2, depth) array
        For the evaluation of expressions.
    stages : (4, 2, n + 1 or N) array
        Of the integrator; see core/model/integrate.py. A step has the measurements m_i of its
        levels, and their sensitivities dm_i / dgamma, at ``stages[POINT]``.

    """

    x: Floats
    stack: Floats
    stages: Floats


class State(NamedTuple):
    """
    What an observer remembers.

    Attributes
    ----------
    levels : (4 + N, N) array
        `HAT` .. `COVARIANCE` and the rows that follow.
    memory : (MEMORY,) array
        `GAMMA` .. `USUAL`.

    """

    levels: Floats
    memory: Floats


@compiled(inline='always')
def observer_at(t: Ints, first: int) -> tuple[Law, Work, State]:
    """Return the bundles whose arrays rows `first` .. of a table name (`Observer.arguments`)."""
    model = Bytecode(plane_at(t, first + 5), integers_of(t, first + 6))
    law = Law(
        integers_of(t, first),
        plane_at(t, first + 1),
        plane_at(t, first + 2),
        line_at(t, first + 3),
        plane_at(t, first + 4),
        model,
    )
    stages = doubles_at(t[first + 9, 0], (4, 2, t[first + 9, 2]))
    work = Work(plane_at(t, first + 7), plane_at(t, first + 8), stages)
    return law, work, State(plane_at(t, first + 10), line_at(t, first + 11))


ARRAYS = 12
"""Arrays of `Law`, `Work` and `State`, one by one."""


def make_work(law: Law, depth: int) -> Work:
    """Return scratch memory for a law whose expressions need a stack of `depth`."""
    levels, states = law.gains.shape[1], len(law.model.offsets) - 1
    rows = ROWS + levels
    if law.flags[SELF_TUNING]:
        rows += scratch_rows(levels - ORDERS)
    return Work(np.zeros((rows, levels)), np.zeros((2, depth)), np.zeros((4, 2, states)))


@compiled(forceinline=True)
def psi(law: Law, level: int, a: float) -> tuple[float, float]:
    """Return psi at a = |eps| > 0 and its slope; psi is odd, so negative eps need no more."""
    if law.flags[SIGN]:
        return 1.0, 0.0
    curves = law.curves
    last = curves.shape[1] - 1
    scale = law.gains[INVERSE_WIDTH, level] * last
    position = a * scale
    if not position < last:
        return curves[level, last], 0.0
    j = int(position)
    rise = curves[level, j + 1] - curves[level, j]
    return curves[level, j] + (position - j) * rise, rise * scale
