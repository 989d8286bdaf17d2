# SPDX-License-Identifier: Apache-2.0
"""Parameters that change while an observer runs: without a jump, all or nothing."""

import itertools

from fhaosmo_ros.core import ConfigurationError, Observer
from fhaosmo_ros.core.parameters.tables import OBSERVER_PARAMETERS
import numpy as np
from observer_cases import assert_same_state, LAWS, samples, SMALL, VARIANTS
import pytest

CHANGES = {
    'unknown_input_decay': [5.0],
    'bandwidth': [2.0],
    'tuning_memory': [3.0],
    'structure': ['cascade', 'levant'],
    'variant': list(VARIANTS),
    'scheme': ['explicit', 'implicit'],
    'prediction_step': [1e-4],
    'correction_period': [5e-4],
    'noise_size': [1.0],
    'state_sizes': [2.0, [1.0, 2.0]],
    'unknown_input_size': [0.1],
    'unknown_input_rate': [2.0],
    'lambda': [2.0, [3.0, 4.0, 5.0]],
    'alpha': [2, [3, 4, 5]],
    'epsilon': [1.0],
    'fuzzy_widths': [0.5, [0.1, 0.2], [0.1, 0.2, 0.3]],
    'fuzzy_systems': [['terms 3'], ['terms 5; output singleton 5', 'curve 0 0.9 1']],
    'gamma_initial': [0.6],
    'gamma_rate': [0.0, 1.0],
    'gamma_min': [0.4],
    'gamma_max': [0.6],
    'gamma_dead_zone': [0.1],
    'gamma_leakage': [0.1],
    'initial_estimate': [1.0, [1.0, 2.0, 3.0]],
    'initial_internal': [1.0, [1.0, 2.0, 3.0]],
    'start_from_measurement': [False],
    'estimate_from': ['filtered', 'internal'],
}


def test_every_live_parameter_is_tried():
    assert set(CHANGES) == {p.name for p in OBSERVER_PARAMETERS.values() if p.live}


@pytest.mark.parametrize('name', CHANGES)
def test_live_change_does_not_move_the_state(name):
    for law, value in itertools.product(LAWS, CHANGES[name]):
        if (law | {name: value}).items() >= {'structure': 'levant', 'scheme': 'explicit'}.items():
            continue
        try:
            assert_state_stays(law, name, value)
        except AssertionError as error:
            error.add_note(f'{law}, {name} = {value}')
            raise


def assert_state_stays(law, name, value):
    observer = Observer(SMALL | law)
    observer.run(*samples())
    before = observer.state
    observer.configure({name: value})
    after = observer.state
    for quantity in before.values.keys() - {'p', 'q', 'gamma'}:
        np.testing.assert_array_equal(after.values[quantity], before.values[quantity])
    # A fresh observer in the same state goes on in the same way: nothing else is remembered.
    fresh = Observer(observer.parameters)
    fresh.restore(after)
    for k in range(20):
        one, other = (o.step(0.01 * k, 1e-3, 0.0) for o in (observer, fresh))
        assert not one.status.rejected
        np.testing.assert_array_equal(one.z, other.z)
        assert one.gamma == other.gamma
    expected = OBSERVER_PARAMETERS[name].coerce(value)
    assert observer.parameters[name] == expected


@pytest.mark.parametrize(
    ('changes', 'named'),
    [
        ({'lambda': -1.0}, 'lambda'),
        ({'lambda': [1.0, 2.0]}, 'lambda'),
        ({'alpha': [1.0, float('nan'), 2.0]}, 'alpha'),
        ({'fuzzy_widths': [0.1] * 4}, 'fuzzy_widths'),
        ({'gamma_min': 0.6}, 'gamma_initial'),
        ({'gamma_min': 0.9}, 'gamma_min'),
        ({'order': 3}, 'order'),
        ({'phi': ['0', '0']}, 'phi'),
        ({'unknown_input': False}, 'unknown_input'),
        ({'unknown_input_derivatives': 1}, 'unknown_input_derivatives'),
        ({'scheme': 'predict_correct'}, 'scheme'),
        ({'initial_estimate': [0.0, 0.0]}, 'initial_estimate'),
        ({'lamda': 1.0}, 'lamda'),
    ],
    ids=str,
)
def test_refused_change_changes_nothing(changes, named):
    observer = Observer(SMALL)
    observer.run(*samples())
    before, parameters = observer.state, observer.parameters
    with pytest.raises(ConfigurationError, match=f"'{named}'") as error:
        observer.configure({'epsilon': 0.7} | changes)
    assert '\n' not in str(error.value)
    assert observer.parameters == parameters
    assert_same_state(observer.state, before)


def test_unchanged_value_of_a_fixed_parameter_is_accepted():
    observer = Observer(SMALL)
    observer.configure({'order': 2, 'phi': list(SMALL['phi']), 'unknown_input': True})
