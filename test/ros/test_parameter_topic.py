# SPDX-License-Identifier: Apache-2.0
"""What the estimator is set to, on a latched topic: the text of a parameter file."""

from fhaosmo_ros.core.parameters.files import loads
from fhaosmo_ros.core.parameters.per_channel import of_channel, with_channels
from fhaosmo_ros.core.parameters.tables import ESTIMATOR_PARAMETERS
import pytest

rclpy = pytest.importorskip('rclpy', reason='rclpy is not installed: needs ROS 2 Jazzy')
pytestmark = pytest.mark.ros

from fhaosmo_ros.nodes.estimator.parameter_topic import LATEST  # noqa: E402
from rig import Parameters, parameters  # noqa: E402
from std_msgs.msg import String  # noqa: E402


class Told:
    """The values on a node's topic."""

    def __init__(self, client, node: str) -> None:
        self._client, self._node = client, node
        self._messages = client.record(f'{node}/parameters', String, LATEST)

    def wait(self, condition) -> dict:
        self._client.wait(
            lambda: self._messages and condition(self.latest), 'parameters on their topic'
        )
        return self.latest

    @property
    def latest(self) -> dict:
        return loads(self._messages[-1].message.data, self._node, ESTIMATOR_PARAMETERS)


def test_it_tells_who_comes_late_and_every_change(client, start):
    start('estimator', *parameters(namespace='/told', epsilon=3.5, phi="['0', '-z2', 'u']"))
    node = '/told/estimator'
    services = Parameters(client, node)
    assert services.set(gamma_rate=0.25)[0].successful
    told = Told(client, node)
    values = told.wait(lambda v: v['gamma_rate'] == 0.25)
    expected = {'epsilon': 3.5, 'phi': ['0', '-z2', 'u'], 'gamma_rate': 0.25}
    assert values == ESTIMATOR_PARAMETERS.defaults() | expected
    assert not services.set(gamma_rate=-1.0)[0].successful
    assert services.set_atomically(epsilon=0.125, publish_rate=50.0).successful
    values = told.wait(lambda v: v['epsilon'] != 3.5)
    assert values == ESTIMATOR_PARAMETERS.defaults() | expected | {
        'epsilon': 0.125, 'publish_rate': 50.0,
    }  # fmt: skip


def test_channels_tell_what_is_their_own(client, start):
    start(
        'estimator',
        *parameters(namespace='/many', channels='[hip, knee]', epsilon=3.0),
        '-p', 'knee.epsilon:=5.0',
    )  # fmt: skip
    node = '/many/estimator'
    told = Told(client, node)
    services = Parameters(client, node)
    assert set(told.wait(lambda v: True)) - set(ESTIMATOR_PARAMETERS) == {'knee.epsilon'}
    assert services.set(epsilon=2.0)[0].successful  # hip follows
    told.wait(lambda v: v['epsilon'] == 2.0)
    assert services.set(**{'hip.gamma_rate': 0.5})[0].successful
    values = told.wait(lambda v: 'hip.gamma_rate' in v)
    assert set(values) <= set(with_channels(ESTIMATOR_PARAMETERS, ['hip', 'knee']))
    for channel, epsilon in (('hip', 2.0), ('knee', 5.0)):
        assert of_channel(values, channel)['epsilon'] == epsilon
    assert of_channel(values, 'knee')['gamma_rate'] != 0.5
