# SPDX-License-Identifier: Apache-2.0
"""What is wrong with a recorded y, or with its model, in plain sentences."""

from itertools import pairwise
import math

from fhaosmo_ros.tools.tuning.bag_gains import BEGIN, Gains, Run
from fhaosmo_ros.tools.tuning.identify import (
    Identified,
    NothingToFind,
    PIECES,
)
from fhaosmo_ros.tools.tuning.likelihood import QUICKEST
import numpy as np

SURE = 10.0
"""A difference of log-likelihoods that is no accident."""
NO_NOISE = 1e-7
"""Noise over the size of y below which y is a simulated one without noise."""
WANDERING = 0.99
"""A correlation from which on the noise is a random walk."""
UNSEEN = 0.97
"""Expected error of d over its size from which on an estimate tells nothing."""
SMALL_CORRELATION = 0.05
UNLIKELY = 0.01
NEAR = 1.2
"""Sizes that differ by less than this factor are alike."""
CHANGED = 1.5
TREND = 3.0
"""A drift of d along the bag counts from so many times the rest of d on."""


def refuse(found: Identified) -> None:
    """
    Raise where there can be no gains.

    Raises
    ------
    NothingToFind
        Why.

    """
    likelihood, design, y = found.likelihood, found.best.design, found.likelihood.samples.y
    period, sensor = likelihood.period, found.sensor
    top = 0.9 * QUICKEST / period
    white = found.white or found.best
    silent = sensor.noise_std < NO_NOISE * float(np.std(y)) and not sensor.quantisation
    if silent and not likelihood.fixed:
        raise NothingToFind(
            f'y: expected noise, got none that shows ({sensor.noise_std:.1e} in a y of '
            f'{np.std(y):.3g}), as in a simulation without noise: the less noise, the larger the '
            'gains, without limit. Say what the sensor will have: -p noise_size:=...'
        )
    if not likelihood.fixed and max(white.design.bandwidth, design.bandwidth) > top:
        raise NothingToFind(
            f'y: the likeliest filter follows every sample ({design.bandwidth:.3g} rad/s at '
            f'{1.0 / period:.4g} Hz). Either y has no noise that shows, or it moves in a way that '
            'the model cannot: it jumps, or order or phi are wrong. Say what noise the sensor '
            'has (-p noise_size:=...), sample faster, or correct the model'
        )
    if design.colour > WANDERING:
        step = found.best.noise / math.sqrt(period)
        raise NothingToFind(
            f'y: its error wanders like a random walk, by {step:.3g} in a second (in the unit of '
            'y), which cannot be told from what d does. Either the sensor drifts, or y has no '
            'noise that shows, or order or phi do not fit this plant'
        )
    if found.silent < SURE:
        raise NothingToFind(
            f'd: expected a y that d moves, got one that the model explains with d = 0 (noise '
            f'{found.best.noise:.3g}). Record while the unknown input acts, and longer'
        )


def refuse_unseen(found: Identified, gains: Gains) -> None:
    """
    Raise where the estimate of d would tell nothing.

    Raises
    ------
    NothingToFind
        Why.

    """
    share = gains.expected[-1] / found.size_of_input
    if share > UNSEEN:
        raise NothingToFind(
            f'd: it changes too fast to be seen through this noise: the expected error is '
            f'{min(share, 1.0):.2f} of its size, and an estimate of 0 has 1.00. Does y drift or '
            f'jump by itself, or is the order ({found.likelihood.model.order}) too high by one? '
            'Else a sensor with less noise, or a higher rate, is needed'
        )


def notes(found: Identified, gains: Gains, run: Run) -> list[str]:
    """Return what a user should know before trusting the gains."""
    return [
        *_of_noise(found),
        *_of_model(found),
        *_of_run(found, run),
    ]


def _of_noise(found: Identified) -> list[str]:
    design, texts = found.best.design, []
    count = int(found.likelihood.samples.used.sum())
    if found.white is not None and design.colour > 0.1:
        gain = (found.best.training - found.white.training) * count
        texts.append(
            f'The noise of y is coloured: neighbouring samples correlate by {design.colour:.2f}, '
            'as behind a low-pass filter in the sensor, or where its zero drifts. Fixed gains '
            f'know white noise only. These count on white noise of {found.best.low_noise:.3g}, '
            'which has the same power at low frequencies; so innovations are smaller than '
            'expected, and correlated. '
            f'`gains: self_tuning` follows the colour itself. (White noise is less likely by '
            f'{gain:.0f} in the logarithm.)'
        )
    r = found.best.innovations
    edges = np.linspace(0, len(r), PIECES + 1).astype(int)
    levels = []
    for a, b in pairwise(edges):
        piece = np.abs(r[a:b][np.isfinite(r[a:b]) & found.likelihood.samples.used[a:b]])
        if len(piece) >= 30:
            levels.append(float(np.median(piece)) / 0.6745 * found.best.noise)
    if levels and max(levels) > CHANGED * min(levels):
        texts.append(
            f'Noise, or d, changes along the bag: in tenths of it the innovations have a size of '
            f'{min(levels):.3g} to {max(levels):.3g}. Fixed gains fit their mean; '
            '`gains: self_tuning` follows such changes.'
        )
    if found.sensor.quantisation > 2.0 * found.best.noise:
        texts.append(
            f'y comes in steps of {found.sensor.quantisation:.3g}, larger than its noise: the '
            'error of the steps is not random. docs/recipes.md says what helps.'
        )
    if found.outliers:
        texts.append(
            f'{found.outliers} samples ({found.outliers / len(r):.2%}) are outliers. They were '
            'left out; the estimator rejects such samples, too.'
        )
    return texts


def _of_model(found: Identified) -> list[str]:
    model, samples, texts = found.likelihood.model, found.likelihood.samples, []
    n, whole = model.order, float(samples.h.sum())
    rates = model.jacobian(np.zeros(n)) + np.eye(n, k=1)
    growth = float(np.linalg.eigvals(rates).real.max())
    if growth * whole > SURE:
        texts.append(
            f'The model is unstable: at rest, without d, it grows tenfold within '
            f'{math.log(10.0) / growth:.2g} s, but y has stayed within {samples.y.min():.3g} and '
            f'{samples.y.max():.3g} for {whole:.0f} s. If no controller holds this plant, then a '
            'sign in phi is wrong; if one does, its command should be a known input, or d '
            'contains it.'
        )
    level, gain = max(found.shaken.items(), key=lambda item: item[1])
    if gain > SURE and level < n + 1:
        where = f"z{level}' = {f'z{level + 1}' if level < n else 'd'} + Phi_{level}"
        texts.append(
            f'The model misses something: y is likelier by {gain:.0f} in the logarithm if random '
            f'shocks act in {where} as well. The order may be wrong (an unknown input that acts '
            'there makes a model of fewer states the right one), phi may be, or y may slip or '
            'drift. Standard deviations are too small then.'
        )
    smoother = found.tried.get(2), found.tried.get(1)
    if found.best.design.derivatives == 2 and all(smoother):
        gain = (smoother[0].held_out - smoother[1].held_out) * 0.5 * len(samples.y)
        if gain > SURE:
            texts.append(
                'd is so smooth that two of its derivatives are followed. If the order '
                f'({n}) is right, there is nothing to do. A model with too few states shows the '
                'same: d is then a state of the plant, and what acts on it lies behind.'
            )
    begin = int(BEGIN * len(samples.y))
    t, d = np.cumsum(samples.h)[begin:], found.best.estimates[begin:, n]
    slope, middle = np.polyfit(t - t.mean(), d, 1)
    rest = float(np.std(d - middle - slope * (t - t.mean())))
    drift = float(slope) * whole
    if abs(drift) > TREND * rest:
        texts.append(
            f'd drifts by {drift:+.3g} along the bag, {abs(drift) / rest:.1f} times what it '
            'varies otherwise. That is the unknown input, or a drift of the sensor, or of the '
            'plant: y alone does not tell which.'
        )
    if found.best.design.decay * whole < 3.0:
        texts.append(
            f'd does not come back to 0 within this bag of {whole:.0f} s, so its size is hardly '
            'known. A longer bag would tell.'
        )
    return texts


def _of_run(found: Identified, run: Run) -> list[str]:
    texts, coloured = [], found.best.design.colour > 0.1
    lost = run.counters.divergences
    if lost:
        texts.append(
            f'With these gains the estimator lost y {lost} times in this bag and began afresh: '
            'do not use them before the notes above are settled.'
        )
    if not coloured and not 1.0 / NEAR < run.size < NEAR:
        texts.append(
            f'Innovations have {run.size:.2f} times the expected size: the model or the noise '
            'are not what they are taken for, and so are the standard deviations.'
        )
    largest = float(np.abs(run.correlations).max())
    if not coloured and run.probability < UNLIKELY and largest > SMALL_CORRELATION:
        lag = int(np.abs(run.correlations).argmax()) + 1
        texts.append(
            f'Innovations are not white: they correlate by {run.correlations[lag - 1]:+.2f} with '
            f'those {lag} before them. The model of the plant, of d or of the noise does not '
            'quite fit; the gains are the best of their kind, but standard deviations are too '
            'small.'
        )
    return texts
