# SPDX-License-Identifier: Apache-2.0
"""What a tuning says: gains.yaml, which the estimator loads, and report.md."""

from collections.abc import Iterable, Iterator, Sequence
import math
from pathlib import Path
from typing import Any

from fhaosmo_ros import __version__
from fhaosmo_ros.core.parameters.files import dumps
from fhaosmo_ros.core.parameters.tables import ESTIMATOR_PARAMETERS
from fhaosmo_ros.core.simulation.metrics import rms
from fhaosmo_ros.core.simulation.recordings import Recording
from fhaosmo_ros.tools.tuning.identify import Identification, SURE
from fhaosmo_ros.tools.tuning.search import finished
from fhaosmo_ros.tools.tuning.tuner import Tuner
import numpy as np

SMALL_CORRELATION, UNLIKELY = 0.05, 0.01


def save(folder: Path, command: str, parameters: dict[str, Any], text: str) -> None:
    """Write a new folder: the report as a page, and at the head of the gains."""
    folder.mkdir()
    text = f'    python -m fhaosmo_ros {command}\n\n(fhaosmo_ros {__version__})\n\n{text}\n'
    (folder / 'report.md').write_text(f'# Tuning\n\n{text}', 'utf-8')
    head = ''.join(f'# {line}'.rstrip() + '\n' for line in text.splitlines())
    (folder / 'gains.yaml').write_text(head + dumps(parameters), 'utf-8')


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a Markdown table."""
    lines = [head, ['---'] * len(head), *rows]
    return '\n'.join(f'| {" | ".join(cells)} |' for cells in lines)


def of_search(tuner: Tuner, study: Any, held_out: list[Recording]) -> tuple[dict[str, Any], str]:
    """Return the gains for a simulated family, and a report of them."""
    tuned, columns, found = tuner.parameters(study.best_params), [''], []
    start = tuner.parameters({d.name: d.start for d in tuner.space})
    for title, parameters in (('start', start), ('tuned', tuned)):
        columns += [f'{title}, training', f'{title}, held out']
        found += [tuner.objective(parameters), tuner.objective(parameters, held_out)]
    rows = [['error, relative to the truth', *(f'{error:.4f}' for error, _ in found)]]
    names = [*(f'z{k}' for k in range(1, len(tuner.objective.scale))), 'd']
    for name, of_name in zip(names, zip(*(rms(e) for _, e in found), strict=True), strict=True):
        rows.append([f'RMS error of {name}', *(f'{error:.3g}' for error in of_name)])
    text = '\n\n'.join([
        f'{finished(study)} trials on {len(tuner.objective.recordings)} simulated recordings; '
        f'{len(held_out)} others, held out, took no part in the search.',
        table(columns, rows),
    ])  # fmt: skip
    return tuned, text


def of_bag(found: Identification, bag: str) -> tuple[dict[str, Any], str]:
    """Return the gains for what the y of a bag shows, and a report of them."""
    best, (parameters, expected) = found.best, found.gains()
    size, white = found.size_of_input(best.design, best.noise), found.whiteness()
    span = found.samples.h.sum()
    rows = [
        (f'samples in {bag}', f'{len(found.samples.y)} in {span:.1f} s'),
        ('noise of y (standard deviation)', f'{best.noise:.4g}' + ' (given)' * found.fixed),
        ('size of d (RMS)', f'{size:.4g}'),
        ('time in which d changes (1/kappa), s', f'{1.0 / best.design.decay:.4g}'),
        ('derivatives of d that are followed', f'{best.design.derivatives}'),
    ]
    for i, error in enumerate(expected[:-1], 1):
        rows.append((f'expected error of z{i}', f'{error:.3g}'))
    share = expected[-1] / size
    rows.append(('expected error of d', f'{expected[-1]:.3g} ({share:.2f} of its size)'))
    rows.append(('probability that innovations are white (Ljung-Box)', f'{white[1]:.2g}'))
    told = [f'Note: {text}' for text in notes(found, *white)]
    text = '\n\n'.join([table(['found in y', ''], rows), *told])
    return ESTIMATOR_PARAMETERS.part_of(parameters), text


def notes(found: Identification, correlation: float, probability: float) -> Iterator[str]:
    """Say what a user should know before trusting the gains."""
    samples, model, whole = found.samples, found.model, float(found.samples.h.sum())
    if found.quantum > 2.0 * found.best.noise:
        yield (
            f'y comes in steps of {found.quantum:.3g}, larger than its noise: the '
            'error of the steps is not random. docs/recipes.md says what helps.'
        )
    if found.outliers:
        yield (
            f'{found.outliers} samples ({found.outliers / len(samples.y):.2%}) are outliers. They '
            'were left out; the estimator rejects such samples, too.'
        )
    rates = model.jacobian(np.zeros(model.order)) + np.eye(model.order, k=1)
    growth = float(np.linalg.eigvals(rates).real.max())
    if growth * whole > SURE:
        yield (
            f'The model is unstable: at rest, without d, it grows tenfold within '
            f'{math.log(10.0) / growth:.2g} s, but y has stayed within {samples.y.min():.3g} and '
            f'{samples.y.max():.3g} for {whole:.0f} s. If no controller holds this plant, then a '
            'sign in phi is wrong; if one does, its command should be a known input, or d '
            'contains it.'
        )
    if probability < UNLIKELY and abs(correlation) > SMALL_CORRELATION:
        yield (
            f'Innovations are not white: they correlate by {correlation:+.2f} with earlier '
            'ones. The model of the plant, of d or of the noise does not quite fit; the gains are '
            'the best of their kind, but standard deviations are too small. '
            '`gains: self_tuning` follows noise that is coloured.'
        )
