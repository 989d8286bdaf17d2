# SPDX-License-Identifier: Apache-2.0
"""Many channels in one node: their samples are queued, and stepped together at the timer."""

from collections.abc import Mapping
from typing import Any

from fhaosmo_ros.core.channel_parameters import of_channel
from fhaosmo_ros.core.channels import Channels
from fhaosmo_ros.nodes.channel import Channel
from rclpy.node import Node


class Queue:
    """
    Samples in the order in which they came: channel, stamp, y and the known input of each.

    A timer that is late finds more of them; none is dropped.
    """

    def __init__(self) -> None:
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
        super().__init__(node, values, inputs=f'{name}/', outputs=f'~/{name}/')

    def _take(self, stamp: int, y: float) -> None:
        queue = self._queue
        queue.channel.append(self._index)
        queue.stamps.append(stamp)
        queue.y.append(y)
        queue.u.append(self.estimator.input)


class ChannelGroup:
    """
    Channels that share a timer; to the node it is like a `Channel`.

    Parameters
    ----------
    node : Node
    values : mapping
        All parameters, the channels' own ones included.
    names : list of str

    """

    def __init__(self, node: Node, values: Mapping[str, Any], names: list[str]) -> None:
        self._node = node
        self._queue = Queue()
        self._rate = float(values['publish_rate'])
        self._timer: Any = None
        self._channels: list[QueuedChannel] = []
        try:
            for index, name in enumerate(names):
                with naming(name):
                    self._channels.append(
                        QueuedChannel(node, of_channel(values, name), name, index, self._queue)
                    )
        except BaseException:
            self.destroy()
            raise
        self._together = Channels([channel.estimator for channel in self._channels])

    def _tick(self) -> None:
        queue = self._queue
        if queue.y:
            words = self._together.advance(queue.channel, queue.stamps, queue.y, queue.u)
            for index, word, y in zip(queue.channel, words, queue.y, strict=True):
                self._channels[index].took(word, y)
            queue.clear()
        for channel in self._channels:
            channel.publish()
