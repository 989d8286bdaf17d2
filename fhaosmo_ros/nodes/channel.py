# SPDX-License-Identifier: Apache-2.0
"""One channel of an estimator node: y (and u) in, one observer, estimates out on a timer."""

from collections.abc import Mapping
from time import perf_counter, time_ns
from typing import Any

from fhaosmo_ros.core.online import OnlineEstimator
from fhaosmo_ros.core.parameters import ONLINE_PARAMETERS
from fhaosmo_ros.core.status import REJECTED, Status
from fhaosmo_ros.nodes.diagnostics import Report, WARN
from fhaosmo_ros.nodes.health import Health
from fhaosmo_ros.nodes.messages import read_double
from fhaosmo_ros.nodes.outputs import Outputs
from fhaosmo_ros.nodes.publishers import PublisherWatch
from fhaosmo_ros.nodes.snapshots import SnapshotPublisher
from fhaosmo_ros.nodes.subscription import input_qos, subscribe_with_info
from rclpy.node import Node
from std_msgs.msg import Float64
from std_srvs.srv import SetBool, Trigger

TOLD = REJECTED | int(Status.RESTARTED | Status.DIVERGED)
"""Flags of a step that are logged."""


class Channel:
    """
    Subscribes ``y`` (and ``u``), steps the observer on each sample, publishes on a timer.

    It is made inactive: its topics and services exist, samples are dropped, nothing is published.

    Parameters
    ----------
    node : Node
        Owns the topics, the services and the timer.
    values : mapping
        All parameters of the estimator.
    inputs, outputs : str
        What stands before the names of the topics read (y, u) and of those written and the
        service (state, ..., reset).

    name : str
        What stands before the names of its reports.

    Raises
    ------
    ConfigurationError
        Parameters that can't be used; nothing has been subscribed or published then.

    """

    def __init__(
        self, node: Node, values: Mapping[str, Any],
        inputs: str = '', outputs: str = '~/', name: str = '',
    ) -> None:  # fmt: skip
        self._node = node
        self._name = name
        self._clock = node.get_clock()
        self._logger = node.get_logger()
        self.estimator = OnlineEstimator(online(values))
        _compile(values)
        self._clock_stamps = values['sampling'] == 'clock'
        self._max_gap = float(values['max_gap'])
        self._rate = float(values['publish_rate'])
        self._timer: Any = None
        self._active = False
        self._forget()
        observer = self.estimator.observer
        self._outputs = Outputs(node, outputs, observer.order, observer.levels)
        self._snapshots = SnapshotPublisher(node, self.estimator, outputs)
        self._health = Health(self.estimator, values)
        qos = input_qos(values)
        self._y = subscribe_with_info(node, Float64, inputs + 'y', self._on_sample, qos, raw=True)
        subscriptions = [self._y]
        if observer.uses_input:
            subscriptions.append(
                subscribe_with_info(node, Float64, inputs + 'u', self._on_input, qos, raw=True)
            )
        services = [
            node.create_service(Trigger, outputs + 'reset', self.reset),
            node.create_service(SetBool, outputs + 'freeze', self.freeze),
        ]
        self._owned = [
            *((node.destroy_subscription, s) for s in subscriptions),
            *((node.destroy_service, s) for s in services),
        ]
        self._watches = [PublisherWatch(node, s) for s in subscriptions]

    def activate(self) -> None:
        """Take samples and publish from now on; the first sample starts the observer afresh."""
        self.estimator.reset()
        self._snapshots.reset()
        self._forget()
        self._active = True
        self._start_timer()
        parameters = self.estimator.observer.parameters
        self._logger.info(
            f'estimating {parameters["order"]} states and the unknown input from '
            f'{self._y.topic_name} ({parameters["variant"]}, {parameters["scheme"]})'
        )

    def deactivate(self) -> None:
        """Drop samples and publish nothing from now on."""
        self._active = False
        self._stop_timer()

    def destroy(self) -> None:
        """Take the topics and the services away."""
        self.deactivate()
        for destroy, entity in self._owned:
            destroy(entity)
        self._owned = []
        self._outputs.destroy()
        self._snapshots.destroy()

    def check(self, changes: Mapping[str, Any]) -> None:
        """Raise what `configure` would raise, and change nothing."""
        self.estimator.check(online(changes))

    def configure(self, changes: Mapping[str, Any]) -> None:
        """Change live parameters from the next sample on."""
        self.estimator.configure(online(changes))
        self._snapshots.changed()
        self._health.configure(changes)
        self._max_gap = float(changes.get('max_gap', self._max_gap))
        if 'sampling' in changes:
            self._clock_stamps = changes['sampling'] == 'clock'
        if 'publish_rate' in changes:
            self._rate = float(changes['publish_rate'])
            if self._active:
                self._stop_timer()
                self._start_timer()

    def reports(self) -> list[Report]:
        """Return the reports for /diagnostics, on the time since the last ones."""
        publishers, *of_input = [watch.look() for watch in self._watches]
        self._mixed = len(publishers.heard) > 1
        reports = self._health.reports(self._y.topic_name, publishers, self._stale, self._name)
        for found in of_input:
            for text in found.unheard.values() or ([] if found.heard else ['no publisher of u']):
                reports[0].find(WARN, text)
        return reports

    def _forget(self) -> None:
        self._arrived = False
        self._stale = True
        self._silent_since: int | None = None
        self._sequence = 0
        self._mixed = False

    def _on_sample(self, data: bytes, info: Mapping[str, Any]) -> None:
        if not self._active:
            return
        source = info['source_timestamp']
        stamp = self._clock.now().nanoseconds if self._clock_stamps else source
        sequence = info['publication_sequence_number'] or 0  # 0: the middleware has none
        if sequence != self._sequence + 1:
            self._count_lost(sequence)
        self._sequence = sequence
        y = read_double(data)
        self._health.delays.append(time_ns() - source)
        self._take(stamp, y)

    def _take(self, stamp: int, y: float) -> None:
        """Step the observer to a sample."""
        begin, estimator = perf_counter(), self.estimator
        word = estimator.advance(stamp, y)
        self.taken(word, stamp, y, estimator.observer.unknown_input, perf_counter() - begin)

    def taken(
        self, word: int, stamp: int, y: float, unknown_input: float, duration: float
    ) -> None:
        """
        Remember, and tell, what became of a sample.

        Parameters
        ----------
        word : int
            Status word of its step.
        stamp, y
            The sample.
        unknown_input : float
            Estimate of d after it.
        duration : float
            Time that the step took, in seconds.

        """
        self._health.durations.append(duration)
        if not word & REJECTED:
            health = self._health
            self._arrived = True
            self._snapshots.accepted(stamp)
            health.latest = perf_counter()
            health.stamps.append(stamp)
            health.unknown_inputs.append(unknown_input)
        if word & TOLD:
            self._tell(word, y)

    def _tell(self, word: int, y: float) -> None:
        if word & Status.RESTARTED:
            self._logger.warning(
                'the stamps jumped by more than max_gap, ahead or back: restarted from the new one'
            )
        if word & Status.DIVERGED:
            self._logger.error(
                'the observer had lost y and started again from it; its gains do not fit'
            )
        if word & REJECTED:
            self._logger.warning(
                f'rejected a sample: {_reason(word, y)} '
                f'({self.estimator.counters.rejected} rejected so far)',
                throttle_duration_sec=5.0,
            )

    def _count_lost(self, sequence: int) -> None:
        """Count the samples between the publisher's last sequence number and this one."""
        if 0 < sequence <= self._sequence:  # another publisher's
            self._mixed = True  # until `reports` has looked how many there are
        elif sequence and self._sequence and not self._mixed:
            self._health.lost += sequence - self._sequence - 1

    def _on_input(self, data: bytes, _: Mapping[str, Any]) -> None:
        u = read_double(data)
        if not self.estimator.set_input(u):
            self._logger.warning(
                f'rejected u = {u}: expected a finite number; the last one is held',
                throttle_duration_sec=5.0,
            )

    def _start_timer(self) -> None:
        self._timer = self._node.create_timer(1.0 / self._rate, self.publish)

    def _stop_timer(self) -> None:
        if self._timer is not None:
            self._node.destroy_timer(self._timer)
            self._timer = None

    def publish(self) -> None:
        """Publish the latest estimate, unless samples have stopped coming."""
        estimator = self.estimator
        if self._is_stale():
            return
        estimate = estimator.estimate
        if estimate is None:  # reset, and no sample since
            return
        self._outputs.publish(estimate, estimator.stamp)

    def _is_stale(self) -> bool:
        """Return True, and say it once, while no sample has come for max_gap."""
        if self._arrived:
            self._arrived = self._stale = False
            self._silent_since = None
        elif not self._stale:
            now = self._clock.now().nanoseconds
            if self._silent_since is None:  # the clock is not read while samples come
                self._silent_since = now
            elif not 0 <= now - self._silent_since <= self._max_gap * 1e9:  # or it jumped back
                self._stale = True
                self._logger.warning(
                    f'no usable sample on {self._y.topic_name} for {self._max_gap:g} s: not '
                    'publishing until one comes'
                )
        return self._stale

    def reset(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        """Start the observer afresh."""
        self.estimator.reset()
        self._snapshots.reset()
        response.success = True
        response.message = 'the observer starts afresh with the next sample'
        self._logger.info(f'reset: {response.message}')
        return response

    def freeze(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        """Hold gamma, or let it adapt again."""
        self.estimator.freeze(request.data)
        self._snapshots.changed()
        response.success = True
        response.message = 'gamma is held' if request.data else 'gamma adapts again'
        self._logger.info(f'freeze: {response.message}')
        return response


def online(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return the parameters of the update path among the node's."""
    return {name: value for name, value in values.items() if name in ONLINE_PARAMETERS}


def _compile(values: Mapping[str, Any]) -> None:
    """Compile before the first sample arrives; cached on disk after the first start."""
    trial = OnlineEstimator(online(values))
    for k in range(3):
        trial.advance(k * 1_000_000 + 1, 0.0)


def _reason(word: int, y: float) -> str:
    if word & Status.HELD:
        return 'its stamp lies more than max_gap from the one before; the next one decides'
    if word & Status.REJECTED_PERIOD:
        return 'expected a stamp later than the one before'
    if word & Status.REJECTED_SPIKE:
        return f'y = {y} lies beyond spike_gate'
    if word & Status.REJECTED_STUCK:
        return f'y = {y} has not changed for stuck_time'
    if word & Status.REJECTED_MEASUREMENT:
        return f'expected a finite y of at most divergence_limit, got {y}'
    return f'y = {y} would have made the estimate infinite'
