# SPDX-License-Identifier: Apache-2.0
"""How likely each member is, and the mean of all (D 28)."""

import math

from fhaosmo_ros.core.compiled.cache import compiled
from fhaosmo_ros.core.model.bytecode import Floats
from fhaosmo_ros.core.observer.arrays import (
    COVARIANCE,
    DERIVATIVES,
    DRIVE,
    HAT,
    Law,
    LIKELIEST,
    LOSS,
    MODEL,
    NOISE,
    SLIDER,
    TOLD,
)
from fhaosmo_ros.core.observer.covariance import GATE
from fhaosmo_ros.core.observer.self_tuning.filters import at, HUBER
from fhaosmo_ros.core.observer.self_tuning.members import (
    BANDS,
    COLOUR,
    CORRELATION,
    COUNT,
    FAR,
    FAST,
    fill,
    IN_BAND,
    INTENSITY,
    KAPPA,
    LOG_VARIANCE,
    Members,
    ORDERS,
    PRIOR,
    repeat,
    SCORE,
    Scratch,
    SQUARE,
    STEP_OF_BANDS,
    WEIGHT,
)
import numpy as np

FLOOR, QUANTISED_FLOOR = 30.0, 100.0
"""
No log-likelihood falls further below the best one (D 28, D 31), but by what the member's prior is
below that of the likeliest: a larger d needs more reason to be believed.
"""
CLEARLY = 2.0
"""A member is clearly likelier than another one if its log-likelihood is so much larger."""
NEGLIGIBLE = 25.0
"""Members whose log-likelihood is so far below the best one have no weight."""


@compiled(fastmath=FAST)
def judge(members: Members, scratch: Scratch, grown: float, kept: float, calm: bool) -> None:
    """
    Take a sample into the log-likelihoods, and bound the innovations (D 27, D 28), in place.

    Parameters
    ----------
    kept : float
        Part of the log-likelihoods that is not forgotten; negative to leave them as they are.
    calm : bool
        True if the noise has not grown of late: then samples in a row that are far off a member
        are not outliers, but its fault.

    """
    noise, log_noise, r = scratch.lines[0], scratch.lines[1], scratch.lines[2]
    fill(noise, members.noise[SQUARE])
    for g in range(IN_BAND):
        log_noise[g] = math.log(noise[g])
    repeat(log_noise)
    for k in range(ORDERS):
        far, innovation, share = members.record[FAR, k], scratch.b[k], scratch.s[k]
        for g in range(COUNT):
            r[g] = innovation[g] * innovation[g] / (share[g] * noise[g])
            far[g] = far[g] + 1.0 if r[g] > GATE * GATE else 0.0
        if kept >= 0.0:
            score, prior = members.record[SCORE, k], members.record[PRIOR, k]
            log_s = members.record[LOG_VARIANCE, k]
            for g in range(COUNT):
                late = max(far[g] - 1.0, 0.0) if calm else 0.0
                most = HUBER * HUBER * (1.0 + late * late)
                likelihood = min(r[g] / grown, most) + log_s[g] + log_noise[g]
                score[g] = prior[g] + kept * (score[g] - prior[g]) - 0.5 * likelihood
        for g in range(COUNT):
            if r[g] > HUBER * HUBER:
                late = max(far[g] - 1.0, 0.0)  # in a row: not an outlier, but d
                limit = HUBER * math.sqrt(share[g] * noise[g]) * (1.0 + late * late)
                innovation[g] = min(max(innovation[g], -limit), limit)


@compiled(fastmath=FAST - {'nnan'})
def weigh(members: Members, floor: float) -> int:
    """Turn log-likelihoods into weights (D 28); return which member is the likeliest."""
    best, total, likeliest = -math.inf, 0.0, 0
    for k in range(ORDERS):
        score = members.record[SCORE, k]
        for g in range(COUNT):
            best = max(best, score[g])
    for k in range(ORDERS - 1, -1, -1):
        score = members.record[SCORE, k]
        for g in range(COUNT - 1, -1, -1):
            if score[g] == best:  # the first of them; before they are judged there are many
                likeliest = k * COUNT + g
    usual = members.record[PRIOR, likeliest // COUNT, likeliest % COUNT]
    for k in range(ORDERS):
        score, weight = members.record[SCORE, k], members.record[WEIGHT, k]
        prior = members.record[PRIOR, k]
        for g in range(COUNT):
            score[g] = max(score[g] - best, min(prior[g] - usual, 0.0) - floor)
            weight[g] = 0.0
        for g in range(COUNT):
            if score[g] > -NEGLIGIBLE:  # few of them
                weight[g] = math.exp(score[g])
                total += weight[g]
    for k in range(ORDERS):
        weight = members.record[WEIGHT, k]
        for g in range(COUNT):
            weight[g] /= total
    return likeliest


@compiled()
def tell_model(
    law: Law, members: Members, memory: Floats, h: float, jumped: bool, x: Floats
) -> None:
    """
    Write the model of d and the noise of the likeliest member to `x`, for a smoother (D 34).

    It stays until another one is clearly likelier. Coloured noise counts as white noise that is as
    dense where the member's bandwidth ends.
    """
    k, g = divmod(int(memory[TOLD]), COUNT)
    if members.record[SCORE, k, g] < -CLEARLY:
        memory[TOLD] = memory[LIKELIEST]
        k, g = divmod(int(memory[TOLD]), COUNT)
    slider = law.scalars[SLIDER]
    row, twice = x[MODEL], 2.0 * (x.shape[1] - ORDERS + 1 + k)
    noise, a = members.noise[SQUARE, COLOUR[g]], members.rates[CORRELATION, g]
    drive = members.record[INTENSITY, k, g] * slider**twice
    edge = min((drive / (noise * h)) ** (1.0 / twice) * h, math.pi)
    row[NOISE] = noise / (1.0 + a * (a - 2.0 * math.cos(edge)))
    row[DRIVE], row[LOSS] = drive, members.rates[KAPPA, g] * slider
    row[DERIVATIVES] = k - ORDERS if jumped else k


@compiled()
def shift(weight: Floats, slider: float) -> Floats:
    """Return the weights of the members whose estimates are shown: `slider` bands quicker."""
    whole = math.floor(slider)
    part, shown = slider - whole, np.zeros((ORDERS, COUNT))
    for k in range(ORDERS):
        for g in range(COUNT):
            band, kind = g // IN_BAND, g % IN_BAND
            low = min(max(band + whole, 0), BANDS - 1) * IN_BAND + kind
            high = min(max(band + whole + 1, 0), BANDS - 1) * IN_BAND + kind
            shown[k, low] += (1.0 - part) * weight[k, g]
            shown[k, high] += part * weight[k, g]
    return shown


@compiled(fastmath=FAST)
def weighted(w: Floats, values: Floats) -> float:
    """Return the sum of w times `values` over the members that have a weight."""
    total = 0.0
    for g in range(COUNT):
        value = w[g] * values[g]
        total += value if w[g] > 0.0 else 0.0
    return total


@compiled(fastmath=FAST)
def mix(law: Law, members: Members, scratch: Scratch, x: Floats) -> None:
    """Write the mean of the members' estimates, and its variances, to rows of `x` (D 28)."""
    n, kappa, shown = x.shape[1] - ORDERS, members.rates[KAPPA], members.record[WEIGHT]
    if law.scalars[SLIDER] != 1.0:
        shown = shift(shown, math.log(law.scalars[SLIDER]) / math.log(STEP_OF_BANDS))
    x[HAT], x[COVARIANCE], derivative = 0.0, 0.0, scratch.lines[0]
    shares = [shown[k].sum() for k in range(ORDERS)]
    for k in range(ORDERS):
        if shares[k] == 0.0:
            continue
        w, z = shown[k], members.x[k]
        for i in range(n + 1):
            x[HAT, i] += weighted(w, z[i])
        d, rate, second = z[n], z[n + min(k, 1)], z[n + k]
        for g in range(COUNT):
            derivative[g] = (rate[g] if k > 0 else 0.0) - kappa[g] * d[g]
        x[HAT, n + 1] += weighted(w, derivative)
        for g in range(COUNT):
            derivative[g] = kappa[g] * kappa[g] * d[g]
            if k > 0:
                derivative[g] -= 2.0 * kappa[g] * rate[g]
            if k > 1:
                derivative[g] += second[g]
        x[HAT, n + 2] += weighted(w, derivative)
    for k in range(ORDERS):
        if shares[k] == 0.0:
            continue
        w, z, p = shown[k], members.x[k], members.p[k]
        for i in range(n + 1):
            mean, value, variance = x[HAT, i], z[i], p[at(n + 1 + k, i, i)]
            total = 0.0
            for g in range(COUNT):
                off = value[g] - mean
                part = w[g] * (max(variance[g], 0.0) + off * off)
                total += part if w[g] > 0.0 else 0.0
            x[COVARIANCE, i] += total
