# SPDX-License-Identifier: Apache-2.0
"""`python -m studies.delay` makes docs/delay.png and the table beside it: a y that comes late."""

from pathlib import Path
import sys
from typing import Any

from fhaosmo_ros.core import Family, OnlineEstimator, Recording
from fhaosmo_ros.tools.plot.figures import COLOURS, TRUTH
from matplotlib.figure import Figure
import numpy as np
from numpy.typing import NDArray
from studies.document import refill

PAGE, PART = Path(__file__).resolve().parents[1] / 'docs' / 'operation.md', 'delay'
MODEL = {'order': 2, 'phi': ['0', '8*u - 3*z2 - 5*sin(z1)']}
PLANT = MODEL | {
    'duration': 12.0, 'sample_rate': 200.0, 'noise_std': 5e-4, 'initial_state': 0.0,
    'integration_step': 1e-3, 'disturbances': ['steps'], 'step_interval': 2.0, 'rms_of_d': 1.0,
    'rms_of_u': 1.0, 'band_of_d': [2.0, 12.0],
}  # fmt: skip
GAINS = MODEL | {
    'structure': 'levant', 'scheme': 'predict_correct', 'variant': 'sign',
    'lambda': [5.5, 16.0, 22.0],
}  # fmt: skip
DELAYS = np.array([0.0, 5.0, 10.0, 20.0, 30.0, 40.0, 60.0, 80.0, 100.0]) * 1e-3
SHOWN = 0.04
"""Delay (s) of the curves over time."""
SETTLED, RECORDINGS = 3.0, 4
PRINTED = (0.0, 10.0, 20.0, 40.0, 100.0)
"""Delays (ms) in the table."""
UNTOLD, TOLD, PREDICTED = 'delay not told', 'measurement_delay', '... with predict_to_now'
WAYS = {
    UNTOLD: (COLOURS[0], ':', lambda delay: {}),
    TOLD: ('#009E73', '--', lambda delay: {'measurement_delay': delay}),
    PREDICTED: (
        '#000000', '-', lambda delay: {'measurement_delay': delay, 'predict_to_now': True},
    ),
}  # fmt: skip


def estimates(r: Recording, changes: dict[str, Any]) -> NDArray[np.float64]:
    """Return what is known when each sample comes: z1, z2 and d, a row a sample."""
    stamps = 10**9 + np.round(r.t * 1e9).astype(np.int64)
    found = OnlineEstimator(GAINS | changes).run(stamps, r.y, r.u)
    return np.column_stack([found.z, found.unknown_input])


def errors() -> dict[str, NDArray[np.float64]]:
    """Return the RMS errors of z1, z2 and d at the present, a row a delay, for each way."""
    rows: dict[str, list[NDArray[np.float64]]] = {way: [] for way in WAYS}
    for delay in DELAYS:
        recordings = Family(PLANT | {'measurement_delay': delay}).recordings(RECORDINGS)
        for way, (_, _, changes) in WAYS.items():
            wrong = [
                (estimates(r, changes(delay)) - np.column_stack([r.z, r.d]))[r.t > SETTLED]
                for r in recordings
            ]
            rows[way].append(np.sqrt(np.mean(np.concatenate(wrong) ** 2, axis=0)))
    return {way: np.array(found) for way, found in rows.items()}


def draw(wrong: dict[str, NDArray[np.float64]]) -> Figure:
    """Draw z2 and d over time for one delay, and the errors of both over the delay."""
    r = Family(PLANT | {'measurement_delay': SHOWN}).recordings(1)[0]
    part = (r.t > 5.0) & (r.t < 8.0)
    figure = Figure(figsize=(9.5, 5.2), layout='constrained')
    axes = figure.subplots(2, 2, sharex='col', width_ratios=(2.0, 1.0))
    for row, (name, column, true) in enumerate((('$z_2$', 1, r.z[:, 1]), ('$d$', 2, r.d))):
        over_time, over_delay = axes[row]
        for way, (colour, line, changes) in WAYS.items():
            if way != TOLD:
                found = estimates(r, changes(SHOWN))[part, column]
                over_time.plot(r.t[part], found, color=colour, ls=line, lw=1.2, label=way)
            share = wrong[way][:, column]
            over_delay.plot(DELAYS * 1e3, share, line, color=colour, lw=1.4, label=way)
        over_time.plot(r.t[part], true[part], color=TRUTH['color'], lw=1.2, label='truth')
        over_time.set_ylabel(name)
        over_delay.set_ylabel(f'RMS error of {name} now')
        over_delay.set_ylim(0.0, None)
        for each in axes[row]:
            each.grid(alpha=0.3)
    axes[0, 0].set_title(f'y comes {SHOWN * 1e3:g} ms late', fontsize='medium')
    axes[0, 0].legend(fontsize='small')
    axes[0, 1].legend(fontsize='small')
    axes[1, 0].set_xlabel('time [s]')
    axes[1, 1].set_xlabel('delay of y [ms]')
    return figure


def table(wrong: dict[str, NDArray[np.float64]]) -> str:
    """Return the errors at some delays as a table."""
    columns = [(2, UNTOLD), (2, TOLD), (1, UNTOLD), (1, TOLD), (1, PREDICTED)]
    lines = [
        '| y late by | d now: nobody told | `measurement_delay` | velocity now: nobody told '
        '| `measurement_delay` | with `predict_to_now` |',
        '|---' * 6 + '|',
    ]
    for delay in PRINTED:
        k = int(np.argmin(abs(DELAYS * 1e3 - delay)))
        cells = [f'{wrong[way][k, column]:.2g}' for column, way in columns]
        lines.append(f'| {delay:g} ms | {" | ".join(cells)} |')
    return '\n'.join(lines)


def main() -> int:
    """Write the figure and the table of this checkout."""
    wrong = errors()
    for path in refill(PAGE, {PART: table(wrong)}, draw(wrong), name='delay'):
        print(path)
    return 0


if __name__ == '__main__':
    sys.exit(main())
