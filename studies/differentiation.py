# SPDX-License-Identifier: Apache-2.0
"""
`python -m studies.differentiation` measures what smoothing brings, and writes docs/smoothing.json.

First with the shipped files, on a simulation of the plant in the same file; then beside PyNumDiff.
PyNumDiff's simulated systems with its own noise, each of its methods tuned by its own optimiser:
without the truth, as a user has to (it is told the bandwidth of the signal), and with the truth.
Ours has y' as unknown input. Without the truth it is told nothing: it takes the noise, the size
and the correlation time of y', and the number of derivatives, that make its innovations likeliest.

The second takes hours; `--check` computes our columns alone and compares them with those that were
written; `--files` makes the first table alone.
"""

import argparse
import json
from pathlib import Path
import sys
from time import process_time
from typing import Any
import warnings

from fhaosmo_ros.core import Observer, OnlineEstimator, Plant
from fhaosmo_ros.core.observer.configuration import deadbeat_shares, ObserverConfiguration
from fhaosmo_ros.core.observer.kalman import Uncertainty
from fhaosmo_ros.core.observer.smoother import Smoother
from fhaosmo_ros.core.observer.smoothing import BEGINS, MEASURED
from fhaosmo_ros.core.parameters.errors import ConfigurationError
from fhaosmo_ros.core.parameters.files import load
from fhaosmo_ros.core.parameters.tables import PLANT_PARAMETERS
from fhaosmo_ros.tools.cli.share import shipped
import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize
from studies.model import model_alone, SELF_TUNING

FILES = ('noise_1e-4', 'noise_1e-3', 'noise_1e-2', 'models/pendulum')
DURATION, LAGS, TIMED = 20.0, (0.05, 0.2, 0.5), 'noise_1e-3'
"""Of the recordings (s); lags (s); the file whose time a sample is printed."""
DT, LAG = 0.01, 0.2
BANDLIMITS = {
    'sine': 3.0, 'triangle': 4.0, 'pop_dyn': 2.0, 'linear_autonomous': 4.0,
    'pi_cruise_control': 2.0, 'lorenz_x': 4.0,
}  # fmt: skip
"""Hz, told to PyNumDiff's optimiser; ours is not told."""
NOISES = (0.1,)
METHODS = (
    'kerneldiff', 'butterdiff', 'savgoldiff', 'splinediff', 'spectraldiff', 'waveletdiff',
    'finitediff', 'polydiff', 'rbfdiff', 'rtsdiff',
)  # fmt: skip
"""Without those that need convex optimisation, each of which takes minutes a signal."""
DERIVATIVES, NEAR = (1, 2, 3), 1.1
RESULTS = Path(__file__).resolve().parents[1] / 'docs' / 'smoothing.json'
Cell = tuple[NDArray[np.float64], NDArray[np.float64]]


def with_file(name: str, self_tuning: bool = False) -> list[float]:
    """
    Return errors of d over d: those of the observer, of `LAGS`, of the whole recording.

    With gains of the file, or told its model alone; then followed by the share of the d that are
    within a standard deviation of those of the whole recording.
    """
    path = shipped(f'config/{name}.yaml')
    p = OnlineEstimator.from_yaml(path).parameters
    plant = load(path, 'plant', PLANT_PARAMETERS) | {'noise_std': p['noise_size']}
    if self_tuning:
        p = model_alone(p) | SELF_TUNING
    t = np.arange(0.0, DURATION, 1e-3)
    stamps, truth = np.round(t * 1e9).astype(np.int64) + 1, Plant(plant).simulate(t)
    found = [
        OnlineEstimator(p | {'smoothing_lag': lag}).run(stamps, truth.y) for lag in (0.0, *LAGS)
    ]
    found.append(Observer(p).smooth(t, truth.y))
    off = [f.unknown_input - truth.unknown_input[: len(f.t)] for f in found]
    numbers = [rms(wrong) / rms(truth.unknown_input) for wrong in off]
    if self_tuning:
        numbers.append(float(np.mean(abs(off[-1]) < found[-1].standard_deviation[:, -1])))
    return [float(f'{number:.4g}') for number in numbers]


def costs() -> list[float]:
    """Return CPU a sample (µs): live without and with `LAGS`, and of a whole recording."""
    p = OnlineEstimator.from_yaml(shipped(f'config/{TIMED}.yaml')).parameters
    y = p['noise_size'] * np.random.default_rng(1).standard_normal(6000)
    found = []
    for lag in (0.0, *LAGS):
        estimator = OnlineEstimator(p | {'smoothing_lag': lag})
        for k, sample in enumerate(y):
            if k == len(y) // 2:  # the lag is over
                begin = process_time()
            estimator.update(10**9 + 10**6 * k, sample)
        found.append((process_time() - begin) / (len(y) // 2))
    observer = Observer(p)
    for _ in range(2):
        begin = process_time()
        observer.smooth(1e-3 * np.arange(len(y)), y)
        spent = (process_time() - begin) / len(y)
    return [float(f'{1e6 * x:.3g}') for x in (*found, spent)]


def files_table(results: dict[str, Any]) -> str:
    """Return what smoothing brings with the shipped files, and what it costs."""
    lags = ' | '.join(f'lag of {1e3 * lag:g} ms' for lag in LAGS)
    lines = [
        f'| file | observer | {lags} | whole recording | true d within its σ |',
        '|---' * (4 + len(LAGS)) + '|',
    ]
    for name, errors in results['files'].items():
        lines.append(f'| {name} | {" | ".join(f"{x:.2g}" for x in errors)} | |')
        *errors, inside = results['self-tuning'][name]
        numbers = ' | '.join(f'{x:.2g}' for x in errors)
        lines.append(f'| its model, self-tuning | {numbers} | {100.0 * inside:.0f} % |')
    spent = ' | '.join(f'{x:.2g} µs' for x in results['microseconds'])
    return '\n'.join([*lines, f'| CPU a sample, {TIMED} | {spent} | |'])


def cell(system: str, noise: float) -> Cell:
    """Return y and the truth of its derivative."""
    from pynumdiff.utils import simulate

    y, _, rate = getattr(simulate, system)(duration=4, noise_parameters=(0, noise), dt=DT)
    return np.asarray(y, dtype=np.float64), np.asarray(rate, dtype=np.float64)


def parameters(derivatives: int, noise: float, size: float, decay: float) -> dict[str, Any]:
    """Return an observer of y' whose gains are those of the Kalman filter (D 19)."""
    p = {
        'order': 1, 'phi': ['0'], 'structure': 'levant', 'scheme': 'predict_correct',
        'variant': 'fuzzy_adaptive', 'gamma_initial': 1e-4, 'gamma_min': 1e-4, 'gamma_rate': 0.0,
        'correction_period': DT, 'noise_size': noise, 'state_sizes': [noise],
        'unknown_input_size': size, 'unknown_input_decay': decay,
        'unknown_input_derivatives': derivatives, 'fuzzy_systems': ['curve 0 1'],
        'fuzzy_widths': [16.0 * noise], 'fuzzy_growth': True,
    }  # fmt: skip
    model = ObserverConfiguration(p | {'noise_size': 0.0}).model
    steady = Uncertainty(model, ObserverConfiguration(p).parameters, np.array([noise])).steady(DT)
    levels = derivatives + 2
    injections, shares = np.zeros(levels), deadbeat_shares(levels)
    for i in reversed(range(levels)):
        behind = sum(
            shares[j, i] * DT ** (j - i + 1) * injections[j] for j in range(i + 1, levels)
        )
        injections[i] = max(steady[0, i] / noise**2 - behind, 1e-9) / DT
    return p | {'lambda': [float(g) for g in injections * 16.0 * noise]}


def unfitness(
    y: NDArray[np.float64], p: dict[str, Any], rate: NDArray[np.float64] | None
) -> float:
    """Return minus the logarithm of the likelihood of the innovations, or the error of y'."""
    observer = Observer(p)
    if rate is not None:
        return rms(observer.smooth(np.arange(len(y)) * DT, y).unknown_input - rate)
    smoother, count = Smoother(observer.configuration), len(y)
    samples = y, np.full(count, DT), np.zeros((count, 1))
    kinds = np.full(count, MEASURED)
    kinds[0] = BEGINS
    zero, none = np.zeros((count, observer.levels)), np.empty((count, 0))
    smoother.take(zero, zero, samples, np.arange(count), kinds, none, none)
    e, variance = smoother.innovations()
    return 0.5 * float(np.sum(np.log(variance) + e**2 / variance))


def tuned(y: NDArray[np.float64], rate: NDArray[np.float64] | None = None) -> dict[str, Any]:
    """Return the parameters of the largest likelihood; with `rate`, from there the best ones."""
    rough = float(np.std(np.diff(y, 3)) / np.sqrt(20.0))
    starts = [(rough, 5.0 * float(np.std(y)), decay) for decay in (0.5, 3.0)]
    if rate is not None:
        starts = [sizes_of(tuned(y))]
    return searched(y, rate, starts)


def sizes_of(p: dict[str, Any]) -> tuple[float, float, float]:
    """Return what is searched for."""
    return p['noise_size'], p['unknown_input_size'], p['unknown_input_decay']


def searched(
    y: NDArray[np.float64],
    rate: NDArray[np.float64] | None,
    starts: list[tuple[float, float, float]],
) -> dict[str, Any]:
    """Return the best parameters that searches from these starts find."""
    best: tuple[float, dict[str, Any]] = (np.inf, {})
    for derivatives in DERIVATIVES:

        def cost(x: NDArray[np.float64], k: int = derivatives) -> float:
            if not (abs(x) < 14.0).all():
                return 1e9
            try:
                return unfitness(y, parameters(k, *np.exp(x).tolist()), rate)
            except ConfigurationError:
                return 1e9

        for start in starts:
            options = {'maxiter': 160}
            found = minimize(cost, np.log(start), method='Nelder-Mead', options=options)
            if found.fun < best[0]:
                best = found.fun, parameters(derivatives, *np.exp(found.x).tolist())
    return best[1]


def ours(y: NDArray[np.float64], rate: NDArray[np.float64]) -> dict[str, Any]:
    """Return the RMS errors of y' and what was tuned."""
    p = tuned(y)
    t = np.arange(len(y)) * DT
    observer = Observer(p)
    stamps = np.round(t * 1e9).astype(np.int64) + 1
    lagging = OnlineEstimator(p | {'smoothing_lag': LAG}).run(stamps, y).unknown_input
    found = {
        'causal': rms(observer.run(t, y).unknown_input - rate),
        'lag': rms(lagging - rate[: len(lagging)]),
        'smoothed': rms(observer.smooth(t, y).unknown_input - rate),
        'with the truth': rms(Observer(tuned(y, rate)).smooth(t, y).unknown_input - rate),
    }
    names = ('unknown_input_derivatives', 'noise_size', 'unknown_input_size')
    return found | {name: p[name] for name in (*names, 'unknown_input_decay')}


def theirs(
    y: NDArray[np.float64], rate: NDArray[np.float64], bandlimit: float, name: str, known: bool
) -> float:
    """Return the RMS error of one of PyNumDiff's methods."""
    import pynumdiff
    from pynumdiff.optimize import optimize

    method = getattr(pynumdiff, name)
    told = {'dxdt_truth': rate} if known else {'bandlimit': bandlimit}
    with warnings.catch_warnings():
        warnings.simplefilter('ignore')
        found, _ = optimize(method, y, DT, parallel=False, **told)
        return rms(method(y, DT, **found)[1] - rate)


def rms(x: NDArray[np.float64]) -> float:
    """Return the root of the mean square."""
    return float(np.sqrt(np.mean(np.square(x))))


def table(results: dict[str, Any]) -> str:
    """Return the table of the page."""
    lines = [
        '| system, noise | causal | lag of 200 ms | smoothed | best of theirs | ratio | smoothed, '
        'tuned with the truth | best of theirs, likewise | ratio |',
        '|---|---|---|---|---|---|---|---|---|',
    ]
    for name, row in results.items():
        mine = row['ours']
        columns = [f'{mine[key]:.3g}' for key in ('causal', 'lag')]
        for key, way in (('smoothed', 'loss'), ('with the truth', 'truth')):
            method = min(row[way], key=row[way].__getitem__)
            best = row[way][method]
            columns.append(f'{mine[key]:.3g}')
            columns += [f'{best:.3g} ({method})', f'{mine[key] / best:.2f}']
        lines.append(f'| {name} | {" | ".join(columns)} |')
    said = []
    for key, way, how in (('smoothed', 'loss', 'Without'), ('with the truth', 'truth', 'With')):
        ratios = [row['ours'][key] / min(row[way].values()) for row in results.values()]
        near = sum(ratio <= NEAR for ratio in ratios)
        said.append(
            f'{how} the truth ours is at most {NEAR:g} times the best of theirs in {near} of the '
            f'{len(ratios)} systems, at worst {max(ratios):.2f} times, at best {min(ratios):.2f}.'
        )
    return '\n'.join([*lines, '', *said])


def texts(results: dict[str, Any]) -> dict[str, str]:
    """Return the tables by name."""
    return {'files': files_table(results), 'table': table(results['systems'])}


def main() -> int:
    """Compute what is missing in the results, write them and tell them."""
    parser = argparse.ArgumentParser(description=__doc__.split('\n')[1])
    parser.add_argument('--check', action='store_true', help='compute our columns, compare')
    parser.add_argument('--files', action='store_true', help='the shipped files alone')
    parser.add_argument('--methods', nargs='*', default=METHODS, help='of PyNumDiff')
    arguments = parser.parse_args()
    results = json.loads(RESULTS.read_text()) if RESULTS.exists() else {'systems': {}}
    if not arguments.check:
        results['files'] = {f: with_file(f) for f in FILES}
        results['self-tuning'] = {f: with_file(f, self_tuning=True) for f in FILES}
        results['microseconds'] = costs()
    for noise in () if arguments.files else NOISES:
        for system, bandlimit in BANDLIMITS.items():
            y, rate = cell(system, noise)
            name = f'{system}, {noise:g}'
            row = results['systems'].setdefault(name, {'loss': {}, 'truth': {}})
            mine = ours(y, rate)
            print(name, mine, flush=True)
            if arguments.check and abs(mine['smoothed'] / row['ours']['smoothed'] - 1.0) > 0.02:
                print(f'{name}: expected {row["ours"]["smoothed"]:.4g}')
                return 1
            row['ours'] = mine
            for method in () if arguments.check else arguments.methods:
                for way in ('loss', 'truth'):
                    if method not in row[way]:
                        row[way][method] = theirs(y, rate, bandlimit, method, way == 'truth')
                        print(name, method, way, row[way][method], flush=True)
            if not arguments.check:
                RESULTS.write_text(json.dumps(results, indent=1) + '\n')
    if not arguments.check:
        RESULTS.write_text(json.dumps(results, indent=1) + '\n')
        print(*texts(results).values(), sep='\n\n')
    return 0


if __name__ == '__main__':
    sys.exit(main())
