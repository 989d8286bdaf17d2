# SPDX-License-Identifier: Apache-2.0
"""The channels of an estimator node, one or many: their timer and their common messages."""

from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

from fhaosmo_ros.core.online.estimator import OnlineEstimator
from fhaosmo_ros.core.parameters.declaration import Parameters
from fhaosmo_ros.core.parameters.errors import ConfigurationError
from fhaosmo_ros.core.parameters.per_channel import of_channel, UNNAMED
from fhaosmo_ros.nodes.estimator.channel import Channel, ChannelChange
from fhaosmo_ros.nodes.estimator.sources import Sources
from fhaosmo_ros.nodes.estimator.typed_outputs import Output, TypedOutputs
from fhaosmo_ros.nodes.middleware.diagnostics import Report
from rclpy.node import Node
from std_srvs.srv import SetBool, Trigger


class Channels:
    """
    Channels that share a timer and the typed messages.

    Parameters
    ----------
    node : Node
    values : Parameters
        Of the node, the channels' own ones included.
    estimators : mapping of str to OnlineEstimator
        As `make_estimators` returns them.
    sources : Sources
        Of the node. They are not open yet.

    Attributes
    ----------
    channels : list of Channel

    """

    def __init__(
        self,
        node: Node,
        values: Parameters,
        estimators: Mapping[str, OnlineEstimator],
        sources: Sources,
    ) -> None:
        self._node = node
        self._rate = values['publish_rate']
        self._each = values['publish_on'] == 'sample'
        sources.after_message(self._publish_typed)
        self._outputs: dict[str, Output] = {}
        """Estimates that have been published, but not yet in the typed messages."""
        self._typed: TypedOutputs | None = None
        self._timer: Any = None
        self._services: list[Any] = []
        self.channels: list[Channel] = []
        try:
            for name, estimator in estimators.items():
                own = of_channel(values, name)
                self.channels.append(Channel(node, own, estimator, sources, self._estimated, name))
            self._typed = TypedOutputs(node, values)
            if list(estimators) != UNNAMED:  # else the channel's own services have these names
                self._services = [
                    node.create_service(Trigger, '~/reset', self._reset),
                    node.create_service(SetBool, '~/freeze', self._freeze),
                ]
        except BaseException:
            self.destroy()
            raise

    def activate(self) -> None:
        """Take samples and publish from now on."""
        for channel in self.channels:
            channel.activate()
        self._start_timer()

    def deactivate(self) -> None:
        """Drop samples and publish nothing from now on."""
        for channel in self.channels:
            channel.deactivate()
        self._stop_timer()

    def destroy(self) -> None:
        """Take all topics and services away."""
        self.deactivate()
        while self.channels:
            self.channels.pop().destroy()
        if self._typed is not None:
            self._typed.destroy()
        while self._services:
            self._node.destroy_service(self._services.pop())

    def prepare(self, values: Parameters) -> list[ChannelChange]:
        """
        Return what `adopt` takes to go on with other live parameters; change nothing.

        Raises
        ------
        ConfigurationError
            They do not fit together in one of the channels.

        """
        changes = []
        for channel in self.channels:
            with naming_channel(channel.name):
                changes.append(channel.prepare(of_channel(values, channel.name)))
        return changes

    def adopt(self, changes: list[ChannelChange]) -> None:
        """Go on with what `prepare` has returned, from the next sample on."""
        for channel, change in zip(self.channels, changes, strict=True):
            channel.adopt(change)
        rate = changes[0].values['publish_rate']
        self._each = changes[0].values['publish_on'] == 'sample'
        if rate != self._rate:
            self._rate = rate
            if self._timer is not None:
                self._stop_timer()
                self._start_timer()

    def reports(self) -> list[Report]:
        """Return the reports of all channels."""
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
        if self._outputs and self._typed is not None:
            self._typed.publish(list(self._outputs.values()))
            self._outputs.clear()

    def _start_timer(self) -> None:
        self._timer = self._node.create_timer(1.0 / self._rate, self._tick)

    def _stop_timer(self) -> None:
        if self._timer is not None:
            self._node.destroy_timer(self._timer)
            self._timer = None

    def _reset(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        for channel in self.channels:
            channel.reset(request, response)
        return response

    def _freeze(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        for channel in self.channels:
            channel.freeze(request, response)
        return response


def make_estimators(values: Parameters, names: Iterable[str]) -> dict[str, OnlineEstimator]:
    """
    Return the estimators of an estimator node by the names of its channels.

    Raises
    ------
    ConfigurationError
        Values that do not fit together, with the name of the channel.

    """
    estimators = {}
    for name in names:
        with naming_channel(name):
            estimators[name] = OnlineEstimator(of_channel(values, name))
    return estimators


@contextmanager
def naming_channel(name: str) -> Iterator[None]:
    """Put the channel's name, if it has one, in front of an error of its parameters."""
    try:
        yield
    except ConfigurationError as error:
        if not name:
            raise
        raise ConfigurationError(f"channel '{name}': {error}") from None
