# SPDX-License-Identifier: Apache-2.0
"""One channel of an estimator node: y (and u) in, one observer, estimates out on a timer."""

from collections.abc import Mapping
from functools import partial
from time import perf_counter, time_ns
from typing import Any, NamedTuple

from fhaosmo_ros.core.observer.status import REJECTED, Status
from fhaosmo_ros.core.online.estimator import Change, OnlineEstimator
from fhaosmo_ros.core.parameters.declaration import Parameters
from fhaosmo_ros.nodes.estimator.health import Health
from fhaosmo_ros.nodes.estimator.outputs import Outputs
from fhaosmo_ros.nodes.estimator.snapshots import SnapshotPublisher
from fhaosmo_ros.nodes.middleware.diagnostics import Report, WARN
from fhaosmo_ros.nodes.middleware.messages import read_double
from fhaosmo_ros.nodes.middleware.publisher_watch import PublisherWatch
from fhaosmo_ros.nodes.middleware.subscription import input_qos, subscribe_with_info
from rclpy.node import Node
from std_msgs.msg import Float64
from std_srvs.srv import SetBool, Trigger

TOLD = REJECTED | int(Status.RESTARTED | Status.DIVERGED)
"""Flags of a step that are logged."""
QUIET = 5.0
"""Seconds between two warnings of one kind."""


class ChannelChange(NamedTuple):
    """A live change of parameters that a channel can take; see `Channel.prepare`."""

    values: Parameters
    estimator: Change


class Channel:
    """
    Subscribes ``y`` and the known inputs, steps the observer on each sample, publishes on a timer.

    A new channel is inactive: its topics and services exist, but samples are dropped and nothing
    is published.

    Parameters
    ----------
    node : Node
        Owns the topics, the services and the timer.
    values : Parameters
        Those of an estimator node, as they are for this channel.
    estimator : OnlineEstimator
        Made with `values`.
    inputs, outputs : str
        Prefixes of the topics read (y, u), and of the topics written and the services (state, ...,
        reset).
    name : str
        Prefix of the names of its reports.

    """

    def __init__(
        self,
        node: Node,
        values: Parameters,
        estimator: OnlineEstimator,
        inputs: str = '',
        outputs: str = '~/',
        name: str = '',
    ) -> None:
        self._node = node
        self._name = name
        self._clock = node.get_clock()
        self._logger = node.get_logger()
        self.estimator = estimator
        self._values = values
        self._clock_stamps = values['sampling'] == 'clock'
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
        for index, name in enumerate(observer.inputs):
            if name in observer.used_inputs:
                take = partial(self._on_input, index, name)
                subscriptions.append(
                    subscribe_with_info(node, Float64, inputs + name, take, qos, raw=True)
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

    def prepare(self, values: Parameters) -> ChannelChange:
        """
        Return what `adopt` takes to go on with other live parameters; change nothing.

        Raises
        ------
        ConfigurationError
            They do not fit together.

        """
        return ChannelChange(values, self.estimator.prepare(values))

    def adopt(self, change: ChannelChange) -> None:
        """Go on with what `prepare` has returned, from the next sample on."""
        self.estimator.adopt(change.estimator)
        self._snapshots.changed()
        before, self._values = self._values, change.values
        self._health.limits = change.values
        self._clock_stamps = change.values['sampling'] == 'clock'
        if self._active and change.values['publish_rate'] != before['publish_rate']:
            self._stop_timer()
            self._start_timer()

    def reports(self) -> list[Report]:
        """Return the reports for /diagnostics, on the time since the last ones."""
        publishers, *of_input = [watch.look() for watch in self._watches]
        self._mixed = len(publishers.heard) > 1
        reports = self._health.reports(self._y.topic_name, publishers, self._stale, self._name)
        names = self.estimator.observer.used_inputs
        for name, found in zip(names, of_input, strict=True):
            missing = [] if found.heard else [f'no publisher of {name}']
            for text in found.unheard.values() or missing:
                reports[0].find(WARN, text)
        return reports

    def _forget(self) -> None:
        self._arrived = False
        self._stale = True
        self._quiet_until: dict[int, float] = {}
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
        Remember, and log, what became of a sample.

        Parameters
        ----------
        word : int
            Status word of its step.
        stamp, y
            The sample.
        unknown_input : float
            Estimate of d after the sample.
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
        counters = self.estimator.counters
        if word & Status.RESTARTED:
            self._logger.warning(
                'the stamps jumped by more than max_gap, ahead or back: restarted from the new one'
                f' ({counters.restarts_forward + counters.restarts_backward} restarts so far); '
                'where y always comes so slowly, set max_gap to several of its periods',
                throttle_duration_sec=QUIET,
            )
        if word & Status.DIVERGED:
            self._logger.error(
                'the observer had lost y and started again from it; its gains do not fit '
                f'({counters.divergences} divergences so far)',
                throttle_duration_sec=QUIET,
            )
        if word & REJECTED:
            flag, reason = _reason(word, y)
            now = perf_counter()
            if now >= self._quiet_until.get(flag, 0.0):  # each reason by itself
                self._quiet_until[flag] = now + QUIET
                self._logger.warning(
                    f'rejected a sample: {reason} ({counters.rejected} rejected so far)'
                )

    def _count_lost(self, sequence: int) -> None:
        """Count the samples between the publisher's last sequence number and this one."""
        if 0 < sequence <= self._sequence:  # another publisher's
            self._mixed = True  # until `reports` has looked how many there are
        elif sequence and self._sequence and not self._mixed:
            self._health.lost += sequence - self._sequence - 1

    def _on_input(self, index: int, name: str, data: bytes, _: Mapping[str, Any]) -> None:
        u = read_double(data)
        if not self.estimator.set_input(u, index):
            self._logger.warning(
                f'rejected {name} = {u}: expected a finite number; the last one is held',
                throttle_duration_sec=QUIET,
            )

    def _start_timer(self) -> None:
        self._timer = self._node.create_timer(1.0 / self._values['publish_rate'], self.publish)

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
        """Return True while no sample has come for max_gap, and log it once."""
        if self._arrived:
            self._arrived = self._stale = False
            self._silent_since = None
        elif not self._stale:
            now, max_gap = self._clock.now().nanoseconds, self._values['max_gap']
            if self._silent_since is None:  # the clock is not read while samples come
                self._silent_since = now
            elif not 0 <= now - self._silent_since <= max_gap * 1e9:  # or it jumped back
                self._stale = True
                self._logger.warning(
                    f'no usable sample on {self._y.topic_name} for {max_gap:g} s: not '
                    'publishing until one comes',
                    throttle_duration_sec=QUIET,
                )
        return self._stale

    def reset(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        """Start the observer afresh with the next sample."""
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


def _reason(word: int, y: float) -> tuple[int, str]:
    """Return the flag that says why a sample was rejected, and the reason in words."""
    for flag, text in (
        (
            Status.HELD,
            'its stamp lies more than max_gap from the one before; the next one decides',
        ),
        (Status.REJECTED_PERIOD, 'expected a stamp later than the one before'),
        (Status.REJECTED_SPIKE, f'y = {y} lies beyond spike_gate'),
        (Status.REJECTED_STUCK, f'y = {y} has not changed for stuck_time'),
        (
            Status.REJECTED_MEASUREMENT,
            f'expected a finite y of at most divergence_limit, got {y}',
        ),
    ):
        if word & flag:
            return int(flag), text
    return int(Status.REJECTED_STEP), f'y = {y} would have made the estimate infinite'
