# SPDX-License-Identifier: Apache-2.0
"""The output of a search: gains.yaml and report.md."""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from fhaosmo_ros import __version__
from fhaosmo_ros.core.parameters.files import dumps
from fhaosmo_ros.tools.tuning.objective import Evaluation
from fhaosmo_ros.tools.tuning.search import Result
from fhaosmo_ros.tools.tuning.tuner import Tuner
import numpy as np

OVERFITTED = 1.25
"""The report warns from this ratio of the held-out error to the training error on."""


def save(
    folder: Path, parameters: Mapping[str, Any], comments: Sequence[str], parts: Sequence[str]
) -> None:
    """Write a YAML that `estimator` loads as it is, and the parts of a report."""
    folder.mkdir()
    head = ''.join(f'# {line}'.rstrip() + '\n' for line in comments)
    (folder / 'gains.yaml').write_text(head + dumps(parameters), 'utf-8')
    (folder / 'report.md').write_text('\n\n'.join(parts) + '\n', 'utf-8')


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a Markdown table."""
    lines = [head, ['---'] * len(head), *rows]
    return '\n'.join(f'| {" | ".join(cells)} |' for cells in lines)


def write(folder: Path, tuner: Tuner, result: Result, command: str) -> str:
    """Write everything into a new folder; return the report's main part, to be printed."""
    begin, best = {d.name: d.start for d in tuner.space}, result.best
    found = {
        f'{title}, {data}': objective(tuner.parameters(values))
        for title, values in (('given' if tuner.given else 'start', begin), ('tuned', best))
        for data, objective in (('training', tuner.training), ('held out', tuner.held_out))
    }
    training, held_out = (found[f'tuned, {data}'].error for data in ('training', 'held out'))
    p = tuner.data.parameters
    comments = [
        'Made by',
        f'    python -m fhaosmo_ros {command}',
        f'({result.trials} trials, fhaosmo_ros {__version__}) for a simulated family.',
        f'Noise of y {p["noise_std"]:.3g}, {p["sample_rate"]:g} Hz, '
        f'd: {", ".join(dict.fromkeys(p["disturbances"]))} with an RMS of {p["rms_of_d"]:.3g}.',
        f'Error relative to the truth: {training:.3f} in training, {held_out:.3f} on held-out '
        'recordings.',
    ]
    main = '\n\n'.join([_evaluations(found), *warnings(training, held_out)])
    parts = [
        '# Tuning',
        f'    python -m fhaosmo_ros {command}',
        f'{result.trials} trials in the study; '
        f'{len(tuner.data.training)} recordings to train on, {len(tuner.data.held_out)} held out.',
        '## Result',
        main,
        'The error is the weighted RMS error over that of the truth, a geometric mean over the '
        'recordings. Held-out recordings took no part '
        'in the search.',
        '## Searched',
        table(
            ['parameter', 'from', 'to', 'start', 'tuned'],
            [
                [d.name, *(f'{x:.4g}' for x in (d.low, d.high, d.start, best[d.name]))]
                for d in tuner.space
            ],
        ),
        '## Settings',
        '\n'.join(f'    {name}: {value}' for name, value in (p | dict(tuner.tuning)).items()),
    ]
    save(folder, tuner.parameters(best), comments, parts)
    return main


def _evaluations(columns: Mapping[str, Evaluation]) -> str:
    """Return a table of evaluations, a column each."""
    found = columns.values()
    errors = np.sqrt([np.mean(np.square(e.errors), axis=0) for e in found]).T
    names = [*(f'z{k}' for k in range(1, len(errors))), 'd']
    rows = [
        ['error, relative to the truth', *(f'{e.error:.4f}' for e in found)],
        *(
            [f'RMS error of {name}', *(f'{error:.3g}' for error in of_name)]
            for name, of_name in zip(names, errors, strict=True)
        ),
    ]
    return table(['', *columns], rows)


def warnings(training: float, held_out: float) -> list[str]:
    """Return what a user should know before using gains of these errors."""
    found = []
    if held_out > OVERFITTED * training:
        found.append(
            f'Note: The error on held-out recordings is {held_out / training:.2f} times that of '
            'the training: more recordings, or fewer parameters to search, would help.'
        )
    if held_out > 0.9:
        found.append(
            f'Note: An estimate that is always 0 has the error 1; this one {held_out:.2f}. Either '
            'this sensor hardly shows this d, or more trials, or another start, are needed.'
        )
    return found
