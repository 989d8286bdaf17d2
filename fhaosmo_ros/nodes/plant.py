# SPDX-License-Identifier: Apache-2.0
"""The plant node: simulates a triangular system and publishes y and the truth."""

from collections.abc import Mapping
from functools import partial
import math
from typing import Any

from fhaosmo_ros.core.parameters.declaration import Parameters, Value
from fhaosmo_ros.core.simulation.plant import Plant
from fhaosmo_ros.nodes.middleware.endpoints import create_publisher, set_period
from fhaosmo_ros.nodes.middleware.messages import labelled
from fhaosmo_ros.nodes.middleware.node import BaseNode
from fhaosmo_ros.nodes.middleware.spin import run_node
import numpy as np
from std_msgs.msg import Float64, Float64MultiArray

MAX_PAUSE = 1_000_000_000
"""Clock jumps beyond this many nanoseconds are not simulated through."""
TOPICS = {'y': Float64, '~/state': Float64MultiArray, '~/unknown_input': Float64}


class PlantNode(BaseNode):
    """
    Publishes ``y``, ``~/state`` and ``~/unknown_input`` at `sample_rate`.

    `given` are values of parameters, also of rclpy's own such as use_sim_time; those that can't be
    used raise ConfigurationError.
    """

    def __init__(self, given: Mapping[str, Any]) -> None:
        super().__init__('plant', given)
        values = self.values
        self.plant = Plant(values)
        self._u = [0.0] * len(self.plant.model.inputs)
        self._now: int | None = None  # of the node's clock, in ns, and the time of the plant
        self._time = 0
        self._state_message = labelled([f'z{i + 1}' for i in range(self.plant.model.order)])
        self._publish_y, self._publish_state, self._publish_d = (
            create_publisher(self, kind, topic).publish for topic, kind in TOPICS.items()
        )
        for index, name in enumerate(self.plant.model.inputs):
            if name in self.plant.model.used_inputs:
                take = partial(self._on_input, index, name)
                self.create_subscription(Float64, name, take, 10)
        self.plant.sample(0.0)
        self._timer = self.create_timer(1.0 / values['sample_rate'], self._tick)
        self.get_logger().info(
            f'simulating {self.plant.model.order} states, d: {values["disturbance"]}, '
            f'y at {values["sample_rate"]:g} Hz'
        )

    def _tick(self) -> None:
        """
        Bring the simulation to the clock's present time and publish; y first.

        The time between the clock's reading and the stamp of y acts as noise on y, so the clock is
        read again after the long way, for the little that is left.
        """
        clock = self.get_clock()
        self.plant.advance(self._plant_time(clock.now().nanoseconds), self._u)
        if not np.isfinite(self.plant.states).all():
            self.get_logger().error(
                'the simulated plant has left the finite numbers: nothing is published any more; '
                'its phi, the disturbance or a known input make it unstable. Correct them and '
                'start the node again',
                once=True,
            )
            return
        now = self._plant_time(clock.now().nanoseconds)
        y = self.plant.measure(now)
        if not math.isfinite(y):
            return
        self._publish_y(Float64(data=y))
        self._publish_state(self._state_message(self.plant.states))
        self._publish_d(Float64(data=self.plant.unknown_input(now)))

    def _plant_time(self, now: int) -> float:
        """Return the plant's time in seconds; it stands still while the clock jumps."""
        step = 0 if self._now is None else now - self._now
        if not 0 <= step <= MAX_PAUSE:
            self.get_logger().warning(
                f'the clock jumped by {step * 1e-9:.3g} s: the plant goes on from where it was',
                throttle_duration_sec=5.0,
            )
            step = 0
        self._now, self._time = now, self._time + step
        return self._time * 1e-9

    def _on_input(self, index: int, name: str, message: Float64) -> None:
        if math.isfinite(message.data):
            self._u[index] = message.data
        else:
            self.get_logger().warning(
                f'rejected {name} = {message.data}: expected a finite number; the last one is '
                'held',
                throttle_duration_sec=5.0,
            )

    def _prepare(self, values: Parameters, changes: Mapping[str, Value]) -> Any:
        return self.plant.prepare(values), 'noise_seed' in changes  # also the same seed

    def _adopt(self, change: Any) -> None:
        self.plant.adopt(*change)
        set_period(self._timer, 1.0 / self.values['sample_rate'])


def main(argv: list[str] | None = None) -> int:
    """Run the plant node."""
    return run_node('plant', PlantNode, argv)
