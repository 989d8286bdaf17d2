# SPDX-License-Identifier: Apache-2.0
"""The output of a tuning by a bag: gains.yaml, report.md and a figure."""

from collections.abc import Sequence
import math
from pathlib import Path

from fhaosmo_ros import __version__
from fhaosmo_ros.core.parameters.tables import ESTIMATOR_PARAMETERS
from fhaosmo_ros.tools.tuning import figures
from fhaosmo_ros.tools.tuning.bag_gains import BEGIN, Gains, Run
from fhaosmo_ros.tools.tuning.identify import Identified, LAGS
from fhaosmo_ros.tools.tuning.report import parameter_file, table
import numpy as np

FLAT = 2.0
"""A standard deviation of a logarithm from which on a number is not known."""


def write(
    folder: Path,
    found: Identified,
    gains: Gains,
    run: Run,
    notes: Sequence[str],
    command: str,
    origin: str,
) -> str:
    """
    Write everything into a new folder.

    Returns
    -------
    str
        The report's main part, to be printed.

    """
    folder.mkdir()
    likelihood, y = found.likelihood, found.likelihood.samples.y
    whole = float(likelihood.samples.h.sum())
    share = gains.expected[-1] / found.size_of_input
    comments = [
        'Made by',
        f'    python -m fhaosmo_ros {command}',
        f'(fhaosmo_ros {__version__}) from {origin}: {len(y)} samples, {whole:.1f} s.',
        f'Found: noise {found.best.low_noise:.3g}; d with an RMS of {found.size_of_input:.3g}; '
        f'its expected error is {gains.expected[-1]:.3g}.',
        *(f'Note: {text}' for text in notes),
    ]
    parameters = ESTIMATOR_PARAMETERS.part_of(gains.parameters)
    (folder / 'gains.yaml').write_text(parameter_file(parameters, comments), 'utf-8')
    main = '\n\n'.join([
        _found(found, gains),
        f'The error of d is expected to be {share:.2f} of its size.',
        _run(run, gains),
        *(f'Note: {text}' for text in notes),
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
    (folder / 'report.md').write_text('\n\n'.join(parts) + '\n', encoding='utf-8')
    begin = int(BEGIN * len(run.t))
    figures.save_identified(
        run.t, run.unknown_input, gains.expected[-1], run.t[begin], run.correlations,
        2.0 / math.sqrt(len(run.t) - begin), folder / 'estimates.png',
    )  # fmt: skip
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
    if design.colour > 0.1:
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


def _run(run: Run, gains: Gains) -> str:
    largest = int(np.abs(run.correlations).argmax())
    counts = run.counters
    rows = [
        ('innovations, measured / expected', f'{run.size:.2f} (expected {gains.innovation:.3g})'),
        (
            f'their largest correlation within {LAGS} samples',
            f'{run.correlations[largest]:+.3f} over {largest + 1}; chance explains '
            f'{2.0 / math.sqrt(len(run.t)):.3f}',
        ),
        ('probability of that if they are white (Ljung-Box)', f'{run.probability:.2g}'),
        ('samples rejected, times begun afresh', f'{counts.rejected}, {counts.divergences}'),
    ]
    return table(['the estimator along the bag', ''], rows)
