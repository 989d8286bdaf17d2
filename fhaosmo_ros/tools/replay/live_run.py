# SPDX-License-Identifier: Apache-2.0
"""Following a live estimator through a bag: the same first sample, resets and live changes."""

from collections.abc import Collection, Iterator
from typing import Any, NamedTuple

from fhaosmo_ros.core.online.estimator import OnlineEstimator
from fhaosmo_ros.core.online.snapshots import Flag, Snapshot, unpack
from fhaosmo_ros.core.parameters.errors import ConfigurationError
from fhaosmo_ros.core.parameters.per_channel import split
from fhaosmo_ros.core.parameters.tables import ONLINE_PARAMETERS
from fhaosmo_ros.tools.bags.reader import BagReader, Samples
from fhaosmo_ros.topics import SNAPSHOT
import numpy as np
from numpy.typing import NDArray

EVENTS = '/parameter_events'
BLOCK = 16_384
"""Samples that are searched for a stamp at a time."""
AGREEMENT = 1e-12
"""Relative or absolute difference up to which two memories count as the same."""
COMPARED = 'z_hat', 'z_tilde', 'p', 'q', 'gamma', 'y', 'pending'
"""What snapshots of every version hold of a state."""


class Event(NamedTuple):
    """A snapshot of the live estimator, and the parameters that changed before it."""

    snapshot: Snapshot
    changes: dict[str, Any]


def find_estimator(reader: BagReader, node: str, channel: str) -> str | None:
    """Return the live estimator whose snapshots a bag has; of several that of node and channel."""
    found = reader.names_above(SNAPSHOT)
    for part in (node.strip('/'), channel):
        found = [name for name in found if f'/{part}/' in f'{name}/'] or found
    if len(found) > 1:
        raise ConfigurationError(
            'expected --node and --channel of one of the live estimators in the bag '
            f'({", ".join(found)}), or --afresh'
        )
    return found[0] if found else None


class LiveRun:
    """
    Repeats at an estimator what was done to a live one, at the same samples.

    `name` is the full name of the live one's node, followed by the channel's if it has channels.
    Live changes of the parameters `fixed` are not repeated.
    """

    def __init__(
        self, reader: BagReader, name: str, estimator: OnlineEstimator, fixed: Collection[str]
    ) -> None:
        self._name, self._estimator = name, estimator
        self._events = _read_events(reader, name, fixed)
        self._begin = ''  # how and where it began
        self._same: list[bool] = []  # whether snapshots are

    def begin(self, samples: Samples) -> Samples:
        """Return the samples from the first one at which a snapshot tells the live state."""
        estimator, changes = self._estimator, dict[str, Any]()
        while self._events:
            event = self._events.pop(0)
            stamp, flags, values = event.snapshot
            changes |= event.changes
            found = np.flatnonzero(samples.stamps == stamp)
            if not len(found):
                continue
            first, how, unfit = int(found[0]), '', ''
            if flags & Flag.STARTED:
                # First sample of the live estimator, or first after a restart: it may hold inputs.
                held = np.ravel(values.get('u', ()))
                for index, u in enumerate(held[: len(estimator.inputs)].tolist()):
                    estimator.set_input(u, index)
                self._events.insert(0, event._replace(changes=changes))
            else:
                self._configure(changes)
                try:
                    estimator.load_state_dict(values)
                    how = 'from the state it had'
                    first += 1  # the snapshot is what it was after this one
                except ConfigurationError as error:  # as of an observer of another size
                    unfit = f'; its state does not fit ({error})'
            self._begin = f'{how or "afresh"} after {first} samples of the bag{unfit}'
            return samples.part(slice(first, None))
        return samples

    def parts(self, stamps: NDArray[np.int64]) -> Iterator[slice]:
        """
        Yield parts of the samples; in between, do what was done to the live estimator there.

        A part may be empty.
        """
        position, estimator = 0, self._estimator
        for event in self._events:
            stamp, flags, values = event.snapshot
            # If the bag lacks that sample, the event takes place before the next one.
            at, found = _find(stamps, position, stamp)
            begins = at if flags & Flag.STARTED else at + found
            yield slice(position, begins)
            self._configure(event.changes)
            if flags & Flag.STARTED:
                estimator.reset()
            position = at + found
            yield slice(begins, position)
            if flags & Flag.RESET:
                estimator.reset()
            if found or estimator.latest == stamp:
                ours, theirs = (
                    np.concatenate([np.ravel(memory.get(name, ())) for name in COMPARED])
                    for memory in (estimator.state_dict(), values)
                )
                alike = estimator.latest == stamp and ours.shape == theirs.shape
                near = {'rtol': AGREEMENT, 'atol': AGREEMENT, 'equal_nan': True}
                self._same.append(alike and np.allclose(ours, theirs, **near))
        yield slice(position, len(stamps))

    def _configure(self, changes: dict[str, Any]) -> None:
        try:
            if changes:
                self._estimator.configure(changes)
        except ConfigurationError as error:
            raise ConfigurationError(
                f'live change of {", ".join(changes)}: {error}; -p keeps a parameter fixed, '
                '--afresh repeats no changes'
            ) from None

    def report(self) -> str:
        """Return a line that says how far the live estimator was followed."""
        if not self._begin:
            return (
                f"{self._name} not followed: none of its snapshots' stamps is that of a sample; "
                'began afresh at the first'
            )
        same, count = sum(self._same), len(self._same)
        differs = ' (parameters differ, or one of the two missed samples)' * (same < count)
        return (
            f'followed {self._name} {self._begin}; {same} of {count} snapshots are the same to '
            f'{AGREEMENT:g}{differs}'
        )


def _find(stamps: NDArray[np.int64], position: int, stamp: int) -> tuple[int, bool]:
    """Return where a stamp is, else where the first later one is, and which of the two it is."""
    for begin in range(position, len(stamps), BLOCK):
        block = stamps[begin : begin + BLOCK]
        for found, wanted in ((True, block == stamp), (False, block > stamp)):
            if wanted.any():
                return begin + int(wanted.argmax()), found
    return len(stamps), False


def _read_events(reader: BagReader, name: str, fixed: Collection[str]) -> list[Event]:
    """Return the events of a live estimator in order."""
    events: list[Event] = []
    changes: dict[str, Any] = {}
    for topic, _, message in reader.read_all([f'{name}/{SNAPSHOT}', EVENTS]):
        if topic == EVENTS:
            node, channel = message.node, name.removeprefix(message.node).strip('/')
            if name == node or name.startswith(f'{node}/'):
                for parameter in message.changed_parameters:
                    of_channel, key = split(parameter.name)
                    if of_channel == channel and key in ONLINE_PARAMETERS and key not in fixed:
                        # The number of the type, and behind it a value of each type in order.
                        given = [*vars(parameter.value).values()]
                        changes[key] = ONLINE_PARAMETERS[key].coerce(given[given[0]])
            continue
        try:
            snapshot = unpack(message.data, message.layout.dim[0].label.split(','))
        except (IndexError, ConfigurationError) as error:
            raise ConfigurationError(
                f'topic {topic!r}: {error}; --afresh does without it'
            ) from None
        # The node publishes the change first, then the snapshot.
        took_them = not events or snapshot.flags & (Flag.CHANGED | Flag.STARTED)
        events.append(Event(snapshot, changes if took_them else {}))
        if took_them:
            changes = {}
    return events
