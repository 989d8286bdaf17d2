# SPDX-License-Identifier: Apache-2.0
"""The estimator node: a managed node that keeps a channel alive from y to the estimates."""

from collections.abc import Mapping
from typing import Any

from fhaosmo_ros.core.errors import ConfigurationError
from fhaosmo_ros.core.online import OnlineEstimator
from fhaosmo_ros.core.parameters import ESTIMATOR_PARAMETERS
from fhaosmo_ros.nodes.channel import Channel, online
from fhaosmo_ros.nodes.diagnostics import DiagnosticsPublisher, ERROR, OK, Report, STALE
from fhaosmo_ros.nodes.lifecycle import ManagedNode
from fhaosmo_ros.nodes.parameters import declare, on_change, values_of
from fhaosmo_ros.nodes.spin import run_node


class EstimatorNode(ManagedNode):
    """
    A managed node around a channel.

    configure reads the parameters and makes the channel; activate lets it take samples and
    publish; deactivate stops that; cleanup takes the channel away, and then every parameter can
    be set.

    Raises
    ------
    ConfigurationError
        Parameters that can't be used; nothing has been subscribed or published then.

    """

    def __init__(self, **options: Any) -> None:
        super().__init__(
            'estimator', automatically_declare_parameters_from_overrides=True, **options
        )
        values = declare(
            self, ESTIMATOR_PARAMETERS, lambda v: OnlineEstimator(online(v)), fixed=['autostart']
        )
        self._channels: list[Channel] = []
        self._diagnostics = DiagnosticsPublisher(
            self, self._reports, values['diagnostics_period'], values['hardware_id']
        )
        on_change(self, ESTIMATOR_PARAMETERS, self._check, self._adopt)
        if values['autostart']:
            try:
                self.start()
            except Exception:
                self.destroy_node()
                raise
        else:
            self.get_logger().info('waiting to be configured, for instance by ros2 lifecycle set')

    def configure(self) -> None:
        """Make the channel from the present parameters."""
        values = values_of(self, ESTIMATOR_PARAMETERS)
        self._channels.append(Channel(self, values))
        if self.get_parameter('use_sim_time').value and values['sampling'] == 'source_stamp':
            self.get_logger().warning(
                "use_sim_time with sampling = source_stamp: the middleware's stamps know nothing "
                "of /clock, so dt is in the host's time; set sampling to clock for simulation time"
            )

    def activate(self) -> None:
        """Take samples and publish."""
        for channel in self._channels:
            channel.activate()

    def deactivate(self) -> None:
        """Stop that."""
        for channel in self._channels:
            channel.deactivate()

    def cleanup(self) -> None:
        """Take the channel away."""
        while self._channels:
            self._channels.pop().destroy()

    def _check(self, changes: Mapping[str, Any]) -> None:
        if not self._channels:  # each value by itself; together they are checked by configure
            return
        for name, value in changes.items():
            parameter = ESTIMATOR_PARAMETERS[name]
            if not parameter.live:
                now = parameter.coerce(self.get_parameter(name).value)
                if value != now:
                    raise ConfigurationError(
                        f"parameter '{name}': read when the node is configured (it is {now!r}), "
                        f'got {value!r}; set it after the transition cleanup'
                    )
        for channel in self._channels:
            channel.check(changes)

    def _adopt(self, changes: Mapping[str, Any]) -> None:
        for channel in self._channels:
            channel.configure(changes)
        if 'diagnostics_period' in changes:
            self._diagnostics.set_period(changes['diagnostics_period'])
        self._diagnostics.hardware_id = changes.get('hardware_id', self._diagnostics.hardware_id)

    def _reports(self) -> list[Report]:
        state = Report('state')
        active = self.state == 'active'
        state.find(OK if active else STALE, self.state)
        if self.get_parameter('use_sim_time').value and not self.get_clock().now().nanoseconds:
            state.find(ERROR, 'use_sim_time, but nothing on /clock yet')
        if not active:
            return [state]
        return [state, *(r for channel in self._channels for r in channel.reports())]


def main(argv: list[str] | None = None) -> int:
    """Run the estimator node."""
    return run_node('estimator', EstimatorNode, argv)
