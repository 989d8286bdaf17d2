# SPDX-License-Identifier: Apache-2.0
"""How likely each member is, and the mean of all (D 28)."""

import math

from fhaosmo_ros.core.compiled.cache import compiled
from fhaosmo_ros.core.model.bytecode import Floats
from fhaosmo_ros.core.observer.arrays import COVARIANCE, HAT, Law, SLIDER
from fhaosmo_ros.core.observer.covariance import GATE
from fhaosmo_ros.core.observer.self_tuning.filters import at, HUBER
from fhaosmo_ros.core.observer.self_tuning.members import (
    BANDS,
    COLOUR,
    COUNT,
    FAR,
    IN_BAND,
    KAPPA,
    LOG_VARIANCE,
    Members,
    OfEach,
    ORDERS,
    PRIOR,
    SCORE,
    SQUARE,
    STEP_OF_BANDS,
    WEIGHT,
)
import numpy as np

FLOOR, QUANTISED_FLOOR = 30.0, 100.0
"""No log-likelihood falls further below the best one (D 28, D 31)."""
VAGUE = 0.04
"""Part of the square of half a quantum by which predictions are less certain than their P says."""
NEGLIGIBLE = 25.0
"""Members whose log-likelihood is so far below the best one have no weight."""


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
            late = max(record[FAR, k, g] - 1.0, 0.0)  # in a row: not an outlier, but d
            limit = HUBER * math.sqrt(variance) * (1.0 + late * late)
            b[k, g] = min(max(b[k, g], -limit), limit)


@compiled()
def judge_quantised(members: Members, y: float, ahead: OfEach, quanta: float, kept: float) -> None:
    """
    Take a quantised sample into the log-likelihoods (D 31), in place.

    A prediction that would be rounded to `y` is not worse than another one that would be.

    Parameters
    ----------
    ahead : tuple of arrays
        The members' predictions of z and d.
    quanta : float
        Variance of the error of rounding.

    """
    record, half = members.record, math.sqrt(3.0 * quanta)
    least = max(members.noise[SQUARE, 0] - quanta, 0.0) + VAGUE * half * half
    box = half * math.sqrt(2.0 / math.pi)
    for k in range(ORDERS):
        for g in range(COUNT):
            variance = members.p[k][0, g] + least
            off = max(abs(y - ahead[k][0, g]) - half, 0.0)
            likelihood = min(off * off / variance, HUBER * HUBER)
            likelihood += 2.0 * math.log(math.sqrt(variance) + box)
            prior = record[PRIOR, k, g]
            score = prior + kept * (record[SCORE, k, g] - prior)
            record[SCORE, k, g] = score - 0.5 * likelihood


@compiled()
def weigh(members: Members, floor: float) -> int:
    """Turn log-likelihoods into weights (D 28); return the colour of the likeliest member."""
    score, weight, total = members.record[SCORE], members.record[WEIGHT], 0.0
    best, colour = -math.inf, 0
    for k in range(ORDERS):
        for g in range(COUNT):
            if score[k, g] > best:
                best, colour = score[k, g], COLOUR[g]
    for k in range(ORDERS):
        for g in range(COUNT):
            score[k, g] = max(score[k, g] - best, -floor)
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
