# SPDX-License-Identifier: Apache-2.0
"""
A power that adapts, held against one that does not, where d and the noise change.

The run is the demonstration's: the paper's plant, d = 0.1 sin whose frequency goes from 0.5 to 5
rad/s, noise of 1e-4 on the last third of y. All gains of the fuzzy cascade are searched twice, by
the same CMA-ES: with a power that is held; and, from the best of these gains on, with one that
adapts, law and all gains together. A Kalman filter gets one tuning for the same run. All are
judged on noise and initial states that no search has seen.
"""

import argparse
from functools import cache
import sys
from typing import Any

from fhaosmo_ros.core import ConfigurationError, Observer, Plant, Recording, TriangularModel
from fhaosmo_ros.core.parameters.files import load
from fhaosmo_ros.core.parameters.tables import OBSERVER_PARAMETERS
from fhaosmo_ros.tools.cli.command import shipped
from fhaosmo_ros.tools.tuning.search import Dimension, minimise, Values
import numpy as np
from studies.evidence import markdown, Row
from studies.harness import Found, Results, run_study
from studies.methods import LINEAR_LIMIT, mean, METHODS, objective, Setting, trial, tune

PERIOD, DURATION, NOISY_FROM, SETTLED = 1e-3, 20.0, 13.3, 2.0
"""Seconds: of the run, from when y has noise, from when errors count."""
NOISE = 1e-4
TRAINED, JUDGED = (1, 2), (11, 12, 13, 14, 15)  # seeds of noise and initial states
STARTS, TRIALS, QUICK = (1, 2, 3, 4), 3000, 20
RATES = (1.0, 10.0, 100.0, 1000.0)  # gamma in the law, D 7
REACH = 1e3  # how far a search goes from the demonstration's gains, as a factor to both sides
HELD = {'gamma_rate': 0.0, 'gamma_leakage': 0.0}
LISTS = {'lambda': 4, 'alpha': 3, 'fuzzy_widths': 4}  # how many entries of each list act
LAW = (
    Dimension('gamma_rate', 10.0, 1e6, 30.0),
    Dimension('gamma_leakage', 1e-4, 1e2, 0.3),
    Dimension('gamma_dead_zone', 1e-9, 1.0, 1e-5),
)


def measure(arguments: argparse.Namespace, results: Results) -> Found:
    """Search and judge."""
    trials = QUICK if arguments.quick else TRIALS

    def best(adapts: bool, start: Values, law: Values) -> dict[str, Any]:
        cells = {seed: (searched, adapts, seed, trials, start) for seed in STARTS}
        return min((judged(v, law) for v in results(cells).values()), key=lambda f: f['training'])

    held = best(False, {}, HELD)
    gains = {k: v for k, v in held.items() if k not in ('training', 'judged', 'gamma', *HELD)}
    found = {'the power is held': held}
    for rate in RATES:
        law = {**HELD, 'gamma_rate': rate}
        found[f'the same gains, it adapts by {rate:g}'] = judged(gains, law)
    found['it adapts, all gains searched with the law'] = best(True, gains, {})
    found['Kalman filter, one tuning'] = results({'': (kalman, trials)})['']
    rows: list[Row] = [{'observer': name, **row} for name, row in found.items()]
    table = markdown(
        ('observer', 'error in training', 'error judged', 'γ is'),
        [(r['observer'], f'{r["training"]:.3f}', f'{r["judged"]:.3f}', r['gamma']) for r in rows],
    )
    return Found({'power': rows}, {'power': table}, {})


def recording(seed: int) -> Recording:
    """Return one run of the demonstration's plant."""
    random = np.random.default_rng(seed)
    t = np.arange(0.0, DURATION, PERIOD)
    truth = Plant(
        disturbance='chirp', disturbance_amplitude=0.1, disturbance_omega=0.5,
        initial_state=random.uniform(-0.3, 0.3, 3).tolist(),
    ).simulate(t)  # fmt: skip
    noise = NOISE * random.standard_normal(len(t)) * (t >= NOISY_FROM)
    return Recording(t, truth.y + noise, np.zeros(len(t)), truth.z, truth.unknown_input, 'chirp')


@cache
def demonstrated() -> dict[str, Any]:
    """Return the demonstration's parameters: a search asks for them thousands of times."""
    return dict(load(shipped('config/demo.yaml'), 'estimator', OBSERVER_PARAMETERS))


def run(values: Values, law: Values, recordings: list[Recording]) -> tuple[float, str]:
    """Return the error of the cascade with these gains and this law, and how far gamma moves."""
    given = demonstrated()
    values = dict(values)
    lists = {n: [values.pop(f'{n} {i}') for i in range(k)] for n, k in LISTS.items()}
    lists['alpha'].append(given['alpha'][3])
    try:
        found = [Observer(given | lists | values | law).run(r.t, r.y) for r in recordings]
    except ConfigurationError:
        return np.inf, ''
    late = found[0].gamma[recordings[0].t >= SETTLED]
    pairs = zip(recordings, found, strict=True)
    error = mean(objective(r, f.unknown_input, SETTLED) for r, f in pairs)
    return error, f'{late.min():.2f} .. {late.max():.2f}'


def judged(values: Values, law: Values) -> dict[str, Any]:
    """Return how a cascade does on the recordings of the search, and on others."""
    training, _ = run(values, law, [recording(k) for k in TRAINED])
    found, moves = run(values, law, [recording(k) for k in JUDGED])
    return {'training': training, 'judged': found, 'gamma': moves, **values, **law}


def searched(adapts: bool, seed: int, trials: int, start: Values) -> Values:
    """Return the best gains, with those of the law if the power adapts."""
    given = demonstrated()
    entries = {
        f'{name} {i}': given[name][i] for name, count in LISTS.items() for i in range(count)
    }
    space = [Dimension(name, x / REACH, x * REACH, x) for name, x in entries.items()]
    space.append(Dimension('epsilon', 1e-5, 10.0, given['epsilon']))
    space.append(Dimension('gamma_initial', 0.05, 1.0, 0.8, log=False))
    space = [d._replace(start=start.get(d.name, d.start)) for d in space]
    space += LAW if adapts else ()
    training = [recording(k) for k in TRAINED]
    law = {} if adapts else HELD
    return minimise(lambda v: run(v, law, training)[0], space, trials, seed).best


def kalman(trials: int) -> dict[str, Any]:
    """Return the same of a steady-state Kalman filter with a Matern model of d."""
    method = METHODS[LINEAR_LIMIT]
    setting = Setting(TriangularModel(('0', '0', '-z3')), PERIOD, 0.1, NOISE, SETTLED)
    training, others = ([recording(k) for k in seeds] for seeds in (TRAINED, JUDGED))
    best = tune(method, setting, training, trials, 1)
    judged = trial(method, setting, best.values, others).value
    return {'training': best.value, 'judged': judged, 'gamma': '', **best.values}


if __name__ == '__main__':
    sys.exit(run_study('power', __doc__, measure))
