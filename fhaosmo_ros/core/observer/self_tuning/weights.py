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
from fhaosmo_ros.core.observer.self_tuning.covariances import at
from fhaosmo_ros.core.observer.self_tuning.filters import HUBER
from fhaosmo_ros.core.observer.self_tuning.members import (
    BAND,
    BANDS,
    COLOUR,
    COLOURS,
    CORRELATION,
    COUNT,
    FAR,
    FAST,
    fill,
    HALF,
    IN_BAND,
    KAPPA,
    largest_of,
    LOG_VARIANCE,
    Members,
    ORDER,
    ORDERS,
    PRIOR,
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
    noise, log_noise, r, logs = (
        scratch.lines[0], scratch.lines[1], scratch.lines[2], scratch.lines[3]
    )  # fmt: skip
    fill(noise, members.noise[SQUARE])
    for c in range(COLOURS.size):
        logs[c] = math.log(members.noise[SQUARE, c])
    fill(log_noise, logs)
    far, innovation, share = members.record[FAR], scratch.b, scratch.s
    for g in range(members.active):
        r[g] = innovation[g] * innovation[g] / (share[g] * noise[g])
        far[g] = far[g] + 1.0 if r[g] > GATE * GATE else 0.0
    if kept >= 0.0:
        score, prior = members.record[SCORE], members.record[PRIOR]
        log_s, slack = members.record[LOG_VARIANCE], 1.0 if calm else 0.0
        for g in range(members.active):
            late = slack * max(far[g] - 1.0, 0.0)
            most = HUBER * HUBER * (1.0 + late * late)
            likelihood = min(r[g] / grown, most) + log_s[g] + log_noise[g]
            score[g] = prior[g] + kept * (score[g] - prior[g]) - 0.5 * likelihood
    for g in range(members.active):
        if r[g] > HUBER * HUBER:
            late = max(far[g] - 1.0, 0.0)  # in a row: not an outlier, but d
            limit = HUBER * math.sqrt(share[g] * noise[g]) * (1.0 + late * late)
            innovation[g] = min(max(innovation[g], -limit), limit)


@compiled(fastmath=FAST - {'nnan'})
def weigh(members: Members, floor: float) -> int:
    """Turn log-likelihoods into weights (D 28); return which member is the likeliest."""
    score, weight, prior = members.record[SCORE], members.record[WEIGHT], members.record[PRIOR]
    best, total, likeliest = largest_of(score, weight, members.active), 0.0, 0
    while score[likeliest] < best:  # the first of them; before they are judged there are many
        likeliest += 1
    usual = prior[likeliest]
    for g in range(members.active):
        score[g] = max(score[g] - best, min(prior[g] - usual, 0.0) - floor)
        weight[g] = 0.0
    for g in range(members.active):
        if score[g] > -NEGLIGIBLE:  # few of them
            weight[g] = math.exp(score[g])
            total += weight[g]
    for g in range(members.active):
        weight[g] /= total
    return likeliest


@compiled(fastmath=FAST - {'nnan'})
def are_finite(members: Members) -> bool:
    """Return False if any member, or its weight, is lost: where Phi or P grows without a limit."""
    total, z, p, weight = 0.0, members.x[0], members.p[0], members.record[WEIGHT]
    for g in range(members.active):
        total += z[g] * weight[g] + p[g]
    return total - total == 0.0


@compiled()
def tell_model(
    law: Law, members: Members, memory: Floats, h: float, jumped: bool, x: Floats
) -> None:
    """
    Write the model of d and the noise of the likeliest member to `x`, for a smoother (D 34).

    It stays until another one is clearly likelier. Coloured noise counts as white noise that is as
    dense where the member's bandwidth ends.
    """
    if members.record[SCORE, int(memory[TOLD])] < -CLEARLY:
        memory[TOLD] = memory[LIKELIEST]
    g = int(memory[TOLD])
    slider, k = law.scalars[SLIDER], ORDER[g]
    row, twice = x[MODEL], 2.0 * (x.shape[1] - ORDERS + 1 + k)
    noise, a = members.noise[SQUARE, COLOUR[g]], members.rates[CORRELATION, g]
    drive = members.drive[k, g] * slider**twice
    edge = min((drive / (noise * h)) ** (1.0 / twice) * h, math.pi)
    row[NOISE] = noise / (1.0 + a * (a - 2.0 * math.cos(edge)))
    row[DRIVE], row[LOSS] = drive, members.rates[KAPPA, g] * slider
    row[DERIVATIVES] = k - ORDERS if jumped else k


@compiled()
def shift(weight: Floats, slider: float) -> Floats:
    """Return the weights of the members whose estimates are shown: `slider` bands quicker."""
    whole = math.floor(slider)
    part, shown = slider - whole, np.zeros(COUNT)
    for g in range(COUNT):
        band, quicker = BAND[g], -IN_BAND if g < HALF else IN_BAND
        low = min(max(band + whole, 0), BANDS - 1) - band
        high = min(max(band + whole + 1, 0), BANDS - 1) - band
        shown[g + low * quicker] += (1.0 - part) * weight[g]
        shown[g + high * quicker] += part * weight[g]
    return shown


@compiled(fastmath=FAST)
def weighted(w: Floats, values: Floats, count: int) -> float:
    """Return the sum of w times `values` over the members that have a weight."""
    total = 0.0
    for g in range(count):
        value = w[g] * values[g]
        total += value if w[g] > 0.0 else 0.0
    return total


@compiled(fastmath=FAST)
def mix(law: Law, members: Members, scratch: Scratch, x: Floats) -> None:
    """Write the mean of the members' estimates, and its variances, to rows of `x` (D 28)."""
    n, kappa, w, count = (
        x.shape[1] - ORDERS, members.rates[KAPPA], members.record[WEIGHT], members.active
    )  # fmt: skip
    if law.scalars[SLIDER] != 1.0:
        w = shift(w, math.log(law.scalars[SLIDER]) / math.log(STEP_OF_BANDS))
    z, p, derivative = members.x, members.p, scratch.lines[0]
    d, first, second, third = z[n], z[n + 1], z[n + 2], z[n + 3]
    x[COVARIANCE] = 0.0
    for i in range(n + 1):
        x[HAT, i] = weighted(w, z[i], count)
    for g in range(count):
        derivative[g] = first[g] - kappa[g] * d[g]
    x[HAT, n + 1] = weighted(w, derivative, count)
    for g in range(count):
        derivative[g] = second[g] - kappa[g] * (2.0 * first[g] - kappa[g] * d[g])
    x[HAT, n + 2] = weighted(w, derivative, count)
    for g in range(count):
        c = kappa[g]
        derivative[g] = third[g] - c * (3.0 * second[g] - c * (3.0 * first[g] - c * d[g]))
    x[HAT, n + 3] = weighted(w, derivative, count)
    for i in range(n + 1):
        mean, value, variance, total = x[HAT, i], z[i], p[at(n + ORDERS, i, i)], 0.0
        for g in range(count):
            off = value[g] - mean
            part = w[g] * (max(variance[g], 0.0) + off * off)
            total += part if w[g] > 0.0 else 0.0
        x[COVARIANCE, i] = total
