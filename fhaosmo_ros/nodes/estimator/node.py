# SPDX-License-Identifier: Apache-2.0
"""The estimator node: a managed node (ROS 2 lifecycle) of one channel or many."""

from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from copy import copy
from functools import partial
from typing import Any

from fhaosmo_ros.core.parameters import per_channel
from fhaosmo_ros.core.parameters.declaration import Parameters, Value
from fhaosmo_ros.core.parameters.errors import ConfigurationError
from fhaosmo_ros.core.parameters.per_channel import CHANNELS, complete, FROM_JOINTS, of_channel
from fhaosmo_ros.core.parameters.tables import ESTIMATOR_PARAMETERS
from fhaosmo_ros.inputs import with_joints
from fhaosmo_ros.messages.fields import JOINT_STATE, listed
from fhaosmo_ros.nodes.estimator.channel import Channel
from fhaosmo_ros.nodes.estimator.outputs import parameter_text, TypedOutputs
from fhaosmo_ros.nodes.estimator.sources import Source
from fhaosmo_ros.nodes.middleware import diagnostics
from fhaosmo_ros.nodes.middleware.diagnostics import ERROR, OK, Report, STALE, WARN
from fhaosmo_ros.nodes.middleware.endpoints import full_name, OVERRIDABLE, SENSOR_QOS, set_period
from fhaosmo_ros.nodes.middleware.lifecycle import ManagedNode
from fhaosmo_ros.nodes.middleware.spin import run_node
from fhaosmo_ros.topics import PARAMETERS, STANDARD_DEVIATION
import rclpy
from rclpy.parameter import Parameter as RosParameter
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from std_srvs.srv import Trigger


class EstimatorNode(ManagedNode):
    """
    A managed node around one channel, or many, which share a timer and the typed messages.

    Where the channels are `FROM_JOINTS`, making it lasts until the first message of joints. After
    cleanup every parameter can be set, except the names of the channels. `given` are values
    of parameters, also of rclpy's own such as use_sim_time. Those that can't be used raise
    ConfigurationError before anything is subscribed or published.
    """

    def __init__(self, given: Mapping[str, Any]) -> None:
        given = with_joints(given)
        # In simulated time the middleware's stamps are of no use, but those of headers are.
        self._chooses_sampling = given.get('use_sim_time') is True and 'sampling' not in given
        if self._chooses_sampling:
            given['sampling'] = 'clock'
        super().__init__('estimator', given, fixed=['autostart', CHANNELS])
        self._channels: list[Channel] = []  # none while it is unconfigured
        diagnostics.publish_diagnostics(self, self._reports)
        try:
            if self.values['autostart']:
                self.start()
            else:
                self._new_channels(self.values)  # bad parameters end the node in any case
                self.get_logger().info('waiting to be configured, as by ros2 lifecycle set')
        except Exception:
            self.destroy_node()
            raise

    def _new_channels(self, values: Parameters, *more: str) -> list[Channel]:
        """Return new channels, and some more; raise for parameters that do not fit together."""
        channels = []
        for name in [*values[CHANNELS], *more]:
            with naming_channel(name):
                channels.append(Channel(self, of_channel(values, name), name))
        axes = [channel.values['output_axis'] for channel in channels[: len(values[CHANNELS])]]
        if {'wrench', 'accel'} & set(values['typed_outputs']) and len(set(axes)) < len(axes):
            raise ConfigurationError(
                "parameter 'output_axis': expected another axis for each channel, got "
                f'{", ".join(axes)}'
            )
        return channels

    def _with_channels(self, values: Parameters) -> Parameters:
        if values[CHANNELS] != FROM_JOINTS:
            return values
        if (kind := values['input_type']) not in ('', JOINT_STATE):
            raise values.table['input_type'].error(kind, f'{JOINT_STATE} for {FROM_JOINTS[0]}')
        own, found = per_channel.channels_with_own(values), list[str]()
        self._new_channels(values, *own)  # bad parameters are told before any joint is known
        topic, most = self.resolve_topic_name(values['input_topic']), values['max_channels']
        log = self.get_logger()

        def take(message: JointState) -> None:
            names = dict.fromkeys(message.name)
            found[:] = list(filter(self._fits, names))[:most]
            if left := [repr(name) for name in names if name not in found]:
                log.warning(
                    f'{len(left)} joints are no channels, as topics can not have their names, or '
                    f'there are more than max_channels ({most}): {listed(left)}; raise it, or '
                    'name a channel, and set its input_field to position[NAME]',
                    throttle_duration_sec=diagnostics.QUIET,
                )

        heard = self.create_subscription(
            JointState, topic, take, copy(SENSOR_QOS), qos_overriding_options=OVERRIDABLE
        )
        while not found:
            log.warning(
                f'channels from_joint_names: waiting for the first message on {topic}',
                throttle_duration_sec=diagnostics.QUIET,
            )
            rclpy.spin_once(self, timeout_sec=0.1)  # so often a signal can end it
        self.destroy_subscription(heard)
        for name in set(own) - set(found):
            log.error(f"parameters of '{name}' are not used: there is no such joint")
        log.info(f'channels: {", ".join(found)}')
        known = ['', *found]
        kept = {k: v for k, v in values.items() if per_channel.split(k)[0] in known}
        return complete({**kept, CHANNELS: found}, ESTIMATOR_PARAMETERS)

    def _fits(self, name: str) -> bool:
        """Return whether a channel, and its topics, may have a name."""
        with suppress(ConfigurationError):
            per_channel.channel_names({CHANNELS: [name or '?']})  # '' is no channel's name
            return bool(full_name(self, f'~/{name}/{STANDARD_DEVIATION}'))  # its longest topic
        return False

    def configure(self) -> None:
        """Make the channel, or channels, from the present parameters, and what they share."""
        values = self.values
        channels = self._new_channels(values)
        latest = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self._parameters_topic = self.create_publisher(String, f'~/{PARAMETERS}', latest)
        self._timer = self.create_timer(1.0 / values['publish_rate'], self._tick)
        self._timer.cancel()
        self.typed = TypedOutputs(self, values)
        self.sources: dict[str, Source] = {}  # by topic
        for channel in channels:
            channel.open()
        by_prefix = {channel.prefix: [channel] for channel in channels}
        for prefix, those in {**by_prefix, '~/': channels}.items():
            self.create_service(Trigger, f'{prefix}reset', partial(self._reset, those))
        self._channels = channels
        self._look()
        self._publish_parameters()

    def _publish_parameters(self) -> None:
        text = parameter_text(self, self.values, self._channels)
        self._parameters_topic.publish(String(data=text))

    def _look(self) -> None:
        """Look for y and u; in simulated time take dt from headers where all known y have one."""
        for source in self.sources.values():
            source.look()
        stamps = {channel.y.stamps for channel in self._channels if channel.y.stamps}
        if self._chooses_sampling and stamps == {'header'}:
            self._chooses_sampling = False
            self.get_logger().info('use_sim_time: dt comes from the header stamps')
            self.set_parameters([RosParameter('sampling', value='source_stamp')])

    def activate(self) -> None:
        """Take samples and publish."""
        self._log = diagnostics.ReportLog(self, diagnostics.BEGIN)
        for channel in self._channels:
            channel.activate()
        self._timer.reset()

    def deactivate(self) -> None:
        """Drop samples and publish nothing."""
        if self._channels:
            self._timer.cancel()
        for channel in self._channels:
            channel.deactivate()

    def cleanup(self) -> None:
        """Destroy the channels."""
        super().cleanup()
        self._channels = []

    def _tick(self) -> None:
        for channel in self._channels:
            channel.tick()
        self.typed.publish()

    def _reset(self, channels: Iterable[Channel], _: Any, response: Any) -> Any:
        """Answer the service that lets channels start afresh."""
        response.success = True
        response.message = 'the observer starts afresh with the next sample'
        for channel in channels:
            channel.reset()
            channel.logger.info(f'reset: {response.message}')
        return response

    def _prepare(self, values: Parameters, changes: Mapping[str, Value]) -> None:
        """Raise for changes that can not be, with the name of the channel."""
        if self._channels:  # else configure checks whether the values fit together
            self.values.changed_live(changes, 'node; set it after the transition cleanup')
        for channel in self._channels:
            with naming_channel(channel.name):
                channel.estimator.prepare(of_channel(values, channel.name))

    def _adopt(self, _: None) -> None:
        for channel in self._channels:
            channel.adopt(of_channel(self.values, channel.name))
        if self._channels:
            set_period(self._timer, 1.0 / self.values['publish_rate'])
            self._publish_parameters()

    def _reports(self) -> list[Report]:
        state = Report('state')
        active = self.state == 'active'
        state.find(OK if active else STALE, self.state)
        if self.get_parameter('use_sim_time').value and not self.get_clock().now().nanoseconds:
            clock = self.resolve_topic_name('/clock')
            state.find(ERROR, f'use_sim_time, but nothing on {clock} yet')
        reports = [state]
        if self._channels:
            self._look()
            nodes = self.count_publishers(self._parameters_topic.topic_name)
            same = f'{nodes} nodes have this name, their estimates mix'
            state.find(WARN, same, nodes > 1)
        if active:
            for channel in self._channels:
                reports += channel.health.reports()
            silent = (STALE, 'no usable samples')  # which is said of the input
            self._log.tell(r for r in reports if (r.level, r.text) != silent)
        return reports


@contextmanager
def naming_channel(name: str) -> Iterator[None]:
    """Put the channel's name, if it has one, in front of an error of its parameters."""
    try:
        yield
    except ConfigurationError as error:
        if not name:
            raise
        raise ConfigurationError(f"channel '{name}': {error}") from None


def main(argv: list[str] | None = None) -> int:
    """Run the estimator node."""
    return run_node('estimator', EstimatorNode, argv)
