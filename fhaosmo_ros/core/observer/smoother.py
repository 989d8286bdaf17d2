# SPDX-License-Identifier: Apache-2.0
"""Smoothed estimates in the order of their samples, with bounded memory; see smoothing.pyx."""

from typing import Any

from fhaosmo_ros.core.model.inputs import known_inputs
from fhaosmo_ros.core.observer.configuration import DERIVATIVES, Floats
from fhaosmo_ros.core.observer.estimates import Estimate, Trajectory, TUNING
from fhaosmo_ros.core.observer.smoothing import Kind, Passes, POINT
from fhaosmo_ros.core.observer.status import AFRESH, JUMPED, LEVEL_SHIFT, REJECTED, UNUSED
from fhaosmo_ros.core.observer.structure import Record
import numpy as np
from numpy.typing import ArrayLike, NDArray

Ints = NDArray[np.int64]
BLOCK = 2048
"""Rows after which a recording is smoothed as far as later samples no longer matter."""
BEGINNING = 1000
"""
First rows of a recording for which a self-tuning observer's model is what it knows after them.
"""


class Smoother:
    """
    Smoothed estimates of an observer's samples, handed out in their order.

    Memory is bounded: a row is dropped once its estimate is final, `lag` later or, for a whole
    recording, when later samples can no longer change it by more than 1e-9 standard deviations.

    Parameters
    ----------
    observer : Observer
    lag : int, optional
        In nanoseconds; None for all that comes later.
    every : bool
        Samples that were not used have a row, too.

    Attributes
    ----------
    estimate : Estimate or None
        The latest one that was due.
    stamp : int
        Of its sample, in nanoseconds.
    standard_deviation : (n + 1,) array
        Of its errors, as a self-tuning observer expects; NaN with fixed gains.
    tuning : (7,) array
        What it had found by then; NaN with fixed gains.
    numbers : (K,) array
        Which of all samples that were taken the rows are that were handed out last.

    Raises
    ------
    ConfigurationError
        The parameters do not say how large noise and d are.

    """

    def __init__(self, observer: Any, lag: int | None = None, every: bool = False) -> None:
        self._observer, self._lag, self._every = observer, lag, every
        self._expected = {Kind.JUMPS: False, Kind.BEGINS: True}
        self._time: Any = None
        self._taken = 0  # samples so far
        # Of these rows those from `done` on wait to be handed out, those from `passed` on for a
        # self-tuning observer's model, and those from `count` on are room for some more.
        self._rows = np.zeros(0, dtype=POINT)
        self._done = self._passed = self._count = 0
        self._wait = BLOCK
        self.numbers: Ints = np.zeros(0, dtype=np.int64)
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
        # What is due where nothing is.
        self._nothing = np.zeros((0, 1 + self._passes.tunes, self._observer.levels))

    def cut(self) -> None:
        """Let the next row begin: it has nothing to do with those before it, which are due."""
        self._expected[Kind.BEGINS], self.estimate = True, None

    def take(self, found: Trajectory, times: NDArray[Any], u: Floats) -> Trajectory:
        """
        Take the samples of a run; return the rows that are due now.

        Parameters
        ----------
        found : Trajectory
            Of K samples, as the observer estimates them.
        times, u : (K,), (K, m) arrays
            The observer's time after each, in ns if integers, else in s; the inputs until then.

        """
        kept = np.flatnonzero(self._every | ((found.status & UNUSED) == 0))
        kinds, numbers = self._kinds(found.status)[kept], self._taken + kept
        self._taken += len(times)
        found, times, u = found.rows(kept), times[kept], u[kept]
        more = zip(self._waiting, [*found, numbers], strict=True)
        self._waiting = [np.concatenate(pair) for pair in more]
        smoothed = [self._nothing]
        for begin in range(0, len(kept), BLOCK):
            block = slice(begin, begin + BLOCK)
            self._append(found.rows(block), times[block], u[block], kinds[block])
            smoothed.append(self._smoothed())
        return self._handed_out(np.concatenate(smoothed))

    def finish(self) -> Trajectory:
        """Return the rows that still wait: nothing comes after them."""
        smoothed = self._smoothed(ends=True)
        if not self._passed:  # the observer knows nothing but y
            smoothed = self._rows['own'][: self._count, :, : self._observer.levels].copy()
            self._count, self._expected[Kind.BEGINS] = 0, True
        return self._handed_out(smoothed)

    def _kinds(self, status: Ints) -> Ints:
        """
        Return what the rows of samples are, by their status flags.

        A jump of y, and a restart, are those of the next sample that is used.
        """
        kinds: Ints = np.where(status & UNUSED, Kind.UNMEASURED, Kind.MEASURED)
        used = np.flatnonzero(kinds == Kind.MEASURED)
        for kind, flags in ((Kind.JUMPS, JUMPED), (Kind.BEGINS, AFRESH)):
            marks = np.flatnonzero(np.append(self._expected[kind], status & flags)) - 1
            after = np.searchsorted(used, marks)  # the first one used from each mark on
            self._expected[kind] = len(used) in after
            kinds[used[after[after < len(used)]]] = kind
        return kinds

    def _append(self, found: Trajectory, times: NDArray[Any], u: Floats, kinds: Ints) -> None:
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
        else:
            rows['model'] = self._passes.model

    def _smoothed(self, ends: bool = False) -> Floats:
        """Return the estimates that are due now, or all that wait where the recording ends."""
        rows, lag = self._rows[max(self._passed - 1, 0) : self._count], self._lag
        if self._passes.tunes:
            early = lag is None and len(rows) <= BEGINNING and not ends
            if not self._passed and (early or not rows['model']['drive'].any()):
                return self._nothing
            self._complete(rows)
        self._passes.forward(rows)
        self._passed, rows = self._count, self._rows[self._done : self._count]
        end = len(rows)
        if lag is None and not ends:
            end = 0
            if len(rows) >= self._wait:
                end = self._passes.settled(rows)
                self._wait = len(rows) - end + BLOCK
        found: Floats = self._passes.back(rows, end, None if ends else lag)
        self._done += len(found)
        return found

    def _complete(self, rows: NDArray[Any]) -> None:
        """Let what a self-tuning observer knows stand for what it did not know before (D 34)."""
        own, model, numbers = rows['own'], rows['model'], np.arange(len(rows))
        known = model['drive'] > 0.0
        latest = np.maximum.accumulate(np.where(known, numbers, 0))
        if not self._passed:
            first = int(np.argmax(known))
            own[:first, :, 1:] = own[first, :, 1:]
            stands = first if self._lag is not None else max(first, min(BEGINNING, numbers[-1]))
            latest[:stands] = latest[stands]
        model[:] = model[latest]
        # d has not jumped at each of them.
        model['derivatives'][latest != numbers] %= DERIVATIVES + 1

    def _handed_out(self, smoothed: Floats) -> Trajectory:
        """Return the oldest rows with their smoothed estimates; they wait no more."""
        count, n = len(smoothed), self._observer.order
        *columns, self.numbers = (column[:count] for column in self._waiting)
        self._waiting = [column[count:] for column in self._waiting]
        rows = Trajectory(*columns)
        if not count:
            return rows
        rows.z[:], rows.unknown_input[:] = smoothed[:, 0, :n], smoothed[:, 0, n]
        if self._passes.tunes:
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


def smooth(observer: Any, t: ArrayLike, y: ArrayLike, u: ArrayLike | None = None) -> Trajectory:
    """
    Let a fresh observer go forward through samples; estimate each from all of them.

    See `Observer.smooth`.
    """
    whole: Trajectory = observer.run(t, y, u)
    if not observer.started:
        return whole
    first = int(np.argmax((whole.status & REJECTED) == 0))
    u = known_inputs(0.0 if u is None else u, observer.inputs, len(whole.t))
    for k in np.flatnonzero(~np.isfinite(u).all(axis=1)).tolist():  # the last ones are held
        u[k] = u[max(k - 1, first)]
    smoother = Smoother(observer, every=True)
    found = [smoother.take(whole.rows(slice(first, None)), whole.t[first:], u[first:])]
    found.append(smoother.finish())
    for name in ('z', 'unknown_input', 'standard_deviation'):
        getattr(whole, name)[first:] = np.concatenate([getattr(rows, name) for rows in found])
    return whole
