# SPDX-License-Identifier: Apache-2.0
"""The channels of an estimator node, one or many: their timer and their common messages."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from typing import Any

from fhaosmo_ros.core.online.estimator import Change, OnlineEstimator
from fhaosmo_ros.core.parameters.declaration import Parameters
from fhaosmo_ros.core.parameters.errors import ConfigurationError
from fhaosmo_ros.core.parameters.per_channel import of_channel
from fhaosmo_ros.nodes.estimator.channel import Channel
from fhaosmo_ros.nodes.estimator.sources import Sources
from fhaosmo_ros.nodes.estimator.typed_outputs import Output, TypedOutputs
from fhaosmo_ros.nodes.middleware.diagnostics import Report
from fhaosmo_ros.nodes.middleware.timers import set_period
from rclpy.node import Node
from std_srvs.srv import SetBool, Trigger

ChannelChange = tuple[Parameters, Change]


class Channels:
    """
    Channels that share a timer and the typed messages.

    `values` are those of the node, the channels' own ones included; estimators come by the names
    of their channels; the sources are not open yet.
    """

    def __init__(
        self,
        node: Node,
        values: Parameters,
        estimators: Mapping[str, OnlineEstimator],
        sources: Sources,
    ) -> None:
        self._sources = sources
        self._outputs: dict[str, Output] = {}
        """Estimates that have been published, but not yet in the typed messages."""
        self._typed = TypedOutputs(node, values)
        self._each = values['publish_on'] == 'sample'
        self.channels = [
            Channel(node, of_channel(values, name), estimator, sources, self._estimated, name)
            for name, estimator in estimators.items()
        ]
        sources.after_message = self._publish_typed
        node.create_service(Trigger, '~/reset', partial(self._each_answers, 'reset'))
        node.create_service(SetBool, '~/freeze', partial(self._each_answers, 'freeze'))
        self._timer = node.create_timer(1.0 / values['publish_rate'], self._tick)
        self._timer.cancel()

    def activate(self) -> None:
        """Take samples and publish from now on."""
        for channel in self.channels:
            channel.activate()
        self._timer.reset()

    def deactivate(self) -> None:
        """Drop samples and publish nothing from now on."""
        self._timer.cancel()
        for channel in self.channels:
            channel.deactivate()

    def prepare(self, values: Parameters) -> list[ChannelChange]:
        """Return what `adopt` takes, or raise ConfigurationError with the channel's name."""
        changes = []
        for channel in self.channels:
            own = of_channel(values, channel.name)
            with naming_channel(channel.name):
                changes.append((own, channel.estimator.prepare(own)))
        return changes

    def adopt(self, changes: list[ChannelChange]) -> None:
        """Go on with what `prepare` has returned, from the next sample on."""
        for channel, (values, change) in zip(self.channels, changes, strict=True):
            channel.adopt(values, change)
        self._each = values['publish_on'] == 'sample'
        set_period(self._timer, 1.0 / values['publish_rate'])

    def reports(self) -> list[Report]:
        """Return the reports of all channels."""
        self._sources.look()
        return [report for channel in self.channels for report in channel.reports()]

    def _tick(self) -> None:
        for channel in self.channels:
            channel.end_waiting()
        for channel in self.channels:
            if not channel.is_stale() and not self._each:
                self._publish(channel)
        self._publish_typed()

    def _estimated(self, channel: Channel) -> None:
        if self._each:
            self._publish(channel)

    def _publish(self, channel: Channel) -> None:
        if channel.name in self._outputs:  # several samples had waited for their known inputs
            self._publish_typed()
        output = channel.publish()
        if output is not None:
            self._outputs[channel.name] = output

    def _publish_typed(self) -> None:
        if self._outputs:
            self._typed.publish(list(self._outputs.values()))
            self._outputs.clear()

    def _each_answers(self, name: str, request: Any, response: Any) -> Any:
        for channel in self.channels:
            getattr(channel, name)(request, response)
        return response


@contextmanager
def naming_channel(name: str) -> Iterator[None]:
    """Put the channel's name, if it has one, in front of an error of its parameters."""
    try:
        yield
    except ConfigurationError as error:
        if not name:
            raise
        raise ConfigurationError(f"channel '{name}': {error}") from None
