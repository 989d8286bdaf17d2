# SPDX-License-Identifier: Apache-2.0
"""One channel of an estimator node: y (and u) in, one observer, estimates out."""

from functools import partial
from time import perf_counter
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from fhaosmo_ros.core.observer.status import UNUSED
from fhaosmo_ros.core.online.estimator import OnlineEstimator
from fhaosmo_ros.core.online.events import described
from fhaosmo_ros.core.online.snapshots import Flag, pack
from fhaosmo_ros.core.parameters.declaration import Parameters
from fhaosmo_ros.core.parameters.units import derivative_unit
from fhaosmo_ros.inputs import known_inputs, measured_output
from fhaosmo_ros.nodes.estimator.health import Health
from fhaosmo_ros.nodes.estimator.outputs import estimate_messages
from fhaosmo_ros.nodes.estimator.sources import check_input, listen, Listener
from fhaosmo_ros.nodes.middleware.diagnostics import array_of, OK, QUIET, Report, WARN
from fhaosmo_ros.nodes.middleware.endpoints import create_publisher, full_name, LATCHED, Listeners
from fhaosmo_ros.nodes.middleware.messages import labelled, message_class, time_message
from fhaosmo_ros.topics import estimates_of, EVENT, SNAPSHOT, STANDARD_DEVIATION
from std_msgs.msg import Float64MultiArray

PERIOD, PERIOD_OF_SELF_TUNING = 1.0, 30.0
"""Seconds between two snapshots; a self-tuning estimator remembers hundreds of numbers."""


class Channel:
    """
    Takes y and the known inputs out of messages, steps the observer, publishes the estimates.

    A new channel has no topics. An open one has, but before it is activated samples are dropped
    and nothing is published. `name` is in its topics, services, reports and log, '' without names;
    topics begin with `prefix`. The `node` has the `sources` and the `typed` outputs that its
    channels share. `measured` and `known` say what y and the known inputs are.

    Messages that nobody hears are not made: one costs more than a step with fixed gains. By the
    snapshots a replay follows the estimator.
    """

    def __init__(self, node: Any, values: Parameters, name: str = '') -> None:
        self._node, self.values, self.name = node, values, name
        self.logger = node.get_logger().get_child(name) if name else node.get_logger()
        self.prefix = f'~/{name}/' if name else '~/'
        self.estimator = OnlineEstimator(values)
        self.measured = measured_output(values, name)
        self.known = known_inputs(values, self.estimator.observer.used_inputs, name)
        self.clock, self._active = node.get_clock(), False
        for wanted in (self.measured, *self.known.values()):
            check_input(node, wanted)
        full_name(node, self.prefix + STANDARD_DEVIATION)  # its longest topic

    def open(self) -> None:
        """Make its topics, and listen to y and to the known inputs."""
        node, estimator, inputs = self._node, self.estimator, self.estimator.observer.inputs
        self._messages = estimate_messages(estimator)
        self._listeners = Listeners({
            name: create_publisher(node, message_class(kind), self.prefix + name)
            for name, kind in estimates_of(self.values).items()
        })  # fmt: skip
        self._events = create_publisher(node, DiagnosticArray, self.prefix + EVENT, latched=True)
        topic = self.prefix + SNAPSHOT
        self._snapshots = node.create_publisher(Float64MultiArray, topic, LATCHED)
        self._period = PERIOD_OF_SELF_TUNING if estimator.observer.self_tuning else PERIOD
        self._due = 0.0  # when the next snapshot is, by perf_counter
        self.u: dict[str, Listener] = {}
        for u, its in self.known.items():
            self.u[u] = listen(node, its, partial(self._on_input, inputs.index(u)))
        self.y = listen(node, self.measured, self._on_sample)  # after u
        self.health = Health(self)

    def activate(self) -> None:
        """Take samples and publish from now on; the first sample starts the observer afresh."""
        self.reset()
        self._arrived, self.stale = False, True
        self._silent_since: int | None = None  # by the node's clock
        self.health.begin()
        self._active = True
        if self.estimator.events.on:
            self._say(self.clock.now().nanoseconds, 'no event yet')
        observer = self.estimator.observer
        self.logger.info(
            f'estimating {observer.order} states and the unknown input from '
            f'{self.y.source.topic} ({observer.description})'
        )

    def deactivate(self) -> None:
        """Drop samples and publish nothing from now on."""
        self._active = False

    def adopt(self, values: Parameters) -> None:
        """Go on with other live parameters."""
        self.estimator.configure(values)
        self._tell_snapshot(Flag.CHANGED)
        self.values = values

    def _on_input(self, index: int, _: int, u: float) -> None:
        self.estimator.set_input(u, index)

    def _on_sample(self, stamp: int, y: float) -> None:
        """Step the observer to a sample."""
        if not self._active:
            return
        if self.values['sampling'] == 'clock':
            stamp = self.clock.now().nanoseconds
        estimator, health, begin = self.estimator, self.health, perf_counter()
        word = estimator.advance(stamp, y)
        now = perf_counter()
        if estimator.events.waiting:
            self._tell_events()
        if not word & UNUSED:
            self._arrived, health.latest = True, now
            health.stamps.append(stamp)
            health.stepping += now - begin
            if now >= self._due:
                self._tell_snapshot(Flag(0) if self._due else Flag.STARTED)
            if self.values['publish_on'] == 'sample':
                self._publish()

    def _publish(self) -> None:
        """Publish the latest estimate, in the typed messages together with other channels'."""
        estimate, stamp = self.estimator.estimate, self.estimator.stamp
        if estimate is not None:
            for name, publisher in self._listeners.heard().items():
                publisher.publish(self._messages[name](estimate, stamp))
            name = self.name or (self.y.field and self.y.field.key) or 'y'
            self._node.typed.add(name, (stamp, estimate, self.values))

    def tick(self) -> None:
        """Publish at the node's rate, if it is to, and until y is silent by the node's clock."""
        if self._arrived:
            self._arrived = self.stale = False
            self._silent_since = None
        elif not self.stale:
            now = self.clock.now().nanoseconds
            if self._silent_since is None:  # the clock is not read while samples come
                self._silent_since = now
            elif not 0 <= now - self._silent_since <= self.estimator.silence * 1e9:
                self.stale = True  # or the clock jumped back
        if not self.stale and self.values['publish_on'] == 'timer':
            self._publish()

    def _tell_snapshot(self, flags: Flag) -> None:
        """Publish what the estimator remembers, and what has happened at the latest sample."""
        if self.estimator.latest is not None:
            labels, vector = pack(flags, self.estimator.state_dict())
            self._snapshots.publish(labelled(labels)(vector))
            self._due = 0.0 if flags == Flag.RESET else perf_counter() + self._period

    def _tell_events(self) -> None:
        """Publish, and log, the events that have begun or ended."""
        unit = derivative_unit(self.values['measurement_unit'], self.estimator.observer.order)
        for event in self.estimator.events.taken():
            text, values = described(event, unit)
            self._say(event.stamp, text, WARN if event.begins else OK, values)
            if event.begins:
                self.logger.warning(f'event: {text}', throttle_duration_sec=QUIET)

    def _say(self, stamp: int, text: str, level: bytes = OK, values: Any = None) -> None:
        """Publish on the topic of events."""
        report = Report(f'{self.name} event'.lstrip(), values or {})
        report.find(level, text)
        self._events.publish(array_of(self._node, time_message(stamp), [report]))

    def reset(self) -> None:
        """Start the observer afresh with the next sample."""
        self.estimator.reset()
        self._tell_snapshot(Flag.RESET)
