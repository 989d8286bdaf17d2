# SPDX-License-Identifier: Apache-2.0
"""
One step of either structure: what is rejected, the law of gamma, and runs of steps.

Equations are cited as P (paper: label of the equation) and D (number in docs/mathematics.md).
The arrays are described in arrays.py; the recursions are in cascade.py and levant.py.
"""

import math
from typing import NamedTuple

from fhaosmo_ros.core.compiled.cache import compiled
from fhaosmo_ros.core.compiled.unowned_arrays import call_at, unowned
from fhaosmo_ros.core.model.bytecode import Bytecode, Floats, Ints
from fhaosmo_ros.core.observer import cascade, levant
from fhaosmo_ros.core.observer.arrays import (
    ADAPTIVE,
    BEYOND,
    COVARIANCE,
    DEAD_ZONE,
    DELAY,
    DRIFT,
    EPSILON,
    FIRST_HAT,
    FIRST_TILDE,
    FRESH,
    FROM_MEASUREMENT,
    GAMMA,
    GAMMA_INITIAL,
    HAT,
    HAT_SENSITIVITY,
    IMPLICIT,
    INVERSE_WIDTH,
    JUMP,
    Law,
    LEAKAGE,
    LEVANT,
    MAX,
    MIN,
    MODEL,
    OFFSET,
    ONE_SIDED,
    PENDING,
    PERIOD,
    PREDICTING,
    RATE,
    RESTART,
    ROWS,
    SAMPLES,
    SATURATED,
    SCALE,
    SCHEDULED,
    SELF_TUNING,
    SETTLED,
    SIGN,
    SINGLE,
    State,
    STEP_AT,
    TABLE_AT,
    TELL,
    TILDE,
    TILDE_SENSITIVITY,
    UPSET,
    USUAL,
    WAIT,
    WATCHED,
    Work,
    Y,
)
from fhaosmo_ros.core.observer.covariance import begin_estimates, is_unlikely, jump
from fhaosmo_ros.core.observer.self_tuning.members import FIRST_SAMPLES
from fhaosmo_ros.core.observer.status import (
    DIVERGED,
    FLAGS_MASK,
    GAMMA_AT_MAX,
    GAMMA_AT_MIN,
    JUMPED,
    LEVEL_SHIFT,
    REJECTED_INPUT,
    REJECTED_MEASUREMENT,
    REJECTED_PERIOD,
    REJECTED_SPIKE,
    REJECTED_STEP,
    SENSITIVITY_RESET,
)

VARIANCES, LIKELIEST_MODEL = 2, 3
"""Indices in `Record.levels`."""
SENSITIVITY_LIMIT = 1e9
"""Sensitivities beyond it are set to 0."""
LOST_SAMPLES = 20
"""More samples in a row that are too far from the prediction say that y is lost (D 21)."""
UNUSUAL = 3.0
"""Innovations of so many times their usual size let gamma adapt (D 8)."""
MEAN_OF = 32
"""Intervals that the running mean remembers."""
HEADROOM = 1e8
"""Reject values above DBL_MAX / HEADROOM, so that differences cannot overflow."""


class Samples(NamedTuple):
    """
    Samples of a run.

    Attributes
    ----------
    y, h : (K,) arrays
        Samples, and the time (s) of the interval that ends at each.
    u : (K, m) array
        Known inputs of that interval.

    """

    y: Floats
    h: Floats
    u: Floats


class Record(NamedTuple):
    """
    What a run records, a row for each recorded sample.

    Attributes
    ----------
    levels : (rows, 2 or 4, N) array
        `HAT` and `TILDE`, and the variances and the `MODEL` of a self-tuning observer.
    gamma : (rows,) array
    eps : (rows or rows + 1, N) array
        Innovations; a run that skips samples needs the row more.
    words : (rows,) array
        Status words.
    tuning : (rows, 7 or 0) array
        What a self-tuning observer has found (`TUNING`).

    """

    levels: Floats
    gamma: Floats
    eps: Floats
    words: Ints
    tuning: Floats


@compiled(forceinline=True)
def innovations(law: Law, state: State, y: float, eps: Floats, row: int) -> int:
    """Write eps_i = m_i - z_hat_i into a row of `eps`; return the number of open levels."""
    levels, epsilon = state.levels, law.scalars[EPSILON]
    count, running = 0, True
    for i in range(levels.shape[1]):
        m = y if i == 0 else levels[TILDE, i - 1]
        eps[row, i] = m - levels[HAT, i]
        if running:
            count += 1
        running = running and abs(eps[row, i]) <= epsilon  # P Eifunction
    return count


@compiled(forceinline=True)
def start(law: Law, state: State, y: float, eps: Floats, row: int) -> int:
    """
    Take `y` as the first sample: no time has passed, so nothing is integrated.

    Returns
    -------
    int
        Status word (see status.py).

    """
    word, memory = 0, state.memory
    memory[OFFSET] = 0.0
    if math.isfinite(HEADROOM * y):
        memory[Y] = y
        memory[PENDING] = 0.0
        if law.flags[FROM_MEASUREMENT]:
            state.levels[HAT, 0] = y
    else:
        word = REJECTED_MEASUREMENT
    return word | (innovations(law, state, memory[Y], eps, row) << LEVEL_SHIFT)


@compiled(forceinline=True)
def step(
    law: Law, work: Work, state: State, y: float, h: float, u: Floats, eps: Floats, row: int
) -> int:
    """
    Advance a state in place to the sample `y` that lies `h` seconds after the last call.

    Returns
    -------
    int
        Status word (see status.py). A rejected sample changes no level; see `Status`.

    """
    x, levels, memory, n = work.x, state.levels, state.memory, law.gains.shape[1]
    word, measured = 0, y
    y -= memory[OFFSET]  # D 23
    if not math.isfinite(HEADROOM * y):
        word |= REJECTED_MEASUREMENT
    for j in range(u.shape[0]):
        if not math.isfinite(u[j]):
            word |= REJECTED_INPUT
    if not (h > 0.0 and math.isfinite(HEADROOM * h)):
        word |= REJECTED_PERIOD
    if not word:
        for r in range(ROWS + n):
            for i in range(n):
                x[r, i] = levels[r, i]
        whole = h + memory[PENDING]
        if law.flags[SELF_TUNING]:
            at, table = law.flags[STEP_AT], law.flags[TABLE_AT]
            loss = call_at(at, table, y, whole, u.ctypes.data, u.shape[0])
            gradient = 0.0
            levant.mirror(x)
        else:
            loss, gradient = advance(law, work, memory, y, whole, u)
        zero = 0.0
        for i in range(n):
            hat, tilde = HEADROOM * x[HAT, i], HEADROOM * x[TILDE, i]
            zero += (hat - hat) + (tilde - tilde)
        if zero != 0.0:  # a difference of equals is 0, and NaN if they are not finite
            word = REJECTED_STEP
            # Nothing of the sample may make the next step fail as well: not its time, and not
            # the y at the interval's beginning, which is what fails explicitly.
            memory[PENDING] = 0.0
            memory[SAMPLES] = 0.0  # the members begin afresh
            if not law.flags[IMPLICIT]:
                memory[Y] = y
        elif memory[BEYOND] > LOST_SAMPLES and jump(law, work, state, u):
            if law.flags[SELF_TUNING]:
                at, table = law.flags[STEP_AT], law.flags[TABLE_AT]
                call_at(at, table, levels[HAT, 0] - x[HAT, 0], JUMP, 0, 0)
            memory[PENDING] = whole
            word = REJECTED_SPIKE | JUMPED
        elif memory[BEYOND] > LOST_SAMPLES:
            restart(law, state, measured)
            word = DIVERGED
        elif memory[BEYOND] > 0.0:
            memory[PENDING] = whole
            word = REJECTED_SPIKE
        else:
            if law.flags[ADAPTIVE]:
                memory[UPSET] = max(memory[UPSET] - whole, 0.0)
                used = y if law.flags[IMPLICIT] else memory[Y]
                if is_upset(law, x if law.flags[IMPLICIT] else levels, used):
                    memory[UPSET] = law.scalars[DELAY]
                word = adapt(law, x, memory, whole, loss, gradient)
            if law.flags[SELF_TUNING] and memory[UPSET] > 0.0:
                memory[UPSET] = 0.0
                word |= JUMPED
            for r in range(ROWS + n):
                for i in range(n):
                    levels[r, i] = x[r, i]
            memory[Y] = y
            memory[PENDING] = 0.0
            mean = memory[PERIOD] if memory[PERIOD] > 0.0 else whole
            memory[PERIOD] = mean + (min(whole, 2.0 * mean) - mean) / MEAN_OF
    if word & (REJECTED_MEASUREMENT | REJECTED_INPUT) and not word & REJECTED_PERIOD:
        memory[PENDING] += h
    return word | (innovations(law, state, memory[Y], eps, row) << LEVEL_SHIFT)


@compiled()
def restart(law: Law, state: State, y: float) -> None:
    """Begin afresh from `y`; the time of the next sample counts from it."""
    levels, memory, n = state.levels, state.memory, law.gains.shape[1]
    if law.flags[SELF_TUNING]:
        call_at(law.flags[STEP_AT], law.flags[TABLE_AT], y, RESTART, 0, 0)
        memory[PENDING] = memory[OFFSET] = memory[WATCHED] = memory[DRIFT] = 0.0
        return
    for i in range(n):
        levels[HAT, i] = law.chances[SINGLE * n + FIRST_HAT, i]
        levels[TILDE, i] = law.chances[SINGLE * n + FIRST_TILDE, i]
        levels[HAT_SENSITIVITY, i] = levels[TILDE_SENSITIVITY, i] = 0.0
        for j in range(n):
            levels[COVARIANCE + i, j] = law.chances[FRESH * n + i, j]
    levels[HAT, 0] = memory[Y] = y
    if law.flags[ADAPTIVE]:
        memory[GAMMA] = law.scalars[GAMMA_INITIAL]
    memory[PENDING] = memory[WAIT] = memory[SATURATED] = memory[BEYOND] = memory[SETTLED] = 0.0
    memory[UPSET] = memory[OFFSET] = memory[WATCHED] = memory[DRIFT] = memory[ONE_SIDED] = 0.0
    memory[SCALE] = 1.0


@compiled(forceinline=True)
def advance(
    law: Law, work: Work, memory: Floats, y: float, h: float, u: Floats
) -> tuple[float, float]:
    """Advance ``work.x`` by the structure and scheme of the law; return L and dL/dgamma."""
    flags, gamma = law.flags, memory[GAMMA]
    if flags[SCHEDULED] and not flags[PREDICTING]:
        if memory[SETTLED] <= 0.0:
            return begin_estimates(law, work, memory, y, h, u)
        if is_unlikely(law, work, memory, y, h, u):
            return 0.0, 0.0
    if flags[LEVANT]:
        if flags[PREDICTING]:
            return levant.predict_correct(law, work, memory, y, h, u)
        if flags[IMPLICIT]:
            return levant.implicit(law, work, memory, y, h, u)
        return levant.explicit(law, work, gamma, memory[Y], h, u)
    if flags[IMPLICIT]:
        return cascade.implicit(law, work, gamma, y, h, u)
    return cascade.explicit(law, work, gamma, memory[Y], h, u)


@compiled(forceinline=True)
def is_upset(law: Law, x: Floats, y: float) -> bool:
    """Return True while y's own innovation is beyond its half-width, as after a jump (D 8)."""
    return abs(y - x[HAT, 0]) * law.gains[INVERSE_WIDTH, 0] > 1.0 and not law.flags[SIGN]


@compiled(forceinline=True)
def adapt(law: Law, x: Floats, memory: Floats, h: float, loss: float, gradient: float) -> int:
    """
    Change gamma (P adaptationlawgamma) and the time to wait in `memory`; return status flags.

    Projection on [gamma_min, gamma_max], dead zone, leakage, and the rest after an upset are
    ours (D 8).
    """
    word, gamma, c = 0, memory[GAMMA], law.scalars
    zero = gradient - gradient
    for r in (HAT_SENSITIVITY, TILDE_SENSITIVITY):
        for i in range(x.shape[1]):
            if not abs(x[r, i]) < SENSITIVITY_LIMIT:
                word = SENSITIVITY_RESET
    if word or zero != 0.0:
        word = SENSITIVITY_RESET
        for r in (HAT_SENSITIVITY, TILDE_SENSITIVITY):
            for i in range(x.shape[1]):
                x[r, i] = 0.0
    leaks, dead_zone = c[DEAD_ZONE] == 0.0, c[DEAD_ZONE]
    if law.flags[SCHEDULED] and not leaks:  # it follows the noise
        if not memory[UPSET] > 0.0:
            change = 1.0 + h / max(c[DELAY], h)
            memory[USUAL] *= change if loss > memory[USUAL] * memory[USUAL] else 1.0 / change
        memory[USUAL] = max(memory[USUAL], dead_zone / UNUSUAL)
        dead_zone = UNUSUAL * memory[USUAL]
    if loss <= dead_zone * dead_zone:  # adaptation rests
        leaks = leaks or memory[WAIT] <= 0.0
        memory[WAIT] = max(memory[WAIT] - h, 0.0)
    else:
        memory[WAIT] = c[DELAY]
        if not word and not (memory[UPSET] > 0.0 and c[DEAD_ZONE] > 0.0):
            gamma -= h * c[RATE] * gradient  # P adaptationlawgamma
    if leaks:
        gamma -= min(h * c[LEAKAGE], 1.0) * (gamma - c[GAMMA_INITIAL])
    if not gamma > c[MIN]:  # also for NaN, from an infinite gradient step
        gamma = c[MIN]
        word |= GAMMA_AT_MIN
    elif gamma >= c[MAX]:
        gamma = c[MAX]
        word |= GAMMA_AT_MAX
    memory[GAMMA] = gamma
    return word


@compiled()
def step_once(
    flags: Ints,
    gains: Floats,
    curves: Floats,
    scalars: Floats,
    chances: Floats,
    code: Floats,
    offsets: Ints,
    x: Floats,
    stack: Floats,
    stages: Floats,
    levels: Floats,
    memory: Floats,
    y: float,
    h: float,
    u: Floats,
    eps: Floats,
) -> int:
    """
    Advance by one sample; see `step`. The innovations go to eps[0].

    Takes the contents of the bundles, because Python calls it for every sample: handing over a
    named tuple costs some 3 microseconds a call.
    """
    law = unowned(Law(flags, gains, curves, scalars, chances, Bytecode(code, offsets)))
    work, state = unowned(Work(x, stack, stages)), unowned(State(levels, memory))
    return step(law, work, state, y, h, unowned(u), unowned(eps), 0)


@compiled(forceinline=True)
def tell_tuning(flags: Ints, memory: Floats, found: Floats) -> None:
    """Write what a self-tuning observer has found (`TUNING`); NaN before it knows the noise."""
    if memory[SAMPLES] > FIRST_SAMPLES:
        call_at(flags[STEP_AT], flags[TABLE_AT], 0.0, TELL, found.ctypes.data, found.size)
    else:
        found[:] = math.nan


@compiled(forceinline=True)
def record_state(law: Law, state: State, record: Record, row: int) -> None:
    """Record what an observer knows, all but innovations and status word."""
    levels, memory = state.levels, state.memory
    for i in range(levels.shape[1]):
        record.levels[row, HAT, i] = levels[HAT, i]
        record.levels[row, TILDE, i] = levels[TILDE, i]
        if record.levels.shape[1] > VARIANCES:
            record.levels[row, VARIANCES, i] = levels[COVARIANCE, i]
            record.levels[row, LIKELIEST_MODEL, i] = levels[MODEL, i]
    record.gamma[row] = memory[GAMMA]
    if record.tuning.shape[1] > 0:
        tell_tuning(law.flags, memory, record.tuning[row])


@compiled()
def run(
    law: Law, work: Work, state: State, samples: Samples, record: Record, first: int, every: int
) -> None:
    """
    Start with the samples before index `first`, step from it on; record every `every`-th one.

    Row r of the record is the state after sample (r + 1) * every - 1; its flags are those of all
    samples since the row before it.
    """
    law, work, state = unowned(law), unowned(work), unowned(state)
    eps = unowned(record.eps)
    u, row, seen = unowned(samples.u), 0, 0
    for k in range(samples.y.shape[0]):
        if k >= first:
            word = step(law, work, state, samples.y[k], samples.h[k], u[k], eps, row)
        else:
            word = start(law, state, samples.y[k], eps, row)
        seen |= word & FLAGS_MASK
        if (k + 1) % every == 0:
            record_state(law, state, record, row)
            record.words[row] = (word >> LEVEL_SHIFT << LEVEL_SHIFT) | seen
            seen = 0
            row += 1
