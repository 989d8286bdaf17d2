# SPDX-License-Identifier: Apache-2.0
"""
CMA-ES against TPE: the same problems, starts and numbers of trials; docs/tuning.md has the result.

    python benchmark/samplers.py            # prints the table, some minutes
"""

import argparse
from time import process_time

from fhaosmo_ros.tools.tuning.parameters import TUNE_PARAMETERS
from fhaosmo_ros.tools.tuning.search.minimise import minimise, StudyOptions
from fhaosmo_ros.tools.tuning.search.space import changes
from fhaosmo_ros.tools.tuning.source import simulated
from fhaosmo_ros.tools.tuning.tuner import Tuner
import numpy as np
from tqdm import tqdm

SAMPLERS = ('cmaes', 'tpe')
COMMON = {'sample_rate': 200.0, 'recordings': 6, 'held_out': 10, 'integration_step': 1e-3}
PENDULUM = {'order': 2, 'phi': ['0', '-19.62*sin(z1) - 0.3*z2 - 0.5*tanh(z2/0.1)']}
PROBLEMS = {
    "paper's plant, noise 1e-4": ({'noise_std': 1e-4}, {}),
    "paper's plant, noise 1e-3, cascade": ({'noise_std': 1e-3}, {'structure': 'cascade'}),
    'pendulum, noise 5e-4': (PENDULUM | {'noise_std': 5e-4, 'rms_of_d': 2.8}, {}),
}
"""Parameters of the family, and of the estimator."""


def main() -> None:
    """Print a Markdown table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument('--trials', type=int, default=600)
    parser.add_argument('--seeds', type=int, default=3)
    arguments = parser.parse_args()
    seeds = range(1, arguments.seeds + 1)
    rows = []
    spent = dict.fromkeys(SAMPLERS, 0.0)
    with tqdm(total=len(PROBLEMS) * len(SAMPLERS) * len(seeds), unit='search') as bar:
        for problem, (family, estimator) in PROBLEMS.items():
            values = TUNE_PARAMETERS.complete(COMMON | family)
            tuner = Tuner(simulated(values, 1), estimator, values, 1)
            start = changes({d.name: d.start for d in tuner.space})
            found = {}
            for sampler in SAMPLERS:
                found[sampler] = []
                for seed in seeds:
                    begin = process_time()
                    result = minimise(
                        tuner.evaluate,
                        tuner.space,
                        arguments.trials,
                        StudyOptions(seed, sampler),
                        jobs=1,
                    )
                    spent[sampler] += process_time() - begin
                    held_out = tuner.held_out(changes(result.best)).objective
                    found[sampler].append((result.value, held_out))
                    bar.update()
            rows.append(
                [problem, f'{tuner.training(start).objective:.4f}']
                + [text(values, k) for values in found.values() for k in range(2)]
                + [f'{tuner.held_out(start).objective:.4f}']
            )
    print(f'{arguments.trials} trials, seeds 1 to {arguments.seeds}, mean (worst):\n')
    print('| problem | start | CMA-ES | held out | TPE | held out | start, held out |')
    print('|---|---|---|---|---|---|---|')
    for row in rows:
        print(f'| {" | ".join(row)} |')
    count = len(PROBLEMS) * len(seeds) * arguments.trials
    each = ', '.join(f'{s} {1e3 * spent[s] / count:.1f} ms' for s in SAMPLERS)
    print(f'\nProcessor time a trial, evaluation and proposal: {each}.')


def text(values: list[tuple[float, float]], column: int) -> str:
    """Return mean and worst of a column."""
    numbers = np.array(values)[:, column]
    return f'{numbers.mean():.4f} ({numbers.max():.4f})'


if __name__ == '__main__':
    main()
