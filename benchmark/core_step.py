# SPDX-License-Identifier: Apache-2.0
"""One step of the core, beside the same step in C; and of the self-tuning observer."""

from collections.abc import Callable
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory
from time import perf_counter, process_time
from typing import Any

from fhaosmo_ros.core import OnlineEstimator, Plant
from fhaosmo_ros.core.observer.observer import Observer
from fhaosmo_ros.core.parameters.files import load
from fhaosmo_ros.core.parameters.tables import PLANT_PARAMETERS
import numpy as np
from reference import assert_agreement, CASE, compile_reference, in_c, in_core, output, PERIOD
from results import CannotMeasureError, Row
from studies.harness import model_alone, SELF_TUNING
from tqdm import tqdm

BAR = 1.1
CALLS = {'explicit': 0.6, 'implicit': None}
"""Microseconds of a call of `Observer.step`; the implicit scheme solves an equation a level."""
VARIANTS = ('sign', 'fuzzy', 'fuzzy_adaptive')
SCHEMES = ('explicit', 'implicit')
MODELS = Path(__file__).parents[1] / 'config' / 'models'
SELF_TUNING_BARS = {'paper_plant': 12.0, 'dc_motor': 12.0, 'pendulum': 100.0}
"""Microseconds a step, of files in `MODELS`."""
LENGTH = 30
"""Seconds of a run at 1 kHz."""
NOISE = 1e-4
"""Of y, where the file has no quantum."""


def measure(quick: bool) -> list[Row]:
    """Return the ratio to C, and the time of a step of every variant and scheme."""
    samples, rounds, calls = (40_000, 5, 2_000) if quick else (400_000, 15, 20_000)
    y = output(samples + 1)
    rows = [_against_c(y, rounds)]
    for variant, scheme in tqdm([*product(VARIANTS, SCHEMES)], desc='core', leave=False):
        step = in_core(CASE | {'variant': variant, 'scheme': scheme}, y)
        step()
        best = min(_seconds(step) for _ in range(3)) / samples
        rows.append(Row(f'core step, {variant}, {scheme}', best * 1e9, 'ns'))
    for scheme, bar in CALLS.items():
        rows.append(_live(CASE | {'scheme': scheme}, y[:calls], None if quick else bar))
    for model, bar in SELF_TUNING_BARS.items():
        rows.append(_self_tuning(model, None if quick else bar, 5 if quick else LENGTH))
    return rows


def _against_c(y: np.ndarray, rounds: int) -> Row:
    name, samples = 'core step / same step in C (-O3)', len(y) - 1
    try:
        with TemporaryDirectory() as folder:
            library = compile_reference(Path(folder))
        assert_agreement(library, y)
    except CannotMeasureError as error:
        tqdm.write(f'core: {error}')
        return Row(name, None, bar=BAR, note=str(error))
    except AssertionError as error:
        reason = ' '.join(str(error).split())
        raise CannotMeasureError(f'reference.c is not the same recursion: {reason}') from None
    ours, c = in_core(CASE, y), in_c(library, y)
    times = np.empty((rounds, 2))
    for k in range(rounds):
        times[k] = _seconds(ours), _seconds(c)
    times *= 1e9 / samples
    median, best = np.median(times, axis=0), times.min(axis=0)
    note = (
        f'N = 4, fuzzy_adaptive, explicit: {median[0]:.1f} / {median[1]:.1f} ns median, '
        f'{best[0]:.1f} / {best[1]:.1f} ns min ({best[0] / best[1]:.2f})'
    )
    return Row(name, float(np.median(times[:, 0] / times[:, 1])), bar=BAR, note=note)


def _live(parameters: dict[str, Any], y: np.ndarray, bar: float | None) -> Row:
    samples = y.tolist()
    observer = Observer(parameters)
    observer.step(samples[0], PERIOD)

    def run() -> None:
        for sample in samples:
            observer.step(sample, PERIOD)

    seconds = min(_seconds(run) for _ in range(3))
    name = f'Observer.step, one call, {parameters["scheme"]}'
    return Row(name, seconds / len(samples) * 1e6, 'us', bar, 'fuzzy_adaptive')


def _self_tuning(model: str, bar: float | None, length: int) -> Row:
    """Return microseconds a step of a recording."""
    path = MODELS / f'{model}.yaml'
    plant = {k: v for k, v in load(path, 'plant').items() if k in PLANT_PARAMETERS}
    noise = {} if plant.get('quantisation') else {'noise_std': NOISE}
    t = np.arange(round(length / PERIOD)) * PERIOD
    y = Plant(plant | noise).simulate(t).y
    stamps = 10**9 + np.round(t * 1e9).astype(np.int64)
    told = model_alone(load(path, 'estimator')) | SELF_TUNING
    estimator = OnlineEstimator(told)
    begin = process_time()
    estimator.run(stamps, y)
    spent = 1e6 * (process_time() - begin) / len(y)
    note = f'{length} s at 1 kHz; {told["order"]} states'
    return Row(f'step, self-tuning, {model}', spent, 'us', bar, note)


def _seconds(run: Callable[[], object]) -> float:
    start = perf_counter()
    run()
    return perf_counter() - start
