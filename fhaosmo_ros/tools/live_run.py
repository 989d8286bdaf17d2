# SPDX-License-Identifier: Apache-2.0
"""Following a live estimator through a bag: the same first sample, resets and live changes."""

from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from itertools import chain
from typing import Any, NamedTuple

from fhaosmo_ros.core.errors import ConfigurationError
from fhaosmo_ros.core.online import OnlineEstimator
from fhaosmo_ros.core.parameters import ONLINE_PARAMETERS
from fhaosmo_ros.core.policy_layout import FROZEN
from fhaosmo_ros.core.snapshot import Flag, INTEGERS, Snapshot, unpack
from fhaosmo_ros.tools.bag_reader import BagReader, Block
import numpy as np
from numpy.typing import NDArray

TOPIC, EVENTS = 'snapshot', '/parameter_events'
TRIES = 30
"""Snapshots whose sample may be missing before the bag is taken for one of other samples."""
AGREEMENT = 1e-12
VALUE_FIELDS = {
    1: 'bool_value', 2: 'integer_value', 3: 'double_value', 4: 'string_value',
    6: 'bool_array_value', 7: 'integer_array_value', 8: 'double_array_value',
    9: 'string_array_value',
}  # fmt: skip
"""Field of a rcl_interfaces/ParameterValue by its type."""


class Event(NamedTuple):
    """What the live estimator told of one sample: its memory, and what changed there."""

    time: int
    snapshot: Snapshot
    changes: dict[str, Any]


def find_estimator(reader: BagReader, name: str | None, channel: str = '') -> str | None:
    """
    Return the name of the estimator to follow: the one given, or the only one in the bag.

    Of those with channels, the one of this channel.

    Raises
    ------
    ConfigurationError
        The one given has no snapshots in the bag, or there are several to choose from.

    """
    found = sorted(
        c.topic.removesuffix(f'/{TOPIC}') for c in reader.connections
        if c.topic.endswith(f'/{TOPIC}') and c.msgcount
    )  # fmt: skip
    of_channel = [other for other in found if channel and other.endswith(f'/{channel}')]
    if name is None and len(of_channel) == 1:
        return of_channel[0]
    if name is None and len(found) > 1:
        raise ConfigurationError(
            f'--follow: expected one of the live estimators in the bag ({", ".join(found)}), or '
            '--afresh'
        )
    if name is not None and name not in found:
        raise ConfigurationError(
            f'--follow: expected an estimator whose snapshots are in the bag '
            f'({", ".join(found) or "none"}), got {name!r}'
        )
    return name or next(iter(found), None)


def read_events(reader: BagReader, name: str, fixed: Iterable[str]) -> list[Event]:
    """
    Return the events of a live estimator in order.

    Parameters
    ----------
    reader : BagReader
    name : str
        What stands before the estimator's topics: the node's full name, and that of the channel
        if it has many.
    fixed : iterable of str
        Parameters whose live changes are not to be repeated.

    """
    events: list[Event] = []
    changes: dict[str, Any] = {}
    topics = {f'{name}/{TOPIC}', EVENTS} & {c.topic for c in reader.connections}
    for topic, time, message in reader.few(topics):
        if topic == EVENTS:
            if name == message.node or name.startswith(f'{message.node}/'):
                channel = name.removeprefix(message.node).strip('/')
                changes |= _changes(message.changed_parameters, channel, set(fixed))
            continue
        try:
            snapshot = unpack(message.data)
        except ValueError as error:
            raise ConfigurationError(
                f'topic {topic!r}: expected snapshots of this version ({error}); --afresh does '
                'without them'
            ) from None
        # The node publishes the change first, then the snapshot.
        took_them = not events or snapshot.flags & (Flag.CHANGED | Flag.STARTED)
        events.append(Event(time, snapshot, changes if took_them else {}))
        if took_them:
            changes = {}
    return events


def _changes(parameters: Sequence[Any], channel: str, fixed: set[str]) -> dict[str, Any]:
    values = {}
    for parameter in parameters:
        of_channel, _, name = parameter.name.rpartition('.')
        if of_channel == channel and name in ONLINE_PARAMETERS and name not in fixed:
            value = getattr(parameter.value, VALUE_FIELDS[parameter.value.type])
            values[name] = ONLINE_PARAMETERS[name].coerce(value)
    return values


class LiveRun:
    """
    Does to an estimator what a live one went through, at the same samples.

    Parameters
    ----------
    name : str
        The live estimator's.
    events : list of Event
    estimator : OnlineEstimator
        The one that follows.

    Attributes
    ----------
    left_out : int
        Samples before the first one that can be followed.

    """

    def __init__(self, name: str, events: list[Event], estimator: OnlineEstimator) -> None:
        self._name, self._events, self._estimator = name, deque(events), estimator
        self.left_out = 0
        self._followed = self._resumed = False
        self._same = self._other = 0

    def begin(self, blocks: Iterator[Block]) -> Iterator[Block]:
        """Yield the samples from the one on at which the live estimator's state is known."""
        held: list[Block] = []
        for _ in range(min(TRIES, len(self._events))):
            event = self._events[0]
            while not held or held[-1].times[-1] <= event.time:
                block = next(blocks, None)
                if block is None:
                    break
                if len(block.times):
                    held.append(block)
            for k, block in enumerate(held):
                found = np.flatnonzero(block.stamps == event.snapshot.stamp)
                if len(found):
                    first = int(found[0]) + self._adopt(event)
                    self._followed = True
                    self.left_out = sum(len(b.times) for b in held[:k]) + first
                    rest = Block(*(column[first:] for column in block))
                    yield from chain([rest], held[k + 1 :], blocks)
                    return
            changes = self._events.popleft().changes
            if self._events:
                following = self._events[0]
                self._events[0] = following._replace(changes=changes | following.changes)
        self._events.clear()
        yield from chain(held, blocks)

    def _adopt(self, event: Event) -> bool:
        """Return True if the memory after the event's sample is now the estimator's too."""
        if event.snapshot.flags & Flag.STARTED:
            return False  # the sample itself is the first
        self._configure(event)
        self._events.popleft()
        try:
            self._estimator.remember(event.snapshot.memory)
        except ConfigurationError:  # an observer of another size starts there
            return False
        self._resumed = True
        return True

    def parts(self, stamps: NDArray[np.int64]) -> Iterator[slice]:
        """Yield parts of a block, each once the estimator is ready for it."""
        position = 0
        while self._events:
            event = self._events[0]
            stamp, flags, _ = event.snapshot
            found = np.flatnonzero(stamps[position:] == stamp)
            if not len(found) and stamp > stamps.max():
                break  # in a later block
            self._events.popleft()
            # Where the bag lacks the very sample, it happens before the next one.
            at = position + int(found[0]) if len(found) else _next(stamps, position, stamp)
            if flags & Flag.STARTED:
                if at > position:
                    yield slice(position, at)
                position = at
                self._configure(event)
                self._estimator.reset()
            end = at + 1 if len(found) else at
            if end > position:
                yield slice(position, end)
                position = end
            self._repeat(event)
            if len(found) or self._estimator.latest == stamp:
                self._compare(event.snapshot)
        if position < len(stamps):
            yield slice(position, len(stamps))

    def _repeat(self, event: Event) -> None:
        """Do what was done after the event's sample."""
        _, flags, memory = event.snapshot
        if not flags & Flag.STARTED:
            self._configure(event)
        if flags & Flag.RESET:
            self._estimator.reset()
        self._estimator.freeze(bool(memory.integers[INTEGERS.index(FROZEN)]))

    def _configure(self, event: Event) -> None:
        if not event.changes:
            return
        try:
            self._estimator.configure(event.changes)
        except ConfigurationError as error:
            raise ConfigurationError(
                f'live change of {", ".join(event.changes)}: {error}; -p keeps a parameter fixed, '
                '--afresh repeats no changes'
            ) from None

    def _compare(self, snapshot: Snapshot) -> None:
        ours, theirs = self._estimator.memory.now, snapshot.memory.now
        same = self._estimator.latest == snapshot.stamp and ours.shape == theirs.shape
        if same and np.allclose(ours, theirs, rtol=AGREEMENT, atol=AGREEMENT, equal_nan=True):
            self._same += 1
        else:
            self._other += 1

    def report(self) -> str:
        """Return a line on how far the live estimator was followed."""
        if not self._followed:
            return (
                f"{self._name} not followed: none of its snapshots' stamps is that of a sample; "
                'began afresh at the first'
            )
        begin = 'from the state it had' if self._resumed else 'afresh'
        count = self._same + self._other
        text = f'followed {self._name} {begin} after {self.left_out} samples of the bag'
        text += f'; {self._same} of {count} snapshots are the same to {AGREEMENT:g}'
        if self._other:
            text += ' (parameters differ, or one of the two missed samples)'
        return text


def _next(stamps: NDArray[np.int64], position: int, stamp: int) -> int:
    later = np.flatnonzero(stamps[position:] > stamp)
    return position + int(later[0]) if len(later) else len(stamps)
