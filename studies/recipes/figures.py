# SPDX-License-Identifier: Apache-2.0
"""A recipe's figure: estimates over time, and the errors of all methods."""

from collections.abc import Mapping, Sequence

from fhaosmo_ros.tools.plot.figures import COLOURS, TRUTH
from matplotlib.axes import Axes
from matplotlib.figure import Figure
import numpy as np
from studies.evidence import Row
from studies.harness import SELF_TUNING
from studies.recipes.judging import Fold, Folds, Judgements, OURS, Recipe, run


def draw(recipe: Recipe, folds: Folds, results: Judgements) -> Figure:
    """Draw the first condition over time, and the errors of all methods in all conditions."""
    figure = Figure(figsize=(10.0, 4.4), layout='constrained')
    over_time, errors = figure.subplots(1, 2, width_ratios=(2.0, 1.0))
    condition = next(iter(folds))
    _estimates(over_time, recipe, folds[condition], results[condition])
    width = 0.8 / len(results)
    for k, (condition, found) in enumerate(results.items()):
        place = np.arange(len(found)) + k * width - 0.4 + width / 2.0
        values = [row['error'] for row in found.values()]
        bars = errors.barh(
            place, values, 0.9 * width, color=list(COLOURS[: len(found)]),
            alpha=1.0 - 0.45 * k / len(results),
        )  # fmt: skip
        where = f'  {condition}' if len(results) > 1 else ''
        labels = [f'{value:#.3g}{where}' for value in values]
        errors.bar_label(bars, labels, fontsize='x-small', padding=2)
    names = [name.replace(', ', ',\n').replace(' less ', '\nless ') for name in recipe.methods]
    errors.set_yticks(np.arange(len(names)), names)
    errors.tick_params(axis='y', labelsize='x-small')
    errors.invert_yaxis()
    top = max(row['error'] for found in results.values() for row in found.values())
    errors.set_xlim(0.0, top * (2.5 if len(results) > 1 else 1.25))
    errors.set_xlabel('RMS error / RMS of the truth')
    for axes in (over_time, errors):
        axes.grid(alpha=0.3)
        axes.set_axisbelow(True)
    return figure


def _estimates(
    axes: Axes, recipe: Recipe, folds: Sequence[Fold], results: Mapping[str, Row]
) -> None:
    """Draw the truth, the estimates of some methods, and the self-tuning one's error band."""
    number_of_fold = min(recipe.fold, len(folds) - 1)  # a short run has one
    fold, scale = folds[number_of_fold], recipe.scale
    r = fold.judged[0]
    part = (r.t - r.t[0] >= recipe.shown[0]) & (r.t - r.t[0] <= recipe.shown[1])
    if not part.any():  # of a short run
        part = r.judged
    axes.plot(r.t[part], scale * r.d[part], **TRUTH)
    for k, (name, method) in enumerate(recipe.methods.items()):
        if name not in recipe.drawn:
            continue
        chosen = results[name]['chosen'].split()
        number = float(chosen[number_of_fold]) if chosen else 0.0
        found = scale * method.estimate(fold.parameters, r, number)
        axes.plot(r.t[part], found[part], color=COLOURS[k], lw=1.1, label=name)
        if name == OURS and recipe.band:
            width = 2.0 * abs(scale) * run(fold.parameters | SELF_TUNING, r).standard_deviation
            low, high = found - width[:, -1], found + width[:, -1]
            axes.fill_between(
                r.t[part], low[part], high[part], color=COLOURS[k], alpha=0.2, lw=0.0,
                label='± 2 of its standard deviations',
            )  # fmt: skip
    low, high = np.percentile(scale * r.d[part], (0, 100))
    room = 0.6 * (high - low)
    axes.set_ylim(low - 0.5 * room, high + room)
    axes.set_xlabel('time [s]')
    axes.set_ylabel(recipe.quantity)
    axes.set_title(r.name, fontsize='small')
    axes.legend(fontsize='x-small', loc='upper left', ncols=2)
