# SPDX-License-Identifier: Apache-2.0
"""One step of the core, beside the same step in C; and of the self-tuning observer."""

from collections.abc import Callable
import ctypes
from itertools import product
import os
from pathlib import Path
import shlex
import subprocess
from tempfile import TemporaryDirectory
from time import process_time
from timeit import repeat, timeit
from typing import Any

from fhaosmo_ros.core import Observer, OnlineEstimator, Plant
from fhaosmo_ros.core.observer.configuration import ObserverConfiguration
from fhaosmo_ros.core.observer.fuzzy import KNOTS
from fhaosmo_ros.core.observer.status import LEVEL_SHIFT
from fhaosmo_ros.core.observer.structure import run as run_structure
from fhaosmo_ros.core.parameters.files import load
from fhaosmo_ros.core.parameters.tables import PLANT_PARAMETERS
from fhaosmo_ros.tools.cli.command import shipped
from fhaosmo_ros.tools.tuning.tuner import stamps_of
import numpy as np
from results import Row
from studies.harness import model_alone, SELF_TUNING

PERIOD, BLOCK = 1e-3, 10_000  # seconds; samples that are recorded at a time, here and in C
CASE = {'variant': 'fuzzy_adaptive', 'scheme': 'explicit', 'fuzzy_widths': [0.1]}
"""Wide fuzzy sets: no chatter, so that rounding does not grow and both end at the same state."""
BAR, CALL_BAR = 1.1, 0.6  # times C; microseconds of a call of `Observer.step`
VARIANTS, SCHEMES = ('sign', 'fuzzy', 'fuzzy_adaptive'), ('explicit', 'implicit')
SELF_TUNING_BARS = {'paper_plant': 12.0, 'dc_motor': 12.0, 'pendulum': 100.0}  # us a step
NOISE = 1e-4  # of y, where the file has no quantum
PARTS = ('z_hat', 'z_tilde', 'p', 'q', 'gamma', 'y', 'pending')  # of a state in reference.c
LAW = ('rate', 'min', 'dead_zone', 'leakage')  # parameters of gamma, at the end of its law


def measure(quick: bool) -> list[Row]:
    """Return the ratio to C, and the time of a step of every variant and scheme."""
    samples, rounds, calls = (40_000, 5, 2_000) if quick else (400_000, 15, 20_000)
    y = Plant({'integration_step': PERIOD}).simulate(np.arange(samples + 1) * PERIOD).y
    rows = [_against_c(y, rounds)]
    for variant, scheme in product(VARIANTS, SCHEMES):
        step = in_core(CASE | {'variant': variant, 'scheme': scheme}, y)
        best = min(repeat(step, number=1, repeat=4)) / samples
        rows.append(Row(f'core step, {variant}, {scheme}', best * 1e9, 'ns'))
    observer, few = _started(CASE, y[0]), y[:calls].tolist()
    best = min(repeat(lambda: [observer.step(v, PERIOD) for v in few], number=1, repeat=3))
    name = 'Observer.step, one call, explicit'
    rows.append(Row(name, best / calls * 1e6, 'us', CALL_BAR, 'fuzzy_adaptive'))
    models = SELF_TUNING_BARS.items()
    return rows + [_self_tuning(model, bar, 5 if quick else 30) for model, bar in models]


def in_core(parameters: dict[str, Any], y: np.ndarray) -> Callable[[], np.ndarray]:
    """Return a callable that steps through y[1:] by the loop behind `Observer.run`."""
    observer, rest = _started(parameters, y[0]), np.ascontiguousarray(y[1:])
    start, h, u = observer.structure.state_dict(), np.full(BLOCK, PERIOD), np.zeros((BLOCK, 1))

    def run() -> np.ndarray:
        observer.structure.load_state_dict(start)
        for y in rest.reshape(-1, BLOCK):
            run_structure(observer.structure, y, h, u)
        return _numbers(observer)

    return run


def in_c(folder: Path, y: np.ndarray) -> Callable[[], np.ndarray]:
    """Return a callable that steps through y[1:] in C, for `CASE`; compiled by $CC, else cc."""
    c = ObserverConfiguration(CASE)
    assert c.curves.shape == (4, KNOTS) == (4, 193), 'reference.c expects other curves'
    gains = np.concatenate([c.lambdas, c.alphas, 1.0 / c.widths, c.curves[:2].ravel()])
    law = np.array(
        [*gains, c.epsilon, c.gamma_initial, *(c.parameters[f'gamma_{n}'] for n in LAW)]
    )
    start, rest = _numbers(_started(CASE, y[0])), np.ascontiguousarray(y[1:])
    library = folder / 'reference.so'
    options = ['-O3', '-shared', '-fPIC', f'-DLEVEL_SHIFT={LEVEL_SHIFT}', '-o', library]
    command = [*shlex.split(os.environ.get('CC', 'cc')), *options]
    subprocess.run([*command, Path(__file__).with_name('reference.c'), '-lm'], check=True)
    function = ctypes.CDLL(str(library)).run
    period, count = ctypes.c_double(PERIOD), ctypes.c_long(BLOCK)

    def run() -> np.ndarray:
        state, record = start.copy(), np.empty((BLOCK, 21))
        for y in rest.reshape(-1, BLOCK):
            at = [x.ctypes.data_as(ctypes.c_void_p) for x in (law, state, y, record)]
            function(*at[:3], period, count, at[3])
        return state

    return run


def _started(parameters: dict[str, Any], y: float) -> Observer:
    """Return an observer after its first sample."""
    observer = Observer(parameters)
    observer.start(y)
    return observer


def _numbers(observer: Observer) -> np.ndarray:
    """Return the numbers of `PARTS`, the first four for each level."""
    found = observer.structure.state_dict()
    return np.concatenate([np.atleast_1d(found[name]) for name in PARTS])


def _against_c(y: np.ndarray, rounds: int) -> Row:
    with TemporaryDirectory() as folder:
        ours, c = in_core(CASE, y), in_c(Path(folder), y)
        np.testing.assert_allclose(ours(), c(), rtol=1e-6, atol=1e-9)
        times = np.array([[timeit(run, number=1) for run in (ours, c)] for _ in range(rounds)])
    times *= 1e9 / (len(y) - 1)
    median, best = np.median(times, axis=0), times.min(axis=0)
    note = (
        f'N = 4, fuzzy_adaptive, explicit: {median[0]:.1f} / {median[1]:.1f} ns median, '
        f'{best[0]:.1f} / {best[1]:.1f} ns min ({best[0] / best[1]:.2f})'
    )
    ratio = float(np.median(times[:, 0] / times[:, 1]))
    return Row('core step / same step in C (-O3)', ratio, bar=BAR, note=note)


def _self_tuning(model: str, bar: float, length: int) -> Row:
    """Return microseconds a step of a recording of `length` seconds."""
    path = shipped(f'config/models/{model}.yaml')
    plant = load(path, 'plant', PLANT_PARAMETERS)
    noise = {} if plant.get('quantisation') else {'noise_std': NOISE}
    t = np.arange(round(length / PERIOD)) * PERIOD
    y = Plant(plant | noise).simulate(t).y
    told = model_alone(load(path, 'estimator')) | SELF_TUNING
    begin = process_time()
    OnlineEstimator(told).run(stamps_of(t), y)
    spent = process_time() - begin
    note = f'{length} s at 1 kHz; {told["order"]} states'
    return Row(f'step, self-tuning, {model}', 1e6 * spent / len(y), 'us', bar, note)
