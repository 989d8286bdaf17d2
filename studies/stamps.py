# SPDX-License-Identifier: Apache-2.0
"""
`python -m studies.stamps` makes tables of docs/operation.md: inexact stamps, and gaps of y.

y has 1 kHz and no noise. First its stamps jitter. Then the clock is /clock, with
`sampling: clock`: a simulator publishes the time and then y, and messages of both come late at
random, in order. Last y has gaps, which are bridged, or stepped over in one step.
"""

from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from pathlib import Path
import sys
from typing import Any

from fhaosmo_ros.core import OnlineEstimator, Plant
from fhaosmo_ros.core.parameters.files import load
from fhaosmo_ros.core.parameters.tables import PLANT_PARAMETERS
from fhaosmo_ros.core.simulation.metrics import rms
from fhaosmo_ros.tools.cli.share import shipped
import numpy as np
from numpy.typing import NDArray
from studies.document import refill

PAGE, NAME = Path(__file__).resolve().parents[1] / 'docs' / 'operation.md', 'stamps'
FILE = 'config/demo.yaml'
RATE, DURATION, SETTLED = 1000, 20.0, 5.0
"""Samples a second; seconds of a recording, and from when on errors count."""
BEGIN = 10**9
"""Stamp (ns) of the first sample; 0 would be none."""
LATENESS = (0.0, 1e-5, 1e-4, 1e-3)
"""Scale (s) of the half-normal distribution of the delays."""
CLOCKS = {'1 kHz': 1, '40 Hz': 25}
"""Samples for each tick of the clock."""
AHEAD = 20_000
"""The time is published so long (ns) before the sample."""
SEEDS = 5
JITTERS = (0.0, 0.01, 0.1, 0.5)
"""Stamps are uniformly distributed within +- so many periods."""
PACK, APART = 10, 10_000
"""Samples that come together, so long (ns) after one another."""
SELF_TUNING = {'order': 3, 'phi': ['0', '0', '-z3'], 'gains': 'self_tuning'}
GAPS, GAP_AT, JUDGED = (0, 30, 100, 300, 500), 8.0, 1.0
"""Lengths (ms) of gaps; when they begin, and for how long after them errors count (s)."""
PHASES = 4
SIGN = {'variant': 'sign', 'lambda': 15.0, 'alpha': 30.0, 'epsilon': 0.025}
GAPPED: dict[str, tuple[dict[str, Any], float]] = {
    'demo, implicit, ω = 1': ({'scheme': 'implicit'}, 1.0),
    'demo, explicit, ω = 1': ({'scheme': 'explicit'}, 1.0),
    'demo, implicit, ω = 5': ({'scheme': 'implicit'}, 5.0),
    'sign, implicit, ω = 5': (SIGN, 5.0),
}
"""Changes of the demo's gains, or other ones, and how fast d is (rad/s)."""
ONE_STEP, NO_RESTART = {'max_step': 10.0}, {'max_gap': 1.0}
Array = NDArray[np.float64]
Stamps = NDArray[np.int64]


@cache
def recording(**changes: float) -> tuple[Array, Array, Array]:
    """Return t, y and d of the demo's plant, y without noise."""
    t = np.arange(round(DURATION * RATE)) / RATE
    truth = Plant(load(shipped(FILE), 'plant', PLANT_PARAMETERS) | changes).simulate(t)
    return t, truth.y, truth.unknown_input


def shown_gains() -> dict[str, dict[str, Any]]:
    """Return the estimators of the tables by name."""
    demo = OnlineEstimator.from_yaml(shipped(FILE)).parameters
    return {
        f'`{FILE}`': demo,
        'the same with `noise_size: 0`': demo | {'noise_size': 0.0},
        'self-tuning': SELF_TUNING,
    }


def nanoseconds(t: Array) -> Stamps:
    """Return times (s) as stamps."""
    return BEGIN + np.round(t * 1e9).astype(np.int64)


def jittered(stamps: Stamps, jitter: float, seed: int) -> Stamps:
    """Return stamps that are off by up to so many periods, in order."""
    rng = np.random.default_rng(seed)
    off = rng.uniform(-jitter, jitter, len(stamps)) * 1e9 / RATE
    return np.sort(stamps + off.astype(np.int64))


def packed(stamps: Stamps) -> Stamps:
    """Return when samples come that are sent in packs, each with its last sample."""
    last = stamps[PACK - 1 :: PACK].repeat(PACK)
    return last + np.tile(np.arange(PACK) * APART, len(last) // PACK)


def clock_readings(stamps: Stamps, per_tick: int, lateness: float, seed: int) -> Stamps:
    """
    Return what a clock on /clock reads when each sample comes.

    Parameters
    ----------
    stamps : (K,) array of int
        When the samples are published. The time is published before every `per_tick`-th one.
    lateness : float
        Scale (s) of the delays of both; what is late holds up what was published after it.

    """
    rng = np.random.default_rng(seed)

    def received(published: Stamps) -> Stamps:
        late = 1e9 * lateness * np.abs(rng.standard_normal(len(published)))
        return np.maximum.accumulate(published + late.astype(np.int64))

    ticks = stamps[::per_tick]
    latest = np.searchsorted(received(ticks - AHEAD), received(stamps), side='right')
    return ticks[np.maximum(latest, 1) - 1]


def error(p: Mapping[str, Any], stamps: Stamps) -> float:
    """Return the error of d over d (RMS)."""
    t, y, d = recording()
    part = t > SETTLED
    found = OnlineEstimator(p).run(stamps, y).unknown_input
    return rms((found - d)[part]) / rms(d[part])


def rounded(value: float) -> float:
    """Return a number as it is kept."""
    return float(f'{value:.3g}')


def jitter_errors(p: Mapping[str, Any]) -> list[float]:
    """Return the errors with `JITTERS` of the stamps, and with packs and `sampling: clock`."""
    stamps = nanoseconds(recording()[0])
    found = [
        np.median([error(p, jittered(stamps, jitter, seed)) for seed in range(SEEDS)])
        for jitter in JITTERS
    ]
    return [*map(rounded, found), rounded(error({**p, 'sampling': 'clock'}, packed(stamps)))]


def clock_errors(p: Mapping[str, Any], per_tick: int) -> list[float]:
    """Return the errors with the readings of a clock (medians), for each lateness."""
    stamps = nanoseconds(recording()[0])
    return [
        rounded(np.median([
            error({**p, 'sampling': 'clock'}, clock_readings(stamps, per_tick, late, seed))
            for seed in range(SEEDS)
        ]))
        for late in LATENESS
    ]  # fmt: skip


def gap_errors(changes: Mapping[str, Any], omega: float, gap: int) -> list[float]:
    """Return the error of d over d (RMS) after a gap (ms) of y: in one step, and bridged."""
    p, squares = dict(changes) | NO_RESTART, []
    demo = OnlineEstimator.from_yaml(shipped(FILE)).parameters
    p = {k: demo[k] for k in (('order', 'phi') if 'variant' in p else demo)} | p
    for phase in np.arange(PHASES) * np.pi / PHASES:
        t, y, d = recording(disturbance_omega=omega, disturbance_phase=phase)
        end = GAP_AT + gap * 1e-3 - 0.5 / RATE
        keep = (t < GAP_AT) | (t > end)
        part = (t[keep] > end) & (t[keep] < end + JUDGED)
        squares.append([
            np.mean((OnlineEstimator(each).run(nanoseconds(t[keep]), y[keep]).unknown_input
                     - d[keep])[part] ** 2)
            for each in (p | ONE_STEP, p)
        ])  # fmt: skip
    return [rounded(each) for each in np.sqrt(np.mean(squares, axis=0)) / rms(d)]


def measure() -> dict[str, Any]:
    """Return everything that the page shows."""
    gains = shown_gains()
    return {
        'jitter': {name: jitter_errors(p) for name, p in gains.items()},
        'clock': {
            name: {clock: clock_errors(p, per_tick) for clock, per_tick in CLOCKS.items()}
            for name, p in gains.items()
        },
        'gaps': {
            name: {str(gap): gap_errors(changes, omega, gap) for gap in GAPS}
            for name, (changes, omega) in GAPPED.items()
        },
    }


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a table in Markdown."""
    return '\n'.join(f'| {" | ".join(row)} |' for row in (head, ['---'] * len(head), *rows))


def shown(values: Iterable[float]) -> list[str]:
    """Return errors as cells."""
    return [f'{value:.2g}' for value in values]


def texts(results: dict[str, Any]) -> dict[str, str]:
    """Return the generated parts of the page."""
    late = [f'{1e6 * each:g} µs' if each < 1e-3 else f'{1e3 * each:g} ms' for each in LATENESS]
    gaps = [
        [f'{gap} ms' if gap else 'none']
        + [cell for name in GAPPED for cell in shown(results['gaps'][name][str(gap)])]
        for gap in GAPS
    ]
    return {
        'jitter': table(
            ['gains', *(f'± {100 * each:g} % of a period' for each in JITTERS), 'packs'],
            [[name, *shown(errors)] for name, errors in results['jitter'].items()],
        ),
        'clock': table(
            ['gains', '`/clock`', f'delays of {late[0]}', *late[1:]],
            [
                [name, clock, *shown(errors)]
                for name, clocks in results['clock'].items()
                for clock, errors in clocks.items()
            ],
        ),
        'gaps': table(
            ['gap', *(head for name in GAPPED for head in (f'{name}: one step', 'bridged'))], gaps
        ),
    }


def main() -> int:
    """Write the tables and the results of this checkout."""
    results = measure()
    for path in refill(PAGE, texts(results), results=results, name=NAME):
        print(path)
    return 0


if __name__ == '__main__':
    sys.exit(main())
