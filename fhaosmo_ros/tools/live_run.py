# SPDX-License-Identifier: Apache-2.0
"""Following a live estimator through a bag: the same first sample, resets and live changes."""

from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from itertools import chain
from typing import Any, NamedTuple

from fhaosmo_ros.core.errors import ConfigurationError
from fhaosmo_ros.core.online import OnlineEstimator
from fhaosmo_ros.core.parameters import ONLINE_PARAMETERS
from fhaosmo_ros.core.snapshot import Flag, Snapshot, unpack
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
    """What the live estimator told of one sample: its state, and what it did before it."""

    time: int
    snapshot: Snapshot
    changes: dict[str, Any]


def find_estimator(reader: BagReader, name: str | None) -> str | None:
    """
    Return the name of the estimator to follow: the one given, or the only one in the bag.

    Raises
    ------
    ConfigurationError
        The one given has no snapshots in the bag, or there are several to choose from.

    """
    found = sorted(
        c.topic.removesuffix(f'/{TOPIC}') for c in reader.connections
        if c.topic.endswith(f'/{TOPIC}') and c.msgcount
    )  # fmt: skip
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
        Full name of the estimator's node.
    fixed : iterable of str
        Parameters whose live changes are not to be repeated.

    """
    events: list[Event] = []
    changes: dict[str, Any] = {}
    topics = {f'{name}/{TOPIC}', EVENTS} & {c.topic for c in reader.connections}
    for topic, time, message in reader.few(topics):
        if topic == EVENTS:
            own = message.node == name
            if own or name.startswith(f'{message.node}/'):  # a channel of that node
                prefix = '' if own else name.removeprefix(f'{message.node}/') + '.'
                changes |= _changes(message.changed_parameters, prefix, set(fixed))
            continue
        try:
            snapshot = unpack(message.data)
        except ValueError as error:
            raise ConfigurationError(
                f'topic {topic!r}: expected snapshots of this version ({error}); --afresh does '
                'without them'
            ) from None
        # The node publishes the change first, then the snapshot of the first sample after it.
        took_them = not events or snapshot.flags & (Flag.CHANGED | Flag.STARTED)
        events.append(Event(time, snapshot, changes if took_them else {}))
        if took_them:
            changes = {}
    return events


def _changes(parameters: Sequence[Any], prefix: str, fixed: set[str]) -> dict[str, Any]:
    values = {}
    for parameter in parameters:
        name = parameter.name.removeprefix(prefix)
        known = parameter.name.startswith(prefix) and name in ONLINE_PARAMETERS
        if known and name not in fixed:
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
        self._largest = 0.0

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
        """Return True if the state after the event's sample is now the estimator's too."""
        if event.snapshot.flags & Flag.STARTED:
            return False  # the sample itself is the first
        self._configure(event)
        self._estimator.freeze(bool(event.snapshot.flags & Flag.FROZEN))
        self._events.popleft()
        try:
            snapshot = event.snapshot
            self._estimator.resume(snapshot.stamp, snapshot.state, snapshot.timing)
        except ConfigurationError:  # an observer of another size starts there
            return False
        self._resumed = True
        return True

    def parts(self, stamps: NDArray[np.int64]) -> Iterator[slice]:
        """Yield parts of a block, each once the estimator is ready for it."""
        position = 0
        while self._events:
            event = self._events[0]
            found = np.flatnonzero(stamps[position:] == event.snapshot.stamp)
            if not len(found) and event.snapshot.stamp > stamps.max():
                break  # in a later block
            self._events.popleft()
            # Where the bag lacks the very sample, the next one has to do.
            at = position + int(found[0]) if len(found) else _next(stamps, position, event)
            if event.snapshot.flags:
                if at > position:
                    yield slice(position, at)
                position = at
                self._repeat(event)
            if len(found):
                yield slice(position, at + 1)
                position = at + 1
                self._compare(event.snapshot)
        if position < len(stamps):
            yield slice(position, len(stamps))

    def _repeat(self, event: Event) -> None:
        self._configure(event)
        if event.snapshot.flags & Flag.STARTED:
            self._estimator.reset()
        self._estimator.freeze(bool(event.snapshot.flags & Flag.FROZEN))

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
        ours, theirs = self._estimator.observer.state, snapshot.state
        if self._estimator.stamp != snapshot.stamp or ours.levels.shape != theirs.levels.shape:
            self._other += 1
            return
        a = np.concatenate([ours.levels.ravel(), ours.memory])
        b = np.concatenate([theirs.levels.ravel(), theirs.memory])
        if np.allclose(a, b, rtol=AGREEMENT, atol=AGREEMENT):
            self._same += 1
        else:
            self._other += 1
            self._largest = max(self._largest, float(np.abs(a - b).max()))

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


def _next(stamps: NDArray[np.int64], position: int, event: Event) -> int:
    later = np.flatnonzero(stamps[position:] > event.snapshot.stamp)
    return position + int(later[0]) if len(later) else len(stamps)
