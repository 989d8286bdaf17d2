# SPDX-License-Identifier: Apache-2.0
"""What a tuning by a bag says: gains.yaml, report.md with notes, and a figure."""

import math
from pathlib import Path

from fhaosmo_ros import __version__
from fhaosmo_ros.core.parameters.tables import ESTIMATOR_PARAMETERS
from fhaosmo_ros.tools.tuning import figures
from fhaosmo_ros.tools.tuning.bag_gains import BEGIN, Gains, Run
from fhaosmo_ros.tools.tuning.identify import Identified, LAGS, SURE
from fhaosmo_ros.tools.tuning.report import save, table
import numpy as np

COLOURED = 0.1
"""Correlation of neighbouring samples from which on the noise is told to be coloured."""
TENTHS = 10
SMALL_CORRELATION = 0.05
UNLIKELY = 0.01
NEAR = 1.2
"""Sizes that differ by less than this factor are alike."""
CHANGED = 1.5
TREND = 3.0
"""A drift of d along the bag counts from so many times the rest of d on."""
FLAT = 2.0
"""A standard deviation of a logarithm from which on a number is not known."""


def write(
    folder: Path, found: Identified, gains: Gains, run: Run, command: str, origin: str
) -> str:
    """Write everything into a new folder; return the report's main part, to be printed."""
    likelihood, y = found.likelihood, found.likelihood.samples.y
    whole = float(likelihood.samples.h.sum())
    share = gains.expected[-1] / found.size_of_input
    told = [f'Note: {text}' for text in notes(found, run)]
    comments = [
        'Made by',
        f'    python -m fhaosmo_ros {command}',
        f'(fhaosmo_ros {__version__}) from {origin}: {len(y)} samples, {whole:.1f} s.',
        f'Found: noise {found.best.low_noise:.3g}; d with an RMS of {found.size_of_input:.3g}; '
        f'its expected error is {gains.expected[-1]:.3g}.',
        *told,
    ]
    parameters = ESTIMATOR_PARAMETERS.part_of(gains.parameters)
    main = '\n\n'.join([
        _found(found, gains),
        f'The error of d is expected to be {share:.2f} of its size.',
        _run(run, gains.innovation),
        *told,
    ])  # fmt: skip
    s = found.sensor
    parts = [
        '# Tuning by a bag',
        f'    python -m fhaosmo_ros {command}',
        f'{origin}: {len(y)} samples of y, {whole:.1f} s, {s.sample_rate:.4g} Hz (jitter '
        f'{1e3 * s.stamp_jitter:.2g} ms, {s.dropout:.2%} lost'
        + (f', steps of {s.quantisation:.4g}' if s.quantisation else '')
        + f'). Model: order {likelihood.model.order}, phi = {list(likelihood.model.phi)}.',
        '## What y shows',
        main,
        'Ranges hold 68 % where the model is right; they follow from the curvature of the '
        'log-likelihood. What is found is that of y in this bag: where d will be quicker or '
        'larger, record it so.',
        '![d, and the innovations](estimates.png)',
        '## Gains',
        '\n'.join(f'    {name}: {value}' for name, value in parameters.items()),
    ]
    save(folder, parameters, comments, parts)
    figures.save_identified(run, gains.expected[-1], folder / 'estimates.png')
    return main


def _found(found: Identified, gains: Gains) -> str:
    design, spread, n = found.best.design, found.spread, found.likelihood.model.order
    period = 1.0 / design.decay
    rows = [
        ('noise of y (standard deviation)', _number(found.best.low_noise, spread['noise'])),
        ('size of d (RMS)', _number(found.size_of_input, spread['size'])),
        ('time in which d changes (1/kappa), s', _number(period, spread['decay'])),
        ('derivatives of d that are followed', f'{design.derivatives}'),
        ('bandwidth of the filter, rad/s', f'{design.bandwidth:.3g}'),
    ]
    if found.likelihood.fixed:
        rows[0] = (rows[0][0], f'{found.best.noise:.4g} (given)')
    if design.colour > COLOURED:
        rows.insert(1, ('of that, correlation from sample to sample', f'{design.colour:.2f}'))
    names = [f'z{i + 1}' for i in range(n)] + ['d']
    rows += [
        (f'expected error of {name}', f'{e:.3g}')
        for name, e in zip(names, gains.expected, strict=True)
    ]
    return table(['found in y', ''], rows)


def _number(value: float, spread: float) -> str:
    if not spread < FLAT:
        return f'{value:.3g} (hardly known)'
    low, high = value * math.exp(-spread), value * math.exp(spread)
    return f'{value:.4g} ({low:.3g} to {high:.3g})'


def _run(run: Run, innovation: float) -> str:
    largest = int(np.abs(run.correlations).argmax())
    counts = run.counters
    rows = [
        ('innovations, measured / expected', f'{run.size:.2f} (expected {innovation:.3g})'),
        (
            f'their largest correlation within {LAGS} samples',
            f'{run.correlations[largest]:+.3f} over {largest + 1}; chance explains '
            f'{2.0 / math.sqrt(len(run.t)):.3f}',
        ),
        ('probability of that if they are white (Ljung-Box)', f'{run.probability:.2g}'),
        ('samples rejected, times begun afresh', f'{counts.rejected}, {counts.divergences}'),
    ]
    return table(['the estimator along the bag', ''], rows)


def notes(found: Identified, run: Run) -> list[str]:
    """Return what a user should know before trusting the gains."""
    return [*_of_noise(found), *_of_model(found), *_of_run(run, found.best.design.colour)]


def _of_noise(found: Identified) -> list[str]:
    design, texts = found.best.design, []
    if found.white is not None and design.colour > COLOURED:
        gain = found.best.log_likelihood - found.white.log_likelihood
        texts.append(
            f'The noise of y is coloured: neighbouring samples correlate by {design.colour:.2f}, '
            'as behind a low-pass filter in the sensor, or where its zero drifts. Fixed gains '
            f'know white noise only. These count on white noise of {found.best.low_noise:.3g}, '
            'which has the same power at low frequencies; so innovations are smaller than '
            'expected, and correlated. '
            f'`gains: self_tuning` follows the colour itself. (White noise is less likely by '
            f'{gain:.0f} in the logarithm.)'
        )
    r = np.where(found.likelihood.samples.used, found.best.innovations, np.nan)
    finite = [np.abs(piece[np.isfinite(piece)]) for piece in np.array_split(r, TENTHS)]
    levels = [
        float(np.median(piece)) / 0.6745 * found.best.noise for piece in finite if len(piece) >= 30
    ]
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
    return texts


def _of_run(run: Run, colour: float) -> list[str]:
    texts, coloured = [], colour > COLOURED
    if lost := run.counters.divergences:
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
