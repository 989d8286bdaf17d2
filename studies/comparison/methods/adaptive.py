# SPDX-License-Identifier: Apache-2.0
"""
Kalman filters that bend or adapt: Huber weights, a noise found from innovations, several models.

One recursion for all three, with covariances relative to the tuned noise. Huber: an innovation e
beyond `huber` standard deviations sqrt(S) counts as if its noise were larger, so that its
influence is bounded. Noise: R <- R + share (max(e^2 - P_11, R_0 / 10^4) - R), the recursive form
of innovation-based adaptive estimation (A. H. Mohamed and K. P. Schwarz, Journal of Geodesy 73,
1999, doi:10.1007/s001900050236). Several models: the interacting multiple model filter
(H. A. P. Blom and Y. Bar-Shalom, IEEE Transactions on Automatic Control 33(8), 1988,
doi:10.1109/9.1299).
"""

import math
from typing import NamedTuple

from fhaosmo_ros.core.compiled.cache import compiled
from fhaosmo_ros.core.compiled.unowned_arrays import unowned
from fhaosmo_ros.core.model.bytecode import Bytecode, Floats
from fhaosmo_ros.core.model.integrate import (
    begin_step,
    CLASSICAL,
    NOW,
    take_slope,
    triangular_rates,
)
from fhaosmo_ros.core.simulation.recordings import Recording
from fhaosmo_ros.tools.tuning.start.sampled_model import SampledModel
import numpy as np
from studies.comparison.methods.method import Setting

LEAST = 1e-4
"""Smallest variance of the noise, over the tuned one."""


class Options(NamedTuple):
    """
    What a filter does beside a Kalman filter.

    Attributes
    ----------
    huber : float
        Innovations beyond so many standard deviations are bounded; infinite: none.
    memory : float
        Seconds over which the noise is found; infinite: it stays as tuned.
    stay : float
        Expected time in seconds that one of several models holds.

    """

    huber: float = math.inf
    memory: float = math.inf
    stay: float = 1.0


@compiled()
def _run(
    model: Bytecode,
    stack: Floats,
    stages: Floats,
    a: Floats,
    q: Floats,
    scale: Floats,
    first: Floats,
    y: Floats,
    h: float,
    settings: Floats,
    out: Floats,
) -> None:
    """
    Estimate from samples of even period; row k of `out` belongs to sample k.

    Parameters
    ----------
    a, q : (N, N) and (M, N, N) arrays
        Transition, and noise of each of M models, in scaled states over the tuned noise.
    scale : (N,) array
        Scaled states over states.
    first : (N, N) array
        Covariance at the first sample.
    settings : (3,) array
        Huber's limit, share of a sample in the noise, probability of another model.

    """
    model, stack, stages = unowned(model), unowned(stack), unowned(stages)
    count, size = q.shape[0], q.shape[1]
    x, mixed = np.zeros((count, size)), np.zeros((count, size))
    p, between = np.zeros((count, size, size)), np.zeros((count, size, size))
    share, other = np.full(count, 1.0 / count), np.zeros(count)
    r, u = np.ones(count), np.zeros(1)
    x[:, 0] = y[0]
    for j in range(count):
        p[j] = first
    switch = settings[2] / max(count - 1, 1) if count > 1 else 0.0
    for k in range(y.shape[0]):
        for j in range(count):  # mix: each model begins from what all of them say
            weights = np.full(count, switch) * share
            weights[j] = (1.0 - switch * (count - 1)) * share[j]
            other[j] = weights.sum()
            weights /= other[j]
            mixed[j], between[j] = 0.0, 0.0
            for i in range(count):
                mixed[j] += weights[i] * x[i]
            for i in range(count):
                away = (x[i] - mixed[j]) * scale
                between[j] += weights[i] * (p[i] + np.outer(away, away))
        best = -np.inf
        for j in range(count):
            stages[NOW, 0] = mixed[j]
            if k > 0:
                begin_step(stages)
                for stage in range(CLASSICAL.nodes.size):
                    triangular_rates(model, 0.0, u, stack, stages)
                    take_slope(CLASSICAL, stage, h, stages)
            prior = a @ between[j] @ a.T + q[j]
            e = (y[k] - stages[NOW, 0, 0]) * scale[0]
            s = prior[0, 0] + r[j]
            other[j] = math.log(other[j] + 1e-300) - 0.5 * (math.log(s) + e * e / s)
            best = max(best, other[j])
            far = abs(e) / (settings[0] * math.sqrt(s))
            divisor = s * max(far, 1.0)
            x[j] = stages[NOW, 0] + prior[:, 0] / divisor * e / scale
            p[j] = prior - np.outer(prior[:, 0], prior[:, 0]) / divisor
            r[j] += settings[1] * (max(e * e - prior[0, 0], LEAST) - r[j])
        share[:] = np.exp(other - best)
        share /= share.sum()
        for j in range(count):
            out[k] += share[j] * x[j]


def unknown_input(
    setting: Setting,
    derivatives: int,
    decay: float,
    intensities: list[float],
    options: Options,
    recording: Recording,
) -> Floats:
    """
    Return the estimates of d, for samples of even period and a model without known inputs.

    Parameters
    ----------
    setting : Setting
        The noise is the tuned one.
    derivatives : int
        Of d; its last one is driven by white noise.
    decay : float
        Of d and its derivatives, in 1/s.
    intensities : list of float
        Of that white noise, over the variance of the tuned noise: a model each.
    options : Options
    recording : Recording

    """
    model, h = setting.model, setting.period
    sampled = SampledModel(model, h, derivatives + 1, decay=decay)
    size = sampled.size
    q = np.array([sampled.process_noise([intensity]) for intensity in intensities])
    scale = h ** np.arange(size) / setting.noise
    about = setting.balance(derivatives) ** np.arange(1.0 + derivatives)
    sizes = np.concatenate([np.ones(model.order), setting.size * about])
    sizes[0] = setting.noise
    out = np.zeros((len(recording.y), size))
    settings = np.array([options.huber, h / options.memory, h / options.stay])
    _run(
        model.with_unknown_input(decay, derivatives), np.zeros((2, model.depth)),
        np.zeros((4, 2, size)), sampled.a, q, scale, np.diag((scale * sizes) ** 2), recording.y, h,
        settings, out,
    )  # fmt: skip
    return out[:, model.order]
