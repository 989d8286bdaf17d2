# SPDX-License-Identifier: Apache-2.0
"""The plant node: simulates a triangular system and publishes y and the truth."""

from collections.abc import Mapping
import math
from typing import Any

from fhaosmo_ros.core.parameters import PLANT_NODE_PARAMETERS, PLANT_PARAMETERS
from fhaosmo_ros.core.plant import Plant
from fhaosmo_ros.nodes.messages import array_encoder, double_encoder
from fhaosmo_ros.nodes.parameters import declare, on_change
from fhaosmo_ros.nodes.spin import run_node
from rclpy.node import Node
from std_msgs.msg import Float64, Float64MultiArray

MAX_PAUSE = 1_000_000_000
"""Clock jumps beyond this many nanoseconds are not simulated through."""
DEPTH = 1000
"""Of the topics' queues: a recorder that is held up for a second loses nothing at 1 kHz."""


class PlantNode(Node):
    """
    Publishes ``y``, ``~/state`` and ``~/unknown_input`` at `sample_rate`.

    Raises
    ------
    ConfigurationError
        Parameters that can't be used; nothing has been published then.

    """

    def __init__(self, **options: Any) -> None:
        super().__init__('plant', automatically_declare_parameters_from_overrides=True, **options)
        values = declare(self, PLANT_NODE_PARAMETERS, lambda v: Plant(_plant(v)))
        self.plant = Plant(_plant(values))
        self.plant.sample(0.0)  # compiles, or loads what an earlier start compiled
        self._u = 0.0
        self._origin: int | None = None
        self._now = 0
        self._encode = double_encoder()
        self._encode_state = array_encoder([f'z{i + 1}' for i in range(self.plant.order)])
        self._publish_y = self.create_publisher(Float64, 'y', DEPTH).publish
        self._publish_state = self.create_publisher(Float64MultiArray, '~/state', DEPTH).publish
        self._publish_d = self.create_publisher(Float64, '~/unknown_input', DEPTH).publish
        if self.plant.uses_input:
            self.create_subscription(Float64, 'u', self._on_input, 10)
        self._timer = self._start_timer(values['sample_rate'])
        on_change(self, PLANT_NODE_PARAMETERS, self._check, self._configure)
        self.get_logger().info(
            f'simulating {self.plant.order} states, d: {values["disturbance"]}, '
            f'y at {values["sample_rate"]:g} Hz'
        )

    def _tick(self) -> None:
        """
        Bring the simulation to the clock's present time and publish; y first.

        The middleware stamps y when it is published, and every microsecond between the clock's
        reading and that moment acts as noise on y. So the long way is integrated first, and the
        clock is read again for the little that is left.
        """
        clock = self.get_clock()
        self.plant.advance(self._plant_time(clock.now().nanoseconds), self._u)
        truth = self.plant.sample(self._plant_time(clock.now().nanoseconds), self._u)
        self._publish_y(self._encode(truth.y))
        self._publish_state(self._encode_state(truth.z))
        self._publish_d(self._encode(truth.unknown_input))

    def _plant_time(self, now: int) -> float:
        """Return the plant's time in seconds; it stands still while the clock jumps."""
        if self._origin is None:
            self._origin = now
        elif not 0 <= now - self._now <= MAX_PAUSE:
            self.get_logger().warning(
                f'the clock jumped by {(now - self._now) * 1e-9:.3g} s: the plant goes on from '
                'where it was'
            )
            self._origin += now - self._now
        self._now = now
        return (now - self._origin) * 1e-9

    def _on_input(self, message: Float64) -> None:
        if math.isfinite(message.data):
            self._u = message.data
        else:
            self.get_logger().warning(
                f'rejected u = {message.data}: expected a finite number; the last one is held',
                throttle_duration_sec=5.0,
            )

    def _start_timer(self, rate: float) -> Any:
        return self.create_timer(1.0 / rate, self._tick)

    def _check(self, changes: Mapping[str, Any]) -> None:
        self.plant.check(_plant(changes))

    def _configure(self, changes: Mapping[str, Any]) -> None:
        self.plant.configure(_plant(changes))
        if 'sample_rate' in changes:
            self.destroy_timer(self._timer)
            self._timer = self._start_timer(changes['sample_rate'])


def _plant(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return the parameters of the simulation among the node's."""
    return {name: value for name, value in values.items() if name in PLANT_PARAMETERS}


def main(argv: list[str] | None = None) -> int:
    """Run the plant node."""
    return run_node('plant', PlantNode, argv)
