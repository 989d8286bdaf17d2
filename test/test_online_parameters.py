# SPDX-License-Identifier: Apache-2.0
"""Every live parameter of the update path changes what it does, and none moves the estimate."""

from typing import Any, NamedTuple

from fhaosmo_ros.core import OnlineEstimator
from fhaosmo_ros.core.parameters.tables import ONLINE_PARAMETERS
import numpy as np
import pytest

START = 1_700_000_000 * 10**9
OF_GAINS = ('gamma', 'p', 'q', 'settled')
"""What an observer remembers of its gains: a change of these may change it."""
LIVE = [name for name, parameter in ONLINE_PARAMETERS.items() if parameter.live]


class Change(NamedTuple):
    """A change of one parameter, what has to be so before for it to matter, and from half on."""

    value: Any
    base: dict[str, Any] = {}  # noqa: RUF012
    prepared: dict[str, Any] = {}  # noqa: RUF012
    reset: bool = False


SEED = [0.0, 1.0, 2.0, 3.0]
PREDICTING = {
    'structure': 'levant', 'scheme': 'predict_correct', 'lambda': [8.0, 20.0, 30.0, 16.0],
    'fuzzy_widths': [1.0],
}  # fmt: skip
SCHEDULED = PREDICTING | {'noise_size': 0.01, 'correction_period': 1e-3}
SELF_TUNING = {'gains': 'self_tuning'}
EVENTS = {
    'event_threshold': 2.0, 'lambda': [740.0], 'alpha': [155.0], 'epsilon': 80.0,
    'fuzzy_widths': [0.1, 1.4], 'gamma_initial': 0.67,
}  # fmt: skip
CHANGES = {
    'unknown_input_decay': Change(50.0),
    'variant': Change('sign'),
    'scheme': Change('explicit'),
    'prediction_step': Change(1e-4, PREDICTING),
    'correction_period': Change(2e-4, PREDICTING),
    'noise_size': Change(1e-3, SCHEDULED, reset=True),
    'state_sizes': Change(5.0, SCHEDULED, reset=True),
    'unknown_input_size': Change(9.0, SCHEDULED, reset=True),
    'lambda': Change(500.0),
    'alpha': Change([10.0, 20.0, 30.0, 40.0]),
    'epsilon': Change(1e-4),
    'fuzzy_widths': Change(0.02),
    'fuzzy_systems': Change(['curve 0 0.8 1']),
    'gamma_initial': Change(0.9, {'gamma_leakage': 5.0, 'gamma_dead_zone': 0.0}),
    'gamma_rate': Change(0.5),
    'gamma_min': Change(0.6, {'gamma_initial': 0.2}, {'gamma_initial': 0.67}),
    'gamma_dead_zone': Change(1e6),
    'gamma_leakage': Change(5.0, {'gamma_dead_zone': 0.0}, {'gamma_initial': 0.9}),
    'initial_estimate': Change(SEED, reset=True),
    'initial_internal': Change(SEED, reset=True),
    'start_from_measurement': Change(False, reset=True),
    'estimate_from': Change('filtered'),
    'sampling': Change('nominal'),
    'nominal_period': Change(0.003, {'sampling': 'nominal'}),
    'max_gap': Change(0.1),
    'spike_gate': Change(0.05),
    'stuck_time': Change(0.005),
    'divergence_time': Change(0.005, {'epsilon': 1e-4}),
    'predict_to_now': Change(True, {'measurement_delay': 0.02}),
    'event_threshold': Change(1e-3),
    'event_deviations': Change(0.1, SELF_TUNING | {'event_duration': 0.0}),
    'event_duration': Change(0.0, EVENTS),
    'event_change_time': Change(0.02, EVENTS),
}


def stream(first: int, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return samples at 1 kHz: jitter, a gap, a spike, a step, a dead stretch."""
    rng = np.random.default_rng(first)
    k = np.arange(first, first + count)
    steps = 10**6 + rng.integers(-100_000, 100_000, count)
    steps[100] += 300 * 10**6
    y = 0.2 + 0.1 * np.sin(0.01 * k) + 1e-3 * rng.standard_normal(count)
    y[50] += 0.3
    y[150:] += 1.0
    y[180:200] = 1.2
    return START + 3 * first * 10**6 + np.cumsum(steps), y


def outputs(change: Change, name: str | None) -> np.ndarray:
    """Return estimates and events after a run in whose middle `name` changes, or nothing."""
    estimator = OnlineEstimator(change.base)
    estimator.run(*stream(0, 250))
    estimator.configure(change.prepared)
    if name:
        observer = estimator.observer
        memory = observer.structure.state_dict()
        estimator.configure({name: change.value})
        assert estimator.parameters[name] == ONLINE_PARAMETERS[name].coerce(change.value)
        for quantity, value in observer.structure.state_dict().items():
            if quantity not in OF_GAINS:
                np.testing.assert_array_equal(value, memory[quantity], err_msg=quantity)
    if change.reset:
        estimator.reset()
    estimator.events.taken()
    result, active = estimator.run(*stream(250, 250)), np.zeros(250)
    for event in estimator.events.taken():
        active[event.sample :] += 1 if event.begins else -1
    return np.column_stack([result.z, result.unknown_input, active])


@pytest.mark.parametrize('name', LIVE)
def test_live_change_has_an_effect_and_makes_no_jump(name):
    one, other = outputs(CHANGES[name], None), outputs(CHANGES[name], name)
    assert np.isfinite(other).all()
    assert not np.array_equal(one, other)
