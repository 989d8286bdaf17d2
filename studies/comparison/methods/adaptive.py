# SPDX-License-Identifier: Apache-2.0
"""
Kalman filters that bend or adapt: Huber weights, a noise found from innovations, several models.

One recursion for all three, with covariances relative to the tuned noise. Huber: an innovation e
beyond `huber` standard deviations sqrt(S) counts as if its noise were larger, so that its
influence is bounded. Noise: R <- R + share (max(e^2 - P_11, R_0 / 10^4) - R), the recursive form
of innovation-based adaptive estimation (A. H. Mohamed and K. P. Schwarz, Journal of Geodesy 73,
1999, doi:10.1007/s001900050236). Several models: the interacting multiple model filter
(H. A. P. Blom and Y. Bar-Shalom, IEEE Transactions on Automatic Control 33(8), 1988,
doi:10.1109/9.1299). Between samples the covariance takes as many steps as there are periods.
"""

import math

from fhaosmo_ros.core.compiled.cache import compiled
from fhaosmo_ros.core.compiled.unowned_arrays import unowned
from fhaosmo_ros.core.model.bytecode import Bytecode, Floats
from fhaosmo_ros.core.model.inputs import known_inputs_of_run
from fhaosmo_ros.core.model.integrate import (
    begin_step,
    CLASSICAL,
    NOW,
    take_slope,
    triangular_rates,
)
from fhaosmo_ros.core.observer.step import Samples
from fhaosmo_ros.core.simulation.recordings import Recording
from fhaosmo_ros.tools.tuning.search.minimise import Dimension
from fhaosmo_ros.tools.tuning.start.sampled_model import SampledModel
import numpy as np
from studies.comparison.methods.linear import each_order, LONGEST, matern_space
from studies.comparison.methods.method import Method, ROBUST, Run, Setting, Values
from studies.comparison.scores import Estimates

LEAST = 1e-4
"""Smallest variance of the noise, over the tuned one."""
HUBER, NOISE, IMM = 'Kalman, Huber', 'Kalman, adaptive noise', 'IMM of three bandwidths'


@compiled()
def _run(
    model: Bytecode,
    stack: Floats,
    stages: Floats,
    a: Floats,
    q: Floats,
    scale: Floats,
    first: Floats,
    samples: Samples,
    periods: Floats,
    settings: Floats,
    out: Floats,
) -> None:
    """
    Estimate from samples; row k of `out` belongs to sample k.

    Parameters
    ----------
    a, q : (N, N) and (M, N, N) arrays
        Transition, and noise of each of M models, in scaled states over the tuned noise.
    scale : (N,) array
        Scaled states over states.
    first : (N, N) array
        Covariance at the first sample.
    periods : (2,) array
        That of `a` and `q`, and the longest step of the prediction, in seconds.
    settings : (3,) array
        Huber's limit, share of a sample in the noise, probability of another model.

    """
    model, stack, stages = unowned(model), unowned(stack), unowned(stages)
    u = unowned(samples.u)
    count, size = q.shape[0], q.shape[1]
    x, mixed = np.zeros((count, size)), np.zeros((count, size))
    p, between = np.zeros((count, size, size)), np.zeros((count, size, size))
    share, other = np.full(count, 1.0 / count), np.zeros(count)
    weights, half, r = np.zeros(count), np.zeros((size, size)), np.ones(count)
    x[:, 0] = samples.y[0]
    for j in range(count):
        p[j] = first
    switch = settings[2] / max(count - 1, 1) if count > 1 else 0.0
    for k in range(samples.y.shape[0]):
        h = samples.h[k]
        steps, times = int(h / periods[1]) + 1, max(1, round(h / periods[0]))
        for j in range(count):  # mix: each model begins from what all of them say
            other[j] = 0.0
            for i in range(count):
                weights[i] = share[i] * (1.0 - switch * (count - 1) if i == j else switch)
                other[j] += weights[i]
            for m in range(size):
                mixed[j, m] = 0.0
                for i in range(count):
                    mixed[j, m] += weights[i] / other[j] * x[i, m]
            for m in range(size):
                for n in range(size):
                    between[j, m, n] = 0.0
                    for i in range(count):
                        away = (x[i, m] - mixed[j, m]) * (x[i, n] - mixed[j, n])
                        spread = p[i, m, n] + away * scale[m] * scale[n]
                        between[j, m, n] += weights[i] / other[j] * spread
        best = -np.inf
        for j in range(count):
            stages[NOW, 0] = mixed[j]
            for _ in range(steps if k > 0 else 0):
                begin_step(stages)
                for stage in range(CLASSICAL.nodes.size):
                    triangular_rates(model, 0.0, u[k], stack, stages)
                    take_slope(CLASSICAL, stage, h / steps, stages)
            prior = between[j]
            for _ in range(times):
                for m in range(size):
                    for n in range(size):
                        half[m, n] = 0.0
                        for i in range(size):
                            half[m, n] += a[m, i] * prior[i, n]
                for m in range(size):
                    for n in range(size):
                        prior[m, n] = q[j, m, n]
                        for i in range(size):
                            prior[m, n] += half[m, i] * a[n, i]
            e = (samples.y[k] - stages[NOW, 0, 0]) * scale[0]
            s = prior[0, 0] + r[j]
            other[j] = math.log(other[j] + 1e-300) - 0.5 * (math.log(s) + e * e / s)
            best = max(best, other[j])
            divisor = s * max(abs(e) / (settings[0] * math.sqrt(s)), 1.0)
            for m in range(size):
                x[j, m] = stages[NOW, 0, m] + prior[m, 0] / divisor * e / scale[m]
                for n in range(size):
                    p[j, m, n] = prior[m, n] - prior[m, 0] * prior[n, 0] / divisor
            r[j] += settings[1] * (max(e * e - prior[0, 0], LEAST) - r[j])
        total = 0.0
        for j in range(count):
            share[j] = math.exp(other[j] - best)
            total += share[j]
        for j in range(count):
            share[j] /= total
            for m in range(size):
                out[k, m] += share[j] * x[j, m]


def _prepare(setting: Setting, values: Values) -> Run:
    model, h, derivatives = setting.model, setting.period, int(values.get('derivatives', 0))
    sampled = SampledModel(model, h, derivatives + 1, decay=values['decay'])
    size, spread = sampled.size, values.get('spread', 1.0)
    factors = (1.0,) if spread == 1.0 else (1.0 / spread, 1.0, spread)
    q = np.array([
        sampled.process_noise([h * (factor * values['bandwidth']) ** (2 * size)])
        for factor in factors
    ])  # fmt: skip
    scale = h ** np.arange(size) / setting.noise
    about = setting.balance(derivatives) ** np.arange(1.0 + derivatives)
    sizes = np.concatenate([np.ones(model.order), setting.size * about])
    sizes[0] = setting.noise
    settings = np.array([
        values.get('huber', math.inf), h / values.get('memory', math.inf),
        h / values.get('stay', 1.0),
    ])  # fmt: skip
    expressions = model.with_unknown_input(values['decay'], derivatives)
    periods = np.array([h, min(LONGEST * h, sampled.resolution)])

    def estimate(r: Recording) -> dict[str, Estimates]:
        u = known_inputs_of_run(r.u, len(r.y), model.inputs)
        samples = Samples(r.y, np.diff(r.t, prepend=r.t[0]), u)
        out = np.zeros((len(r.y), size))
        _run(
            expressions, np.zeros((2, model.depth)), np.zeros((4, 2, size)), sampled.a, q, scale,
            np.diag((scale * sizes) ** 2), samples, periods, settings, out,
        )  # fmt: skip
        return {'filtered': Estimates(out[:, : model.order], out[:, model.order])}

    return estimate


def _method(name: str, text: str, *options: Dimension) -> Method:
    def space(setting: Setting) -> tuple[Dimension, ...]:
        return (*matern_space(setting), *options)

    return Method(name, text, ROBUST, space, _prepare, each_order(*options), needs_noise=True)


ADAPTIVE = (
    _method(
        HUBER, 'Kalman filter, d a Matern process, innovations bounded by Huber',
        Dimension('huber', 1.0, 10.0, 2.5),
    ),
    _method(
        NOISE, 'the same, variance of the noise from the innovations instead',
        Dimension('memory', 0.1, 100.0, 3.0),
    ),
    _method(
        IMM, 'three such filters with different bandwidths, an interacting multiple model',
        Dimension('spread', 1.2, 10.0, 2.0), Dimension('stay', 0.1, 100.0, 3.0),
    ),
)  # fmt: skip
