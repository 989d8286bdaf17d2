# SPDX-License-Identifier: Apache-2.0
"""
Which topics and fields an estimator reads, and known inputs at the header stamps of y.

y is ``input_topic``, ``input_type``, ``input_field`` and ``input_stamp``; the known inputs are the
lists ``known_input_topics`` and so on.
"""

from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

from fhaosmo_ros.core.parameters.declaration import Parameter
from fhaosmo_ros.core.parameters.per_channel import CHANNELS, FROM_JOINTS
from fhaosmo_ros.core.parameters.tables import CHANNEL_PARAMETERS
from fhaosmo_ros.messages.fields import JOINT_STATE
from fhaosmo_ros.topics import FLOAT

BACK = 0.5
"""Seconds by which stamps of a known input go back if its clock does, where max_gap is 0."""
MOST = 1000
"""This many inputs, and samples, are kept at most to be paired."""


class Input(NamedTuple):
    """A number that an estimator reads."""

    topic: str  # as the user wrote it: below the node's namespace, unless it begins with /
    message_type: str  # '' if it is the one that the topic has
    field: str  # '' for the only number
    stamp: str  # auto, header, source or reception; of a known input header or reception
    name: str  # of the channel: the element of a list that is meant where the field has no index

    def absolute(self, namespace: str) -> str:
        """Return the topic's full name in a namespace such as '/rig' ('' or '/' for none)."""
        if self.topic.startswith('/'):
            return self.topic
        return f'/{namespace.strip("/")}/{self.topic}'.replace('//', '/')


def with_joints(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return values to which the topic and type are added that `FROM_JOINTS` stands for."""
    result = dict(values)
    names = values.get(CHANNELS)  # not checked yet
    if ([names] if isinstance(names, str) else names) == FROM_JOINTS:
        for name, value in (('input_topic', 'joint_states'), ('input_type', JOINT_STATE)):
            result[name] = result.get(name) or value
    return result


def measured_output(values: Mapping[str, Any], channel: str = '') -> Input:
    """
    Return what y is.

    Parameters
    ----------
    values : mapping
        Parameters of the channel; defaults for those that are absent.
    channel : str
        Its name, '' without named channels.

    """
    topic, kind, field, stamp = (
        _value(values, f'input_{part}') for part in ('topic', 'type', 'field', 'stamp')
    )
    if stamp == 'auto' and 'header' in _value(values, 'known_input_stamps'):
        stamp = 'header'
    return _input('y', topic, kind, field, stamp, channel)


def known_inputs(
    values: Mapping[str, Any], names: Sequence[str], channel: str = ''
) -> dict[str, Input]:
    """
    Return what the known inputs are, by their names in the model.

    Parameters
    ----------
    values, channel
        As for `measured_output`.
    names : sequence of str
        Of the known inputs that the model uses, such as ``['u']``.

    Raises
    ------
    ConfigurationError
        A list with neither one entry nor one for each known input, or inputs by their header's
        stamp where y is not.

    """
    stamps, by = CHANNEL_PARAMETERS['known_input_stamps'], _value(values, 'input_stamp')
    given = _value(values, stamps.name)
    if 'header' in given and by not in ('auto', 'header'):
        raise stamps.error(given, f'reception where input_stamp is {by}')
    columns = [
        _one_each(CHANNEL_PARAMETERS[f'known_input_{part}'], values, names)
        for part in ('topics', 'types', 'fields', 'stamps')
    ]
    return {
        name: _input(name, *parts, channel) for name, *parts in zip(names, *columns, strict=True)
    }


class StampPairing:
    """
    Finds for each sample of y, of every known input, the newest one not stamped after the sample.

    A sample waits until every paired input has been seen with its stamp or a later one, because
    then none can come that belongs to it. It waits at most until a sample follows whose stamp is
    later by `wait`. So the result does not depend on the order in which the messages come, as
    long as none comes later than that. Stamps are in nanoseconds.

    Parameters
    ----------
    by_stamp : sequence of bool
        Of each known input: True if it is paired, False if it holds from its arrival on.
    wait : int
        0: samples do not wait, and inputs that have not come yet are late.
    max_gap : int
        An input whose stamp goes back by more than that begins a new time.
    held : sequence of float
        The known inputs before the first one of each has come.

    Attributes
    ----------
    late, ahead : int
        Inputs that came after their sample had been released; samples that were released when
        all of an input's stamps were later than theirs.

    """

    def __init__(
        self, by_stamp: Sequence[bool], wait: int, max_gap: int, held: Sequence[float]
    ) -> None:
        self._columns = [j for j, paired in enumerate(by_stamp) if paired]
        self._wait, self._max_gap, self._held = wait, max_gap, list(held)
        self._coming: dict[int, deque[tuple[int, float]]] = {
            j: deque(maxlen=MOST) for j in self._columns
        }
        self._newest: dict[int, int] = {}
        self._known: set[int] = set()
        self._waiting: deque[tuple[int, Any, list[float]]] = deque()
        self._done: int | None = None
        self.late = self.ahead = 0

    def forget_samples(self) -> None:
        """Drop the samples that wait; inputs stay."""
        self._waiting.clear()
        self._done = None

    def take_input(self, j: int, stamp: int, u: float) -> None:
        """Take the known input `j`; one with the stamp 0, which nobody fills, holds at once."""
        if j not in self._coming or not stamp:
            self._held[j] = u
            return
        coming, newest = self._coming[j], self._newest.get(j, stamp)
        if stamp < newest - self._max_gap:
            coming.clear()
        elif stamp < newest:
            self.late += 1
            return
        self._newest[j] = stamp
        coming.append((stamp, u))
        if self._done is not None and 0 <= self._done - stamp <= self._max_gap:
            self.late += 1

    def take_sample(self, stamp: int, sample: Any) -> None:
        """Take a sample of y; those known inputs that are not paired are those of now."""
        self._waiting.append((stamp, sample, self._held.copy()))

    def released(self, at_once: bool = False) -> Iterator[tuple[Any, list[float]]]:
        """Yield the samples that need not wait any more, and their inputs; `at_once`: all."""
        while self._waiting:
            stamp, sample, u = self._waiting[0]
            newest = self._waiting[-1][0]
            if not (
                at_once
                or abs(newest - stamp) >= self._wait
                or len(self._waiting) > MOST
                or all(self._newest.get(j, stamp - 1) >= stamp for j in self._columns)
            ):
                return
            self._waiting.popleft()
            for j in self._columns:
                u[j] = self._at(j, stamp)
            self._done = stamp
            yield sample, u

    def _at(self, j: int, stamp: int) -> float:
        coming = self._coming[j]
        while coming and coming[0][0] <= stamp:
            self._held[j] = coming.popleft()[1]
            self._known.add(j)
        self.ahead += bool(coming) and j not in self._known
        return self._held[j]


def make_pairing(
    values: Mapping[str, Any],
    names: Sequence[str],
    known: Mapping[str, Input],
    held: Sequence[float],
) -> StampPairing | None:
    """
    Return what pairs known inputs with samples by their headers' stamps; None without such inputs.

    Parameters
    ----------
    values : mapping
        Parameters of the channel.
    names : sequence of str
        All known inputs of the model.
    known : mapping of str to Input
        Those that it uses.
    held : sequence of float
        What they are before the first ones come.

    """
    by_stamp = [name in known and known[name].stamp == 'header' for name in names]
    if not any(by_stamp):
        return None
    wait = round(_value(values, 'known_input_wait') * 1e9)
    max_gap = round((_value(values, 'max_gap') or BACK) * 1e9)
    return StampPairing(by_stamp, wait, max_gap, held)


def _value(values: Mapping[str, Any], name: str) -> Any:
    return values.get(name, CHANNEL_PARAMETERS[name].default)


def _one_each(declared: Parameter, values: Mapping[str, Any], names: Sequence[str]) -> list[str]:
    given: list[str] = _value(values, declared.name)
    if len(given) == 1:
        return given * len(names)
    if len(given) != len(names):
        raise declared.error(
            given, f'one for each known input that phi uses ({", ".join(names)}), or one for all'
        )
    return given


def _input(
    name: str, topic: str, message_type: str, field: str, stamp: str, channel: str
) -> Input:
    """Return an input; one of which nothing is said is a Float64 on the topic of its name."""
    if not (topic or message_type or field):
        message_type = FLOAT
    below = f'{channel}/{name}' if channel else name
    return Input(topic or below, message_type, field, stamp, channel)
