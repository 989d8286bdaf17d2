# SPDX-License-Identifier: Apache-2.0
"""Nodes as a user starts them, and a client that waits for what they send."""

import contextlib
import os
from pathlib import Path
import re
import signal
import subprocess
import sys
import threading
import time
from typing import NamedTuple

from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray
import fhaosmo_ros
from fhaosmo_ros.nodes.middleware.spin import Spinner
from fhaosmo_ros.nodes.middleware.subscription import subscribe_with_info
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetAvailableTransitions, GetState
from rcl_interfaces.msg import Parameter as ParameterMessage
from rcl_interfaces.srv import (
    DescribeParameters,
    GetParameters,
    ListParameters,
    SetParameters,
    SetParametersAtomically,
)
import rclpy
from rclpy.context import Context
from rclpy.node import Node
from rclpy.parameter import get_parameter_value, Parameter, parameter_value_to_python
from rclpy.qos import QoSProfile
from rclpy.signals import SignalHandlerOptions
from std_msgs.msg import Float64, Float64MultiArray
from std_srvs.srv import Trigger

ROOT = Path(fhaosmo_ros.__file__).parents[1]
DEADLINE = 30.0
TRIES = 3
"""Of a call, which share the deadline."""
QOS = QoSProfile(depth=1000)
ESTIMATES = {
    'state': Float64MultiArray,
    'unknown_input': Float64,
    'gamma': Float64,
    'innovation': Float64MultiArray,
    'stamp': Time,
}


def command(*arguments: object) -> list[str]:
    return [sys.executable, '-m', 'fhaosmo_ros', *map(str, arguments)]


def parameters(**values: object) -> list[str]:
    """Return `-p` arguments, and those for a `namespace`."""
    words = ['--ros-args']
    namespace = values.pop('namespace', None)
    if namespace:
        words += ['-r', f'__ns:={namespace}']
    for name, value in values.items():
        words += ['-p', f'{name.rstrip("_")}:={value}']
    return words


class Process:
    """A node in a process of its own; its output is kept in files."""

    def __init__(
        self, folder: Path, *arguments: object, code: str = '', **environment: object
    ) -> None:
        self._paths = folder / 'stdout', folder / 'stderr'
        words = [sys.executable, '-c', code, *arguments] if code else command(*arguments)
        with self._paths[0].open('wb') as out, self._paths[1].open('wb') as err:
            self._process = subprocess.Popen(
                words, cwd=ROOT, stdin=subprocess.DEVNULL, stdout=out, stderr=err,
                env=os.environ | {name: str(value) for name, value in environment.items()},
                # A test under nohup ignores SIGHUP, and so would the node.
                preexec_fn=lambda: signal.signal(signal.SIGHUP, signal.SIG_DFL),
            )  # fmt: skip

    @property
    def output(self) -> str:
        return ''.join(path.read_text(errors='replace') for path in self._paths)

    @property
    def running(self) -> bool:
        return self._process.poll() is None

    def send(self, number: int) -> None:
        self._process.send_signal(number)

    def wait(self, timeout: float = DEADLINE) -> int:
        return self._process.wait(timeout)

    def kill(self) -> None:
        """End it the hard way, if it has not ended yet."""
        if self.running:
            self._process.kill()
            self._process.wait()

    def end(self) -> None:
        if self.running:
            self.send(signal.SIGINT)
        try:
            self.wait()
        except subprocess.TimeoutExpired:
            self.kill()
            raise


@contextlib.contextmanager
def node_process(folder: Path, *arguments: object):
    """Run a node; at the end it must have lived, end well and have said nothing terrible."""
    process = Process(folder, *arguments)
    try:
        yield process
        alive = process.running
    finally:
        process.end()
    assert alive, f'the node ended by itself:\n{process.output}'
    assert process.wait() == 0, process.output
    assert 'Traceback' not in process.output, process.output


class Published(NamedTuple):
    """Message with its source time stamp in nanoseconds."""

    stamp: int
    message: object


class Estimate(NamedTuple):
    """What one tick of the estimator's timer published."""

    stamp: int
    z: list[float]
    unknown_input: float
    gamma: float | None
    innovation: list[float]


class Client:
    """A node of the test's own, with a thread that receives."""

    def __init__(self) -> None:
        self._context = Context()
        rclpy.init(context=self._context, signal_handler_options=SignalHandlerOptions.NO)
        self.node = Node('test_client', context=self._context, use_global_arguments=False)
        self._changed = threading.Condition()
        self._services: dict[str, object] = {}
        self._spinner = Spinner(self.node)

    def __enter__(self) -> 'Client':
        self._spinner.__enter__()
        return self

    def __exit__(self, *_: object) -> None:
        self._spinner.__exit__()
        self.node.destroy_node()
        rclpy.try_shutdown(context=self._context)

    def record(self, topic: str, message_type: type, qos: QoSProfile = QOS) -> list[Published]:
        """Return a list that grows with the messages of a topic."""
        messages: list[Published] = []

        def receive(message: object, info: dict) -> None:
            with self._changed:
                messages.append(Published(info['source_timestamp'], message))
                self._changed.notify_all()

        subscribe_with_info(self.node, message_type, topic, receive, qos)
        return messages

    def publisher(self, topic: str, message_type: type = Float64, qos: QoSProfile = QOS):
        """Return a function that publishes a value once somebody else listens."""
        publisher = self.node.create_publisher(message_type, topic, qos)

        def publish(value: object) -> None:
            publisher.publish(message_type(data=value) if message_type is Float64 else value)

        publish.matched = publisher.get_subscription_count
        publish.destroy = lambda: self.node.destroy_publisher(publisher)
        return publish

    def wait(self, condition, what: str, timeout: float = DEADLINE) -> None:
        """Wait until `condition` holds; it is looked at on every message, and now and then."""
        end = time.monotonic() + timeout
        # Without the lock: a condition that calls a service needs the thread that receives.
        while not condition():
            if time.monotonic() > end:
                raise TimeoutError(f'no {what} within {timeout} s')
            with self._changed:
                self._changed.wait(0.05)

    def call_later(self, service: str, service_type: type, request: object, wait: bool = True):
        """Send a request and return the future of its answer; `wait` for the service first."""
        client = self._services.get(service)
        if client is None:
            client = self._services[service] = self.node.create_client(service_type, service)
        if wait:
            self.wait(client.service_is_ready, f'service {service}')
        return client.call_async(request)

    def call(self, service: str, service_type: type, request: object):
        """
        Return a service's answer.

        The middleware may lose the first call of a new client: one that is answered at the very
        moment at which the executor begins to listen, in one of thousands. So it asks again.
        """
        done = threading.Event()
        futures = []
        for _ in range(TRIES):
            futures.append(self.call_later(service, service_type, request))
            futures[-1].add_done_callback(lambda _: done.set())
            if done.wait(DEADLINE / TRIES):
                return next(future.result() for future in futures if future.done())
        raise TimeoutError(f'no answer from {service} within {DEADLINE} s')


class Parameters:
    """The parameter services of a node, as the `ros2 param` commands use them."""

    def __init__(self, client: Client, node: str) -> None:
        self._client = client
        self._node = node

    def names(self) -> set[str]:
        request = ListParameters.Request()
        answer = self._call('list_parameters', ListParameters, request)
        return set(answer.result.names)

    def describe(self, *names: str) -> dict:
        request = DescribeParameters.Request(names=names)
        answer = self._call('describe_parameters', DescribeParameters, request)
        return {d.name: d for d in answer.descriptors}

    def messages(self, *names: str) -> list:
        request = GetParameters.Request(names=names)
        return list(self._call('get_parameters', GetParameters, request).values)

    def get(self, name: str) -> object:
        value = parameter_value_to_python(self.messages(name)[0])
        return list(value) if not isinstance(value, bool | int | float | str) else value

    def request(self, **values: object):
        """Return type and request of the service that sets one after the other."""
        return SetParameters, SetParameters.Request(parameters=_messages(values))

    def set(self, **values: object) -> list:
        """Set one after the other; return the results."""
        return list(self._call('set_parameters', *self.request(**values)).results)

    def set_text(self, name: str, text: str):
        """Set from a text, as `ros2 param set` does."""
        message = ParameterMessage(name=name, value=get_parameter_value(text))
        request = SetParameters.Request(parameters=[message])
        return self._call('set_parameters', SetParameters, request).results[0]

    def set_atomically(self, **values: object):
        request = SetParametersAtomically.Request(parameters=_messages(values))
        return self._call('set_parameters_atomically', SetParametersAtomically, request).result

    def _call(self, service: str, service_type: type, request: object):
        return self._client.call(f'{self._node}/{service}', service_type, request)


GOALS = {
    'configure': 'inactive', 'activate': 'active', 'deactivate': 'inactive',
    'cleanup': 'unconfigured', 'shutdown': 'finalized',
}  # fmt: skip
"""State that a transition leads to, where it succeeds."""


class Manager:
    """Drives a managed node; what it answers is what a user of `ros2 lifecycle` sees."""

    def __init__(self, client: Client, node: str) -> None:
        self._client = client
        self._node = node

    def state(self) -> str:
        return self._call('get_state', GetState, GetState.Request()).current_state.label

    def transitions(self) -> set[str]:
        service = GetAvailableTransitions
        answer = self._call('get_available_transitions', service, service.Request())
        return {t.transition.label for t in answer.available_transitions}

    def change(self, transition: int | str) -> bool:
        by_label = isinstance(transition, str)
        wanted = Transition(label=transition) if by_label else Transition(id=transition)
        goal, before = GOALS.get(transition), self.state()
        answer = self._call('change_state', ChangeState, ChangeState.Request(transition=wanted))
        # Asked again after a lost answer, the node refuses a transition that it has made.
        return answer.success or (before != goal and self.state() == goal)

    def _call(self, service: str, kind: type, request: object):
        return self._client.call(f'{self._node}/{service}', kind, request)


def _messages(values: dict[str, object]) -> list[ParameterMessage]:
    # 'lambda' is a keyword in Python, so the tests write lambda_
    return [Parameter(n.rstrip('_'), value=v).to_parameter_msg() for n, v in values.items()]


class EstimatorRig:
    """
    Feeds an estimator, by default with samples of its own, and collects what it publishes.

    A namespace serves one rig only: a second one would take the first one's subscription of y for
    the estimator's.
    """

    def __init__(
        self,
        client: Client,
        namespace: str = '',
        feed: bool = True,
        greet: bool = True,
        gains: str = 'fixed',
    ) -> None:
        self.client = client
        name = f'{namespace}/estimator'
        self.parameters = Parameters(client, name)
        kinds = {t: kind for t, kind in ESTIMATES.items() if t != 'gamma' or gains == 'fixed'}
        self.topics = {t: client.record(f'{name}/{t}', kind) for t, kind in kinds.items()}
        self._all_diagnostics = client.record('/diagnostics', DiagnosticArray)
        self.y = client.record(f'{namespace}/y', Float64)
        self._name = name.lstrip('/')
        self._estimates: list[Estimate] = []
        self._next = dict.fromkeys(self.topics, 0)
        self._ticks = 0
        self._before = 0
        topics = [f'{name}/{t}' for t in kinds]
        client.wait(
            lambda: all(client.node.count_publishers(t) for t in topics), 'estimator publisher'
        )
        if feed:
            self._publish = client.publisher(f'{namespace}/y')
            if greet:
                self._greet()

    def _greet(self) -> None:
        """Publish samples until the estimator hears them, then have it start afresh."""
        self.client.wait(lambda: self._publish.matched() >= 2, 'subscription of y')
        end = time.monotonic() + DEADLINE
        while not self.estimates:
            if time.monotonic() > end:
                raise TimeoutError(f'{self._name} does not answer to samples')
            self.send(0.0)
            with contextlib.suppress(TimeoutError):
                self.client.wait(lambda: self.estimates, 'estimate', timeout=0.2)
        self.reset()

    def reset(self):
        return self.client.call(f'/{self._name}/reset', Trigger, Trigger.Request())

    @property
    def estimates(self) -> list[Estimate]:
        """What has been published, grouped by tick: a tick publishes `stamp` last."""
        stamps = self.topics['stamp']
        while self._ticks < len(stamps):
            published, stamp = stamps[self._ticks]
            parts = {}
            for topic, messages in self.topics.items():
                k = self._next[topic]
                while k + 1 < len(messages) and messages[k + 1].stamp <= published:
                    k += 1
                if k >= len(messages):
                    return self._estimates  # a message is still on its way
                self._next[topic] = k
                if self._before < messages[k].stamp <= published:
                    parts[topic] = messages[k].message
            if len(parts) == len(self.topics):  # else one was sent before this client listened
                self._estimates.append(
                    Estimate(
                        stamp.sec * 10**9 + stamp.nanosec,
                        list(parts['state'].data), parts['unknown_input'].data,
                        parts['gamma'].data if 'gamma' in parts else None,
                        list(parts['innovation'].data),
                    )
                )  # fmt: skip
                for topic in parts:
                    self._next[topic] += 1
            self._before = published
            self._ticks += 1
        return self._estimates

    def send(self, y: float) -> int:
        """Publish one sample and return its source stamp."""
        before = len(self.y)
        self._publish(y)
        self.client.wait(lambda: len(self.y) > before, 'own sample')
        return self.y[-1].stamp

    def feed(self, y: float) -> Estimate:
        """Publish one sample, wait for the estimate that belongs to it and return it."""
        stamp = self.send(y)
        return self.wait_estimate(lambda e: e.stamp == stamp, f'estimate for y = {y}')

    def wait_estimate(self, condition, what: str) -> Estimate:
        found: list[Estimate] = []

        def look() -> bool:
            found[:] = [e for e in self.estimates[-50:] if condition(e)]
            return bool(found)

        self.client.wait(look, what)
        return found[-1]

    @property
    def diagnostics(self) -> list[Published]:
        """This estimator's messages on /diagnostics, where all nodes publish theirs."""
        start = f'{self._name}: '
        return [
            published for published in list(self._all_diagnostics)
            if any(s.name.startswith(start) for s in published.message.status)
        ]  # fmt: skip

    def count(self, key: str) -> int:
        """Return a counter of the latest diagnostics."""
        value = self.value(key)
        return -1 if value is None else int(value)

    def value(self, key: str) -> str | None:
        """Return a value of the latest diagnostics that has it."""
        for status in self.statuses():
            for pair in status.values:
                if pair.key == key:
                    return pair.value
        return None

    def statuses(self):
        """Return the estimator's statuses, latest first."""
        for published in reversed(self.diagnostics):
            for status in published.message.status:
                if status.name.startswith(f'{self._name}: '):
                    yield status

    def wait_status(self, task: str, level: bytes, *words: str, start: int | None = None):
        """
        Wait for a status of a task with this level and these words in its message.

        Of those that come from now on, or from the `start`-th message on.
        """
        start = len(self.diagnostics) if start is None else start
        found = []

        def look() -> bool:
            for published in self.diagnostics[start:]:
                found.extend(
                    s for s in published.message.status
                    if s.name == f'{self._name}: {task}' and s.level == level
                    and all(word in s.message for word in words)
                )  # fmt: skip
            return bool(found)

        self.client.wait(look, f'{task} with level {level} and {words}')
        return found[-1]

    def wait_count(self, key: str, value: int) -> None:
        self.client.wait(lambda: self.count(key) >= value, f'{key!r} of {value} in diagnostics')


def one_line_error(name: str, text: str) -> str:
    """Return the message if `text` is exactly one line of error from a node."""
    lines = text.splitlines()
    assert len(lines) == 1, text
    match = re.fullmatch(rf'{name}: error: (.+)', lines[0])
    assert match, text
    return match[1]
