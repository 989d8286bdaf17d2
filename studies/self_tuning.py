# SPDX-License-Identifier: Apache-2.0
"""
The idea of the self-tuning observer, in plain NumPy: read this before the compiled one.

Many Kalman filters run side by side. Each is right for a d of one speed and smoothness. How well
they predict y says which of them to believe, and how large the noise is. This is all for a linear
model, even stamps, white noise and a d that does not jump; there both observers agree. What the
compiled one does beside it (core/observer/self_tuning/, D 26 to D 36 of docs/mathematics.md) is
for everything else: coloured noise, quanta, outliers, lost samples, jumps, nonlinear models.
The figure of docs/self_tuning.md is made by `python -m studies.self_tuning`.
"""

import argparse
from math import comb
import sys
from typing import NamedTuple

from fhaosmo_ros.core import Plant
from fhaosmo_ros.tools.plot import COLOURS, draw_band, TRUE_STYLE
from matplotlib.figure import Figure
import numpy as np
from studies.harness import discretised, Floats, Found, Results, run_study

BANDWIDTHS = np.geomspace(6e-4, 3.0, 40)  # how fast the d of a member is, rad a sample
DERIVATIVES = (0, 1, 3)  # how smooth: d is white noise, integrated so many times and once more
DECAY = 0.1  # how soon it forgets, as a part of the bandwidth
FIRST = 50  # samples that tell the noise before the filters begin
MEMORY, NOISE_MEMORY = 8000.0, 1000
"""Samples for which likelihoods, and the size of the noise, are remembered."""
FLOOR = 30.0  # no log-likelihood falls further below the best one: each member can come back soon
INEXACT = 1e-10
"""Innovations are expected to be larger by so much, or rounding would make variances negative."""
LIMIT = 3.0  # an innovation counts as so many standard deviations at most: outliers change little
CLIPPED = 0.9733  # mean of x^2 where |x| < 3, for a normal x of variance 1


class Estimates(NamedTuple):
    """What was found at each of K samples; 0 before the filters begin."""

    d: Floats
    deviation: Floats  # standard deviation of the error of d
    noise: Floats  # standard deviation of the noise on y
    weights: Floats  # (K, 40) of the members of each bandwidth


def estimate(model: Floats, y: Floats, period: float) -> Estimates:
    """
    Estimate d from y, (K,), which is z_1 and noise, sampled each `period` (s).

    z' = model z + (0, .., 0, d), and model is (n, n).
    """
    first_noise = noise_of(y[:FIRST], len(model) + 1)
    members = [(omega / period, k) for omega in BANDWIDTHS for k in DERIVATIVES]
    steps = [member(model, period, first_noise**2, *values) for values in members]
    transition, driven, covariance = (np.array(parts) for parts in zip(*steps, strict=True))
    n, d = len(model), len(model)  # d is the state behind z
    x = np.zeros((len(members), n + max(DERIVATIVES) + 1))
    x[:, 0] = y[FIRST - 1]
    prior = -0.5 * np.log(covariance[:, d, d] / covariance[:, d, d].min())
    covariance[:, :n, :n] += np.diag([first_noise**2, *sizes_of(y[:FIRST], n, period)])
    score, noise = prior.copy(), first_noise**2
    found = Estimates(*np.zeros((3, len(y))), np.zeros((len(y), len(BANDWIDTHS))))
    for j in range(FIRST, len(y)):
        # Each filter predicts y, ..
        x = np.einsum('gij,gj->gi', transition, x)
        covariance = transition @ covariance @ transition.transpose(0, 2, 1) + driven
        expected = (1.0 + INEXACT) * (covariance[:, 0, 0] + noise)
        innovation = y[j] - x[:, 0]
        square = np.minimum(innovation**2 / expected, LIMIT**2)
        # .. is weighed by how well it did, ..
        score = prior + np.exp(-1.0 / MEMORY) * (score - prior)
        score -= 0.5 * (square + np.log(expected))
        best = np.argmax(score)
        least = np.minimum(prior - prior[best], 0.0) - FLOOR
        score = np.maximum(score - score[best], least)
        weight = np.where(score > -FLOOR, np.exp(score), 0.0)
        weight /= np.sum(weight)
        # .. and corrects itself.
        gain = covariance[:, :, 0] / expected[:, np.newaxis]
        bound = LIMIT * np.sqrt(expected)
        x += gain * np.clip(innovation, -bound, bound)[:, np.newaxis]
        covariance -= gain[:, :, np.newaxis] * covariance[:, np.newaxis, 0, :]
        # Innovations that are larger than the likely filters expect say that the noise is.
        average = min(j + 1, NOISE_MEMORY)
        noise *= 1.0 + (weight @ square / CLIPPED - 1.0) / average
        found.d[j] = weight @ x[:, d]
        spread = covariance[:, d, d] + (x[:, d] - found.d[j]) ** 2
        found.deviation[j], found.noise[j] = np.sqrt(weight @ spread), np.sqrt(noise)
        found.weights[j] = np.sum(weight.reshape(len(BANDWIDTHS), -1), axis=1)
    return found


def member(model: Floats, period: float, noise: float, omega: float, k: int) -> tuple[Floats, ...]:
    """
    Return transition, covariance of what drives it over one period, and first covariance.

    (D + kappa)^(k + 1) d is white noise, kappa = DECAY omega, as intense as makes omega the
    filter's bandwidth. States are z, d, (D + kappa) d, .., with zeros behind the last one that the
    member has. The first covariance of d is its stationary one.
    """
    n, size, kappa = len(model), len(model) + max(DERIVATIVES) + 1, DECAY * omega
    a, first, of_d = np.zeros((size, size)), np.zeros((size, size)), slice(n, n + k + 1)
    a[:n, :n] = model
    a[n - 1, n] = 1.0
    a[of_d, of_d] = np.eye(k + 1, k=1) - kappa * np.eye(k + 1)
    intensity = noise * period * omega ** (2 * (n + 1 + k))
    transition, driving = discretised(a, n + k, period)
    below = range(k, -1, -1)
    first[of_d, of_d] = [
        [comb(i + j, i) / (2.0 * kappa) ** (i + j + 1) for j in below] for i in below
    ]
    return transition, intensity * driving, intensity * first


def noise_of(y: Floats, highest: int) -> float:
    """Return the noise of y: the least that medians of its differences say, order by order."""
    return min(
        float(np.median(np.abs(np.diff(y, p)))) / 0.6745 / comb(2 * p, p) ** 0.5
        for p in range(1, highest + 1)
    )


def sizes_of(y: Floats, n: int, period: float) -> Floats:
    """Return the first variances of z_2, .., z_n: ten times what differences say, squared."""
    stride = max((len(y) - 1) // n, 1)
    found = []
    for _ in range(1, n):
        y = (y[stride:] - y[:-stride]) / (stride * period)
        found.append(100.0 * np.mean(y**2))
    return np.array(found)


def draw(t: Floats, d: Floats, noise: Floats, found: Estimates) -> Figure:
    """Draw d, the noise, and which members are believed."""
    figure = Figure(figsize=(9.5, 7.0), layout='constrained')
    top, middle, bottom = figure.subplots(3, 1, sharex=True, height_ratios=[2, 1, 1.6])
    pairs = ((top, d, found.d, 'estimated'), (middle, noise, found.noise, 'found'))
    for axes, truth, estimated, label in pairs:
        axes.plot(t, truth, **TRUE_STYLE)
        axes.plot(t, estimated, color=COLOURS[0], linewidth=1.0, label=label)
    draw_band(top, t, found.d, found.deviation)
    top.set(title='Unknown input', ylim=(1.5 * d.min(), 2.2 * d.max()))
    middle.set(title='Standard deviation of the noise of y', ylim=(0.0, 1.5 * noise.max()))
    for axes in (top, middle):
        axes.legend(loc='upper left', ncols=3)
    shown = bottom.pcolormesh(
        t, BANDWIDTHS / (t[1] - t[0]), found.weights.T, cmap='Greys', vmin=0.0, vmax=1.0
    )
    title = 'How much the members of each bandwidth are believed'
    bottom.set(title=title, yscale='log', ylabel='bandwidth [rad/s]', xlabel='time [s]')
    figure.colorbar(shown, ax=bottom, pad=0.01)
    return figure


def measure(arguments: argparse.Namespace, _: Results) -> Found:
    """Estimate the d of the demonstration, with noise that grows."""
    period = 5e-3
    t = np.arange(0.0, 8.0 if arguments.quick else 24.0, period)
    noise = np.where(t < 16.0, 1e-5, 2e-5)
    truth = Plant(disturbance='chirp', disturbance_omega=0.5).simulate(t)
    y = truth.y + noise * np.random.default_rng(0).standard_normal(len(t))
    model = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, -1.0]])
    figure = draw(t, truth.unknown_input, noise, estimate(model, y, period))
    return Found({}, {}, {'self_tuning': figure})


if __name__ == '__main__':
    sys.exit(run_study('self_tuning', __doc__, measure))
