# SPDX-License-Identifier: Apache-2.0
"""`python -m studies.stamps` makes tables of docs/operation.md: slow clocks, and gaps of y."""

from pathlib import Path
import sys
from typing import Any

from fhaosmo_ros.core import OnlineEstimator
from fhaosmo_ros.core.model.triangular import TriangularModel
from fhaosmo_ros.core.parameters.files import load
from fhaosmo_ros.core.parameters.tables import ONLINE_PARAMETERS
from fhaosmo_ros.core.simulation.recordings import respond
from fhaosmo_ros.tools.cli.share import shipped
import numpy as np
from numpy.typing import NDArray
from studies.document import refill

Floats = NDArray[np.float64]
PAGE = Path(__file__).resolve().parents[1] / 'docs' / 'operation.md'
AMPLITUDE, STEP, PERIOD = 0.1, 5e-4, 1e-3
START = (0.2, 0.2, 0.2)
DURATION, SETTLED = 20.0, 10.0
TICKS, DELAYS, SEEDS = (1000.0, 40.0), (0.0, 1e-5, 1e-4, 1e-3), 4
GAPS, PHASES, BEGIN = (0.0, 0.03, 0.1, 0.3, 0.5), 4, 10.0
WAYS: dict[str, tuple[dict[str, Any], float]] = {
    'demo, implicit, ω = 1': ({}, 1.0),
    'demo, explicit, ω = 1': ({'scheme': 'explicit'}, 1.0),
    'sign, implicit, ω = 5': ({'variant': 'sign'}, 5.0),
}
ONE_STEP = {'max_step': 10.0}
"""No interval is longer than this, so that none is a gap."""


def observed(omega: float, phase: float, duration: float) -> tuple[Floats, Floats, Floats]:
    """Return times, y and d of the paper's plant, y exact and at 1 kHz."""
    grid = np.arange(0.0, duration + STEP, STEP)
    t = np.arange(round(duration / PERIOD)) * PERIOD
    table = AMPLITUDE * np.sin(omega * grid + phase)
    z, d = respond(TriangularModel(('0', '0', '-z3')), START, t, table, STEP, step=STEP)
    return t, z[:, 0], d


def estimated(changes: dict[str, Any], t: Floats, y: Floats) -> Floats:
    """Return d as the estimator of the demo, with these changes, finds it."""
    values = load(shipped('config/demo.yaml'), 'estimator', ONLINE_PARAMETERS) | changes
    stamps = 10**9 + np.round(t * 1e9).astype(np.int64)
    return OnlineEstimator(values).run(stamps, y).unknown_input


def clock_readings(t: Floats, rate: float, delay: float, seed: int) -> Floats:
    """Return what /clock says when each sample comes; ticks and samples are late at random."""
    random = np.random.default_rng(seed)
    ticks = np.arange(0.0, t[-1] + 1.0, 1.0 / rate)
    known = np.maximum.accumulate(ticks + delay * abs(random.standard_normal(len(ticks))))
    come = np.maximum.accumulate(t + delay * abs(random.standard_normal(len(t))))
    # A tick that comes with its sample is known before it.
    return ticks[np.maximum(np.searchsorted(known, come + 1e-9, side='right') - 1, 0)]


def clock_table() -> str:
    """Return the errors of d with the times of a slow or late clock."""
    t, y, d = observed(1.0, 0.0, DURATION)

    def wrong(changes: dict[str, Any], stamps: Floats) -> float:
        off = (estimated(changes, stamps, y) - d)[t > SETTLED]
        return float(np.sqrt(np.mean(off**2)))

    empty = ' | ' * (len(DELAYS) - 1)
    lines = [
        '| `/clock` | delays: none | 10 µs | 100 µs | 1 ms |',
        '|---' * (1 + len(DELAYS)) + '|',
        f'| true stamps instead | {wrong({"sampling": "source_stamp"}, t):.2g} |{empty}|',
    ]
    for rate in TICKS:
        row = []
        for delay in DELAYS:
            readings = [clock_readings(t, rate, delay, seed) for seed in range(SEEDS)]
            row.append(float(np.median([wrong({'sampling': 'clock'}, r) for r in readings])))
        name = f'{rate / 1000.0:g} kHz' if rate >= 1000.0 else f'{rate:g} Hz'
        lines.append(f'| {name} | {" | ".join(f"{x:.2g}" for x in row)} |')
    return '\n'.join(lines)


def after_gap(changes: dict[str, Any], omega: float, gap: float) -> float:
    """Return the RMS error of d in the second after a gap of y."""
    squares = []
    for phase in np.arange(PHASES) * 2.0 * np.pi / PHASES:
        t, y, d = observed(omega, phase, BEGIN + 2.0)
        kept = (t <= BEGIN) | (t >= BEGIN + gap)
        found = estimated({'sampling': 'source_stamp'} | changes, t[kept], y[kept])
        judged = (t[kept] > BEGIN + gap - 1e-9) & (t[kept] < BEGIN + gap + 1.0)
        squares.append(np.mean((found - d[kept])[judged] ** 2))
    return float(np.sqrt(np.mean(squares)))


def gap_table() -> str:
    """Return the errors of d after gaps, with one step over them and bridged."""
    heads = [head for name in WAYS for head in (f'{name}: one step', 'bridged')]
    lines = [f'| gap | {" | ".join(heads)} |', '|---' * (1 + len(heads)) + '|']
    for gap in GAPS:
        row = []
        for changes, omega in WAYS.values():
            row.append(f'{after_gap(changes | ONE_STEP, omega, gap):.2g}')
            row.append(f'{after_gap(changes, omega, gap):.2g}' if gap else '')
        lines.append(f'| {f"{1e3 * gap:g} ms" if gap else "none"} | {" | ".join(row)} |')
    return '\n'.join(lines)


def main() -> int:
    """Write the tables of this checkout."""
    for path in refill(PAGE, {'clock': clock_table(), 'gaps': gap_table()}):
        print(path)
    return 0


if __name__ == '__main__':
    sys.exit(main())
