# SPDX-License-Identifier: Apache-2.0
"""The output of a search: gains.yaml, report.md and a figure of the estimates."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from fhaosmo_ros import __version__
from fhaosmo_ros.core.observer.observer import Observer
from fhaosmo_ros.core.parameters.files import dumps
from fhaosmo_ros.core.parameters.tables import ESTIMATOR_PARAMETERS
from fhaosmo_ros.core.simulation.recordings import Recording
from fhaosmo_ros.tools.tuning.figures import save_estimates
from fhaosmo_ros.tools.tuning.objective import Evaluation, Objective
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


class Column(NamedTuple):
    """One set of gains, evaluated on one set of recordings."""

    title: str
    evaluation: Evaluation
    objective: Objective


def parameter_file(parameters: Mapping[str, Any], comments: Sequence[str]) -> str:
    """Return a YAML that `estimator` loads as it is."""
    head = ''.join(f'# {line}'.rstrip() + '\n' for line in comments)
    return head + dumps(parameters)


def table(columns: Sequence[Column]) -> str:
    """Return a Markdown table of the evaluations, a column each."""
    rows = {'objective': [f'{c.evaluation.objective:.4f}' for c in columns]}
    rows['error, relative to the truth'] = [f'{c.evaluation.error:.4f}' for c in columns]
    recordings = [c.objective.trial.recordings for c in columns]
    quantities = len(columns[0].objective.scale)
    names = [f'z{k + 1}' for k in range(quantities - 1)] + ['d']
    for k, name in enumerate(names):
        rows[f'RMS error of {name}'] = [
            f'{_pooled(c.evaluation.scores.error[:, c.evaluation.choice, k]):.3g}' for c in columns
        ]
    shapes = dict.fromkeys(r.shape for rows_ in recordings for r in rows_)
    if len(shapes) > 1:
        for shape in shapes:
            rows[f'RMS error of d, {shape}'] = [_of_shape(c, shape) for c in columns]
    rows['chatter of d, powers of ten'] = [f'{c.evaluation.chatter:.2f}' for c in columns]
    rows['settling, share of the time'] = [f'{c.evaluation.settling:.2f}' for c in columns]
    rows['estimates from'] = [c.evaluation.estimate_from for c in columns]
    head = ['', *(c.title for c in columns)]
    lines = [f'| {" | ".join(head)} |', '|' + '---|' * len(head)]
    lines += [f'| {" | ".join([name, *cells])} |' for name, cells in rows.items()]
    return '\n'.join(lines)


def _pooled(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values)))) if len(values) else float('nan')


def _of_shape(column: Column, shape: str) -> str:
    chosen = [k for k, r in enumerate(column.objective.trial.recordings) if r.shape == shape]
    errors = column.evaluation.scores.error[chosen, column.evaluation.choice, -1]
    return f'{_pooled(errors):.3g}' if chosen else '-'


def gains_table(space: Sequence[Dimension], start: Mapping[str, float], best: Any) -> str:
    """Return a Markdown table of what was searched."""
    lines = ['| parameter | from | to | start | tuned |', '|---|---|---|---|---|']
    for d in space:
        mark = ' (at its bound)' if at_bound(d, best[d.name]) else ''
        lines.append(
            f'| {d.name} | {d.low:.3g} | {d.high:.3g} | {start[d.name]:.4g} | '
            f'{best[d.name]:.4g}{mark} |'
        )
    return '\n'.join(lines)


def start_table(tried: Mapping[int, float], chosen: int) -> str:
    """Return a Markdown table of the numbers of derivatives of d that were tried."""
    lines = ['| unknown_input_derivatives | objective at the start |', '|---|---|']
    lines += [
        f'| {k}{" (taken)" if k == chosen else ""} | {value:.4f} |' for k, value in tried.items()
    ]
    return '\n'.join(lines)


def at_bound(dimension: Dimension, value: float) -> bool:
    """Return True if the value is so close to a bound that a wider range may be better."""
    low, high = dimension.low, dimension.high
    if dimension.log:
        low, high, value = float(np.log(low)), float(np.log(high)), float(np.log(value))
    return not AT_BOUND < (value - low) / (high - low) < 1.0 - AT_BOUND


def warnings(
    space: Sequence[Dimension], best: Mapping[str, float], tuned: Sequence[Column]
) -> list[str]:
    """Return what a user should know before using the gains."""
    found = []
    training, held_out = (column.evaluation.error for column in tuned)
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
    """
    Write everything into a new folder.

    Returns
    -------
    str
        The report's main part, to be printed.

    """
    folder.mkdir()
    gains = tuner.with_readout(changes(result.best))
    name = 'given' if tuner.before_is_given else 'start'
    before = tuner.with_readout(tuner.before)
    columns = [
        Column(f'{title}, {data}', objective(values), objective)
        for title, values in ((name, before), ('tuned', gains))
        for data, objective in (('training', tuner.training), ('held out', tuner.held_out))
    ]
    tuned = columns[2:]
    parameters = tuner.parameters(gains)
    comments = _comments(tuner, result, command, tuned)
    (folder / 'gains.yaml').write_text(parameter_file(parameters, comments), 'utf-8')
    cautions = warnings(tuner.space, result.best, tuned)
    main = '\n\n'.join([table(columns), *(f'Note: {text}' for text in cautions)])
    text = _document(tuner, result, command, main)
    (folder / 'report.md').write_text(text, encoding='utf-8')
    _draw_estimates(folder / 'estimates.png', tuner, before, gains)
    return main


def _comments(tuner: Tuner, result: TuningResult, command: str, tuned: list[Column]) -> list[str]:
    training, held_out = (column.evaluation for column in tuned)
    p = tuner.data.parameters
    return [
        'Made by',
        f'    python -m fhaosmo_ros {command}',
        f'({result.trials} trials, fhaosmo_ros {__version__}) for a simulated family.',
        f'Noise of y {p["noise_std"]:.3g}, {p["sample_rate"]:g} Hz, '
        f'd: {", ".join(dict.fromkeys(p["disturbances"]))} with an RMS of {p["rms_of_d"]:.3g}.',
        f'Error relative to the truth: {training.error:.3f} in training, '
        f'{held_out.error:.3f} on held-out recordings.',
    ]


def _document(tuner: Tuner, result: TuningResult, command: str, main: str) -> str:
    begin = {d.name: d.start for d in tuner.space}
    settings = tuner.data.parameters | dict(tuner.tuning)
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
        gains_table(tuner.space, begin, result.best),
    ]
    if tuner.tried:
        chosen = tuner.fixed['unknown_input_derivatives']
        parts.append(start_table(tuner.tried, chosen))
    rows = '\n'.join(f'    {name}: {value}' for name, value in settings.items())
    parts += ['## Settings', rows]
    return '\n\n'.join(parts) + '\n'


def _draw_estimates(
    path: Path, tuner: Tuner, before: dict[str, Any], after: dict[str, Any]
) -> None:
    seen: dict[str, Recording] = {}
    for r in tuner.data.held_out:
        seen.setdefault(r.shape, r)
    chosen = list(seen.values())
    if len(chosen) == 1:
        chosen = tuner.data.held_out
    shown = []
    for r in chosen[:SHOWN]:
        pair = (_estimate(tuner, gains, r) for gains in (before, after))
        shown.append((f'held out: {r.shape}', r, *pair))
    save_estimates(shown, tuner.tuning['settled'], path)


def _estimate(tuner: Tuner, gains: dict[str, Any], recording: Recording) -> Any:
    observer = Observer(ESTIMATOR_PARAMETERS.complete(tuner.estimator | gains))
    return observer.run(recording.t, recording.y, recording.u).unknown_input
