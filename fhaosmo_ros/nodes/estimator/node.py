# SPDX-License-Identifier: Apache-2.0
"""The estimator node: a managed node (ROS 2 lifecycle) of one channel or many."""

from collections.abc import Collection, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from functools import partial
from typing import Any

from fhaosmo_ros.core.parameters import per_channel
from fhaosmo_ros.core.parameters.declaration import Parameters, Value
from fhaosmo_ros.core.parameters.errors import ConfigurationError
from fhaosmo_ros.core.parameters.per_channel import CHANNELS, complete, FROM_JOINTS, of_channel
from fhaosmo_ros.core.parameters.tables import ESTIMATOR_PARAMETERS
from fhaosmo_ros.inputs import measured_output, with_joints
from fhaosmo_ros.messages.fields import listed
from fhaosmo_ros.nodes.estimator.channel import Channel
from fhaosmo_ros.nodes.estimator.outputs import parameter_text, TypedOutputs
from fhaosmo_ros.nodes.estimator.sources import check_inputs, Sources
from fhaosmo_ros.nodes.middleware import diagnostics
from fhaosmo_ros.nodes.middleware.diagnostics import ERROR, OK, Report, STALE, WARN
from fhaosmo_ros.nodes.middleware.endpoints import full_name, set_period
from fhaosmo_ros.nodes.middleware.lifecycle import ManagedNode
from fhaosmo_ros.nodes.middleware.spin import run_node
from fhaosmo_ros.topics import PARAMETERS, STANDARD_DEVIATION
from rclpy.parameter import Parameter as RosParameter
from rclpy.qos import DurabilityPolicy, QoSProfile
from std_msgs.msg import String
from std_srvs.srv import Trigger


class EstimatorNode(ManagedNode):
    """
    A managed node around one channel, or many, which share a timer and the typed messages.

    After cleanup every parameter can be set, except the names of the channels. `given` are values
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
        values = self.values
        self._joints: set[str] = set()  # of the message that the names come from
        self._left_out: list[str] = []  # what is said of those that are no channels
        self._channels: list[Channel] = []  # none before the names of the joints are known
        self._parameters_topic: Any = None
        diagnostics.publish_diagnostics(self, self._reports)
        try:
            if values['autostart']:
                self.start()
            else:
                self._new_channels()  # bad parameters end the node in any case
                self.get_logger().info('waiting to be configured, as by ros2 lifecycle set')
        except Exception:
            self.destroy_node()
            raise

    def _new_channels(self) -> list[Channel]:
        """Return new channels; raise for parameters that do not fit together."""
        values = self.values
        names: list[str] = values[CHANNELS]
        if names == FROM_JOINTS:  # which joints there are is not known yet, but some may be named
            names = [*names, *per_channel.channels_with_own(values)]
        channels, inputs = [], []
        for name in names:
            with naming_channel(name):
                channels.append(channel := Channel(self, of_channel(values, name), name))
            inputs += [channel.measured, *channel.known.values()]
            full_name(self, channel.prefix + STANDARD_DEVIATION)  # its longest topic
        check_inputs(self, inputs)
        axes = [channel.values['output_axis'] for channel in channels[: len(values[CHANNELS])]]
        if {'wrench', 'accel'} & set(values['typed_outputs']) and len(set(axes)) < len(axes):
            raise ConfigurationError(
                "parameter 'output_axis': expected another axis for each channel, got "
                f'{", ".join(axes)}'
            )
        return channels

    def configure(self) -> None:
        """Make the channel, or channels, from the present parameters."""
        values = self.values
        channels = self._new_channels()
        self.sources = Sources(self, self._found_type)
        latest = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self._parameters_topic = self.create_publisher(String, f'~/{PARAMETERS}', latest)
        if values[CHANNELS] == FROM_JOINTS:
            source = self.sources.of(measured_output(values))
            source.on_names = self._take_joints
            self.sources.open()
            said = f'waiting for the first message on {source.topic}'
            self.get_logger().info(f'channels from_joint_names: {said}')
        else:
            self._open(channels)
        self._publish_parameters()

    def _publish_parameters(self) -> None:
        if self._parameters_topic is not None:
            text = parameter_text(self, self.values, self._channels)
            self._parameters_topic.publish(String(data=text))

    def _open(self, channels: list[Channel]) -> None:
        """Open channels, and what they share."""
        values = self.values
        self._timer = self.create_timer(1.0 / values['publish_rate'], self._tick)
        self._timer.cancel()
        self.typed = TypedOutputs(self, values)
        for channel in channels:
            channel.open()
        self.sources.after_message = self.typed.publish
        by_prefix = {channel.prefix: [channel] for channel in channels}
        for prefix, those in {**by_prefix, '~/': channels}.items():
            self.create_service(Trigger, f'{prefix}reset', partial(self._reset, those))
        self._channels = channels
        self.sources.open()

    def _found_type(self) -> None:
        """Take dt from header stamps in simulated time, once those that are known are such."""
        stamps = {channel.y.stamps for channel in self._channels if channel.y.stamps}
        if self._chooses_sampling and stamps == {'header'}:
            self._chooses_sampling = False
            self.get_logger().info('use_sim_time: dt comes from the header stamps')
            self.set_parameters([RosParameter('sampling', value='source_stamp')])

    def _take_joints(self, names: Any) -> None:
        """Make the channels from the first names; later, report once those that are new."""
        if not isinstance(names, list) or self._joints.issuperset(names):  # at 1 kHz
            return
        present, log = self.values, self.get_logger()
        if present[CHANNELS] != FROM_JOINTS:
            self.sources.of(measured_output(present)).on_names = None
            new = [name for name in names if name not in self._joints]
            self._left_out.append(left_out(new, 'not in the first message; list all in channels'))
            return
        most = present['max_channels']
        fit, bad = [], []
        for name in dict.fromkeys(names):
            (fit if self._fits(name) else bad).append(name)
        hint = 'name a channel, and set its input_field to position[NAME]'
        self._left_out = [
            left_out(bad, f"can't be the name of a channel; {hint}"),
            left_out(fit[most:], f'beyond max_channels ({most}); raise it'),
        ]
        fit = fit[:most]
        if not fit:
            return
        for name in set(per_channel.channels_with_own(present)) - set(fit):
            log.error(f"parameters of '{name}' are not used: there is no such joint")
        values = complete({
            **{k: v for k, v in present.items() if (per_channel.split(k)[0] or fit[0]) in fit},
            CHANNELS: fit,
        }, ESTIMATOR_PARAMETERS)  # fmt: skip
        self._joints = set(names)
        self.extend(values)
        try:
            self._open(self._new_channels())
        except ConfigurationError as error:
            log.error(str(error))
            return
        self._publish_parameters()
        log.info(f'channels: {", ".join(fit)}')
        if self.state == 'active':
            self.activate()

    def _fits(self, name: str) -> bool:
        """Return whether a channel, and its topics, may have a name."""
        with suppress(ConfigurationError):
            per_channel.channel_names({CHANNELS: [name or '?']})  # '' is no channel's name
            return bool(full_name(self, f'~/{name}/{STANDARD_DEVIATION}'))  # its longest topic
        return False

    def activate(self) -> None:
        """Take samples and publish."""
        self._log = diagnostics.ReportLog(self, diagnostics.BEGIN)
        for channel in self._channels:
            channel.activate()
        if self._channels:
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
        self._channels, self._parameters_topic = [], None

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
        if self._parameters_topic is None:  # configure checks whether the values fit together
            return
        self.values.changed_live(changes, 'node; set it after the transition cleanup')
        for channel in self._channels:
            with naming_channel(channel.name):
                channel.estimator.prepare(of_channel(values, channel.name))

    def _adopt(self, _: None) -> None:
        values = self.values
        for channel in self._channels:
            channel.adopt(of_channel(values, channel.name))
        if self._channels:
            set_period(self._timer, 1.0 / values['publish_rate'])
        self._publish_parameters()

    def _reports(self) -> list[Report]:
        state = Report('state')
        active = self.state == 'active'
        state.find(OK if active else STALE, self.state)
        if self.get_parameter('use_sim_time').value and not self.get_clock().now().nanoseconds:
            clock = self.resolve_topic_name('/clock')
            state.find(ERROR, f'use_sim_time, but nothing on {clock} yet')
        waits = active and not self._channels
        failed = waits and self._joints
        state.find(ERROR, 'no channels of the joints could be made: see the log', failed)
        state.find(STALE, 'no message with the names of the joints yet', waits and not failed)
        for text in self._left_out:
            state.find(WARN, text, text)
        reports = [state]
        if active and not waits:
            self.sources.look()
            for channel in self._channels:
                reports += channel.health.reports()
        if active:  # that y is silent is said of the input
            silent = (STALE, 'no usable samples')
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


def left_out(names: Collection[str], why: str) -> str:
    """Return in words that joints are left out, '' if there are none."""
    count = 'joint' if len(names) == 1 else f'{len(names)} joints'
    return f'left out: {count} {listed(list(map(repr, names)))}: {why}' if names else ''


def main(argv: list[str] | None = None) -> int:
    """Run the estimator node."""
    return run_node('estimator', EstimatorNode, argv)
