# SPDX-License-Identifier: Apache-2.0
"""The figure of the paper about its fuzzy systems: membership functions and curves."""

from collections.abc import Sequence
from typing import NamedTuple

from fhaosmo_ros.core.observer.fuzzy import (
    curve,
    FuzzySystem,
    memberships,
    NAMES,
    read_system,
    SINGLETON,
    Terms,
)
from matplotlib.axes import Axes
from matplotlib.figure import Figure
import numpy as np

COLOURS = ('#D55E00', '#0072B2')
GREY = {'color': '#999999', 'linestyle': ':'}
MOST_NAMES = 9
"""The terms of larger systems have no names in the figure: they would overlap."""


class Row(NamedTuple):
    """
    A fuzzy system and the levels that have it.

    Attributes
    ----------
    text : str
        See `read_system`.
    width : float
        Half-width, in the unit of the innovation.
    levels : str
        In words.

    """

    text: str
    width: float
    levels: str


def fuzzy_figure(rows: Sequence[Row]) -> Figure:
    """Draw a row a system: membership functions of input and output, and the curve."""
    figure = Figure(figsize=(9.0, 0.6 + 2.0 * len(rows)), layout='constrained')
    panels = figure.subplots(len(rows), 3, squeeze=False)
    for row, (left, middle, right) in zip(rows, panels, strict=True):
        system = read_system(row.text)
        left.set_xlabel(f'ε of level {row.levels} [its unit]')
        middle.set_xlabel('ψ [1], before scaling to ±1')
        right.set_xlabel(f'ε of level {row.levels} [its unit]')
        right.set_ylabel('ψ(ε) [1]')
        half = curve(row.text)
        grid = np.linspace(0.0, row.width, len(half))
        right.plot([-row.width, 0, 0, row.width], [-1, -1, 1, 1], **GREY)
        right.plot(np.r_[-grid[::-1], grid], np.r_[-half[::-1], half], color='black')
        right.locator_params(axis='x', nbins=4)
        right.grid(alpha=0.3)
        if isinstance(system, FuzzySystem):
            _draw_terms(left, system.inputs, row.width)
            _draw_terms(middle, system.outputs, 1.0)
            if system.rules != tuple(range(len(system.outputs.peaks))):
                rules = ' '.join(str(k + 1) for k in system.rules)
                middle.set_title(f'rules: {rules}', fontsize=8, pad=12)
        else:
            for axes in (left, middle):
                axes.set_axis_off()
            left.text(0.5, 0.5, f'sampled curve,\nlevel {row.levels}', ha='center', va='center')
    figure.suptitle('membership functions of input and output, and the curve (dotted: sign)')
    return figure


def _draw_terms(axes: Axes, terms: Terms, scale: float) -> None:
    """Draw membership functions over [-scale, scale], and their names above them."""
    x = np.linspace(-1.0, 1.0, 1001)
    count = len(terms.peaks)
    names = NAMES.get(count, [str(k + 1) for k in range(count)])
    for k, (name, peak) in enumerate(zip(names, terms.peaks, strict=True)):
        style = {'color': COLOURS[k % 2], 'linestyle': '--' if k % 2 else '-'}
        if terms.shape == SINGLETON:
            axes.plot([scale * peak] * 2, [0.0, 1.0], marker='o', markevery=[1], **style)
        else:
            axes.plot(scale * x, memberships(x, terms)[k], **style)
        if count <= MOST_NAMES:
            axes.text(scale * peak, 1.05, name, ha='center', fontsize=6)
    axes.set_xlim(-1.05 * scale, 1.05 * scale)
    axes.set_ylim(0.0, 1.18)
    axes.set_ylabel('membership [1]')
    axes.locator_params(axis='x', nbins=4)
