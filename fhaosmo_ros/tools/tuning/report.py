# SPDX-License-Identifier: Apache-2.0
"""The output of a search: gains.yaml, report.md and a figure of the estimates."""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from fhaosmo_ros import __version__
from fhaosmo_ros.core.observer.observer import Observer
from fhaosmo_ros.core.parameters.files import dumps
from fhaosmo_ros.core.parameters.tables import ESTIMATOR_PARAMETERS
from fhaosmo_ros.core.simulation.recordings import Recording
from fhaosmo_ros.tools.tuning.figures import save_estimates
from fhaosmo_ros.tools.tuning.objective import Evaluation
from fhaosmo_ros.tools.tuning.search import Dimension
from fhaosmo_ros.tools.tuning.space import changes
from fhaosmo_ros.tools.tuning.tuner import Tuner, TuningResult
import numpy as np

OVERFITTED = 1.25
"""The report warns from this ratio of the held-out error to the training error on."""
AT_BOUND = 0.02
"""A value counts as at its bound if it is this close to it, as a share of the range."""
SHOWN = 3
"""Recordings in the figure of estimates."""


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


def evaluations(columns: Mapping[str, Evaluation]) -> str:
    """Return a table of the evaluations, a column each."""
    found = columns.values()
    rows = [
        ['objective', *(f'{e.objective:.4f}' for e in found)],
        ['error, relative to the truth', *(f'{e.error:.4f}' for e in found)],
    ]
    mean_squares = np.array([np.mean(e.scores.error[:, e.choice] ** 2, axis=0) for e in found])
    for k, errors in enumerate(np.sqrt(mean_squares).T, 1):
        name = f'z{k}' if k < mean_squares.shape[1] else 'd'
        rows.append([f'RMS error of {name}', *(f'{error:.3g}' for error in errors)])
    rows += [
        ['chatter of d, powers of ten', *(f'{e.chatter:.2f}' for e in found)],
        ['settling, share of the time', *(f'{e.settling:.2f}' for e in found)],
        ['estimates from', *(e.estimate_from for e in found)],
    ]
    return table(['', *columns], rows)


def at_bound(dimension: Dimension, value: float) -> bool:
    """Return True if the value is so close to a bound that a wider range may be better."""
    low, high = dimension.low, dimension.high
    if dimension.log:
        low, high, value = float(np.log(low)), float(np.log(high)), float(np.log(value))
    return not AT_BOUND < (value - low) / (high - low) < 1.0 - AT_BOUND


def warnings(
    space: Sequence[Dimension], best: Mapping[str, float], training: float, held_out: float
) -> list[str]:
    """Return what a user should know before using gains of these errors."""
    found = []
    if held_out > OVERFITTED * training:
        found.append(
            f'The error on held-out recordings is {held_out / training:.2f} times that of the '
            'training: more recordings, or fewer parameters to search, would help.'
        )
    if held_out > 0.9:
        why = (
            'there is hardly anything to be known about this d through this sensor'
            if training < 1.1
            else 'the search has not found gains that work: more trials, or other bounds'
        )
        found.append(
            f'An estimate that is always 0 has the error 1; this one {held_out:.2f}: {why}.'
        )
    stuck = [d.name for d in space if at_bound(d, best[d.name])]
    if stuck:
        found.append(f'At their bounds: {", ".join(stuck)}; wider ones may give better gains.')
    return found


def write(folder: Path, tuner: Tuner, result: TuningResult, command: str) -> str:
    """Write everything into a new folder; return the report's main part, to be printed."""
    gains, before = (tuner.with_readout(x) for x in (changes(result.best), tuner.before))
    name = 'given' if tuner.before_is_given else 'start'
    columns = {
        f'{title}, {data}': objective(values)
        for title, values in ((name, before), ('tuned', gains))
        for data, objective in (('training', tuner.training), ('held out', tuner.held_out))
    }
    training, held_out = (columns[f'tuned, {data}'].error for data in ('training', 'held out'))
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
    cautions = warnings(tuner.space, result.best, training, held_out)
    main = '\n\n'.join([evaluations(columns), *(f'Note: {text}' for text in cautions)])
    rows = [
        [d.name, f'{d.low:.3g}', f'{d.high:.3g}', f'{d.start:.4g}', f'{result.best[d.name]:.4g}']
        for d in tuner.space
    ]
    parts = [
        '# Tuning',
        f'    python -m fhaosmo_ros {command}',
        f'{result.trials} trials in the study, {result.seconds:.0f} s in this run; '
        f'{len(tuner.data.training)} recordings to train on, {len(tuner.data.held_out)} held out.',
        '## Result',
        main,
        'The error is the weighted RMS error over that of the truth, a geometric mean over the '
        'recordings. The objective adds chatter and settling by their weights. Held-out '
        'recordings took no part in the search.',
        '![d and its estimates](estimates.png)',
        '## Gains',
        table(['parameter', 'from', 'to', 'start', 'tuned'], rows),
    ]
    if tuner.tried:
        chosen = tuner.fixed['unknown_input_derivatives']
        rows = [
            [f'{k}{" (taken)" if k == chosen else ""}', f'{value:.4f}']
            for k, value in tuner.tried.items()
        ]
        parts.append(table(['unknown_input_derivatives', 'objective at the start'], rows))
    settings = p | dict(tuner.tuning)
    parts += ['## Settings', '\n'.join(f'    {name}: {value}' for name, value in settings.items())]
    save(folder, tuner.parameters(gains), comments, parts)

    def estimate(values: Mapping[str, Any], r: Recording) -> Any:
        observer = Observer(ESTIMATOR_PARAMETERS.complete(tuner.estimator | values))
        return observer.run(r.t, r.y, r.u).unknown_input

    seen = {r.shape: r for r in reversed(tuner.data.held_out)}  # the first one of each kind of d
    recordings = list(seen.values()) if len(seen) > 1 else tuner.data.held_out
    shown = [
        (f'held out: {r.shape}', r, estimate(before, r), estimate(gains, r))
        for r in recordings[:SHOWN]
    ]
    save_estimates(shown, tuner.tuning['settled'], folder / 'estimates.png')
    return main
