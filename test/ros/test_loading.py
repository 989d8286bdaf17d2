# SPDX-License-Identifier: Apache-2.0
"""A node whose core must be compiled begins when that is over; until then it is unconfigured."""

import sys
from threading import Event

import pytest

rclpy = pytest.importorskip('rclpy', reason='rclpy is not installed: needs ROS 2 Jazzy')
pytestmark = pytest.mark.ros

from fhaosmo_ros.core.compiled import cache  # noqa: E402
from fhaosmo_ros.core.observer import observer  # noqa: E402
from fhaosmo_ros.nodes import plant  # noqa: E402
from fhaosmo_ros.nodes.estimator import node as estimator  # noqa: E402
from fhaosmo_ros.nodes.middleware import loading  # noqa: E402
from fhaosmo_ros.nodes.middleware.spin import Spinner  # noqa: E402
from rclpy.context import Context  # noqa: E402
from rclpy.parameter import Parameter  # noqa: E402
from rclpy.signals import SignalHandlerOptions  # noqa: E402
from waiting import wait_until  # noqa: E402


@pytest.fixture
def context():
    context = Context()
    rclpy.init(context=context, signal_handler_options=SignalHandlerOptions.NO)
    yield context
    rclpy.try_shutdown(context=context)


class Compiler:
    """Stands for a compiler that works until the test says that it has ended."""

    def __init__(self) -> None:
        self.ended = Event()
        self.error: Exception | None = None

    def __call__(self, *_: object) -> None:
        cache.compiling.set()
        assert self.ended.wait(60.0)
        if self.error is not None:
            raise self.error


@pytest.fixture
def compiler(monkeypatch):
    compiler = Compiler()
    monkeypatch.setattr(estimator, 'load', compiler)
    monkeypatch.setattr(plant.Plant, 'sample', compiler)
    yield compiler
    compiler.ended.set()


@pytest.fixture
def node(context, compiler):
    node = estimator.EstimatorNode(context=context, use_global_arguments=False)
    yield node
    node.destroy_node()


def test_it_begins_when_the_compiler_has_ended(node, compiler):
    assert loading.is_loading()
    assert node.state == 'unconfigured'
    assert node._reports()[0].message('', '').message == (
        'unconfigured: the core is still being compiled'
    )
    assert node.set_parameters([Parameter('order', value=2), Parameter('phi', value=['0', '0'])])
    with Spinner(node) as spinner:
        compiler.ended.set()
        wait_until(lambda: node.state == 'active', 'start')
    assert spinner.error is None
    assert not loading.is_loading()
    assert node._channels.estimator.observer.order == 2  # as it was set meanwhile


def test_it_says_why_it_does_not_begin(node, compiler, capfd):
    (result,) = node.set_parameters([Parameter('order', value=2)])  # phi has three expressions
    assert result.successful
    with Spinner(node) as spinner:
        compiler.ended.set()
        said = []
        wait_until(
            lambda: said.append(capfd.readouterr().err) or 'not st' in ''.join(said), 'word'
        )
    assert "not started: parameter 'phi': expected 2 expressions" in ''.join(said)
    assert (node.state, spinner.error) == ('unconfigured', None)


def test_it_does_not_begin_once_it_is_finalized(node, compiler):
    node.trigger_shutdown()
    with Spinner(node):
        compiler.ended.set()
        wait_until(lambda: not node.not_ready, 'end of the compiler')
    assert node.state == 'finalized'


def test_it_answers_while_the_members_of_a_self_tuning_observer_compile(
    context, compiler, monkeypatch
):
    address = observer.step_address()
    monkeypatch.setattr(observer, 'step_address', lambda: compiler() or address)
    options = {'parameter_overrides': [Parameter('gains', value='self_tuning')]}
    node = estimator.EstimatorNode(context=context, use_global_arguments=False, **options)
    try:
        assert loading.is_loading()
        assert node.state == 'unconfigured'
        with Spinner(node):
            compiler.ended.set()
            wait_until(lambda: node.state == 'active', 'start')
    finally:
        node.destroy_node()


def test_an_error_of_the_compiler_ends_the_node(node, compiler):
    compiler.error = ZeroDivisionError('compiler')
    ended = Event()
    with Spinner(node, on_end=ended.set) as spinner:
        compiler.ended.set()
        assert ended.wait(30.0)
    assert spinner.error is compiler.error


def test_a_plant_takes_parameters_while_it_compiles(context, compiler):
    node = plant.PlantNode(context=context, use_global_arguments=False)
    try:
        assert loading.is_loading()
        assert node.set_parameters([Parameter('sample_rate', value=50.0)])[0].successful
        with Spinner(node) as spinner:
            compiler.ended.set()
            wait_until(lambda: node._timer is not None or spinner.error, 'start')
        assert node._timer.timer_period_ns == 20_000_000
    finally:
        node.destroy_node()


def test_blas_is_hidden_only_while_the_core_loads():
    before = sys.modules.pop('scipy.linalg', None)
    try:
        with loading.without_blas():
            assert sys.modules['scipy.linalg'] is None
        assert 'scipy.linalg' not in sys.modules
    finally:
        if before is not None:
            sys.modules['scipy.linalg'] = before
    import scipy.linalg

    with loading.without_blas():
        assert sys.modules['scipy.linalg'] is scipy.linalg
