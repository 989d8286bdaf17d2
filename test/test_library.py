# SPDX-License-Identifier: Apache-2.0
"""What the library offers beside ROS: parameter files, and what `tune` has written."""

from fhaosmo_ros.core import ConfigurationError, Observer, OnlineEstimator
from fhaosmo_ros.core.parameters.files import dumps
import numpy as np
import pytest

GAINS = {
    'order': 2, 'phi': ['0', '-k*z2'], 'constants.k': 2.0, 'structure': 'levant',
    'variant': 'fuzzy', 'lambda': [3.0, 4.0, 5.0], 'divergence_time': 0.1, 'publish_rate': 50.0,
}  # fmt: skip
T = np.arange(50) * 1e-3
Y = 0.1 * np.sin(T)


@pytest.fixture
def gains(tmp_path):
    path = tmp_path / 'gains.yaml'
    path.write_text(dumps(GAINS, 'estimator'))
    return path


@pytest.mark.parametrize('kind', [Observer, OnlineEstimator])
def test_file_of_parameters(kind, gains):
    found = kind.from_yaml(gains)
    for name, value in GAINS.items():
        if name in found.parameters:
            assert found.parameters[name] == value
    assert found.parameters == kind(GAINS).parameters  # also what is not the observer's
    assert ('divergence_time' in found.parameters) == (kind is OnlineEstimator)


@pytest.mark.parametrize('kind', [Observer, OnlineEstimator])
def test_channel_of_a_node(kind, tmp_path):
    path = tmp_path / 'rig.yaml'
    own = {'channels': ['hip', 'knee'], 'knee.constants.k': 3.0, 'knee.lambda': [1.0, 2.0, 3.0]}
    path.write_text(dumps(GAINS | own, '/rig/observer'))
    hip, knee = (
        kind.from_yaml(path, '/rig/observer', name).parameters for name in ('hip', 'knee')
    )
    assert (hip['constants.k'], hip['lambda']) == (2.0, [3.0, 4.0, 5.0])
    assert (knee['constants.k'], knee['lambda']) == (3.0, [1.0, 2.0, 3.0])
    with pytest.raises(ConfigurationError, match=r'rig\.yaml: .*hip or knee, got none'):
        kind.from_yaml(path, '/rig/observer')
    with pytest.raises(ConfigurationError, match=r"rig\.yaml: expected a section 'estimator'"):
        kind.from_yaml(path)


@pytest.mark.parametrize('kind', [Observer, OnlineEstimator])
@pytest.mark.parametrize(
    ('changes', 'said'),
    [
        ({'gamma_min': 0.9}, 'gamma_min'),
        ({'lamda': 1.0}, "'lambda'"),
        ({'phi': ['0', 'b*z2']}, 'b'),
    ],
)
def test_error_begins_with_the_path(kind, changes, said, gains):
    gains.write_text(dumps(GAINS | changes, 'estimator'))
    with pytest.raises(ConfigurationError, match=said) as error:
        kind.from_yaml(gains)
    assert str(error.value).startswith(f'{gains}: ')
    assert str(error.value).count(str(gains)) == 1


def test_a_model_without_inputs_needs_no_u(gains):
    estimator, same = (OnlineEstimator.from_yaml(gains) for _ in range(2))
    stamps = 10**9 + np.arange(50) * 10**6
    found, wanted = estimator.run(stamps, Y), same.run(stamps, Y, np.zeros(50))
    np.testing.assert_array_equal(found.z, wanted.z)
    np.testing.assert_array_equal(Observer.from_yaml(gains).run(T, Y).t, T)


def test_without_u_the_inputs_that_are_held_go_on():
    model = {'order': 1, 'phi': ['a + b'], 'inputs': ['a', 'b']}
    estimator, same = OnlineEstimator(model), OnlineEstimator(model)
    estimator.set_input(0.5, 1)
    stamps = 10**9 + np.arange(50) * 10**6
    found, wanted = estimator.run(stamps, Y), same.run(stamps, Y, np.tile([0.0, 0.5], (50, 1)))
    np.testing.assert_array_equal(found.z, wanted.z)
    assert estimator.inputs == same.inputs == (0.0, 0.5)
