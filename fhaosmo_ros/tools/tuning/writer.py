# SPDX-License-Identifier: Apache-2.0
"""The output of a tuning: gains.yaml, report.md and the figure."""

from pathlib import Path
from typing import Any

from fhaosmo_ros import __version__
from fhaosmo_ros.core.observer.observer import Observer
from fhaosmo_ros.core.parameters.tables import ESTIMATOR_PARAMETERS
from fhaosmo_ros.core.simulation.recordings import Recording
from fhaosmo_ros.tools.tuning import figures, report
from fhaosmo_ros.tools.tuning.space import changes
from fhaosmo_ros.tools.tuning.tuner import Tuner, TuningResult

SHOWN = 3
"""Recordings in the figure of estimates."""


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
        report.Column(f'{title}, {data}', objective(values), objective)
        for title, values in ((name, before), ('tuned', gains))
        for data, objective in (('training', tuner.training), ('held out', tuner.held_out))
    ]
    tuned = columns[2:]
    parameters = tuner.parameters(gains)
    comments = _comments(tuner, result, command, tuned)
    (folder / 'gains.yaml').write_text(report.parameter_file(parameters, comments), 'utf-8')
    cautions = report.warnings(tuner.space, result.best, tuned, tuner.data)
    main = '\n\n'.join([report.table(columns), *(f'Note: {text}' for text in cautions)])
    text = _document(tuner, result, command, main)
    (folder / 'report.md').write_text(text, encoding='utf-8')
    _draw_estimates(folder / 'estimates.png', tuner, before, gains)
    return main


def _comments(
    tuner: Tuner, result: TuningResult, command: str, tuned: list[report.Column]
) -> list[str]:
    training, held_out = (column.evaluation for column in tuned)
    p = tuner.data.parameters
    lines = [
        'Made by',
        f'    python -m fhaosmo_ros {command}',
        f'({result.trials} trials, fhaosmo_ros {__version__}) for: {tuner.data.origin}.',
    ]
    if not tuner.data.origin.startswith('pieces'):
        lines.append(
            f'Noise of y {p["noise_std"]:.3g}, {p["sample_rate"]:g} Hz, '
            f'd: {", ".join(dict.fromkeys(p["disturbances"]))} with an RMS of {p["rms_of_d"]:.3g}.'
        )
    lines.append(
        f'Error relative to the truth: {training.error:.3f} in training, '
        f'{held_out.error:.3f} on held-out recordings.'
    )
    return lines


def _document(tuner: Tuner, result: TuningResult, command: str, main: str) -> str:
    begin = {d.name: d.start for d in tuner.space}
    settings = tuner.data.parameters | dict(tuner.tuning)
    parts = [
        '# Tuning',
        f'    python -m fhaosmo_ros {command}',
        f'{result.trials} trials in the study, {result.seconds:.0f} s in this run; '
        f'{len(tuner.data.training)} recordings to train on, {len(tuner.data.held_out)} held out: '
        f'{tuner.data.origin}.',
        '## Result',
        main,
        'The error is the weighted RMS error over that of the truth, a geometric mean over the '
        'recordings. The objective adds chatter and settling by their weights. Held-out '
        'recordings took no part in the search.',
        '![d and its estimates](estimates.png)',
        '## Gains',
        report.gains_table(tuner.space, begin, result.best),
    ]
    if tuner.tried:
        chosen = tuner.fixed['unknown_input_derivatives']
        parts.append(report.start_table(tuner.tried, chosen))
    if tuner.data.sensor is not None:
        parts += ['## Sensor', report.sensor_table(tuner.data)]
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
    figures.save_estimates(shown, tuner.tuning['settled'], path)


def _estimate(tuner: Tuner, gains: dict[str, Any], recording: Recording) -> Any:
    observer = Observer(ESTIMATOR_PARAMETERS.complete(tuner.estimator | gains))
    return observer.run(recording.t, recording.y, recording.u).unknown_input
