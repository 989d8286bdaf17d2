# SPDX-License-Identifier: Apache-2.0
"""Many channels in one node: samples are queued, and all channels step in one call."""

from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from time import perf_counter
from typing import Any

from fhaosmo_ros.core.observer.status import UNUSED
from fhaosmo_ros.core.online.batch import EstimatorBatch
from fhaosmo_ros.core.online.estimator import OnlineEstimator
from fhaosmo_ros.core.parameters.declaration import Parameters
from fhaosmo_ros.core.parameters.errors import ConfigurationError
from fhaosmo_ros.core.parameters.per_channel import of_channel
from fhaosmo_ros.nodes.estimator.channel import Channel, ChannelChange, TOLD
from fhaosmo_ros.nodes.estimator.sources import Sources
from fhaosmo_ros.nodes.estimator.typed_outputs import TypedOutputs
from fhaosmo_ros.nodes.middleware.diagnostics import Report
from rclpy.node import Node
from std_srvs.srv import SetBool, Trigger

MOST_WAITING = 1000
"""This many waiting samples are stepped before the timer: it bounds memory and work at once."""


class Queue:
    """
    Samples in the order in which they came: channel, stamp, y and the known inputs of each.

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
        self.u: list[tuple[float, ...]] = []


class QueuedChannel(Channel):
    """
    A channel whose samples wait in a queue.

    Parameters
    ----------
    node, values, estimator, sources, name
        As for `Channel`.
    index : int
        Its number in the queue.
    queue : Queue

    """

    def __init__(
        self,
        node: Node,
        values: Parameters,
        estimator: OnlineEstimator,
        sources: Sources,
        name: str,
        index: int,
        queue: Queue,
    ) -> None:
        self._index = index
        self._queue = queue
        self._held = None if estimator.observer.uses_input else estimator.inputs
        self.fresh = False
        """It has an estimate that has not been published."""
        super().__init__(node, values, estimator, sources, name)

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
        queue.u.append(self._held or self.estimator.inputs)
        if len(queue.y) >= MOST_WAITING:
            queue.step()

    def taken(
        self, word: int, stamp: int, y: float, unknown_input: float, duration: float
    ) -> None:
        """Remember, and log, what became of a sample; see `Channel.taken`."""
        super().taken(word, stamp, y, unknown_input, duration)
        if not word & UNUSED:
            self.fresh = True

    def all_taken(
        self, words: list[int], stamps: list[int], unknown_inputs: list[float], duration: float
    ) -> bool:
        """Do what `taken` does for each of some samples, and return True, if all were used."""
        if any(word & (TOLD | UNUSED) for word in words):
            return False
        health = self._health
        health.durations.extend([duration] * len(words))
        health.stamps.extend(stamps)
        health.unknown_inputs.extend(unknown_inputs)
        health.latest = perf_counter()
        self._arrived = self.fresh = True
        self._snapshots.accepted(stamps[0])
        return True

    def _typed_outputs(self, values: Parameters) -> None:
        """Do nothing: the group's messages are those of all channels."""

    def _start_timer(self) -> None:
        """Do nothing: the group's timer serves all of its channels."""


class ChannelGroup:
    """
    Channels that share a timer; the node uses it like a `Channel`.

    Parameters
    ----------
    node : Node
    values : Parameters
        Of the node, the channels' own ones included.
    estimators : mapping of str to OnlineEstimator
        As `make_estimators` returns them.
    sources : Sources
        Of the node. They are not open yet.

    """

    def __init__(
        self,
        node: Node,
        values: Parameters,
        estimators: Mapping[str, OnlineEstimator],
        sources: Sources,
    ) -> None:
        self._node = node
        self._queue = Queue(self._step)
        self._rate = values['publish_rate']
        self._each = values['publish_on'] == 'sample'
        sources.after_message(self._after_message)
        self._typed: TypedOutputs | None = None
        self._timer: Any = None
        self._services: list[Any] = []
        self._channels: list[QueuedChannel] = []
        try:
            for index, (name, estimator) in enumerate(estimators.items()):
                own = of_channel(values, name)
                channel = QueuedChannel(node, own, estimator, sources, name, index, self._queue)
                self._channels.append(channel)
            self._typed = TypedOutputs(node, values)
            self._services = [
                node.create_service(Trigger, '~/reset', self._reset),
                node.create_service(SetBool, '~/freeze', self._freeze),
            ]
        except BaseException:
            self.destroy()
            raise
        self._together = EstimatorBatch(list(estimators.values()))

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
        for channel in self._channels:
            with naming_channel(channel.name):
                changes.append(channel.prepare(of_channel(values, channel.name)))
        return changes

    def adopt(self, changes: list[ChannelChange]) -> None:
        """Go on with what `prepare` has returned, after the samples that wait."""
        self._step()
        for channel, change in zip(self._channels, changes, strict=True):
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
        return [report for channel in self._channels for report in channel.reports()]

    def _tick(self) -> None:
        for channel in self._channels:
            channel.end_waiting()
        self._step()
        alive = [channel for channel in self._channels if not channel.is_stale()]
        if not self._each:
            self._publish(alive)

    def _after_message(self) -> None:
        if self._each and self._queue.y:
            self._step()
            self._publish([channel for channel in self._channels if channel.fresh])

    def _publish(self, channels: Iterable[QueuedChannel]) -> None:
        outputs = []
        for channel in channels:
            channel.fresh = False
            output = channel.output()
            if output is not None:
                outputs.append(output)
        if outputs and self._typed is not None:
            self._typed.publish(outputs)

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
        count, turns = len(self._channels), len(queue.y) // len(self._channels)
        if turns > 1 and queue.channel == list(range(count)) * turns:  # all channels in turn
            for c, channel in enumerate(self._channels):
                its, stamps, y, d = (column[c::count] for column in columns)
                if not channel.all_taken(its, stamps, d, share):
                    for sample in zip(its, stamps, y, d, strict=True):
                        channel.taken(*sample, share)
        else:
            for index, *sample in zip(queue.channel, *columns, strict=True):
                self._channels[index].taken(*sample, share)
        for channel in self._channels:
            channel.tell_events()
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
