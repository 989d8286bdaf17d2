# SPDX-License-Identifier: Apache-2.0
"""The paper's first simulation: 20 s at a step of 1e-5, plant and sign observer."""

from pathlib import Path
from time import perf_counter

from fhaosmo_ros.core.observer.observer import Observer
from fhaosmo_ros.core.parameters.files import load
from fhaosmo_ros.core.parameters.tables import OBSERVER_PARAMETERS, PLANT_PARAMETERS
from fhaosmo_ros.core.simulation.plant import Plant
import numpy as np
from table import Row
from tqdm import tqdm

CONFIGURATION = Path(__file__).parents[1] / 'config' / 'paper.yaml'
STEP = 1e-5
DURATION = 20.0
BAR = 10.0


def measure(quick: bool) -> list[Row]:
    """Return the seconds that the simulation takes."""
    duration = 1.0 if quick else DURATION
    repetitions = 1 if quick else 3
    with tqdm(total=repetitions, desc='simulation', unit='run', leave=False) as progress:
        times = []
        for _ in range(repetitions):
            times.append(simulate(duration)[2])
            progress.update()
    note = f'{round(duration / STEP):,} steps, sign, explicit; RK4 plant; median of {len(times)}'
    return [
        Row(
            f'paper simulation, {duration:g} s at {STEP:g}', float(np.median(times)), 's',
            bar=None if quick else BAR, note=note,
        ),
    ]  # fmt: skip


def simulate(duration: float) -> tuple[np.ndarray, np.ndarray, float]:
    """
    Run the simulation.

    Returns
    -------
    (array, array, float)
        d, its estimate, and the seconds it took.

    """
    start = perf_counter()
    values = load(CONFIGURATION, 'estimator')
    observer = Observer(
        {name: value for name, value in values.items() if name in OBSERVER_PARAMETERS}
        | {'variant': 'sign', 'scheme': 'explicit'}
    )
    values = load(CONFIGURATION, 'plant')
    plant = Plant(
        {name: value for name, value in values.items() if name in PLANT_PARAMETERS}
        | {'integration_step': STEP}
    )
    t = np.arange(round(duration / STEP) + 1) * STEP
    truth = plant.simulate(t)
    estimate = observer.run(t, truth.y)
    return truth.unknown_input, estimate.unknown_input, perf_counter() - start
