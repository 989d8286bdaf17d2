# SPDX-License-Identifier: Apache-2.0
"""The output of a tuning: gains.yaml, report.md and the figures."""

from pathlib import Path
from typing import Any

from fhaosmo_ros import __version__
from fhaosmo_ros.core.family import Recording
from fhaosmo_ros.core.observer import Observer
from fhaosmo_ros.core.parameters import ESTIMATOR_PARAMETERS, OBSERVER_PARAMETERS
from fhaosmo_ros.tools.tuning import figures, report
from fhaosmo_ros.tools.tuning.search import Dimension, Values
from fhaosmo_ros.tools.tuning.space import changes
from fhaosmo_ros.tools.tuning.tuner import Found, front, marks, Tuner
import numpy as np
from tqdm import tqdm

POINTS = 7
"""Values of each parameter in the figure of sensitivities, apart from the best one."""
REACH = 1.0
"""How far they go from the best one, in powers of ten or (linear) halves of the range."""
SHOWN = 3
LOST_TIME, LOST_SAMPLES = 0.1, 20
"""
Seconds, and at least so many samples, beyond the largest half-width after which y is lost and the
estimator begins again from it. Once all levels saturate, integrators behind each other may swing
for ever.
"""
SECOND = {
    'chatter': 'chatter of d, powers of ten',
    'settling': 'settling, share of the time',
}


def write(folder: Path, tuner: Tuner, found: Found, command: str) -> str:
    """
    Write everything into a new folder.

    Returns
    -------
    str
        The report's main part, to be printed.

    """
    folder.mkdir()
    gains = changes(found.best)
    # The training chooses the variables; held-out data are judged by the same ones.
    gains['estimate_from'] = tuner.training(gains).estimate_from
    name = 'given' if tuner.before_is_given else 'start'
    before = {'estimate_from': tuner.training(tuner.before).estimate_from} | tuner.before
    columns = [
        report.Column(f'{title}, {data}', objective(values), objective)
        for title, values in ((name, before), ('tuned', gains))
        for data, objective in (('training', tuner.training), ('held out', tuner.held_out))
    ]
    tuned = columns[2:]
    parameters = _parameters(tuner, gains)
    comments = _comments(tuner, found, command, tuned)
    (folder / 'gains.yaml').write_text(report.parameter_file(parameters, comments), 'utf-8')
    cautions = report.warnings(tuner.space, found.best, tuned, tuner.data)
    main = '\n\n'.join([report.table(columns), *(f'Note: {text}' for text in cautions)])
    text = _document(tuner, found, command, main)
    (folder / 'report.md').write_text(text, encoding='utf-8')
    _draw_estimates(folder / 'estimates.png', tuner, before, gains)
    figures.save_sensitivity(
        _sensitivities(tuner, found.best), tuner.space, found.best, tuned[0].verdict.objective,
        folder / 'sensitivity.png',
    )  # fmt: skip
    if found.pareto is not None:
        chosen, *lists = (
            np.array([(mark.error, getattr(mark, found.pareto)) for mark in some])
            for some in (
                [tuner.judge(found.best)], map(marks, found.trials),
                front(found.trials, found.pareto),
            )
        )  # fmt: skip
        figures.save_front(
            *lists, chosen[0], ('error, relative to the truth', SECOND[found.pareto]),
            folder / 'pareto.png',
        )  # fmt: skip
    return main


def _parameters(tuner: Tuner, gains: dict[str, Any]) -> dict[str, Any]:
    """Return what the estimator needs: what was set for it, and what was found."""
    values = tuner.fixed | gains
    shown = Observer({k: v for k, v in values.items() if k in OBSERVER_PARAMETERS}).parameters
    if shown['structure'] == 'levant' and shown['variant'].startswith('fuzzy'):
        period = float(np.median(np.diff(tuner.data.training[0].t)))
        values = {
            'epsilon': max(shown['fuzzy_widths']),
            'divergence_time': float(f'{max(LOST_TIME, LOST_SAMPLES * period):.4g}'),
        } | values
    # These decide what the gains mean, so they stand there even where they are the defaults.
    for name in ('variant', 'scheme', 'unknown_input'):
        values[name] = shown[name]
    return {name: values[name] for name in ESTIMATOR_PARAMETERS if name in values}


def _comments(tuner: Tuner, found: Found, command: str, tuned: list[report.Column]) -> list[str]:
    training, held_out = (column.verdict for column in tuned)
    p = tuner.data.parameters
    lines = [
        'Made by',
        f'    python -m fhaosmo_ros {command}',
        f'({len(found.trials)} trials, fhaosmo_ros {__version__}) '
        f'for: {tuner.data.origin}.',
    ]  # fmt: skip
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


def _document(tuner: Tuner, found: Found, command: str, main: str) -> str:
    begin = {d.name: d.start for d in tuner.space}
    settings = {**tuner.data.parameters, **{k: tuner.tuning[k] for k in tuner.tuning}}
    parts = [
        '# Tuning',
        f'    python -m fhaosmo_ros {command}',
        f'{len(found.trials)} trials in the study, {found.seconds:.0f} s in this run; '
        f'{len(tuner.data.training)} recordings to train on, {len(tuner.data.held_out)} held out: '
        f'{tuner.data.origin}.',
        '## Result', main,
        'The error is the weighted RMS error over that of the truth, a geometric mean over the '
        'recordings. The objective adds chatter and settling by their weights. Held-out '
        'recordings took no part in the search.',
        '![d and its estimates](estimates.png)',
        '## Gains', report.gains_table(tuner.space, begin, found.best),
        '![Sensitivity](sensitivity.png)',
    ]  # fmt: skip
    if tuner.tried:
        chosen = tuner.fixed['unknown_input_derivatives']
        parts.insert(-1, report.start_table(tuner.tried, chosen))
    if found.pareto is not None:
        parts.append(f'![Error and {found.pareto}](pareto.png)')
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
    values = tuner.estimator | gains
    observer = Observer({k: v for k, v in values.items() if k in OBSERVER_PARAMETERS})
    return observer.run(recording.t, recording.y, recording.u).unknown_input


def _sensitivities(tuner: Tuner, best: Values) -> dict[str, tuple[Any, Any]]:
    curves = {}
    for d in tqdm(tuner.space, desc='sensitivity', unit='parameter', leave=False):
        x = np.unique(np.append(_around(d, best[d.name]), best[d.name]))
        value = [tuner.judge(best | {d.name: float(v)}).objective for v in x]
        curves[d.name] = (x, np.array(value))
    return curves


def _around(d: Dimension, best: float) -> Any:
    part = np.linspace(-REACH, REACH, POINTS)
    x = best * 10.0**part if d.log else best + 0.5 * part * (d.high - d.low)
    return np.clip(x, d.low, d.high)
