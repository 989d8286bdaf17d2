# SPDX-License-Identifier: Apache-2.0
"""The samples of y in a bag, and their estimates."""

from collections.abc import Iterator

from fhaosmo_ros.core.observer.estimates import Trajectory
from fhaosmo_ros.core.observer.status import UNUSED
from fhaosmo_ros.core.online.estimator import OnlineEstimator
from fhaosmo_ros.core.online.events import Event
from fhaosmo_ros.core.parameters.errors import ConfigurationError
from fhaosmo_ros.messages.fields import Unwrapper
from fhaosmo_ros.tools.bags.known_inputs import with_inputs
from fhaosmo_ros.tools.bags.reader import BagReader, Block
from fhaosmo_ros.tools.cli.options import BagInputs
from fhaosmo_ros.tools.replay.live_run import LiveRun
from fhaosmo_ros.tools.replay.sinks import Rows
import numpy as np


class Samples:
    """
    The estimates of a bag's samples, block by block.

    Parameters
    ----------
    reader : BagReader
    estimator : OnlineEstimator
    live : LiveRun or None
        The live estimator to follow.
    inputs : BagInputs
    whole : bool
        Smooth over the whole recording.

    """

    def __init__(
        self,
        reader: BagReader,
        estimator: OnlineEstimator,
        live: LiveRun | None,
        inputs: BagInputs,
        whole: bool,
    ) -> None:
        self._inputs = inputs
        y, self._stamp = inputs.y, inputs.stamp
        self.estimator, self._topic, self._live = estimator, y.topic, live
        self._reader, self._whole = reader, whole
        self._field = reader.field(y.topic, y.field, y.name)
        if self._stamp == 'auto' and not self._field.header:
            # An estimator that used its clock took a sample when it came, not when it was sent.
            self._stamp = 'bag' if estimator.parameters['sampling'] == 'clock' else 'auto'
        self._other_than_bag = False
        self._tells, self._active = estimator.events.on, 0  # 1 while an event lasts
        self._found: list[tuple[int, Event]] = []
        self._waiting, self._dropped = np.zeros((2, 0), dtype=np.int64), 0  # to be smoothed
        self._first: int | None = None
        self._latest = 0

    @property
    def total(self) -> int:
        """Number of samples in the bag."""
        return self._reader.count(self._topic)

    @property
    def span(self) -> float:
        """Seconds from the first sample to the latest."""
        return 0.0 if self._first is None else (self._latest - self._first) * 1e-9

    @property
    def stamps(self) -> str:
        """Where the stamps came from, in words."""
        if not self._other_than_bag:
            return 'bag'
        from_header = self._field.header and self._stamp != 'source'
        return 'header of the messages' if from_header else 'source (publish times of the bag)'

    def __iter__(self) -> Iterator[tuple[int, list[Rows]]]:
        """Yield the number of samples taken, and their estimates."""
        blocks = map(self._noted, self._reader.blocks(self._topic, self._field, self._stamp))
        if self._live:
            blocks = self._live.begin(blocks)
        blocks = (block for block in blocks if len(block.times))
        if self._field.wraps:
            blocks = self._continuous(blocks)
        pairs = ((block, None) for block in blocks)
        estimator, known = self.estimator, self._inputs
        if estimator.observer.uses_input:
            pairs = with_inputs(
                blocks, self._reader, estimator.observer.model, known.u, known.values,
                lambda: estimator.inputs, estimator.reject_inputs,
            )  # fmt: skip
        for block, u in pairs:
            yield len(block.times), list(self._rows(block, u))
        if self._whole:
            yield 0, list(self._due(self.estimator.finish()))
        if self._first is None:
            why = next(iter(self._reader.lacking), 'expected messages, read none')
            raise ConfigurationError(f'topic {self._topic!r}: {why}')

    def _continuous(self, blocks: Iterator[Block]) -> Iterator[Block]:
        """Yield the blocks with the angle continuous, from the live estimator's y on."""
        unwrap = Unwrapper()
        for k, block in enumerate(blocks):
            if k == 0 and self.estimator.latest is not None:
                unwrap.begin_near(self.estimator.state_dict()['y'] + self.estimator.offset)
            values = np.array([unwrap(value) for value in block.values.tolist()])
            yield block._replace(values=values)

    def _noted(self, block: Block) -> Block:
        """Return a block, and remember what to say of it."""
        self._other_than_bag |= bool((block.stamps != block.times).any())
        if self._first is None:
            self._first = int(block.stamps[0])
        self._latest = int(block.stamps[-1])
        return block

    def _rows(self, block: Block, u: np.ndarray | None) -> Iterator[Rows]:
        whole = [slice(0, len(block.times))]
        for part in self._live.parts(block.stamps) if self._live else whole:
            inputs = None if u is None else u[part]
            if part.start < part.stop:
                yield from self._estimate(Block(*(column[part] for column in block)), inputs)

    def _estimate(self, block: Block, u: np.ndarray | None) -> Iterator[Rows]:
        estimates = self.estimator.run(block.stamps, block.values, u)
        active = self._active + np.zeros(len(block.times), dtype=np.int64)
        for event in self.estimator.events.taken():
            self._active = int(event.begins)
            active[event.sample :] = self._active
            self._found.append((int(block.times[event.sample]), event))
        if self.estimator.smooths:
            self._waiting = np.append(self._waiting, [block.times, block.values.view(np.int64)], 1)
            yield from self._due(estimates)
            return
        keep = np.flatnonzero((estimates.status & UNUSED) == 0)
        if len(keep):
            if len(keep) < len(block.times):
                estimates = estimates.rows(keep)
            active = active[keep] if self._tells else active[:0]
            yield Rows(block.times[keep], block.values[keep], estimates, active, self._events())

    def _events(self) -> list[tuple[int, Event]]:
        """Return the events found since the last call."""
        found, self._found = self._found, []
        return found

    def _due(self, estimates: Trajectory) -> Iterator[Rows]:
        """Yield the rows whose smoothed estimates are final, with the samples that waited."""
        numbers = self.estimator.due
        if len(numbers):
            times, y = self._waiting[:, numbers - self._dropped]
            none = np.zeros(0, dtype=np.int64)
            yield Rows(times, y.view(np.float64), estimates, none, self._events())
            self._waiting = self._waiting[:, numbers[-1] + 1 - self._dropped :]
            self._dropped = int(numbers[-1]) + 1
