# SPDX-License-Identifier: Apache-2.0
"""Nodes as a user starts them, and a user that hears, feeds and asks them."""

from collections import defaultdict, namedtuple
from collections.abc import Iterable
from pathlib import Path
import signal
import threading

from builtin_interfaces.msg import Time
from commands import ROOT, wait_until
from diagnostic_msgs.msg import DiagnosticArray
from fhaosmo_ros.nodes.middleware.endpoints import subscribe_with_info
from fhaosmo_ros.nodes.recording import PrivateNode
from fhaosmo_ros.tools.cli.processes import Child
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetState
from rclpy.parameter import Parameter, parameter_value_to_python
from rclpy.parameter_client import AsyncParameterClient
from rclpy.qos import DurabilityPolicy, QoSProfile
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64, Float64MultiArray, Header, String
from std_srvs.srv import Trigger

DEADLINE = 60.0
"""Seconds for what takes one on a quiet machine."""
FIRST_TRY = 0.25
"""Seconds until a call is made again, later twice as many: the middleware may lose the first."""
SECOND = 1_000_000_000
OK, WARN, ERROR, STALE = b'\0', b'\1', b'\2', b'\3'
QOS = QoSProfile(depth=10_000)
LATCHED = QoSProfile(depth=1000, durability=DurabilityPolicy.TRANSIENT_LOCAL)
ESTIMATES = {
    'state': Float64MultiArray, 'unknown_input': Float64, 'innovation': Float64MultiArray,
    'stamp': Time, 'gamma': Float64,
}  # fmt: skip
FED = {'publish_on': 'sample', 'max_gap': 60.0}
"""For an estimator that a test feeds: each sample is answered at once, and no gap restarts it."""


def nanoseconds(stamp: Time) -> int:
    return stamp.sec * SECOND + stamp.nanosec


def as_time(stamp: int) -> Time:
    return Time(sec=stamp // SECOND, nanosec=stamp % SECOND)


def plain(message: Time | Float64 | Float64MultiArray) -> int | float | list[float]:
    """Return nanoseconds, or the numbers of a message."""
    if isinstance(message, Time):
        return nanoseconds(message)
    return message.data if isinstance(message, Float64) else list(message.data)


def values_of(status) -> dict[str, object]:
    """Return the values of a diagnostic status, and its own level and message."""
    own = {'level': status.level, 'message': status.message}
    return own | {pair.key: pair.value for pair in status.values}


def joint_state(stamp: int, names: Iterable[str], positions: Iterable[float]) -> JointState:
    header = Header(stamp=as_time(stamp))
    return JointState(header=header, name=list(names), position=map(float, positions))


def arguments(
    *words: object, namespace: str = '', reliable: Iterable[str] = (), **values: object
) -> list[object]:
    """
    Return ROS arguments: those given, a namespace, and parameters; `lambda_` sets lambda.

    `reliable` are topics in the namespace, or with full names, that an estimator hears reliably.
    """
    for topic in reliable:
        name = topic if topic.startswith('/') else f'{namespace}/{topic}'
        values[f'qos_overrides.{name}.subscription.reliability'] = 'reliable'
    if namespace:
        words = ('-r', f'__ns:={namespace}', *words)
    rules = [f'{name.rstrip("_")}:={value}' for name, value in values.items()]
    return ['--ros-args', *words, *(part for rule in rules for part in ('-p', rule))]


class Process(Child):
    """A node, which is to end when it is told to, and no sooner."""

    _may_end = False

    def __init__(self, log: Path, *words: object) -> None:
        # A test under nohup ignores SIGHUP, and so would the node.
        heard = {'preexec_fn': lambda: signal.signal(signal.SIGHUP, signal.SIG_DFL)}
        super().__init__(log, *map(str, words), cwd=ROOT, **heard)

    def wait(self, timeout: float = DEADLINE) -> int:
        """Return the exit code of a process that is to end."""
        self._may_end = True
        return super().wait(timeout)

    def interrupt(self) -> None:
        """Send SIGINT to a process that has to be running, if nobody has ended it."""
        if not self._may_end:
            assert self.poll() is None, f'it has ended by itself:\n{self.output()}'
            super().interrupt()

    def check_end(self) -> str:
        """Wait for the end after `interrupt`, a good one with nothing terrible in its output."""
        assert self._may_end or self.wait() == 0, self.output()
        for word in ('Traceback', 'Exception', 'terminate called'):
            assert word not in self.output(), self.output()
        return self.output()

    def stop(self) -> str:
        """Let it end, and return what it has said."""
        self.interrupt()
        return self.check_end()


Published = namedtuple('Published', 'stamp message')
"""A message with its source time stamp in nanoseconds."""
Report = namedtuple('Report', 'time statuses')
"""A message on /diagnostics: its own time in nanoseconds, and statuses by their tasks."""
Estimate = namedtuple('Estimate', 'z unknown_input innovation stamp gamma', defaults=[None])
"""What was published for one sample, in the order of `ESTIMATES`; only fixed gains have gamma."""


class User(PrivateNode):
    """A node of the tests' own, with a thread that receives."""

    def __init__(self, name: str = 'user') -> None:
        super().__init__(name)
        self._of_services: dict[str, object] = {}
        self.reports: dict[str, list[Report]] = defaultdict(list)
        self.node.create_subscription(DiagnosticArray, '/diagnostics', self._on_report, QOS)

    def _on_report(self, message: DiagnosticArray) -> None:
        node = message.status[0].name.partition(': ')[0]
        statuses = {status.name.partition(': ')[2]: status for status in message.status}
        self.reports[node].append(Report(nanoseconds(message.header.stamp), statuses))

    def record(self, topic: str, kind: type, qos: QoSProfile = QOS) -> list[Published]:
        """Return a list that grows with the messages of a topic."""
        messages: list[Published] = []

        def receive(message: object, info: dict) -> None:
            messages.append(Published(info['source_timestamp'], message))

        subscribe_with_info(self.node, kind, topic, receive, qos)
        return messages

    def publisher(self, topic: str, kind: type = Float64, heard: int = 1, qos: QoSProfile = QOS):
        """Return a publisher once so many subscriptions hear it."""
        publisher = self.node.create_publisher(kind, topic, qos)
        self.wait(lambda: publisher.get_subscription_count() >= heard, f'subscription of {topic}')
        return publisher

    def wait(self, condition, what: str):
        """Return what `condition` gives once that is true."""
        return wait_until(condition, what, DEADLINE, pause=0.002)

    def client(self, service: str, kind: type):
        """Return the client of a service that is there."""
        if service not in self._of_services:
            self._of_services[service] = self.node.create_client(kind, service)
        self.wait(self._of_services[service].service_is_ready, f'service {service}')
        return self._of_services[service]

    def call(self, service: str, kind: type, request: object = None):
        """Return a service's answer, to a request without content if none is given."""
        return self.answer(self.client(service, kind).call_async, request or kind.Request())

    def answer(self, ask, *request: object):
        """Return the answer to a request, asked again where it gets lost."""
        done, futures, patience = threading.Event(), [], FIRST_TRY
        while patience < DEADLINE:
            futures.append(ask(*request))
            futures[-1].add_done_callback(lambda _: done.set())
            if done.wait(patience):
                return next(future.result() for future in futures if future.done())
            patience *= 2.0
        raise TimeoutError(f'no answer within {DEADLINE} s')


class Parameters:
    """The parameter services of a node, as the `ros2 param` commands use them."""

    def __init__(self, user: User, node: str) -> None:
        self._answer = user.answer
        self.service = AsyncParameterClient(user.node, node)
        user.wait(self.service.services_are_ready, f'parameter services of {node}')

    def ask(self, request: str, *given: object):
        """Return the answer to a request of rclpy's AsyncParameterClient."""
        return self._answer(getattr(self.service, request), *given)

    def messages(self, *names: str) -> list:
        return list(self.ask('get_parameters', names).values)

    def all(self, names) -> dict[str, object]:
        """Return values by name."""
        values = map(parameter_value_to_python, self.messages(*names))
        plain = (v if isinstance(v, bool | int | float | str) else list(v) for v in values)
        return dict(zip(names, plain, strict=True))

    def get(self, name: str) -> object:
        return self.all([name])[name]

    def try_to_set(self, **values: object):
        """Return the result of setting one parameter, or several together; `lambda_`: lambda."""
        changes = [Parameter(name.rstrip('_'), value=value) for name, value in values.items()]
        return self.ask('set_parameters_atomically', changes).result

    def set(self, **values: object) -> None:
        result = self.try_to_set(**values)
        assert result.successful, result.reason


class Manager:
    """Drives a managed node; what it answers is what a user of `ros2 lifecycle` sees."""

    def __init__(self, user: User, node: str) -> None:
        self._user, self._node = user, node

    def state(self) -> str:
        return self._user.call(f'{self._node}/get_state', GetState).current_state.label

    def change(self, transition: int | str) -> bool:
        by_label = isinstance(transition, str)
        wanted = Transition(label=transition) if by_label else Transition(id=transition)
        before, request = self.state(), ChangeState.Request(transition=wanted)
        answer = self._user.call(f'{self._node}/change_state', ChangeState, request)
        # Asked again after a lost answer, the node refuses a transition that it has made.
        return answer.success or before != self.state()


class Rig:
    """A running node: what it says in its log and in its reports."""

    def __init__(self, user: User, process: Process, node: str) -> None:
        self.user, self.process, self.name = user, process, node
        self.reports = user.reports[node.lstrip('/')]

    def said(self, *words: str) -> list[str]:
        """Return the lines of its log that have these words."""
        lines = self.process.output().splitlines()
        return [line for line in lines if all(word in line for word in words)]

    def wait_said(self, *words: str) -> None:
        self.user.wait(lambda: self.said(*words), f'{words} in the log')

    def value(self, key: str) -> str | None:
        """Return a value of the latest report that has it."""
        latest = (values_of(s) for r in reversed(self.reports) for s in r.statuses.values())
        return next((values[key] for values in latest if key in values), None)

    def count(self, key: str) -> int:
        return int(self.value(key) or 0)

    def wait_count(self, key: str, value: int) -> None:
        self.user.wait(lambda: self.count(key) >= value, f'{key!r} of {value} in diagnostics')

    def wait_values(self, task: str, condition, what: str = '', doing=lambda: None):
        """
        Return values of the latest report from now on for which a condition on them holds.

        What is to make it so is done again and again meanwhile.
        """
        since = len(self.reports)

        def look() -> list:
            doing()
            later = (r.statuses for r in self.reports[since:] if task in r.statuses)
            return list(filter(condition, (values_of(statuses[task]) for statuses in later)))

        return self.user.wait(look, what)[-1]

    def wait_status(self, task: str, level: bytes, *words: str, doing=lambda: None):
        """Return values as `wait_values`, of a status with this level and these words."""

        def as_wanted(values) -> bool:
            return values['level'] == level and all(word in values['message'] for word in words)

        return self.wait_values(task, as_wanted, f'{task} with {level} and {words}', doing)


class Estimator(Rig):
    """A running estimator: what it publishes too, and what it can be asked."""

    def __init__(
        self, user: User, process: Process, namespace: str, channel: str = '', gamma: bool = True
    ) -> None:
        node, part = f'{namespace}/estimator', f'/{channel}' if channel else ''
        super().__init__(user, process, node)
        self.name = node + part
        self.topics = {
            topic: user.record(f'{self.name}/{topic}', kind)
            for topic, kind in ESTIMATES.items() if gamma or topic != 'gamma'
        }  # fmt: skip
        self._topic = f'{namespace}{part}/y'
        self.y = user.record(self._topic, Float64)
        # An estimate that nobody hears is not made. Readers are announced in order: once it has
        # written to this one, it knows those that this user made before.
        told = user.record(f'{node}/parameters', String, LATCHED)
        user.wait(lambda: told, f'parameters of {node}')
        self.parameters = Parameters(user, node)

    def listen(self) -> 'Estimator':
        """Wait until it hears y."""
        self._publisher = self.user.publisher(self._topic, heard=2)  # it and our own record
        return self

    def reset(self):
        return self.user.call(f'{self.name}/reset', Trigger)

    def send(self, y: float) -> int:
        """Publish one sample and return its source stamp."""
        before = len(self.y)
        self._publisher.publish(Float64(data=y))
        self.user.wait(lambda: len(self.y) > before, 'own sample')
        return self.y[-1].stamp

    def feed(self, y: float) -> Estimate:
        """Publish one sample, wait for the estimate that belongs to it and return it."""
        stamp = self.send(y)
        return self.wait_estimate(lambda e: e.stamp == stamp, f'estimate for y = {y}')

    @property
    def estimates(self) -> list[Estimate]:
        """What has been published; all topics have had all listeners from the first sample on."""
        rows = zip(*self.topics.values(), strict=False)  # the last estimate may be on its way
        return [Estimate(*(plain(published.message) for published in row)) for row in rows]

    def wait_estimate(self, condition, what: str) -> Estimate:
        return self.user.wait(lambda: [e for e in self.estimates[-50:] if condition(e)], what)[-1]
