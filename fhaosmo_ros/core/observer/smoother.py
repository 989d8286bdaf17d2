# SPDX-License-Identifier: Apache-2.0
"""Smoothed estimates in the order of their samples, with bounded memory; see smoothing.pyx."""

from typing import Any

from fhaosmo_ros.core.observer.configuration import DERIVATIVES, Floats
from fhaosmo_ros.core.observer.estimates import Estimate, Trajectory, TUNING
from fhaosmo_ros.core.observer.smoothing import Kind, kinds_of, Passes, POINT
from fhaosmo_ros.core.observer.status import AFRESH, LEVEL_SHIFT
from fhaosmo_ros.core.observer.structure import Record
import numpy as np
from numpy.typing import NDArray

BLOCK = 2048
"""Rows after which a recording is smoothed as far as later samples no longer matter."""
BEGINNING = 1000
"""
First rows of a recording for which a self-tuning observer's model is what it knows after them.
"""


class Smoother:
    """
    Smoothed estimates of an observer's samples, handed out in their order.

    Memory is bounded: a row is dropped once its estimate is final, `lag` (ns) later or, for a
    whole recording, when later samples can no longer change it by more than 1e-9 standard
    deviations. With `every`, samples that were not used have a row, too.

    Attributes
    ----------
    estimate : Estimate or None
        The latest one that was due.
    stamp : int
        Of its sample, in nanoseconds.
    standard_deviation, tuning : (n + 1,), (7,) arrays
        Of its errors, and what a self-tuning observer had found by then; NaN with fixed gains.
    numbers : (K,) array
        Which of all samples that were taken the rows are that were handed out last.

    Raises
    ------
    ConfigurationError
        The parameters do not say how large noise and d are.

    """

    def __init__(self, observer: Any, lag: int | None = None, every: bool = False) -> None:
        self._observer, self._lag, self._every = observer, lag, every
        self._flags = AFRESH  # of samples since the last one that was used
        self._time: Any = None
        self._taken = 0  # samples so far
        # Of these rows those before `done` have been handed out, those before `passed` have been
        # gone through forward, and those from `count` on are room for some more.
        self._rows = np.zeros(0, dtype=POINT)
        self._done = self._passed = self._count = 0
        self._wait = BLOCK
        self.numbers = np.zeros(0, dtype=np.int64)
        found = Record(observer.structure, 0).columns
        self._waiting = [*Trajectory(self.numbers, **found), self.numbers]  # the same rows
        self.estimate: Estimate | None = None
        self.stamp = 0
        self.standard_deviation = np.full(observer.order + 1, np.nan)
        self.tuning = np.full(len(TUNING), np.nan)
        self.configure()

    def configure(self) -> None:
        """Go on with the observer's present parameters; raise as the constructor."""
        self._passes = Passes(self._observer.configuration)

    def cut(self) -> None:
        """Let the next row begin: it has nothing to do with those before it, which are due."""
        self._flags, self.estimate = AFRESH, None

    def take(self, found: Trajectory, times: NDArray[Any], u: Floats) -> Trajectory:
        """
        Take the samples of a run as the observer estimates them; return the rows that are due now.

        `times` are the observer's after each of K samples, (K,), in ns if integers, else in s; `u`
        the inputs until then, (K, m).
        """
        kinds, self._flags = kinds_of(found.status, self._flags)
        kept = np.flatnonzero(self._every | (kinds != Kind.UNMEASURED))
        more = zip(self._waiting, [*found.rows(kept), self._taken + kept], strict=True)
        self._waiting = [np.concatenate(pair) for pair in more]
        self._taken += len(times)
        smoothed = [np.zeros((0, 2, self._observer.levels))]
        for begin in range(0, len(kept), BLOCK):
            block = kept[begin : begin + BLOCK]
            self._append(found.rows(block), times[block], u[block], kinds[block])
            smoothed.append(self._smoothed())
        return self._handed_out(np.concatenate(smoothed))

    def finish(self) -> Trajectory:
        """Return the rows that still wait: nothing comes after them."""
        return self._handed_out(self._smoothed(ends=True))

    def _append(self, found: Trajectory, times: NDArray[Any], u: Floats, kinds: Any) -> None:
        """Append rows; those that have been handed out make room."""
        c, first, more = self._observer.configuration, self._count, len(times)
        if first + more > len(self._rows):
            drop = min(self._done, max(first - 1, 0))  # one goes before those to come
            kept = self._rows[drop:first]
            self._rows = np.concatenate([kept, np.zeros(len(kept) + 2 * more + 64, dtype=POINT)])
            self._done, self._passed, first = self._done - drop, self._passed - drop, len(kept)
        self._count = first + more
        rows, n = self._rows[first : self._count], c.levels
        h = np.diff(times, prepend=times[0] if self._time is None else self._time)
        h, self._time = np.maximum(h * 1e-9 if h.dtype.kind == 'i' else h, 0.0), times[-1]
        rows['h'], rows['time'], rows['kind'], rows['u'][:, : u.shape[1]] = h, times, kinds, u
        rows['y'] = found.z_hat[:, 0] + found.innovation[:, 0]  # less its offset (D 23)
        own, deviations = rows['own'], found.standard_deviation
        own[:, 0, :n], own[:, 1] = found.z_hat, np.inf
        if c.internal:
            own[:, 0, 1:n] = found.z_tilde[:, :-1]
        own[:, 1, : deviations.shape[1]] = deviations**2
        if c.self_tuning:
            own[:, 0, n - DERIVATIVES : n] = 0.0  # those of d are not relied on
            rows['model'] = found.model.view(POINT['model'])[:, 0]

    def _smoothed(self, ends: bool = False) -> Floats:
        """Return the estimates that are due now, or all that wait where the recording ends."""
        none, lag = np.zeros((0, 2, self._observer.levels)), None if ends else self._lag
        rows = self._rows[max(self._passed - 1, 0) : self._count]
        if self._observer.self_tuning and not self._passed:
            known = np.flatnonzero(rows['model']['drive'])
            early = len(known) == 0 or (self._lag is None and len(rows) <= BEGINNING)
            if early and not ends:
                return none
            if len(known):
                self._complete(rows, known)
        self._passes.forward(rows)
        self._passed, rows = self._count, self._rows[self._done : self._count]
        end = len(rows)
        if lag is None and not ends:
            if end < self._wait:
                return none
            end = self._passes.settled(rows)
            self._wait = len(rows) - end + BLOCK
        found: Floats = self._passes.back(rows, end, lag)
        self._done += len(found)
        return found

    def _complete(self, rows: NDArray[Any], known: NDArray[np.intp]) -> None:
        """Let what a self-tuning observer knows stand for what it did not know before (D 34)."""
        own, model, first = rows['own'], rows['model'], known[0]
        stands = first if self._lag is not None else known[known <= max(first, BEGINNING)][-1]
        own[:first, :, 1:], model[:stands] = own[first, :, 1:], model[stands]
        model['derivatives'][:stands] %= DERIVATIVES + 1  # d has not jumped at each of them

    def _handed_out(self, smoothed: Floats) -> Trajectory:
        """Return the oldest rows with their smoothed estimates; they wait no more."""
        count, n = len(smoothed), self._observer.order
        *columns, self.numbers = (column[:count] for column in self._waiting)
        self._waiting = [column[count:] for column in self._waiting]
        rows = Trajectory(*columns)
        if not count:
            return rows
        rows.z[:], rows.unknown_input[:] = smoothed[:, 0, :n], smoothed[:, 0, n]
        if self._observer.self_tuning:
            rows.standard_deviation[:] = np.sqrt(smoothed[:, 1, : n + 1])
            self.standard_deviation, self.tuning = rows.standard_deviation[-1], rows.tuning[-1]
        self.stamp, self.estimate = int(rows.t[-1]), None
        began = (self._rows['kind'][self._done : self._passed] == Kind.BEGINS).any()
        if self._done and not began:  # else nothing is due yet since the restart
            word = int(rows.status[-1]) | int(rows.open_levels[-1]) << LEVEL_SHIFT
            self.estimate = Estimate(
                rows.z[-1], rows.unknown_input[-1], rows.gamma[-1], rows.innovation[-1], word
            )
        return rows
