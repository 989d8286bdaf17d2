# SPDX-License-Identifier: Apache-2.0
"""Trials of `tune`: how many a minute, and how much a second core brings."""

from time import perf_counter, process_time

import numpy as np
from table import CannotMeasureError, Row
from tqdm import tqdm

try:
    from fhaosmo_ros.tools.tuning.search import minimise
    from fhaosmo_ros.tools.tuning.source import simulated
    from fhaosmo_ros.tools.tuning.tuner import Tuner
except ModuleNotFoundError as error:
    MISSING = error.name
else:
    MISSING = None
from fhaosmo_ros.tools.tuning.parameters import TUNE_PARAMETERS

RECORDINGS = 4
CORES = 2
MILLISECONDS = 30.0
"""A trial of four recordings of 20 s at 1 kHz: 2,000 trials a minute."""
EFFICIENCY = 1.8


def measure(quick: bool) -> list[Row]:
    """Return the time of a trial on two cores, the ratio to one core, and the proposals' share."""
    if MISSING is not None:
        raise CannotMeasureError(f'{MISSING} is not installed (extra: tune)')
    trials, rounds = (20, 1) if quick else (200, 5)
    values = TUNE_PARAMETERS.complete(
        {'noise_std': 1e-4, 'recordings': RECORDINGS, 'held_out': 1, 'integration_step': 1e-3}
    )
    if quick:
        values = values.changed({'duration': 6.0})
    tuner = Tuner(simulated(values, 1), {}, values, 1)
    start = {d.name: d.start for d in tuner.space}
    times, processor = np.empty((rounds, 3)), np.empty((rounds, 3))
    with tqdm(total=3 * rounds, desc='tune', unit='run', leave=False) as progress:
        for k in range(rounds):
            for column, (jobs, work) in enumerate(((1, True), (CORES, True), (1, False))):
                begin, spent = perf_counter(), process_time()
                minimise(
                    # Equal work in every trial, wherever the search goes.
                    lambda _, work=work: tuner.evaluate(start) if work else 1.0,
                    tuner.space,
                    trials,
                    jobs=jobs,
                )
                times[k, column] = (perf_counter() - begin) / trials * 1e3
                processor[k, column] = (process_time() - spent) / trials * 1e3
                progress.update()
    one, two, empty = np.median(times, axis=0)
    ratio = float(np.median(times[:, 1] / times[:, 0]))
    busy = float(np.median(processor[:, 1]))
    note = (
        f'{RECORDINGS} recordings of {values["duration"]:g} s at 1 kHz, predict_correct: '
        f'{60e3 / two:.0f} trials a minute; {busy:.1f} ms of processor time'
    )
    return [
        Row(
            f'tune, a trial on {CORES} cores', float(two), 'ms',
            bar=None if quick else MILLISECONDS, note=note,
        ),
        Row(
            f'tune, {CORES} cores / 1 core', ratio, bar=None if quick else 1.0 / EFFICIENCY,
            note=f'{two:.1f} / {one:.1f} ms; efficiency {1.0 / ratio:.2f} of {CORES}',
        ),
        Row('tune, proposing', float(empty), 'ms', note='a trial without work'),
    ]  # fmt: skip
