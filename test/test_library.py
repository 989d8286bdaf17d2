# SPDX-License-Identifier: Apache-2.0
"""What the library offers beside ROS: parameter files, and what `tune` has written."""

import copy
import pickle

from fhaosmo_ros.core import ConfigurationError, Function, Observer, OnlineEstimator, Plant
from fhaosmo_ros.core.parameters.files import dumps
import numpy as np
import pytest

GAINS = {
    'order': 2, 'phi': ['0', '-k*z2'], 'constants.k': 2.0, 'structure': 'levant',
    'variant': 'fuzzy', 'lambda': [3.0, 4.0, 5.0], 'divergence_time': 0.1, 'publish_rate': 50.0,
}  # fmt: skip
T = np.arange(50) * 1e-3
Y = 0.1 * np.sin(T)


kinds = pytest.mark.parametrize('kind', [Observer, OnlineEstimator])


@kinds
def test_file_of_parameters(kind, tmp_path):
    path = tmp_path / 'gains.yaml'
    path.write_text(dumps(GAINS, 'estimator'))
    found = kind.from_yaml(path).parameters
    assert found == kind(GAINS).parameters  # also what is not the observer's
    assert all(found[name] == GAINS[name] for name in found.keys() & GAINS.keys())
    assert ('divergence_time' in found) == (kind is OnlineEstimator)
    for changes, said in (
        ({'gamma_min': 0.97}, 'gamma_min'), ({'lamda': 1.0}, "'lambda'"),
        ({'phi': ['0', 'b']}, 'b'),
    ):  # fmt: skip
        path.write_text(dumps(GAINS | changes, 'estimator'))
        with pytest.raises(ConfigurationError, match=said) as error:
            kind.from_yaml(path)
        assert str(error.value).startswith(f'{path}: ')
        assert str(error.value).count(str(path)) == 1


@kinds
def test_channel_of_a_node(kind, tmp_path):
    path, node = tmp_path / 'rig.yaml', '/rig/observer'
    own = {'channels': ['hip', 'knee'], 'knee.constants.k': 3.0, 'knee.lambda': [1.0, 2.0, 3.0]}
    path.write_text(dumps(GAINS | own, node))
    hip, knee = (kind.from_yaml(path, node, name).parameters for name in ('hip', 'knee'))
    assert (hip['constants.k'], hip['lambda']) == (2.0, [3.0, 4.0, 5.0])
    assert (knee['constants.k'], knee['lambda']) == (3.0, [1.0, 2.0, 3.0])
    with pytest.raises(ConfigurationError, match=r'rig\.yaml: .*hip or knee, got none'):
        kind.from_yaml(path, node)
    with pytest.raises(ConfigurationError, match=r"rig\.yaml: expected a section 'estimator'"):
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
    for word in str(named['order']), 'sin(z1)':
        assert word in repr(found)


def test_columns_of_a_table_are_taken():
    u, wanted = np.cos(T), Observer(OSCILLATOR).run(T, Y, np.cos(T))
    found = Observer(OSCILLATOR).run(T[:, np.newaxis], Y[:, np.newaxis], u[:, np.newaxis])
    np.testing.assert_array_equal(found.z, wanted.z)
    assert f'{len(T)} samples' in repr(found)
    assert f'unknown_input={found.unknown_input[-1]:.4g}' in repr(found)


def test_input_that_phi_uses_must_be_given():
    observer = Observer(OSCILLATOR)
    for call in (
        lambda: observer.run(T, Y), lambda: observer.smooth(T, Y),
        lambda: observer.step(0.1, 1e-3),
    ):  # fmt: skip
        with pytest.raises(ConfigurationError, match='expected values of u'):
            call()
    assert not observer.started


def test_seconds_are_no_stamps():
    estimator = OnlineEstimator(GAINS)
    with pytest.raises(TypeError, match='integer'):
        estimator.update(0.001, 0.1)
    with pytest.raises(ConfigurationError, match='nanoseconds'):
        estimator.run(T, Y)


def swing(z, u):
    return -3.0 * np.sin(z[0]) - z[1] * u[0]


def gradient(z, u):
    return [-3.0 * np.cos(z[0]), -u[0]]


@pytest.mark.parametrize('gains', ['fixed', 'self_tuning'])
@pytest.mark.parametrize(('slopes', 'tolerance'), [(gradient, 1e-12), (None, 1e-6)])
def test_python_function_is_as_its_expression(gains, slopes, tolerance):
    u = np.cos(T)
    wanted = Observer(OSCILLATOR, gains=gains).run(T, Y, u)
    observer = Observer(OSCILLATOR, gains=gains, phi=['0', Function(swing, slopes)])
    for found in observer.run(T, Y, u), copy.deepcopy(observer).run(T + 1.0, Y, u):
        assert np.isfinite(found.z).all()
    np.testing.assert_allclose(
        Observer(observer.parameters).run(T, Y, u).z, wanted.z, rtol=tolerance, atol=tolerance
    )
    assert pickle.loads(pickle.dumps(Function(swing))).function is swing  # noqa: S301


def test_exception_of_a_python_function_comes_out():
    def spring(z, u):
        if z[0] > 0.004:
            raise ArithmeticError
        return -z[0]

    with pytest.raises(IndexError):
        Observer(OSCILLATOR, phi=['0', Function(lambda z, u: z[2])])
    model = OSCILLATOR | {'phi': ['0', Function(spring)], 'noise_size': 1e-3}
    observer, online = Observer(model), OnlineEstimator(model)
    whole = OnlineEstimator(model)
    whole.smooth()
    stamps = np.round(T * 1e9).astype(np.int64) + 1
    for call in (
        lambda: observer.run(T, Y, 0.0), lambda: observer.smooth(T, Y, 0.0),
        lambda: [observer.step(y, 1e-3, 0.0) for y in Y],
        lambda: online.run(stamps, Y, 0.0),
        lambda: [online.update(*sample) for sample in zip(stamps + stamps[-1], Y, strict=True)],
        lambda: (whole.run(stamps, Y, 0.0), whole.finish()),
    ):  # fmt: skip
        with pytest.raises(ArithmeticError):
            call()
