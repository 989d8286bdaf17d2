# SPDX-License-Identifier: Apache-2.0
"""Known inputs at the header stamps of the samples of y: for the node, and for tools."""

from collections import deque
from collections.abc import Iterator, Sequence
from typing import Any

MOST = 1000
"""This many inputs, and samples, are kept at most."""


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
