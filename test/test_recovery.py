# SPDX-License-Identifier: Apache-2.0
"""Whoever ships gains ships an estimator that finds y again, whatever happens to it."""

from pathlib import Path

from fhaosmo_ros.core.online.estimator import OnlineEstimator
from fhaosmo_ros.core.parameters.files import load
from fhaosmo_ros.core.parameters.tables import ONLINE_PARAMETERS, PLANT_PARAMETERS
from fhaosmo_ros.core.simulation.plant import Plant
import numpy as np
import pytest

CONFIG = Path(__file__).resolve().parents[1] / 'config'
FILES = sorted(CONFIG.glob('**/*.yaml'))
TUNED = [path for path in FILES if 'predict_correct' in path.read_text(encoding='utf-8')]
RATE = 1000
HIT, BACK, LATEST = 6 * RATE, 13 * RATE // 2, 7 * RATE
"""Samples: when it happens, when it is over, and how long the estimator may take from then on."""


@pytest.fixture(scope='module', params=TUNED, ids=[path.stem for path in TUNED])
def case(request):
    """Estimator's parameters, times, and what its own plant does."""
    values = load(request.param, 'estimator')
    plant = {k: v for k, v in load(request.param, 'plant').items() if k in PLANT_PARAMETERS}
    t = np.arange(BACK + LATEST + 2 * RATE) / RATE
    truth = Plant(plant).simulate(t)
    online = {name: value for name, value in values.items() if name in ONLINE_PARAMETERS}
    return online, t, truth.y, truth.unknown_input


def error(parameters, t, y, d):
    estimator = OnlineEstimator(parameters)
    found = np.empty(len(t))
    for k, at in enumerate(t):
        estimator.advance(10**9 + round(at * 1e9), float(y[k]))
        found[k] = estimator.estimate.unknown_input
    return np.abs(found - d), estimator


def finds_y_again(parameters, t, y, d):
    wrong, estimator = error(parameters, t, y, d)
    usual = wrong[HIT - 2 * RATE : HIT].max()
    assert wrong[BACK + LATEST :].max() < 3.0 * usual
    return estimator


@pytest.mark.parametrize('offset', [0.1, 1.0, -10.0, 1000.0])
def test_sensor_that_is_wrong_for_half_a_second(case, offset):
    parameters, t, y, d = case
    y = y.copy()
    y[HIT:BACK] += offset
    finds_y_again(parameters, t, y, d)


@pytest.mark.parametrize('earlier', [1, 3, 5])
def test_plant_that_goes_back_in_its_motion(case, earlier):
    """As a simulator that is reset, or a bag that begins again; all states jump."""
    parameters, t, y, d = case
    order = np.concatenate([np.arange(HIT), np.arange(HIT - earlier * RATE, len(t))])[: len(t)]
    finds_y_again(parameters, t, y[order], d[order])


def test_y_counts_as_lost_where_all_levels_saturate(case):
    parameters, *_ = case
    assert parameters['epsilon'] == max(parameters['fuzzy_widths'])
    assert parameters['divergence_time'] == 0.1
