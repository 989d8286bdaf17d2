# SPDX-License-Identifier: Apache-2.0
"""
The self-tuning observer: members side by side, weighted by how well they predict y (D 26 to D 29).

Equations are cited by their numbers in docs/mathematics.md (D). members.py describes the arrays.
Every function works on all members of one k; P of the members in columns >= `moving` is steady and
is left as it is.
"""

from functools import cache
import math

from fhaosmo_ros.core.compiled.cache import compiled, compiled_callback
from fhaosmo_ros.core.compiled.unowned_arrays import doubles_at, integers_at, unowned
from fhaosmo_ros.core.model.bytecode import Floats
from fhaosmo_ros.core.model.integrate import NOW
from fhaosmo_ros.core.observer.arrays import (
    ARRAYS,
    BEYOND,
    CALM,
    COVARIANCE,
    FAR_SIGN,
    FIRST_NOISE,
    FLOW_PERIOD,
    FORGETTING,
    FRESH,
    HAT,
    Law,
    LEAST_NOISE,
    LIKELIEST,
    LINEAR,
    MOVING,
    observer_at,
    PREDICTION_STEP,
    QUANTUM,
    REPEATED,
    ROWS,
    SAMPLES,
    SLIDER,
    STEADY_PERIOD,
    UNSETTLED,
    Work,
    Y,
)
from fhaosmo_ros.core.observer.members import (
    BANDS,
    BANDWIDTHS,
    COLOUR,
    COLOURS,
    CORRELATION,
    COUNT,
    DECAYED,
    FACTORIALS,
    FAR,
    FIRST_SAMPLES,
    IN_BAND,
    INTENSITY,
    KAPPA,
    LOG_VARIANCE,
    Members,
    members_in,
    ORDERS,
    PRIOR,
    RATIO,
    RESIDUAL,
    SCORE,
    SHORT,
    SQUARE,
    STEP_OF_BANDS,
    TAU,
    USED,
    VARIANCE,
    WEIGHT,
)
from fhaosmo_ros.core.observer.prediction import predict
from numba import types
import numpy as np

HUBER = 3.0
"""Innovations of more standard deviations count as so many (Huber 1964)."""
GATE = 6.0
"""A sample that is further off for every member is not used (D 29)."""
LOST_SAMPLES = 20
IGNORANT = 9.0
"""A member whose innovations' variance is so many times the smallest one does not judge y."""
FLOOR = 30.0
"""No log-likelihood falls further below the best one."""
NEGLIGIBLE = 25.0
"""Members whose log-likelihood is so far below the best one have no weight."""
CLIPPED = 0.9733
"""Mean of min(x^2, 9) where x is normal with variance 1."""
NOISE_SAMPLES = 1000.0
"""The noise is averaged over so many samples."""
CLOSE = 8.0
"""Members whose log-likelihood is so far below the best of their colour do not tell the noise."""
SHORT_SHARE = 0.05
STEADY = 1.5
"""If squared innovations over S are larger of late for every member, the noise has grown."""
QUICK_SAMPLES = 30.0
"""It is averaged over so many samples then."""
CALM_SAMPLES = 40.0
"""Until so many samples after that no sample judges the members."""
ANOTHER, FAR_OFF = 1.3, 3.0
"""Factors on the variance of the noise, of the likeliest colour and others, that make P move."""
NEAR = 0.25
"""An interval that differs by at most this part of it needs no other gains."""
LONG = 12.0
"""Time constants of a member after which its P is steady."""
SAME_LOW, SAME_HIGH = 0.3, 0.7
"""Shares of repeated samples between which y passes from noisy to quantised."""
SAME_SAMPLES = 300.0


@compiled(forceinline=True)
def at(d: int, i: int, j: int) -> int:
    """Return the row of P_ij, i <= j, in an upper triangle of d rows."""
    return i * d - i * (i - 1) // 2 + j - i


@compiled()
def predict_states(
    members: Members, n: int, k: int, h: float, mean: Floats, predicted: Floats, x: Floats
) -> None:
    """Predict the members' estimates: the mean's path, plus the flow of their deviations."""
    flow, kappa, decayed = members.flow, members.rates[KAPPA], members.rates[DECAYED]
    ahead = np.empty((n, COUNT))
    for i in range(n):
        base = predicted[i]
        for j in range(n + ORDERS):
            base -= flow[i, j] * mean[j]
        row = ahead[i]
        f0, f1, f2, d = flow[i, n], flow[i, n + 1], flow[i, n + 2], x[n]
        for g in range(COUNT):
            c = kappa[g]
            row[g] = base + (f0 - c * (f1 - c * f2)) * d[g]
        if k > 0:
            rate = x[n + 1]
            for g in range(COUNT):
                row[g] += (f1 - 2.0 * kappa[g] * f2) * rate[g]
        if k > 1:
            second = x[n + 2]
            for g in range(COUNT):
                row[g] += f2 * second[g]
        for j in range(n):
            s, other = flow[i, j], x[j]
            if s != 0.0:
                for g in range(COUNT):
                    row[g] += s * other[g]
    for i in range(n):
        row, target = ahead[i], x[i]
        for g in range(COUNT):
            target[g] = row[g]
    for i in range(k + 1):  # exp of D 17: e^(-kappa h) times a polynomial
        target = x[n + i]
        for g in range(COUNT):
            target[g] *= decayed[g]
        for j in range(i + 1, k + 1):
            factor, other = h ** (j - i) / FACTORIALS[j - i], x[n + j]
            for g in range(COUNT):
                target[g] += decayed[g] * factor * other[g]


@compiled()
def predict_covariances(
    members: Members, n: int, k: int, h: float, p: Floats, moving: int
) -> None:
    """P <- A P A' + Q of the members that move (D 27)."""
    flow, kappa, decayed = members.flow, members.rates[KAPPA], members.rates[DECAYED]
    intensity, d = members.record[INTENSITY, k], n + 1 + k
    product, chain = np.empty((d, d, moving)), np.empty((n, k + 1, moving))
    for i in range(n):
        f0, f1, f2 = flow[i, n], flow[i, n + 1], flow[i, n + 2]
        for g in range(moving):
            c = kappa[g]
            chain[i, 0, g] = f0 - c * (f1 - c * f2)
            if k > 0:
                chain[i, 1, g] = f1 - 2.0 * c * f2
            if k > 1:
                chain[i, 2, g] = f2
    for j in range(d):  # A P
        for i in range(n):
            row = product[i, j]
            for g in range(moving):
                row[g] = 0.0
            for m in range(n):
                s, other = flow[i, m], p[at(d, min(j, m), max(j, m))]
                if s != 0.0:
                    for g in range(moving):
                        row[g] += s * other[g]
            for m in range(k + 1):
                part, other = chain[i, m], p[at(d, min(j, n + m), max(j, n + m))]
                for g in range(moving):
                    row[g] += part[g] * other[g]
        for i in range(k + 1):
            row = product[n + i, j]
            for g in range(moving):
                row[g] = 0.0
            for m in range(i, k + 1):
                other = p[at(d, min(j, n + m), max(j, n + m))]
                factor = h ** (m - i) / FACTORIALS[m - i]
                for g in range(moving):
                    row[g] += decayed[g] * factor * other[g]
    for i in range(d):  # .. A' + Q, Q as in D 20
        for j in range(i, d):
            below = 2 * d - 2 - i - j
            share = h ** (below + 1) / (below + 1)
            share /= FACTORIALS[d - 1 - i] * FACTORIALS[d - 1 - j]
            row = p[at(d, i, j)]
            for g in range(moving):
                row[g] = share * intensity[g]
            if j < n:
                for m in range(n):
                    s, other = flow[j, m], product[i, m]
                    if s != 0.0:
                        for g in range(moving):
                            row[g] += s * other[g]
                for m in range(k + 1):
                    part, other = chain[j, m], product[i, n + m]
                    for g in range(moving):
                        row[g] += part[g] * other[g]
            else:
                for m in range(j, d):
                    factor, other = h ** (m - j) / FACTORIALS[m - j], product[i, m]
                    for g in range(moving):
                        row[g] += decayed[g] * factor * other[g]


@compiled()
def expect_innovations(
    members: Members, n: int, k: int, h: float, p: Floats, gain: Floats, s: Floats, moving: int
) -> None:
    """Write P C', and the variances of the innovations over that of the noise (D 27)."""
    d, correlation = n + 1 + k, members.rates[CORRELATION]
    used, top = members.noise[USED], min(3, n + 1 + k)
    for g in range(moving, COUNT):
        s[g] = members.record[VARIANCE, k, g]
    for i in range(d):
        row, other = gain[i], p[at(d, 0, i)]
        for g in range(moving):
            row[g] = (1.0 - correlation[g]) * other[g]
        for j in range(1, top):  # z_1 of the sample before is the state of now, h back
            other, factor = p[at(d, min(i, j), max(i, j))], -((-h) ** j) / FACTORIALS[j]
            for g in range(moving):
                row[g] += correlation[g] * factor * other[g]
    first = gain[0]
    for g in range(moving):
        s[g] = (1.0 - correlation[g]) * first[g]
    for j in range(1, top):
        row, factor = gain[j], -((-h) ** j) / FACTORIALS[j]
        for g in range(moving):
            s[g] += correlation[g] * factor * row[g]
    for g in range(moving):
        s[g] = 1.0 + max(s[g], 0.0) / used[COLOUR[g]]


@compiled()
def correct_covariances(
    members: Members, n: int, k: int, p: Floats, gain: Floats, s: Floats, moving: int
) -> None:
    """Take a sample into P of the members that move, and turn P C' into their gains (D 27)."""
    d, used, inverse = n + 1 + k, members.noise[USED], np.empty(moving)
    for g in range(moving):
        inverse[g] = 1.0 / (s[g] * used[COLOUR[g]])
    for i in range(d):
        first = gain[i]
        for j in range(i, d):
            second, row = gain[j], p[at(d, i, j)]
            for g in range(moving):
                row[g] -= first[g] * second[g] * inverse[g]
    for i in range(d):
        row = gain[i]
        for g in range(moving):
            row[g] *= inverse[g]


@compiled()
def correct_states(members: Members, n: int, k: int, y: float, ahead: Floats, b: Floats) -> None:
    """Correct the members' predictions by their innovations `b`, of bounded influence."""
    x, gain = members.x[k], members.gain[k]
    for i in range(n + 1 + k):
        row, source, factor = x[i], ahead[i], gain[i]
        for g in range(COUNT):
            row[g] = source[g] + factor[g] * b[g]
    residual, correlation = members.record[RESIDUAL, k], members.rates[CORRELATION]
    for g in range(COUNT):
        c = correlation[g]
        limit = HUBER * math.sqrt(members.noise[SQUARE, COLOUR[g]] / (1.0 - c * c))
        residual[g] = min(max(y - x[0, g], -limit), limit)


@compiled()
def gather(law: Law, work: Work, memory: Floats, members: Members, y: float, h: float) -> None:
    """Collect the first samples, which tell the period, the noise and the sizes (D 28)."""
    n, x, first = law.gains.shape[1] - ORDERS, work.x, members.p[2]
    count = int(memory[SAMPLES])
    if count == 0:
        first[0, 0], first[1, 0] = memory[Y], 0.0
        count = 1
    if count == FIRST_SAMPLES:  # y has not changed since
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
    noise, largest, binomial, quantum, repeated = math.inf, 0.0, 1.0, math.inf, 0.0
    for i in range(count):
        largest = max(largest, abs(first[0, i]))
    for order in range(1, n + 2):
        length = count - order
        binomial *= (4.0 * order - 2.0) / order  # (2 order)! / order!^2
        for i in range(length):
            differences[i] = differences[i + 1] - differences[i]
            values[i] = abs(differences[i])
            if order == 1 and values[i] > 1e-12 * largest:
                quantum = min(quantum, values[i])
            elif order == 1:
                repeated += 1.0 / length
        size = middle(values, length) / 0.6745 / math.sqrt(binomial)
        if size > 0.0:
            noise = min(noise, size)
    if quantum == math.inf and least == 0.0:
        return
    if repeated > SAME_LOW:
        noise = max(quantum / math.sqrt(12.0), noise if noise < math.inf else 0.0)
        memory[QUANTUM] = quantum
    memory[REPEATED] = repeated
    if noise == math.inf:
        noise = quantum
    noise = max(noise, least, 1e-9 * largest, 1e-150)
    begin(law, memory, members, count, y, period, noise)
    memory[SAMPLES] = FIRST_SAMPLES + 1


@compiled()
def middle(values: Floats, count: int) -> float:
    """Return the median of the first `count` values, which are sorted in place."""
    for i in range(1, count):
        value, j = values[i], i
        while j > 0 and values[j - 1] > value:
            values[j] = values[j - 1]
            j -= 1
        values[j] = value
    return float(values[count // 2])


@compiled()
def begin(
    law: Law, memory: Floats, members: Members, count: int, y: float, period: float, noise: float
) -> None:
    """Let the members begin at `y` (D 28)."""
    n = law.gains.shape[1] - ORDERS
    sizes, first = np.empty(n), members.p[2][0, :count].copy()
    stride = max((count - 1) // n, 1)
    for i in range(n):  # how large z_i may be: its setting, or what differences say
        sizes[i] = law.chances[FRESH * law.gains.shape[1] + i, i]
        if i > 0:
            for j in range(count - i * stride):
                first[j] = (first[j + stride] - first[j]) / (stride * period)
                sizes[i] = max(sizes[i], first[j] * first[j])
    memory[MOVING] = COUNT
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
    least = math.inf
    for k in range(ORDERS):
        x = members.x[k]
        p = members.p[k]
        d = n + 1 + k
        x[:] = 0.0
        p[:] = 0.0
        for g in range(COUNT):
            omega, kappa = BANDWIDTHS[g] / period, rates[KAPPA, g]
            intensity = noise * noise * period * omega ** (2 * d)
            record[INTENSITY, k, g] = intensity
            x[0, g] = y
            p[0, g] = noise * noise
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
            record[PRIOR, k, g] = -0.5 * size
            least = min(least, size)
    for k in range(ORDERS):
        for g in range(COUNT):
            record[PRIOR, k, g] += 0.5 * least
            record[SCORE, k, g] = record[PRIOR, k, g]
            record[VARIANCE, k, g] = 1.0
            record[LOG_VARIANCE, k, g] = record[RESIDUAL, k, g] = record[FAR, k, g] = 0.0
            record[SHORT, k, g] = 1.0
    memory[LIKELIEST] = weigh(members)


@compiled()
def weigh(members: Members) -> int:
    """Turn log-likelihoods into weights (D 28); return the colour of the likeliest member."""
    score, weight, total = members.record[SCORE], members.record[WEIGHT], 0.0
    best, colour = -math.inf, 0
    for k in range(ORDERS):
        for g in range(COUNT):
            if score[k, g] > best:
                best, colour = score[k, g], COLOUR[g]
    for k in range(ORDERS):
        for g in range(COUNT):
            score[k, g] = max(score[k, g] - best, -FLOOR)
            weight[k, g] = math.exp(score[k, g]) if score[k, g] > -NEGLIGIBLE else 0.0
            total += weight[k, g]
    for k in range(ORDERS):
        for g in range(COUNT):
            weight[k, g] /= total
    return colour


@compiled()
def mix(law: Law, members: Members, x: Floats) -> None:
    """Write the mean of the members' estimates, and its variances, to rows of `x` (D 28)."""
    n, slider = x.shape[1] - ORDERS, math.log(law.scalars[SLIDER]) / math.log(STEP_OF_BANDS)
    whole = math.floor(slider)
    part = slider - whole
    weight, kappa = members.record[WEIGHT], members.rates[KAPPA]
    shown = np.zeros((ORDERS, COUNT))
    for k in range(ORDERS):
        for g in range(COUNT):
            w = weight[k, g]
            if w > 0.0:
                band = g // IN_BAND
                low = min(max(band + whole, 0), BANDS - 1) * IN_BAND + g % IN_BAND
                high = min(max(band + whole + 1, 0), BANDS - 1) * IN_BAND + g % IN_BAND
                shown[k, low] += (1.0 - part) * w
                if part > 0.0:
                    shown[k, high] += part * w
    for i in range(x.shape[1]):
        x[HAT, i] = x[COVARIANCE, i] = 0.0
    for k in range(ORDERS):
        z = members.x[k]
        for g in range(COUNT):
            w = shown[k, g]
            if w > 0.0:
                for i in range(n + 1):
                    x[HAT, i] += w * z[i, g]
                c, d, rate, second = kappa[g], z[n, g], 0.0, 0.0
                if k > 0:
                    rate = z[n + 1, g]
                if k > 1:
                    second = z[n + 2, g]
                x[HAT, n + 1] += w * (rate - c * d)
                x[HAT, n + 2] += w * (second - 2.0 * c * rate + c * c * d)
    for k in range(ORDERS):
        z = members.x[k]
        p = members.p[k]
        for g in range(COUNT):
            w = shown[k, g]
            if w > 0.0:
                for i in range(n + 1):
                    off = z[i, g] - x[HAT, i]
                    x[COVARIANCE, i] += w * (max(p[at(n + 1 + k, i, i), g], 0.0) + off * off)


@compiled()
def follow_period(law: Law, members: Members, memory: Floats, h: float) -> None:
    """Decide which covariances move, and what depends on the period (D 27)."""
    rates, noise = members.rates, members.noise
    if h != memory[FLOW_PERIOD]:
        for g in range(COUNT):
            rates[DECAYED, g] = math.exp(-rates[KAPPA, g] * h)
            tau = rates[TAU, g]
            rates[CORRELATION, g] = math.exp(-h / tau) if tau > 0.0 else 0.0
    changed = abs(h - memory[STEADY_PERIOD]) > NEAR * memory[STEADY_PERIOD]
    likeliest = int(memory[LIKELIEST])
    for c in range(COLOURS.size):
        ratio, limit = noise[SQUARE, c] / noise[USED, c], ANOTHER if c == likeliest else FAR_OFF
        changed = changed or not 1.0 / limit < ratio < limit
    if changed:
        noise[USED] = noise[SQUARE]
    if changed or not law.flags[LINEAR]:
        memory[UNSETTLED] = 0.0
        memory[STEADY_PERIOD] = h
    memory[UNSETTLED] += h
    n = law.gains.shape[1] - ORDERS
    slowed = 1.0
    for c in range(COLOURS.size):
        slowed = min(slowed, (memory[FIRST_NOISE] / noise[USED, c]) ** (0.5 / (n + 1)))
    moving = 0
    for band in range(BANDS):
        kappa, ratio = rates[KAPPA, band * IN_BAND], RATIO[band * IN_BAND]
        if kappa / ratio * slowed * memory[UNSETTLED] < LONG:
            moving += IN_BAND
    memory[MOVING] = moving


@compiled()
def find_quantum(members: Members, memory: Floats, y: float) -> float:
    """
    Follow the quantum of y; return the half-width of the zone in which y says nothing (D 29).

    The zone is 0 unless samples repeat, which noise of the size of the quantum prevents.
    """
    step = abs(y - memory[Y])
    if step > 1e-12 * abs(y) and (memory[QUANTUM] == 0.0 or step < memory[QUANTUM]):
        memory[QUANTUM] = step
    repeats = 1.0 if step == 0.0 else 0.0
    memory[REPEATED] += (repeats - memory[REPEATED]) / SAME_SAMPLES
    share = min(max((memory[REPEATED] - SAME_LOW) / (SAME_HIGH - SAME_LOW), 0.0), 1.0)
    least = share * memory[QUANTUM] ** 2 / 12.0
    for c in range(COLOURS.size):
        square = max(members.noise[SQUARE, c], least * (1.0 - COLOURS[c] ** 2))
        members.noise[SQUARE, c] = square
    return float(0.5 * share * memory[QUANTUM])


@compiled()
def carry_flow(
    law: Law, work: Work, members: Members, memory: Floats, h: float, u: Floats
) -> None:
    """Predict the mean, with its derivative by each of its entries (D 27); to ``stages[NOW]``."""
    levels, now = law.gains.shape[1], work.stages[NOW]
    known = law.flags[LINEAR] and h == memory[FLOW_PERIOD]
    for j in range(levels - 1 if known else 0, levels):
        for i in range(levels):
            now[0, i], now[1, i] = work.x[HAT, i], 0.0
        now[1, j] = 1.0
        predict(law, work, h, u, law.scalars[PREDICTION_STEP])
        for i in range(levels):
            members.flow[i, j] = now[1, i]
    memory[FLOW_PERIOD] = h


@compiled()
def knowing(members: Members, s: Floats) -> float:
    """Return the largest variance of the innovations with which a member can judge a sample."""
    noise, least = members.noise[SQUARE], math.inf
    for k in range(ORDERS):
        for g in range(COUNT):
            least = min(least, s[k, g] * noise[COLOUR[g]])
    return IGNORANT * least


@compiled()
def is_likely(members: Members, b: Floats, s: Floats, largest: float) -> bool:
    """Return True if a member that can judge the sample finds it likely (D 29)."""
    noise = members.noise[SQUARE]
    for k in range(ORDERS):
        for g in range(COUNT):
            variance = s[k, g] * noise[COLOUR[g]]
            if variance <= largest and b[k, g] * b[k, g] <= GATE * GATE * variance:
                return True
    return False


@compiled()
def follow_noise(members: Members, b: Floats, s: Floats, largest: float, count: float) -> float:
    """
    Follow the noise of y of each colour, by the innovations of its likeliest members (D 29).

    Parameters
    ----------
    largest : float
        See `knowing`.
    count : float
        Number of samples to average over.

    Returns
    -------
    float
        How much larger than expected squared innovations have been of late, for every member:
        more than 1 while the noise grows.

    """
    record, noise = members.record, members.noise
    weights, squares, least = np.zeros(COLOURS.size), np.zeros(COLOURS.size), math.inf
    best = np.full(COLOURS.size, -math.inf)
    for k in range(ORDERS):
        for g in range(COUNT):
            best[COLOUR[g]] = max(best[COLOUR[g]], record[SCORE, k, g])
    for k in range(ORDERS):
        for g in range(COUNT):
            r = b[k, g] * b[k, g] / (s[k, g] * noise[SQUARE, COLOUR[g]])
            r = min(r, HUBER * HUBER)
            record[SHORT, k, g] += SHORT_SHARE * (r - record[SHORT, k, g])
            if s[k, g] * noise[SQUARE, COLOUR[g]] <= largest:
                least = min(least, record[SHORT, k, g])
            below = record[SCORE, k, g] - best[COLOUR[g]]
            if below > -CLOSE:
                share = math.exp(below)
                weights[COLOUR[g]] += share
                squares[COLOUR[g]] += share * r
    if least > STEADY:  # every member that can judge says so: the noise has grown
        count = min(count, QUICK_SAMPLES)
    for c in range(COLOURS.size):
        ratio = squares[c] / weights[c] / CLIPPED
        noise[SQUARE, c] *= 1.0 + (ratio - 1.0) / count
    return max(least, 1.0)


@compiled()
def judge(members: Members, b: Floats, s: Floats, grown: float, kept: float) -> None:
    """
    Take a sample into the log-likelihoods, and bound the innovations (D 27, D 28), in place.

    Parameters
    ----------
    kept : float
        Part of the log-likelihoods that is not forgotten; negative to leave them as they are.

    """
    record, colours = members.record, members.noise[SQUARE]
    log_colours = np.log(colours)
    for k in range(ORDERS):
        for g in range(COUNT):
            variance = s[k, g] * colours[COLOUR[g]]
            r = b[k, g] * b[k, g] / variance
            record[FAR, k, g] = record[FAR, k, g] + 1.0 if r > GATE * GATE else 0.0
            if kept >= 0.0:
                prior, log_s = record[PRIOR, k, g], record[LOG_VARIANCE, k, g]
                likelihood = min(r / grown, HUBER * HUBER) + log_s + log_colours[COLOUR[g]]
                score = prior + kept * (record[SCORE, k, g] - prior)
                record[SCORE, k, g] = score - 0.5 * likelihood
            limit = HUBER * math.sqrt(variance)
            b[k, g] = min(max(b[k, g], -limit), limit)


@compiled()
def step_members(
    law: Law, work: Work, memory: Floats, rows: Floats, y: float, h: float, u: Floats
) -> float:
    """
    Advance the members, and the estimates in ``work.x``, to the sample `y`.

    Returns
    -------
    float
        Square of the innovation of the mean. A sample that is too far off is counted in
        ``memory[BEYOND]``, and changes nothing else.

    """
    x, n = work.x, law.gains.shape[1] - ORDERS
    members = unowned(members_in(rows, n))
    if memory[SAMPLES] <= FIRST_SAMPLES:
        gather(law, work, memory, members, y, h)
        return 0.0
    zone = find_quantum(members, memory, y)
    follow_period(law, members, memory, h)
    moving, now = int(memory[MOVING]), work.stages[NOW]
    carry_flow(law, work, members, memory, h, u)
    mean, predicted = x[HAT].copy(), now[0].copy()
    b, s, believed = np.empty((3, ORDERS, COUNT))
    # A sample that is not likely must change none of these.
    x0, x1, x2 = members.x
    ahead, p, gain = (x0.copy(), x1.copy(), x2.copy()), members.p, members.gain
    if moving > 0:
        p, gain = (
            (p[0].copy(), p[1].copy(), p[2].copy()),
            (gain[0].copy(), gain[1].copy(), gain[2].copy()),
        )
    for k in range(ORDERS):
        predict_states(members, n, k, h, mean, predicted, ahead[k])
        if moving > 0:
            predict_covariances(members, n, k, h, p[k], moving)
        expect_innovations(members, n, k, h, p[k], gain[k], s[k], moving)
        residual, correlation = members.record[RESIDUAL, k], members.rates[CORRELATION]
        for g in range(COUNT):
            off = y - ahead[k][0, g] - correlation[g] * residual[g]
            b[k, g] = max(off - zone, 0.0) + min(off + zone, 0.0)
            believed[k, g] = s[k, g]
            if memory[BEYOND] > 0.0:  # P grows meanwhile, and the quick members believe anything
                believed[k, g] = min(s[k, g], 4.0 * members.record[VARIANCE, k, g])
    count = min(memory[SAMPLES], NOISE_SAMPLES)
    memory[SAMPLES] = count + 1.0
    largest = knowing(members, believed)
    if not is_likely(members, b, believed, largest):
        sign = math.copysign(1.0, b[ORDERS - 1, COUNT - 1])
        if sign == memory[FAR_SIGN] or memory[BEYOND] == 0.0:
            memory[BEYOND] += 1.0
        else:  # noise has both signs, y that is off has one
            memory[BEYOND] = 1.0
            follow_noise(members, b, believed, largest, count)
        memory[FAR_SIGN] = sign
        return 0.0
    memory[BEYOND] = 0.0
    grown = follow_noise(members, b, believed, largest, count)
    memory[CALM] = memory[CALM] + 1.0 if grown <= STEADY else 0.0
    kept = math.exp(-h / law.scalars[FORGETTING])
    members.record[VARIANCE, :, :moving] = s[:, :moving]
    members.record[LOG_VARIANCE, :, :moving] = np.log(s[:, :moving])
    judge(members, b, s, grown, kept if memory[CALM] > CALM_SAMPLES else -1.0)
    for k in range(ORDERS):
        if moving > 0:
            correct_covariances(members, n, k, p[k], gain[k], s[k], moving)
            members.p[k][:, :moving] = p[k][:, :moving]
            members.gain[k][:, :moving] = gain[k][:, :moving]
        correct_states(members, n, k, y, ahead[k], b[k])
    memory[LIKELIEST] = weigh(members)
    mix(law, members, x)
    find_strays(members, n, x)
    return float((y - x[HAT, 0]) ** 2)


@compiled()
def find_strays(members: Members, n: int, x: Floats) -> None:
    """Put members that have been far off for long to the mean."""
    far, kappa = members.record[FAR], members.rates[KAPPA]
    for k in range(ORDERS):
        z = members.x[k]
        for g in range(COUNT):
            if far[k, g] > LOST_SAMPLES:
                far[k, g] = 0.0
                for i in range(n + 1):
                    z[i, g] = x[HAT, i]
                rate = x[HAT, n + 1] + kappa[g] * x[HAT, n]
                if k > 0:
                    z[n + 1, g] = rate
                if k > 1:
                    z[n + 2, g] = x[HAT, n + 2] + kappa[g] * (2.0 * rate - kappa[g] * x[HAT, n])


@compiled()
def restart_members(law: Law, levels: Floats, memory: Floats, rows: Floats, y: float) -> None:
    """Begin afresh from `y`: z is not known any more, d and the noise are (D 29)."""
    n = law.gains.shape[1] - ORDERS
    members = members_in(rows, n)
    memory[UNSETTLED], memory[BEYOND] = 0.0, 0.0
    levels[HAT, 0] = memory[Y] = y
    for k in range(ORDERS):
        z = members.x[k]
        p = members.p[k]
        d = n + 1 + k
        for g in range(COUNT):
            c = members.rates[CORRELATION, g]
            z[0, g] = y
            for i in range(n):
                size = law.chances[FRESH * law.gains.shape[1] + i, i]
                p[at(d, i, i), g] = max(size, levels[HAT, i] ** 2)
                for j in range(i + 1, d):
                    p[at(d, i, j), g] = 0.0
            p[0, g] = members.noise[SQUARE, COLOUR[g]] / (1.0 - c * c)
            members.record[RESIDUAL, k, g] = members.record[FAR, k, g] = 0.0
            members.record[SHORT, k, g] = 1.0


def _step_at(table: int, y: float, h: float, inputs: int, count: int) -> float:
    """Do what `step_members` does, or with h = 0 `restart_members`, on the arrays of a table."""
    law, work, (levels, memory) = observer_at(integers_at(table, (ARRAYS, 3)), 0)
    rows = levels[ROWS + law.gains.shape[1] :]
    if h > 0.0:
        return step_members(law, work, memory, rows, y, h, doubles_at(inputs, count))
    restart_members(law, levels, memory, rows, y)
    return 0.0


@cache
def step_address() -> int:
    """Return the address of the machine code of a step; compiles it where that is new."""
    integer, double = types.int64, types.float64
    return compiled_callback(_step_at, double(integer, double, double, integer, integer))
