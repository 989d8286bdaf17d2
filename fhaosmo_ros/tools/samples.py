# SPDX-License-Identifier: Apache-2.0
"""A bag's samples of y, and the estimates of them."""

import argparse
from collections.abc import Iterator

from fhaosmo_ros.core.errors import ConfigurationError
from fhaosmo_ros.core.online import OnlineEstimator
from fhaosmo_ros.core.status import REJECTED
from fhaosmo_ros.tools.bag_reader import BagReader, Block
from fhaosmo_ros.tools.held_input import HeldInput
from fhaosmo_ros.tools.live_run import LiveRun
from fhaosmo_ros.tools.sinks import Rows
import numpy as np


class Samples:
    """The estimates of a bag's samples, block by block."""

    def __init__(
        self, reader: BagReader, estimator: OnlineEstimator, live: LiveRun | None,
        arguments: argparse.Namespace,
    ) -> None:  # fmt: skip
        topic = arguments.topic
        self.estimator, self.topic, self._live = estimator, topic, live
        self._reader, self._backwards = reader, arguments.backwards == 'error'
        self._every, self._seen, self._taken = arguments.every, 0, 0
        self._field = reader.field(topic, arguments.field)
        self._use_header = self._field.has_header and arguments.stamp != 'bag'
        if arguments.stamp == 'header' and not self._field.has_header:
            raise ConfigurationError(
                f'--stamp header: expected messages with a header on {topic}, '
                f'got {reader.message_type(topic)}'
            )
        self._input = None
        if estimator.observer.uses_input:
            self._input = HeldInput(
                reader, arguments.input_topic, arguments.input_field, estimator.reject_inputs
            )
        self._first: int | None = None
        self._latest: int | None = None

    @property
    def total(self) -> int:
        """Number of samples in the bag."""
        return self._reader.count(self.topic)

    @property
    def span(self) -> float:
        """Seconds from the first sample to the latest."""
        return 0.0 if self._first is None else (self._latest - self._first) * 1e-9

    def __iter__(self) -> Iterator[tuple[int, list[Rows]]]:
        """Yield the number of samples taken, and their estimates."""
        blocks = self._checked()
        if self._live:
            blocks = self._live.begin(blocks)
        for block in blocks:
            if len(block.times):
                u = self._input(block.times) if self._input else np.zeros(len(block.times))
                yield len(block.times), list(self._rows(block, u))
        if not self._taken:
            raise ConfigurationError(
                f'topic {self.topic!r}: expected messages, read none although the bag lists them'
            )

    def _checked(self) -> Iterator[Block]:
        for block in self._reader.blocks(self.topic, self._field, self._use_header):
            if len(block.times):
                self._check(block)
                yield block

    def _check(self, block: Block) -> None:
        stamps = block.stamps
        if self._first is None:
            self._first = self._latest = int(stamps[0])
        previous = np.concatenate([[self._latest], stamps[:-1]])
        back = np.flatnonzero(stamps < previous)
        if len(back) and self._backwards and self.estimator.uses_stamps:
            k = int(back[0])
            raise ConfigurationError(
                f'topic {self.topic!r}: expected stamps that never go back, got {stamps[k]} '
                f'after {previous[k]} (sample {self._taken + k + 1}); --backwards reject treats '
                'them as the live node does'
            )
        self._latest = int(stamps[-1])
        self._taken += len(stamps)

    def _rows(self, block: Block, u: np.ndarray) -> Iterator[Rows]:
        whole = [slice(0, len(block.times))]
        for part in self._live.parts(block.stamps) if self._live else whole:
            yield from self._estimate(Block(*(column[part] for column in block)), u[part])

    def _estimate(self, block: Block, u: np.ndarray) -> Iterator[Rows]:
        estimates = self.estimator.run(block.stamps, block.values, u)
        keep = np.flatnonzero((estimates.status & REJECTED) == 0)
        count = len(keep)
        keep = keep[(self._every - 1 - self._seen) % self._every :: self._every]
        self._seen += count
        if len(keep):
            if len(keep) < len(block.times):
                estimates = type(estimates)(*(a[keep] for a in estimates))
            yield Rows(block.times[keep], block.values[keep], estimates)
