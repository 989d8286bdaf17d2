# SPDX-License-Identifier: Apache-2.0
"""The first samples, and members that begin with what these tell (D 26, D 28)."""

import math

from fhaosmo_ros.core.compiled.cache import compiled
from fhaosmo_ros.core.model.bytecode import Floats
from fhaosmo_ros.core.observer.arrays import (
    ACTIVE,
    CALM,
    COVARIANCE,
    FIRST_NOISE,
    FLOW_PERIOD,
    FRESH,
    HAT,
    INTERVAL,
    JITTER,
    LATTICE,
    Law,
    LEAST_NOISE,
    LIKELIEST,
    MOVING,
    QUANTUM,
    ROUGHNESS,
    SAMPLES,
    STEADY_PERIOD,
    TOLD,
    UNSETTLED,
    Work,
    Y,
)
from fhaosmo_ros.core.observer.covariance import MEDIAN
from fhaosmo_ros.core.observer.self_tuning.covariances import at
from fhaosmo_ros.core.observer.self_tuning.jumps import watch
from fhaosmo_ros.core.observer.self_tuning.members import (
    BANDWIDTHS,
    COLOUR,
    COLOURS,
    CORRELATION,
    COUNT,
    FACTORIALS,
    FAR,
    FIRST_SAMPLES,
    HALF,
    KAPPA,
    LOG_VARIANCE,
    Members,
    ORDER,
    ORDERS,
    PRIOR,
    RATIO,
    RESIDUAL,
    SCORE,
    SHORT,
    SQUARE,
    TAU,
    USED,
    VARIANCE,
)
from fhaosmo_ros.core.observer.self_tuning.noise import (
    CALM_SAMPLES,
    difference,
    is_multiple,
    LATTICE_SHARE,
)
from fhaosmo_ros.core.observer.self_tuning.weights import FLOOR, weigh
import numpy as np

MOST = 0.8
"""Share of the first samples' differences that say how large z may be; others may be outliers."""
CHANGING = 8
"""
y may be constant until its sensor is ready. So many samples from its first change on tell whether
it is quantised; if not, the first samples are those from there on.
"""
ALL_BUT_ONE = 0.8
"""Of so few steps: all are multiples of the smallest one, which does not count."""
REPEATED = 0.3
"""If a larger share of the first samples repeat the one before, y is quantised."""
WITHIN_SAMPLES, MORE_REASON = 1.0, 50.0
"""
Members with a larger bandwidth (rad a sample) tell d from the last two or three samples. There
errors of rounding, which are not white, look like such a d: where y is quantised, log-likelihoods
of these members are smaller by `MORE_REASON`.
"""


@compiled()
def gather(law: Law, work: Work, memory: Floats, members: Members, y: float, h: float) -> None:
    """Collect the first samples, which tell the period, the noise and the sizes (D 28)."""
    n, x, first = law.gains.shape[1] - ORDERS, work.x, members.p
    count = int(memory[SAMPLES])
    if count == 0:
        first[0, 0], first[1, 0] = memory[Y], 0.0
        count = 1
    if count == FIRST_SAMPLES:  # y had not changed by then
        for i in range(count - 1):
            first[0, i], first[1, i] = first[0, i + 1], first[1, i + 1]
        count -= 1
    first[0, count], first[1, count] = y, h
    count += 1
    memory[SAMPLES] = count
    for i in range(x.shape[1]):
        x[HAT, i] = 0.0
        x[COVARIANCE, i] = math.inf
    x[HAT, 0] = y
    least = law.scalars[LEAST_NOISE]
    if count < FIRST_SAMPLES and not (least > 0.0 and count > 2 * n + 4):
        return
    period = 0.0
    for i in range(1, count):
        period += first[1, i] / (count - 1)
    differences, values = first[0, :count].copy(), np.empty(count)
    noise, largest, binomial, quantum = math.inf, 0.0, 1.0, math.inf
    rough = np.zeros(n + 2)
    for i in range(count):
        largest = max(largest, abs(first[0, i]))
    changed = 1  # number of the first sample that is another one
    while changed < count and abs(first[0, changed] - first[0, 0]) <= 1e-12 * largest:
        changed += 1
    since = count - changed
    if changed > 1 and least == 0.0 and not (since >= CHANGING and on_lattice(first[0], count)):
        if since >= CHANGING:
            for i in range(since + 1):
                first[0, i], first[1, i] = first[0, i + changed - 1], first[1, i + changed - 1]
            memory[SAMPLES] = since + 1
        return
    for order in range(1, n + 2):
        length = count - order
        binomial *= (4.0 * order - 2.0) / order  # (2 order)! / order!^2
        for i in range(length):
            differences[i] = differences[i + 1] - differences[i]
            values[i] = abs(differences[i])
            if order == 1 and values[i] > 1e-12 * largest:
                quantum = min(quantum, values[i])
        size = ranked(values, length, 0.5) / MEDIAN / math.sqrt(binomial)
        if size > 0.0:
            noise = min(noise, size)
        rough[order] = size * size
    if quantum < math.inf:
        memory[QUANTUM] = quantum
        memory[LATTICE] = share_of_multiples(first[0, :count], quantum)
        if memory[LATTICE] > LATTICE_SHARE:
            noise = max(quantum / math.sqrt(12.0), noise if noise < math.inf else 0.0)
    if noise == math.inf:
        noise = quantum
    jitter = 0.0
    for i in range(2, count):
        h, before = first[1, i], first[1, i - 1]
        jitter += (h - before) ** 2 / (6.0 * h * before) / (count - 2)
    memory[JITTER], memory[INTERVAL] = jitter, h
    noise = max(noise, math.sqrt(2.0 * jitter * rough[1]), least, 1e-9 * largest, 1e-150)
    begin(law, memory, members, count, y, period, noise, rough)
    memory[SAMPLES] = FIRST_SAMPLES + 1


@compiled()
def on_lattice(values: Floats, count: int) -> bool:
    """Return True if the last `CHANGING` steps seem to be those of a quantised y."""
    quantum = math.inf
    for i in range(count - CHANGING, count):
        step = abs(values[i] - values[i - 1])
        if step > 0.0:
            quantum = min(quantum, step)
    return bool(share_of_multiples(values[count - CHANGING - 1 : count], quantum) > ALL_BUT_ONE)


@compiled()
def share_of_multiples(values: Floats, quantum: float) -> float:
    """Return the share of multiples of `quantum` among the steps; 1 if many samples repeat."""
    steps, multiples, repeated = 0.0, -1.0, 0.0  # the smallest step is one in any case
    for i in range(1, len(values)):
        step = abs(values[i] - values[i - 1])
        if step < 0.99 * quantum:
            repeated += 1.0
        else:
            steps += 1.0
            if is_multiple(step, quantum, values[i]):
                multiples += 1.0
    return 1.0 if repeated > REPEATED * (len(values) - 1) else multiples / steps


@compiled()
def ranked(values: Floats, count: int, share: float) -> float:
    """Return the value that a share of the first `count` ones is below; sorts these in place."""
    for i in range(1, count):
        value, j = values[i], i
        while j > 0 and values[j - 1] > value:
            values[j] = values[j - 1]
            j -= 1
        values[j] = value
    return float(values[int(share * count)])


@compiled()
def begin(
    law: Law,
    memory: Floats,
    members: Members,
    count: int,
    y: float,
    period: float,
    noise: float,
    rough: Floats,
) -> None:
    """Let the members begin at `y` (D 28)."""
    n = law.gains.shape[1] - ORDERS
    sizes, samples = np.empty(n), members.p[0, :count].copy()
    first = samples.copy()
    stride = max((count - 1) // n, 1)
    for i in range(n):  # how large z_i may be: its setting, or what differences say
        sizes[i] = law.chances[FRESH * law.gains.shape[1] + i, i]
        if i > 0:
            length = count - i * stride
            values = np.empty(length)
            for j in range(length):
                first[j] = (first[j + stride] - first[j]) / (stride * period)
                values[j] = first[j] * first[j]
            sizes[i] = max(sizes[i], ranked(values, length, MOST))
    memory[MOVING] = HALF
    memory[STEADY_PERIOD] = period
    memory[UNSETTLED] = 0.0
    memory[FLOW_PERIOD] = 0.0
    memory[FIRST_NOISE] = noise * noise
    for c in range(COLOURS.size):
        members.noise[SQUARE, c] = members.noise[USED, c] = noise * noise
    rates, record = members.rates, members.record
    for g in range(COUNT):
        omega, colour = BANDWIDTHS[g] / period, COLOURS[COLOUR[g]]
        rates[KAPPA, g] = RATIO[g] * omega
        rates[TAU, g] = -period / math.log(colour) if colour > 0.0 else 0.0
        rates[CORRELATION, g] = colour
    members.rough[0] = 0.0
    for order in range(rough.size):
        members.rough[1:, order] = max(rough[order], noise * noise)
    memory[ROUGHNESS], memory[CALM] = 1.0, CALM_SAMPLES + 1.0
    for j in range(count):
        difference(members, memory, samples[j])
    x, p, d, least = members.x, members.p, n + ORDERS, math.inf
    quantised = memory[LATTICE] > LATTICE_SHARE
    x[:], p[:], members.drive[:] = 0.0, 0.0, 0.0
    for g in range(COUNT):
        omega, kappa, k = BANDWIDTHS[g] / period, rates[KAPPA, g], ORDER[g]
        intensity = noise * noise * period * omega ** (2 * (n + 1 + k))
        members.drive[k, g] = intensity
        x[0, g], p[0, g] = y, noise * noise
        for i in range(1, n):
            p[at(d, i, i), g] = sizes[i]
        for i in range(k + 1):
            for j in range(i, k + 1):
                below = 2 * k - i - j
                p[at(d, n + i, n + j), g] = (
                    intensity
                    * FACTORIALS[below]
                    / (FACTORIALS[k - i] * FACTORIALS[k - j] * (2.0 * kappa) ** (below + 1))
                )
        size = math.log(p[at(d, n, n), g])
        record[PRIOR, g] = -0.5 * size
        least = min(least, size)
    for g in range(COUNT):
        record[PRIOR, g] += 0.5 * least
        if quantised and BANDWIDTHS[g] > WITHIN_SAMPLES:
            record[PRIOR, g] -= MORE_REASON
        record[SCORE, g] = record[PRIOR, g]
        record[VARIANCE, g] = record[SHORT, g] = 1.0
        record[LOG_VARIANCE, g] = record[RESIDUAL, g] = record[FAR, g] = 0.0
    memory[ACTIVE] = COUNT
    memory[LIKELIEST] = memory[TOLD] = weigh(members, FLOOR)
    watch(members, memory[TOLD])
