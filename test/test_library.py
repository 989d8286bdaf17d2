# SPDX-License-Identifier: Apache-2.0
"""What the library offers beside ROS: parameter files, and what `tune` has written."""

from fhaosmo_ros.core import ConfigurationError, Observer, OnlineEstimator, Plant
from fhaosmo_ros.core.parameters.files import dumps
import numpy as np
import pytest

GAINS = {
    'order': 2, 'phi': ['0', '-k*z2'], 'constants.k': 2.0, 'structure': 'levant',
    'variant': 'fuzzy', 'lambda': [3.0, 4.0, 5.0], 'divergence_time': 0.1, 'publish_rate': 50.0,
}  # fmt: skip
T = np.arange(50) * 1e-3
Y = 0.1 * np.sin(T)


@pytest.mark.parametrize('kind', [Observer, OnlineEstimator])
def test_file_of_parameters(kind, tmp_path):
    path = tmp_path / 'gains.yaml'
    path.write_text(dumps(GAINS, 'estimator'))
    found = kind.from_yaml(path).parameters
    assert found == kind(GAINS).parameters  # also what is not the observer's
    assert all(found[name] == GAINS[name] for name in found.keys() & GAINS.keys())
    assert ('divergence_time' in found) == (kind is OnlineEstimator)
    path.write_text(dumps(GAINS | {'channels': ['hip'], 'hip.constants.k': 3.0}, '/rig/observer'))
    for name in ('hip', ''):  # a single one need not be named
        assert kind.from_yaml(path, '/rig/observer', name).parameters['constants.k'] == 3.0
    with pytest.raises(ConfigurationError, match=r'gains\.yaml: .*hip, got hop'):
        kind.from_yaml(path, '/rig/observer', 'hop')
    with pytest.raises(ConfigurationError, match=r"gains\.yaml: expected a section 'estimator'"):
        kind.from_yaml(path)


def test_without_u_the_inputs_that_are_held_go_on():
    model = {'order': 1, 'phi': ['a + b'], 'inputs': ['a', 'b']}
    estimator, same = OnlineEstimator(model), OnlineEstimator(model)
    estimator.set_input(0.5, 1)
    stamps = 10**9 + np.arange(50) * 10**6
    found, wanted = estimator.run(stamps, Y), same.run(stamps, Y, np.tile([0.0, 0.5], (50, 1)))
    np.testing.assert_array_equal(found.z, wanted.z)
    assert estimator.inputs == same.inputs == (0.0, 0.5)


OSCILLATOR = {'order': 2, 'phi': ['0', '-k*sin(z1) - z2*u'], 'constants.k': 3.0}


@pytest.mark.parametrize('kind', [Observer, OnlineEstimator, Plant])
def test_keywords_are_parameters(kind):
    named = {name: OSCILLATOR[name] for name in ('order', 'phi')}
    own = {} if kind is Plant else {'lambda_': 5.0}
    found = kind(**named, constants={'k': 3}, **own)
    assert found.parameters == kind(OSCILLATOR | ({'lambda': 5.0} if own else {})).parameters
    assert kind(OSCILLATOR, constants={'k': 4}).parameters['constants.k'] == 4.0
    for name in ('lamda', 'constant'):
        with pytest.raises(ConfigurationError, match=name):
            kind(**{name: {'k': 1.0}})
    for word in (str(named['order']), 'sin(z1)') if kind is not Plant else ():
        assert word in repr(found)


def test_input_that_phi_uses_must_be_given_and_seconds_are_no_stamps():
    observer, estimator = Observer(OSCILLATOR), OnlineEstimator(GAINS)
    for call, *values in (observer.run, T, Y), (observer.smooth, T, Y), (observer.step, 0.1, 0.1):
        with pytest.raises(ConfigurationError, match='expected values of u'):
            call(*values)
    assert not observer.started
    with pytest.raises(TypeError, match='integer'):
        estimator.update(0.001, 0.1)
    with pytest.raises(ConfigurationError, match='nanoseconds'):
        estimator.run(T, Y)
