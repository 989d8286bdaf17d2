# SPDX-License-Identifier: Apache-2.0
"""The estimator node: y in; states, unknown input and gamma out, at the rate of a timer."""

from collections.abc import Mapping
from typing import Any

from builtin_interfaces.msg import Time
from fhaosmo_ros.core.observer import Observer
from fhaosmo_ros.core.online import OnlineEstimator
from fhaosmo_ros.core.parameters import ESTIMATOR_PARAMETERS, ONLINE_PARAMETERS
from fhaosmo_ros.core.status import REJECTED, Status
from fhaosmo_ros.nodes.diagnostics import DiagnosticsPublisher
from fhaosmo_ros.nodes.messages import fill, labelled
from fhaosmo_ros.nodes.parameters import declare, on_change
from fhaosmo_ros.nodes.snapshots import SnapshotPublisher
from fhaosmo_ros.nodes.spin import run_node
from fhaosmo_ros.nodes.subscription import subscribe_with_info
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from std_msgs.msg import Float64, Float64MultiArray
from std_srvs.srv import Trigger

SENSOR_QOS = QoSProfile(depth=1000, reliability=ReliabilityPolicy.BEST_EFFORT)
"""Best effort matches every publisher; the depth holds a second at 1 kHz."""


class EstimatorNode(Node):
    """
    Subscribes ``y`` (and ``u``), steps the observer on each sample, publishes on a timer.

    Raises
    ------
    ConfigurationError
        Parameters that can't be used; nothing has been subscribed or published then.

    """

    def __init__(self, **options: Any) -> None:
        super().__init__(
            'estimator', automatically_declare_parameters_from_overrides=True, **options
        )
        values = declare(self, ESTIMATOR_PARAMETERS, lambda v: OnlineEstimator(_online(v)))
        self.estimator = OnlineEstimator(_online(values))
        self._compile()
        self._clock_stamps = values['sampling'] == 'clock'
        self._max_gap = float(values['max_gap'])
        self._sequence = 0
        self._lost = 0
        self._arrived = False
        self._stale = True
        self._silent_since: int | None = None

        observer = self.estimator.observer
        self._state = labelled([f'z{i + 1}' for i in range(observer.order)])
        self._innovation = labelled([f'eps{i + 1}' for i in range(observer.levels)])
        self._d, self._gamma, self._stamp = Float64(), Float64(), Time()
        self._publish_state = self.create_publisher(Float64MultiArray, '~/state', 10).publish
        self._publish_d = self.create_publisher(Float64, '~/unknown_input', 10).publish
        self._publish_gamma = self.create_publisher(Float64, '~/gamma', 10).publish
        self._publish_innovation = self.create_publisher(
            Float64MultiArray, '~/innovation', 10
        ).publish
        self._publish_stamp = self.create_publisher(Time, '~/stamp', 10).publish
        self._snapshots = SnapshotPublisher(self, self.estimator)
        self._diagnostics = DiagnosticsPublisher(self, self._report)
        self.create_service(Trigger, '~/reset', self._reset)
        self._timer = self._start_timer(values['publish_rate'])
        on_change(self, ESTIMATOR_PARAMETERS, self._check, self._configure)
        if observer.uses_input:
            self.create_subscription(Float64, 'u', self._on_input, SENSOR_QOS)
        self._y = subscribe_with_info(self, Float64, 'y', self._on_sample, SENSOR_QOS)
        if self.get_parameter('use_sim_time').value and values['sampling'] == 'source_stamp':
            self.get_logger().warning(
                "use_sim_time with sampling = source_stamp: the middleware's stamps know nothing "
                "of /clock, so dt is in the host's time; set sampling to clock for simulation time"
            )
        parameters = observer.parameters
        self.get_logger().info(
            f'estimating {observer.order} states and the unknown input from {self._y.topic_name} '
            f'({parameters["variant"]}, {parameters["scheme"]})'
        )

    def _compile(self) -> None:
        """Compile before the first sample arrives; cached on disk after the first start."""
        trial = Observer(self.estimator.observer.parameters)
        trial.start(0.0)
        trial.step(0.0, 1e-3)

    def _on_sample(self, message: Float64, info: Mapping[str, Any]) -> None:
        if self._clock_stamps:
            stamp = self.get_clock().now().nanoseconds
        else:
            stamp = info['source_timestamp']
        self._count_lost(info.get('publication_sequence_number'))
        estimator = self.estimator
        restarts = estimator.counters.restarts
        word = estimator.advance(stamp, message.data)
        if estimator.counters.restarts != restarts:
            self.get_logger().warning(
                'more than max_gap between two usable samples: restarted from the new one'
            )
        if not word & REJECTED:
            self._arrived = True
            self._snapshots.accepted()
        else:
            self.get_logger().warning(
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
            self.get_logger().warning(
                f'rejected u = {message.data}: expected a finite number; the last one is held',
                throttle_duration_sec=5.0,
            )

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
            now = self.get_clock().now().nanoseconds
            if self._silent_since is None:  # the clock is not read while samples come
                self._silent_since = now
            elif not 0 <= now - self._silent_since <= self._max_gap * 1e9:  # or it jumped back
                self._stale = True
                self.get_logger().warning(
                    f'no usable sample on {self._y.topic_name} for {self._max_gap:g} s: not '
                    'publishing until one comes'
                )
        return self._stale

    def _start_timer(self, rate: float) -> Any:
        return self.create_timer(1.0 / rate, self._publish)

    def _check(self, changes: Mapping[str, Any]) -> None:
        self.estimator.check(_online(changes))

    def _configure(self, changes: Mapping[str, Any]) -> None:
        self.estimator.configure(_online(changes))
        self._snapshots.changed()
        self._max_gap = float(changes.get('max_gap', self._max_gap))
        if 'sampling' in changes:
            self._clock_stamps = changes['sampling'] == 'clock'
            self.estimator.forget_stamp()
        if 'publish_rate' in changes:
            self.destroy_timer(self._timer)
            self._timer = self._start_timer(changes['publish_rate'])

    def _reset(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self.estimator.reset()
        response.success = True
        response.message = 'the observer starts afresh with the next sample'
        self.get_logger().info(f'reset: {response.message}')
        return response

    def _report(self) -> dict[str, Any]:
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


def _online(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return the parameters of the update path among the node's."""
    return {name: value for name, value in values.items() if name in ONLINE_PARAMETERS}


def _reason(word: int, y: float) -> str:
    if word & Status.REJECTED_PERIOD:
        return 'expected a stamp later than the one before'
    if word & Status.REJECTED_MEASUREMENT:
        return f'expected a finite y, got {y}'
    return f'y = {y} would have made the estimate infinite'


def main(argv: list[str] | None = None) -> int:
    """Run the estimator node."""
    return run_node('estimator', EstimatorNode, argv)
