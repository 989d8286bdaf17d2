# SPDX-License-Identifier: Apache-2.0
"""The samples of y in a bag, and their estimates."""

from collections.abc import Iterator

from fhaosmo_ros.core.observer.estimates import Trajectory
from fhaosmo_ros.core.observer.status import UNUSED
from fhaosmo_ros.core.online.estimator import OnlineEstimator
from fhaosmo_ros.core.online.events import Event
from fhaosmo_ros.messages.fields import Unwrapper
from fhaosmo_ros.tools.bags.inputs import BagInputs
from fhaosmo_ros.tools.bags.reader import Watch
from fhaosmo_ros.tools.replay.live_run import LiveRun
from fhaosmo_ros.tools.replay.sinks import Rows
import numpy as np

BLOCK = 16_384
"""Samples that are estimated, and written, at a time."""
NONE = np.zeros(0, dtype=np.int64)


class Samples:
    """
    The samples of a bag, and their estimates block by block.

    Parameters
    ----------
    estimator : OnlineEstimator
    live : LiveRun or None
        The live estimator to follow.
    inputs : BagInputs
    whole : bool
        Smooth over the whole recording.
    watch : callable
        See `BagReader.samples`.

    Attributes
    ----------
    span : float
        Seconds from the first sample to the latest.
    stamps : str
        Where the stamps came from, in words.

    Raises
    ------
    ConfigurationError
        The bag lacks a topic or a field, or has no samples.

    """

    def __init__(
        self,
        estimator: OnlineEstimator,
        live: LiveRun | None,
        inputs: BagInputs,
        whole: bool,
        watch: Watch,
    ) -> None:
        self.estimator, self._live, self._whole = estimator, live, whole
        samples, field = inputs.samples(watch)
        self.span = float(samples.stamps[-1] - samples.stamps[0]) * 1e-9
        self.stamps = 'source (publish times of the bag)'
        if np.array_equal(samples.stamps, samples.times):
            self.stamps = 'bag'
        elif field.header and inputs.y.stamp != 'source':
            self.stamps = 'header of the messages'
        if live:
            samples = live.begin(samples)
        if field.wraps:
            unwrap = Unwrapper()
            if estimator.latest is not None:
                unwrap.begin_near(estimator.state_dict()['y'] + estimator.offset)
            samples = samples.unwrapped(unwrap)
        self._samples, self._u = samples, None
        if estimator.observer.uses_input:
            self._u = inputs.at(samples, estimator.inputs, estimator.reject_inputs)
        self._active = 0  # 1 while an event lasts
        self._found: list[tuple[int, Event]] = []

    def __iter__(self) -> Iterator[Rows]:
        """Yield estimates."""
        stamps = self._samples.stamps
        for part in self._live.parts(stamps) if self._live else [slice(0, len(stamps))]:
            for begin in range(part.start, part.stop, BLOCK):
                yield from self._estimate(slice(begin, min(begin + BLOCK, part.stop)))
        if self._whole:
            yield from self._due(self.estimator.finish())

    def _estimate(self, part: slice) -> Iterator[Rows]:
        times, stamps, y = self._samples.part(part)
        estimates = self.estimator.run(stamps, y, None if self._u is None else self._u[part])
        active = self._active + np.zeros(len(times), dtype=np.int64)
        for event in self.estimator.events.taken():
            self._active = int(event.begins)
            active[event.sample :] = self._active
            self._found.append((int(times[event.sample]), event))
        if self.estimator.smoothing is not None:
            yield from self._due(estimates)
            return
        keep = np.flatnonzero((estimates.status & UNUSED) == 0)
        if len(keep):
            if len(keep) < len(times):
                estimates = estimates.rows(keep)
            active = active[keep] if self.estimator.events.on else NONE
            yield Rows(times[keep], y[keep], estimates, active, self._events())

    def _events(self) -> list[tuple[int, Event]]:
        """Return the events found since the last call."""
        found, self._found = self._found, []
        return found

    def _due(self, estimates: Trajectory) -> Iterator[Rows]:
        """Yield the rows whose smoothed estimates are final."""
        smoothing = self.estimator.smoothing
        if smoothing is not None and len(smoothing.numbers):
            numbers = smoothing.numbers
            times, _, y = self._samples
            yield Rows(times[numbers], y[numbers], estimates, NONE, self._events())
