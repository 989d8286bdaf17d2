# SPDX-License-Identifier: Apache-2.0
"""Many channels in one node: their samples are queued, and stepped together at the timer."""

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from time import perf_counter
from typing import Any

from fhaosmo_ros.core.channel_parameters import of_channel
from fhaosmo_ros.core.channels import Channels
from fhaosmo_ros.core.errors import ConfigurationError
from fhaosmo_ros.core.online import OnlineEstimator
from fhaosmo_ros.core.parameters import ONLINE_PARAMETERS
from fhaosmo_ros.nodes.channel import Channel
from fhaosmo_ros.nodes.diagnostics import Report
from rclpy.node import Node
from std_srvs.srv import SetBool, Trigger

MOST_WAITING = 1000
"""So many samples are stepped before the timer: bounds memory, and the work at once."""


class Queue:
    """
    Samples in the order in which they came: channel, stamp, y and the known input of each.

    Attributes
    ----------
    step : callable
        Steps all channels through what waits.

    """

    def __init__(self, step: Callable[[], None]) -> None:
        self.step = step
        self.clear()

    def clear(self) -> None:
        """Forget all samples."""
        self.channel: list[int] = []
        self.stamps: list[int] = []
        self.y: list[float] = []
        self.u: list[float] = []


class QueuedChannel(Channel):
    """
    A channel whose samples wait in a queue.

    Parameters
    ----------
    node, values
        As for `Channel`.
    name : str
        Stands before its topics: ``hip/y``, ``~/hip/state``.
    index : int
        Its number in the queue.
    queue : Queue

    """

    def __init__(
        self, node: Node, values: Mapping[str, Any], name: str, index: int, queue: Queue
    ) -> None:
        self.name = name
        self._index = index
        self._queue = queue
        super().__init__(node, values, f'{name}/', f'~/{name}/', f'{name} ')
        self._logger = node.get_logger().get_child(name)

    def reset(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        """Start the observer afresh; samples that wait come before it."""
        self._queue.step()
        return super().reset(request, response)

    def freeze(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        """Hold gamma, or let it adapt again; samples that wait come before it."""
        self._queue.step()
        return super().freeze(request, response)

    def _take(self, stamp: int, y: float) -> None:
        queue = self._queue
        queue.channel.append(self._index)
        queue.stamps.append(stamp)
        queue.y.append(y)
        queue.u.append(self.estimator.input)
        if len(queue.y) >= MOST_WAITING:
            queue.step()

    def _start_timer(self) -> None:
        """Do nothing: the group's timer serves all of its channels."""


class ChannelGroup:
    """
    Channels that share a timer; to the node it is like a `Channel`.

    Parameters
    ----------
    node : Node
    values : mapping
        All parameters, the channels' own ones included.
    names : list of str

    Raises
    ------
    ConfigurationError
        Parameters that can't be used, with the name of the channel; nothing is left behind.

    """

    def __init__(self, node: Node, values: Mapping[str, Any], names: list[str]) -> None:
        self._node = node
        self._queue = Queue(self._step)
        self._rate = float(values['publish_rate'])
        self._timer: Any = None
        self._services: list[Any] = []
        self._channels: list[QueuedChannel] = []
        try:
            for index, name in enumerate(names):
                with of(name):
                    own = of_channel(values, name)
                    channel = QueuedChannel(node, own, name, index, self._queue)
                self._channels.append(channel)
            self._services = [
                node.create_service(Trigger, '~/reset', self._reset),
                node.create_service(SetBool, '~/freeze', self._freeze),
            ]
        except BaseException:
            self.destroy()
            raise
        self._together = Channels([channel.estimator for channel in self._channels])
        Channels([OnlineEstimator()]).advance([0], [1], [0.0], [0.0])  # compiles

    def activate(self) -> None:
        """Take samples and publish from now on."""
        self._queue.clear()
        for channel in self._channels:
            channel.activate()
        self._start_timer()

    def deactivate(self) -> None:
        """Drop samples and publish nothing from now on."""
        for channel in self._channels:
            channel.deactivate()
        self._stop_timer()

    def destroy(self) -> None:
        """Take all topics and services away."""
        self.deactivate()
        while self._channels:
            self._channels.pop().destroy()
        while self._services:
            self._node.destroy_service(self._services.pop())

    def check(self, changes: Mapping[str, Any]) -> None:
        """Raise what `configure` would raise, and change nothing."""
        for channel in self._channels:
            with of(channel.name):
                channel.check(own_changes(changes, channel.name))

    def configure(self, changes: Mapping[str, Any]) -> None:
        """Change live parameters from the next sample on; those that wait count as before it."""
        self._step()
        for channel in self._channels:
            channel.configure(own_changes(changes, channel.name))
        if 'publish_rate' in changes:
            self._rate = float(changes['publish_rate'])
            if self._timer is not None:
                self._stop_timer()
                self._start_timer()

    def reports(self) -> list[Report]:
        """Return the reports of all channels."""
        return [report for channel in self._channels for report in channel.reports()]

    def _tick(self) -> None:
        self._step()
        for channel in self._channels:
            channel.publish()

    def _step(self) -> None:
        """Step all channels through the samples that wait."""
        queue = self._queue
        if not queue.y:
            return
        begin = perf_counter()
        words, unknown_inputs = self._together.advance(
            queue.channel, queue.stamps, queue.y, queue.u
        )
        share = (perf_counter() - begin) / len(queue.y)
        columns = words.tolist(), queue.stamps, queue.y, unknown_inputs.tolist()
        for index, *sample in zip(queue.channel, *columns, strict=True):
            self._channels[index].taken(*sample, share)
        queue.clear()

    def _start_timer(self) -> None:
        self._timer = self._node.create_timer(1.0 / self._rate, self._tick)

    def _stop_timer(self) -> None:
        if self._timer is not None:
            self._node.destroy_timer(self._timer)
            self._timer = None

    def _reset(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        for channel in self._channels:
            channel.reset(request, response)
        return response

    def _freeze(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        for channel in self._channels:
            channel.freeze(request, response)
        return response


def own_changes(changes: Mapping[str, Any], name: str) -> dict[str, Any]:
    """Return what changes for a channel: its own parameters, and those that only the node has."""
    return {
        key: value for key, value in of_channel(changes, name).items()
        if f'{name}.{key}' in changes or key not in ONLINE_PARAMETERS
    }  # fmt: skip


@contextmanager
def of(name: str) -> Iterator[None]:
    """Put the channel's name, if it has one, before what is wrong with its parameters."""
    try:
        yield
    except ConfigurationError as error:
        if not name:
            raise
        raise ConfigurationError(f"channel '{name}': {error}") from None
