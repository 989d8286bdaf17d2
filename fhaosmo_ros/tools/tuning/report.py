# SPDX-License-Identifier: Apache-2.0
"""What a tuning says: gains.yaml, which the estimator loads, and report.md with notes."""

from collections.abc import Iterable, Iterator, Sequence
import math
from pathlib import Path
from typing import Any, NamedTuple

from fhaosmo_ros import __version__
from fhaosmo_ros.core.parameters.files import dumps
from fhaosmo_ros.core.parameters.tables import ESTIMATOR_PARAMETERS
from fhaosmo_ros.tools.tuning.identify import Gains, Identified, LAGS, Run, SURE
from fhaosmo_ros.tools.tuning.search import Result
from fhaosmo_ros.tools.tuning.tuner import Tuner
import numpy as np

SMALL_CORRELATION, UNLIKELY = 0.05, 0.01


class Report(NamedTuple):
    """What there is to say of gains."""

    parameters: dict[str, Any]
    summary: list[str]  # lines at the head of both files
    main: str  # tables and notes, which are also printed


def save(folder: Path, command: str, report: Report) -> None:
    """Write a new folder with both files."""
    folder.mkdir()
    made = f'python -m fhaosmo_ros {command}'
    lines = ['Made by', f'    {made}', f'(fhaosmo_ros {__version__}).', *report.summary]
    head = ''.join(f'# {line}\n' for line in lines)
    (folder / 'gains.yaml').write_text(head + dumps(report.parameters), 'utf-8')
    parts = ['# Tuning', f'    {made}', '\n'.join(report.summary), report.main]
    (folder / 'report.md').write_text('\n\n'.join(parts) + '\n', 'utf-8')


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a Markdown table."""
    lines = [head, ['---'] * len(head), *rows]
    return '\n'.join(f'| {" | ".join(cells)} |' for cells in lines)


# from simulated recordings


def of_search(tuner: Tuner, result: Result) -> Report:
    """Report the gains for a simulated family."""
    best, begin = result.best, {d.name: d.start for d in tuner.space}
    columns, found = [''], []
    for title, values in (('given' if tuner.given else 'start', begin), ('tuned', best)):
        for data, objective in (('training', tuner.training), ('held out', tuner.held_out)):
            columns.append(f'{title}, {data}')
            found.append(objective(tuner.parameters(values)))
    errors = np.sqrt([np.mean(np.square(e.errors), axis=0) for e in found]).T
    names = [*(f'z{k}' for k in range(1, len(errors))), 'd']
    rows = [['error, relative to the truth', *(f'{e.error:.4f}' for e in found)]]
    for name, of_name in zip(names, errors, strict=True):
        rows.append([f'RMS error of {name}', *(f'{error:.3g}' for error in of_name)])
    training, held_out = (e.error for e in found[2:])
    p = tuner.tuning
    summary = [
        f'{result.trials} trials for a simulated family: noise of y {p["noise_std"]:.3g}, '
        f'{p["sample_rate"]:g} Hz, '
        f'd: {", ".join(dict.fromkeys(p["disturbances"]))} with an RMS of {p["rms_of_d"]:.3g}.',
        f'Error relative to the truth: {training:.3f} in training '
        f'({len(tuner.training.recordings)} recordings), {held_out:.3f} on '
        f'{len(tuner.held_out.recordings)} that took no part in the search.',
    ]
    searched = [
        [d.name, *(f'{x:.4g}' for x in (d.low, d.high, d.start, best[d.name]))]
        for d in tuner.space
    ]
    main = [table(columns, rows), table(['parameter', 'from', 'to', 'start', 'tuned'], searched)]
    return Report(tuner.parameters(best), summary, '\n\n'.join(main))


# from a bag


def of_bag(found: Identified, gains: Gains, run: Run, bag: str) -> Report:
    """Report the gains for what the y of a bag shows."""
    likelihood, best, size = found.likelihood, found.best, found.size_of_input
    samples, told = likelihood.samples, [f'Note: {text}' for text in notes(found, run)]
    summary = [
        f'Bag {bag}: {len(samples.y)} samples, {samples.h.sum():.1f} s, '
        f'{1.0 / likelihood.period:.4g} Hz'
        + (f', steps of {found.quantum:.4g}.' if found.quantum else '.'),
        f'Found: noise {best.noise:.3g}; d with an RMS of {size:.3g}; '
        f'its expected error is {gains.expected[-1]:.3g}.',
        *told,
    ]
    given = ' (given)' if likelihood.fixed else ''
    rows = [
        ('noise of y (standard deviation)', f'{best.noise:.4g}{given}'),
        ('size of d (RMS)', f'{size:.4g}'),
        ('time in which d changes (1/kappa), s', f'{1.0 / best.design.decay:.4g}'),
        ('derivatives of d that are followed', f'{best.design.derivatives}'),
        ('bandwidth of the filter, rad/s', f'{best.design.bandwidth:.3g}'),
    ]
    for i, error in enumerate(gains.expected[:-1], 1):
        rows.append((f'expected error of z{i}', f'{error:.3g}'))
    share = gains.expected[-1] / size
    rows.append(('expected error of d', f'{gains.expected[-1]:.3g} ({share:.2f} of its size)'))
    along = [
        ('innovations, measured / expected', f'{run.size:.2f}'),
        (f'their largest correlation within {LAGS} samples', f'{run.correlation:+.3f}'),
        ('probability of that if they are white (Ljung-Box)', f'{run.probability:.2g}'),
        ('samples rejected', f'{run.counters.rejected}'),
        ('times begun afresh', f'{run.counters.divergences}'),
    ]
    main = '\n\n'.join([
        table(['found in y', ''], rows),
        table(['the estimator along the bag', ''], along),
        *told,
        'This is what y shows in this bag: where d will be quicker or larger, record it so.',
    ])  # fmt: skip
    return Report(ESTIMATOR_PARAMETERS.part_of(gains.parameters), summary, main)


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
    if run.probability < UNLIKELY and abs(run.correlation) > SMALL_CORRELATION:
        yield (
            f'Innovations are not white: they correlate by {run.correlation:+.2f} with earlier '
            'ones. The model of the plant, of d or of the noise does not quite fit; the gains are '
            'the best of their kind, but standard deviations are too small. '
            '`gains: self_tuning` follows noise that is coloured.'
        )
