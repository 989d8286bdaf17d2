# SPDX-License-Identifier: Apache-2.0
"""The estimator node: a managed node that keeps channels alive from y to the estimates."""

from collections.abc import Mapping
from typing import Any

from fhaosmo_ros.core.channel_parameters import (
    channel_names,
    CHANNELS,
    of_channel,
    UNNAMED,
    with_channels,
)
from fhaosmo_ros.core.errors import ConfigurationError
from fhaosmo_ros.core.online import OnlineEstimator
from fhaosmo_ros.core.parameter_file import select
from fhaosmo_ros.core.parameters import ESTIMATOR_PARAMETERS
from fhaosmo_ros.nodes.channel import Channel, online
from fhaosmo_ros.nodes.channel_group import ChannelGroup, of
from fhaosmo_ros.nodes.diagnostics import DiagnosticsPublisher, ERROR, OK, Report, STALE
from fhaosmo_ros.nodes.following import Following
from fhaosmo_ros.nodes.lifecycle import ManagedNode
from fhaosmo_ros.nodes.outputs import check_overrides
from fhaosmo_ros.nodes.parameter_topic import ParameterTopic
from fhaosmo_ros.nodes.parameters import declare, on_change, overrides_of, values_of
from fhaosmo_ros.nodes.spin import run_node


class EstimatorNode(ManagedNode):
    """
    A managed node around a channel, or many.

    configure reads the parameters and makes the channel; activate lets it take samples and
    publish; deactivate stops that; cleanup takes the channel away, and then every parameter can
    be set, except the names of the channels.

    Raises
    ------
    ConfigurationError
        Parameters that can't be used; nothing has been subscribed or published then.

    """

    def __init__(self, **options: Any) -> None:
        super().__init__(
            'estimator', automatically_declare_parameters_from_overrides=True, **options
        )
        overrides = overrides_of(self)
        self._names = channel_names(overrides)
        common = select(
            {n: v for n, v in overrides.items() if n in ESTIMATOR_PARAMETERS}, ESTIMATOR_PARAMETERS
        )
        self._table = with_channels(ESTIMATOR_PARAMETERS, self._names, common)
        values = declare(self, self._table, self._check_all, fixed=['autostart', CHANNELS])
        self._channels: Channel | ChannelGroup | None = None
        self._parameter_topic: ParameterTopic | None = None
        self._following = Following(self._names, overrides)
        self._diagnostics = DiagnosticsPublisher(
            self, self._reports, values['diagnostics_period'], values['hardware_id']
        )
        on_change(self, self._table, self._check, self._adopt, self._following.complete)
        if values['autostart']:
            try:
                self.start()
            except Exception:
                self.destroy_node()
                raise
        else:
            self.get_logger().info('waiting to be configured, for instance by ros2 lifecycle set')

    def configure(self) -> None:
        """Make the channel, or channels, from the present parameters."""
        values = values_of(self, self._table)
        check_overrides(self, [f'~/{name}/' if name else '~/' for name in self._names])
        if self._names == UNNAMED:
            self._channels = Channel(self, values)
        else:
            self._channels = ChannelGroup(self, values, self._names)
        self._parameter_topic = ParameterTopic(self, self._table)
        self._parameter_topic.publish()
        if self.get_parameter('use_sim_time').value and values['sampling'] == 'source_stamp':
            self.get_logger().warning(
                "use_sim_time with sampling = source_stamp: the middleware's stamps know nothing "
                "of /clock, so dt is in the host's time; set sampling to clock for simulation time"
            )

    def activate(self) -> None:
        """Take samples and publish."""
        assert self._channels is not None
        self._channels.activate()

    def deactivate(self) -> None:
        """Stop that."""
        if self._channels is not None:
            self._channels.deactivate()

    def cleanup(self) -> None:
        """Take the channels away."""
        if self._channels is not None:
            self._channels.destroy()
            self._channels = None
        if self._parameter_topic is not None:
            self._parameter_topic.destroy()
            self._parameter_topic = None

    def _check_all(self, values: Mapping[str, Any]) -> None:
        """Raise if a channel can't be made of these values."""
        for name in self._names:
            with of(name):
                OnlineEstimator(online(of_channel(values, name)))

    def _check(self, changes: Mapping[str, Any]) -> None:
        if self._channels is None:  # each value by itself; together they are checked by configure
            return
        for name, value in changes.items():
            parameter = self._table[name]
            if not parameter.live:
                now = parameter.coerce(self.get_parameter(name).value)
                if value != now:
                    raise ConfigurationError(
                        f"parameter '{name}': read when the node is configured (it is {now!r}), "
                        f'got {value!r}; set it after the transition cleanup'
                    )
        self._channels.check(changes)

    def _adopt(self, changes: Mapping[str, Any]) -> None:
        self._following.adopted(changes)
        if self._channels is not None:
            self._channels.configure(changes)
        if self._parameter_topic is not None:
            self._parameter_topic.publish()
        if 'diagnostics_period' in changes:
            self._diagnostics.set_period(changes['diagnostics_period'])
        self._diagnostics.hardware_id = changes.get('hardware_id', self._diagnostics.hardware_id)

    def _reports(self) -> list[Report]:
        state = Report('state')
        active = self.state == 'active'
        state.find(OK if active else STALE, self.state)
        if self.get_parameter('use_sim_time').value and not self.get_clock().now().nanoseconds:
            state.find(ERROR, 'use_sim_time, but nothing on /clock yet')
        if not active or self._channels is None:
            return [state]
        return [state, *self._channels.reports()]


def main(argv: list[str] | None = None) -> int:
    """Run the estimator node."""
    return run_node('estimator', EstimatorNode, argv)
