# SPDX-License-Identifier: Apache-2.0
"""
The presets config/noise_*.yaml beside Kalman filters, on held-out recordings; docs/tuning.md.

    python benchmark/presets.py             # prints the table

The Kalman filters' model of d (a random walk; a decaying one) and their bandwidth are tuned on the
recordings that the presets were tuned on, by the same objective: by a scan, which is closer than a
search.
"""

import argparse

from fhaosmo_ros.core.model.triangular import TriangularModel
from fhaosmo_ros.core.parameters.files import load
from fhaosmo_ros.core.parameters.tables import ONLINE_PARAMETERS
from fhaosmo_ros.tools.cli.share import shipped
from fhaosmo_ros.tools.tuning.objective import Evaluation, Objective
from fhaosmo_ros.tools.tuning.parameters import TUNE_PARAMETERS
from fhaosmo_ros.tools.tuning.source import simulated
from fhaosmo_ros.tools.tuning.start.find import SCHEME
from fhaosmo_ros.tools.tuning.start.sampled_model import SampledModel
from fhaosmo_ros.tools.tuning.start.theory import kalman_like
import numpy as np
from tqdm import tqdm

NOISES = ('1e-4', '1e-3', '1e-2')
WIDE, LINEAR = 1e4, 1e-5
"""Half-width in units of the noise, and gamma, at which predict_correct is the linear filter."""
DECAYS = (0.0, *np.geomspace(0.2, 5.0, 5).tolist())
BANDWIDTHS = np.geomspace(1.5, 40.0, 17)


def main() -> None:
    """Print a Markdown table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    parser.add_argument('--recordings', type=int, default=36)
    count = parser.parse_args().recordings
    print('| noise | preset | demo.yaml | Kalman, random walk | Kalman, decaying |')
    print('|---|---|---|---|---|')
    for noise in tqdm(NOISES, unit='noise'):
        values = TUNE_PARAMETERS.complete(
            {'noise_std': float(noise), 'recordings': count, 'held_out': count}
        )
        data = simulated(values, 1)
        training = Objective(data.training, dict(SCHEME), values, choose=False)
        cells = [noise]
        for name in (f'noise_{noise}', 'demo'):
            preset = load(shipped(f'config/{name}.yaml'), 'estimator', ONLINE_PARAMETERS)
            held_out = Objective(data.held_out, preset, values, False, training.scale)
            cells.append(cell(held_out({})))
        held_out = Objective(data.held_out, dict(SCHEME), values, False, training.scale)
        points = [(decay, w) for decay in DECAYS for w in BANDWIDTHS]
        judged = {
            p: training(gains(float(noise), *p)).objective for p in tqdm(points, leave=False)
        }
        for some in ([p for p in points if p[0] == 0.0], points):
            best = min(some, key=judged.__getitem__)
            cells.append(cell(held_out(gains(float(noise), *best))))
        print(f'| {" | ".join(cells)} |', flush=True)


def cell(evaluation: Evaluation) -> str:
    """Return error and objective."""
    return f'{evaluation.error:.3f} ({evaluation.objective:.3f})'


def gains(noise: float, decay: float, bandwidth: float) -> dict[str, object]:
    """Return the observer that is the Kalman filter (D 19)."""
    defaults = TUNE_PARAMETERS.defaults()
    period = 1.0 / defaults['sample_rate']
    plant = TriangularModel.of(defaults)
    model = SampledModel(plant, period, decay=decay)
    width = WIDE * noise
    return {
        'unknown_input_decay': decay, 'correction_period': period, 'fuzzy_widths': [width],
        'lambda': kalman_like(model, bandwidth, width, noise, LINEAR).tolist(),
        'gamma_initial': LINEAR, 'gamma_min': LINEAR,
    }  # fmt: skip


if __name__ == '__main__':
    main()
