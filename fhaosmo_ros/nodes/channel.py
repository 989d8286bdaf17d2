# SPDX-License-Identifier: Apache-2.0
"""One channel of an estimator node: y (and u) in, one observer, estimates out on a timer."""

from collections.abc import Mapping
from typing import Any

from builtin_interfaces.msg import Time
from fhaosmo_ros.core.observer import Observer
from fhaosmo_ros.core.online import OnlineEstimator
from fhaosmo_ros.core.parameters import ONLINE_PARAMETERS
from fhaosmo_ros.core.status import REJECTED, Status
from fhaosmo_ros.nodes.messages import fill, labelled
from fhaosmo_ros.nodes.subscription import SENSOR_QOS, subscribe_with_info
from rclpy.node import Node
from std_msgs.msg import Float64, Float64MultiArray
from std_srvs.srv import Trigger


class Channel:
    """
    Subscribes ``y`` (and ``u``), steps the observer on each sample, publishes on a timer.

    It is made inactive: its subscriptions and publishers exist, samples are dropped, nothing is
    published.

    Parameters
    ----------
    node : Node
        Owns the topics, the service and the timer.
    values : mapping
        All parameters of the estimator.
    inputs, outputs : str
        What stands before the names of the topics read (y, u) and of those written and the
        service (state, ..., reset).

    Raises
    ------
    ConfigurationError
        Parameters that can't be used; nothing has been subscribed or published then.

    """

    def __init__(
        self, node: Node, values: Mapping[str, Any], inputs: str = '', outputs: str = '~/'
    ) -> None:
        self._node = node
        self._clock = node.get_clock()
        self._logger = node.get_logger()
        self.estimator = OnlineEstimator(online(values))
        self._compile()
        self._clock_stamps = values['sampling'] == 'clock'
        self._max_gap = float(values['max_gap'])
        self._rate = float(values['publish_rate'])
        self._timer: Any = None
        self._forget()
        self._sequence = 0
        self._lost = 0

        observer = self.estimator.observer
        self._state = labelled([f'z{i + 1}' for i in range(observer.order)])
        self._innovation = labelled([f'eps{i + 1}' for i in range(observer.levels)])
        self._d, self._gamma, self._stamp = Float64(), Float64(), Time()
        publishers = [
            node.create_publisher(kind, outputs + name, 10)
            for name, kind in (
                ('state', Float64MultiArray), ('unknown_input', Float64), ('gamma', Float64),
                ('innovation', Float64MultiArray), ('stamp', Time),
            )
        ]  # fmt: skip
        (
            self._publish_state, self._publish_d, self._publish_gamma,
            self._publish_innovation, self._publish_stamp,
        ) = (p.publish for p in publishers)  # fmt: skip
        service = node.create_service(Trigger, outputs + 'reset', self._reset)
        self._y = subscribe_with_info(node, Float64, inputs + 'y', self._on_sample, SENSOR_QOS)
        self._owned = [
            *((node.destroy_publisher, p) for p in publishers),
            (node.destroy_service, service),
            (node.destroy_subscription, self._y),
        ]
        if observer.uses_input:
            u = node.create_subscription(Float64, inputs + 'u', self._on_input, SENSOR_QOS)
            self._owned.append((node.destroy_subscription, u))

    def activate(self) -> None:
        """Take samples and publish from now on; the first sample starts the observer afresh."""
        self.estimator.reset()
        self._forget()
        self._timer = self._start_timer()
        parameters = self.estimator.observer.parameters
        self._logger.info(
            f'estimating {parameters["order"]} states and the unknown input from '
            f'{self._y.topic_name} ({parameters["variant"]}, {parameters["scheme"]})'
        )

    def deactivate(self) -> None:
        """Drop samples and publish nothing from now on."""
        if self._timer is not None:
            self._node.destroy_timer(self._timer)
            self._timer = None

    def destroy(self) -> None:
        """Take the topics and the service away."""
        self.deactivate()
        for destroy, entity in self._owned:
            destroy(entity)
        self._owned = []

    def check(self, changes: Mapping[str, Any]) -> None:
        """Raise what `configure` would raise, and change nothing."""
        self.estimator.check(online(changes))

    def configure(self, changes: Mapping[str, Any]) -> None:
        """Change live parameters from the next sample on."""
        self.estimator.configure(online(changes))
        self._max_gap = float(changes.get('max_gap', self._max_gap))
        if 'sampling' in changes:
            self._clock_stamps = changes['sampling'] == 'clock'
            self.estimator.forget_stamp()
        if 'publish_rate' in changes:
            self._rate = float(changes['publish_rate'])
            if self._timer is not None:
                self._node.destroy_timer(self._timer)
                self._timer = self._start_timer()

    def report(self) -> dict[str, Any]:
        """Return what diagnostics show."""
        counters = self.estimator.counters
        estimate = self.estimator.estimate
        return {
            'samples accepted': counters.accepted,
            'samples lost': self._lost,
            'rejected measurements': counters.rejected_measurements,
            'rejected stamps': counters.rejected_stamps,
            'rejected inputs': counters.rejected_inputs,
            'rejected steps': counters.rejected_steps,
            'restarts': counters.restarts,
            'open levels': estimate.open_levels if estimate else 0,
            'gamma': estimate.gamma if estimate else float('nan'),
        }

    def _compile(self) -> None:
        """Compile before the first sample arrives; cached on disk after the first start."""
        trial = Observer(self.estimator.observer.parameters)
        trial.start(0.0)
        trial.step(0.0, 1e-3)

    def _forget(self) -> None:
        self._arrived = False
        self._stale = True
        self._silent_since: int | None = None

    def _on_sample(self, message: Float64, info: Mapping[str, Any]) -> None:
        if self._timer is None:
            return
        stamp = self._clock.now().nanoseconds if self._clock_stamps else info['source_timestamp']
        self._count_lost(info.get('publication_sequence_number'))
        estimator = self.estimator
        restarts = estimator.counters.restarts
        word = estimator.advance(stamp, message.data)
        if estimator.counters.restarts != restarts:
            self._logger.warning(
                'more than max_gap between two usable samples: restarted from the new one'
            )
        if not word & REJECTED:
            self._arrived = True
        else:
            self._logger.warning(
                f'rejected a sample: {_reason(word, message.data)} '
                f'({estimator.counters.rejected} rejected so far)',
                throttle_duration_sec=5.0,
            )

    def _count_lost(self, sequence: int | None) -> None:
        """Count the samples between the publisher's last sequence number and this one."""
        if sequence:
            if self._sequence and sequence > self._sequence + 1:
                self._lost += sequence - self._sequence - 1
            self._sequence = sequence

    def _on_input(self, message: Float64) -> None:
        if not self.estimator.set_input(message.data):
            self._logger.warning(
                f'rejected u = {message.data}: expected a finite number; the last one is held',
                throttle_duration_sec=5.0,
            )

    def _start_timer(self) -> Any:
        return self._node.create_timer(1.0 / self._rate, self._publish)

    def _publish(self) -> None:
        estimator = self.estimator
        if self._is_stale():
            return
        estimate = estimator.estimate
        if estimate is None:  # reset, and no sample since
            return
        self._publish_state(fill(self._state, estimate.z))
        self._d.data = estimate.unknown_input
        self._publish_d(self._d)
        self._gamma.data = estimate.gamma
        self._publish_gamma(self._gamma)
        self._publish_innovation(fill(self._innovation, estimate.innovation))
        self._stamp.sec, self._stamp.nanosec = divmod(estimator.stamp, 1_000_000_000)
        self._publish_stamp(self._stamp)

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

    def _reset(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self.estimator.reset()
        response.success = True
        response.message = 'the observer starts afresh with the next sample'
        self._logger.info(f'reset: {response.message}')
        return response


def online(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return the parameters of the update path among the node's."""
    return {name: value for name, value in values.items() if name in ONLINE_PARAMETERS}


def _reason(word: int, y: float) -> str:
    if word & Status.REJECTED_PERIOD:
        return 'expected a stamp later than the one before'
    if word & Status.REJECTED_MEASUREMENT:
        return f'expected a finite y, got {y}'
    return f'y = {y} would have made the estimate infinite'
