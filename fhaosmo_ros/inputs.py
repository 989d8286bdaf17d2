# SPDX-License-Identifier: Apache-2.0
"""
Which topics and fields an estimator reads, and known inputs at the header stamps of y.

y is ``input_topic``, ``input_type``, ``input_field`` and ``input_stamp``; the known inputs are the
lists ``known_input_topics`` and so on.
"""

from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

from fhaosmo_ros.core.parameters.per_channel import CHANNELS, FROM_JOINTS
from fhaosmo_ros.core.parameters.tables import CHANNEL_PARAMETERS
from fhaosmo_ros.messages.fields import JOINT_STATE
from fhaosmo_ros.topics import FLOAT

PARTS = ('topic', 'type', 'field', 'stamp')
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
    """Return what y is, by the complete parameters of a channel; its name is '' without names."""
    *parts, stamp = (values[f'input_{part}'] for part in PARTS)
    if stamp == 'auto' and 'header' in values['known_input_stamps']:
        stamp = 'header'
    return _input('y', *parts, stamp, channel)


def known_inputs(
    values: Mapping[str, Any], names: Sequence[str], channel: str = ''
) -> dict[str, Input]:
    """
    Return what the known inputs are that the model uses, by their `names` in it; else as for y.

    Raises ConfigurationError for a list with neither one entry nor one for each of them, and for
    inputs by their header's stamp where y is not.
    """
    stamps, by = CHANNEL_PARAMETERS['known_input_stamps'], values['input_stamp']
    if 'header' in values[stamps.name] and by not in ('auto', 'header'):
        raise stamps.error(values[stamps.name], f'reception where input_stamp is {by}')
    columns = []
    for part in PARTS:
        declared = CHANNEL_PARAMETERS[f'known_input_{part}s']
        given: list[str] = values[declared.name]
        if len(given) not in (1, len(names)):
            listed = ', '.join(names)
            raise declared.error(
                given, f'one for each known input that phi uses ({listed}), or one for all'
            )
        columns.append(given if len(given) == len(names) else given * len(names))
    return {
        name: _input(name, *parts, channel) for name, *parts in zip(names, *columns, strict=True)
    }


class Pairing:
    """
    Finds the known inputs of each sample of y, live and in a bag.

    An input by its header's stamp is the newest one that is not stamped after the sample. The
    sample waits until every such input has been seen with its stamp or a later one, because then
    none can come that belongs to it; at most until a sample follows whose stamp is later by
    `known_input_wait`. So the result does not depend on the order in which the messages come, as
    long as none comes later than that. Any other input is the latest one that came before the
    sample. Stamps are in nanoseconds.

    `values` are the parameters of the channel, `names` all known inputs of the model, `known`
    those that it uses, `held` what they are before the first ones come. `by_stamp` is False where
    none has to be paired. `late` inputs came after their sample had been released; `lacking`
    samples waited for one in vain; `ahead` samples were released when all of an input's stamps
    were later than theirs, or the next one by more than max_gap.
    """

    def __init__(
        self,
        values: Mapping[str, Any],
        names: Sequence[str],
        known: Mapping[str, Input],
        held: Sequence[float],
    ) -> None:
        self._wait = round(values['known_input_wait'] * 1e9)
        self._max_gap = round((values['max_gap'] or BACK) * 1e9)
        self._held = list(held)
        paired = [names.index(name) for name, its in known.items() if its.stamp == 'header']
        self.by_stamp = bool(paired)
        self._coming: dict[int, deque[tuple[int, float]]] = {j: deque(maxlen=MOST) for j in paired}
        self._newest = dict.fromkeys(paired, 0)
        self._known: set[int] = set()
        self._waiting: deque[tuple[int, Any, list[float]]] = deque()
        self._done = self.late = self.lacking = self.ahead = 0

    def forget_samples(self) -> None:
        """Drop the samples that wait; inputs stay."""
        self._waiting.clear()
        self._done = 0

    def take_input(self, j: int, stamp: int, u: float) -> None:
        """Take the known input `j`; one with the stamp 0, which nobody fills, holds at once."""
        if j not in self._coming or not stamp:
            self._held[j] = u
            return
        back = self._newest[j] - stamp
        if back > self._max_gap:  # its clock begins again
            self._coming[j].clear()
        elif back > 0:
            self.late += 1
            return
        self._newest[j] = stamp
        self._coming[j].append((stamp, u))
        self.late += 0 <= self._done - stamp <= self._max_gap

    def take_sample(self, stamp: int, sample: Any) -> None:
        """Take a sample of y; those known inputs that are not paired are those of now."""
        self._waiting.append((stamp, sample, self._held.copy()))

    def released(self, at_once: bool = False) -> Iterator[tuple[Any, list[float]]]:
        """Yield the samples that need not wait any more, and their inputs; `at_once`: all."""
        while self._waiting:
            stamp, sample, u = self._waiting[0]
            complete = all(newest >= stamp for newest in self._newest.values())
            if not (
                complete
                or at_once
                or abs(self._waiting[-1][0] - stamp) >= self._wait
                or len(self._waiting) > MOST
            ):
                return
            self.lacking += self._wait > 0 and not complete
            self._waiting.popleft()
            for j, coming in self._coming.items():
                while coming and coming[0][0] <= stamp:
                    self._held[j] = coming.popleft()[1]
                    self._known.add(j)
                if coming and (j not in self._known or coming[0][0] - stamp > self._max_gap):
                    self.ahead += 1
                u[j] = self._held[j]
            self._done = stamp
            yield sample, u


def _input(
    name: str, topic: str, message_type: str, field: str, stamp: str, channel: str
) -> Input:
    """Return an input; one of which nothing is said is a Float64 on the topic of its name."""
    if not (topic or message_type or field):
        message_type = FLOAT
    below = f'{channel}/{name}' if channel else name
    return Input(topic or below, message_type, field, stamp, channel)
