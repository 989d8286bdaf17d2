# SPDX-License-Identifier: Apache-2.0
"""What a tuning by a bag says: gains.yaml, and report.md with notes."""

from collections.abc import Iterator
import math
from pathlib import Path

from fhaosmo_ros import __version__
from fhaosmo_ros.core.parameters.tables import ESTIMATOR_PARAMETERS
from fhaosmo_ros.tools.tuning.bag_gains import Gains, Run
from fhaosmo_ros.tools.tuning.identify import Identified, LAGS, SURE
from fhaosmo_ros.tools.tuning.report import save, table
import numpy as np

SMALL_CORRELATION, UNLIKELY = 0.05, 0.01
NEAR = 1.2
"""Sizes that differ by less than this factor are alike."""


def write(
    folder: Path, found: Identified, gains: Gains, run: Run, command: str, origin: str
) -> str:
    """Write everything into a new folder; return the report's main part, to be printed."""
    likelihood, y = found.likelihood, found.likelihood.samples.y
    error, size = gains.expected[-1], found.size_of_input
    read = f'{len(y)} samples, {likelihood.samples.h.sum():.1f} s'
    told = [f'Note: {text}' for text in notes(found, run)]
    comments = [
        'Made by',
        f'    python -m fhaosmo_ros {command}',
        f'(fhaosmo_ros {__version__}) from {origin}: {read}.',
        f'Found: noise {found.best.noise:.3g}; d with an RMS of {size:.3g}; '
        f'its expected error is {error:.3g}.',
        *told,
    ]
    parameters = ESTIMATOR_PARAMETERS.part_of(gains.parameters)
    main = '\n\n'.join([
        _found(found, gains),
        f'The error of d is expected to be {error / size:.2f} of its size.',
        _run(run, gains.innovation),
        *told,
    ])  # fmt: skip
    parts = [
        '# Tuning by a bag',
        f'    python -m fhaosmo_ros {command}',
        f'{origin}: {read}, {1.0 / likelihood.period:.4g} Hz'
        + (f', steps of {found.quantum:.4g}' if found.quantum else '')
        + f'. Model: order {likelihood.model.order}, phi = {list(likelihood.model.phi)}.',
        '## What y shows',
        main,
        'What is found is that of y in this bag: where d will be quicker or larger, record it so.',
        '## Gains',
        '\n'.join(f'    {name}: {value}' for name, value in parameters.items()),
    ]
    save(folder, parameters, comments, parts)
    return main


def _found(found: Identified, gains: Gains) -> str:
    """Return the table of what y shows."""
    best, given = found.best, ' (given)' if found.likelihood.fixed else ''
    rows = [
        ('noise of y (standard deviation)', f'{best.noise:.4g}{given}'),
        ('size of d (RMS)', f'{found.size_of_input:.4g}'),
        ('time in which d changes (1/kappa), s', f'{1.0 / best.design.decay:.4g}'),
        ('derivatives of d that are followed', f'{best.design.derivatives}'),
        ('bandwidth of the filter, rad/s', f'{best.design.bandwidth:.3g}'),
    ]
    names = [*(f'z{i + 1}' for i in range(len(gains.expected) - 1)), 'd']
    rows += [
        (f'expected error of {name}', f'{e:.3g}')
        for name, e in zip(names, gains.expected, strict=True)
    ]
    return table(['found in y', ''], rows)


def _run(run: Run, innovation: float) -> str:
    """Return the table of what the estimator does with y."""
    largest = int(np.abs(run.correlations).argmax())
    counts = run.counters
    rows = [
        ('innovations, measured / expected', f'{run.size:.2f} (expected {innovation:.3g})'),
        (
            f'their largest correlation within {LAGS} samples',
            f'{run.correlations[largest]:+.3f} over {largest + 1}; chance explains '
            f'{2.0 / math.sqrt(len(run.unknown_input)):.3f}',
        ),
        ('probability of that if they are white (Ljung-Box)', f'{run.probability:.2g}'),
        ('samples rejected, times begun afresh', f'{counts.rejected}, {counts.divergences}'),
    ]
    return table(['the estimator along the bag', ''], rows)


def notes(found: Identified, run: Run) -> Iterator[str]:
    """Say what a user should know before trusting the gains."""
    best, samples = found.best, found.likelihood.samples
    if found.quantum > 2.0 * best.noise:
        yield (
            f'y comes in steps of {found.quantum:.3g}, larger than its noise: the '
            'error of the steps is not random. docs/recipes.md says what helps.'
        )
    if found.outliers:
        yield (
            f'{found.outliers} samples ({found.outliers / len(samples.y):.2%}) are outliers. They '
            'were left out; the estimator rejects such samples, too.'
        )
    model, whole = found.likelihood.model, float(samples.h.sum())
    n = model.order
    rates = model.jacobian(np.zeros(n)) + np.eye(n, k=1)
    growth = float(np.linalg.eigvals(rates).real.max())
    if growth * whole > SURE:
        yield (
            f'The model is unstable: at rest, without d, it grows tenfold within '
            f'{math.log(10.0) / growth:.2g} s, but y has stayed within {samples.y.min():.3g} and '
            f'{samples.y.max():.3g} for {whole:.0f} s. If no controller holds this plant, then a '
            'sign in phi is wrong; if one does, its command should be a known input, or d '
            'contains it.'
        )
    if lost := run.counters.divergences:
        yield (
            f'With these gains the estimator lost y {lost} times in this bag and began afresh: '
            'do not use them before the notes above are settled.'
        )
    if not 1.0 / NEAR < run.size < NEAR:
        yield (
            f'Innovations have {run.size:.2f} times the expected size: the model or the noise '
            'are not what they are taken for, and so are the standard deviations.'
        )
    lag = int(np.abs(run.correlations).argmax())
    if run.probability < UNLIKELY and abs(run.correlations[lag]) > SMALL_CORRELATION:
        yield (
            f'Innovations are not white: they correlate by {run.correlations[lag]:+.2f} with '
            f'those {lag + 1} before them. The model of the plant, of d or of the noise does not '
            'quite fit; the gains are the best of their kind, but standard deviations are too '
            'small. `gains: self_tuning` follows noise that is coloured.'
        )
