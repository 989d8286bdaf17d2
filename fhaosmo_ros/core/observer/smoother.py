# SPDX-License-Identifier: Apache-2.0
"""Smoothed estimates in the order of their samples, with bounded memory; see smoothing.pyx."""

from typing import Any

from fhaosmo_ros.core.model.inputs import known_inputs
from fhaosmo_ros.core.observer.configuration import DERIVATIVES, Floats
from fhaosmo_ros.core.observer.estimates import Estimate, Trajectory, TUNING
from fhaosmo_ros.core.observer.smoothing import BEGINS, JUMPS, MEASURED, Rows, UNMEASURED
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
        self._rows, self._wait = Rows(observer.configuration), BLOCK
        self._expected = {JUMPS: 0, BEGINS: 1}
        self._held: list[NDArray[Any]] = []  # rows that wait for a self-tuning observer's model
        self._model: Floats | None = None  # the latest one
        self._time: Any = None
        self._taken = 0
        nothing: Ints = np.zeros(0, dtype=np.int64)
        self._found = Trajectory(nothing, **Record(observer.structure, 0).columns)  # they wait
        self._numbers = self.numbers = nothing
        self.estimate: Estimate | None = None
        self.stamp = 0
        self.standard_deviation = np.full(observer.order + 1, np.nan)
        self.tuning = np.full(len(TUNING), np.nan)

    def configure(self) -> None:
        """Go on with the observer's present parameters; raise as the constructor."""
        self._rows.configure(self._observer.configuration)

    def cut(self) -> None:
        """Let the next row begin: it has nothing to do with those before it, which are due."""
        self._expected[BEGINS], self.estimate = 1, None

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
        kinds = self._kinds(found.status)
        kept = np.flatnonzero(self._every | ((found.status & UNUSED) == 0))
        numbers, smoothed = self._taken + kept, []
        self._taken += len(times)
        found, times, u, kinds = found.rows(kept), times[kept], u[kept], kinds[kept]
        for begin in range(0, max(len(kept), 1), BLOCK):
            block = slice(begin, begin + BLOCK)
            if len(kept):
                self._hold(found.rows(block), times[block], u[block], kinds[block])
            end = self._rows.count
            if self._lag is None:
                end = self._rows.done
                if self._rows.count - end >= self._wait:
                    end = self._rows.settled()
                    self._wait = self._rows.count - end + BLOCK
            smoothed.append(self._rows.smooth(end, self._lag))
        self._found = Trajectory._make(map(np.concatenate, zip(self._found, found, strict=True)))
        self._numbers = np.concatenate([self._numbers, numbers])
        return self._handed_out(np.concatenate(smoothed))

    def finish(self) -> Trajectory:
        """Return the rows that still wait: nothing comes after them."""
        if self._held and not self._held[-1].any():  # the observer knows nothing but y
            smoothed, self._held = self._held[0], []
        else:
            self._go()
            smoothed = self._rows.smooth(self._rows.count)
        return self._handed_out(smoothed)

    def _kinds(self, status: Ints) -> Ints:
        """
        Return what the rows of samples are, by their status flags.

        A jump of y, and a restart, are those of the next sample that is used.
        """
        kinds: Ints = np.where(status & UNUSED, UNMEASURED, MEASURED)
        used = np.flatnonzero(kinds == MEASURED)
        for kind, flags in ((JUMPS, JUMPED), (BEGINS, AFRESH)):
            marks = self._expected[kind] + np.cumsum((status & flags) > 0)
            kinds[used[np.diff(marks[used], prepend=0) > 0]] = kind
            latest = marks[used[-1]] if len(used) else 0
            self._expected[kind] = int(len(status) > 0 and marks[-1] > latest)
        return kinds

    def _hold(self, found: Trajectory, times: NDArray[Any], u: Floats, kinds: Ints) -> None:
        """Append rows; a self-tuning observer's wait until it knows a model."""
        h = np.diff(times, prepend=times[0] if self._time is None else self._time)
        h, self._time = h * 1e-9 if h.dtype.kind == 'i' else h, times[-1]
        if self._lag is None:  # no age matters
            times = np.zeros(len(times), dtype=np.int64)
        c = self._observer.configuration
        own = np.full((len(h), 1 + c.self_tuning, c.levels), np.inf)
        own[:, 0] = found.z_hat
        if c.internal:
            own[:, 0, 1:] = found.z_tilde[:, :-1]
        if c.self_tuning:
            own[:, 1, : found.standard_deviation.shape[1]] = found.standard_deviation**2
        y = found.z_hat[:, 0] + found.innovation[:, 0]  # less its offset (D 23)
        rows = [own, y, h, u, times, kinds, found.model]
        if self._held:
            rows = [np.concatenate(pair) for pair in zip(self._held, rows, strict=True)]
        self._held, early = rows, self._lag is None and len(rows[0]) <= BEGINNING
        if not c.self_tuning or self._model is not None or (rows[-1].any() and not early):
            self._go()

    def _go(self) -> None:
        """Go forward through the rows that are held."""
        if self._held:
            (own, *samples, models), self._held = self._held, []
            if self._observer.self_tuning:
                models = self._completed(own, models)
            self._rows.append(own, *samples, models)

    def _completed(self, own: Floats, models: Floats) -> Floats:
        """Let what a self-tuning observer knows stand for what it did not know before (D 34)."""
        numbers, known = np.arange(len(models)), models[:, 1] > 0.0  # it has a q
        latest = np.maximum.accumulate(np.where(known, numbers, -1))
        if self._model is None:
            first = int(np.argmax(known))
            own[:first, :, 1:] = own[first, :, 1:]
            stands = first if self._lag is not None else max(first, min(BEGINNING, numbers[-1]))
            latest[:stands], self._model = latest[stands], models[first]
        own[:, 0, -DERIVATIVES:] = 0.0  # those of d are not relied on
        models = np.vstack([models, self._model])[latest]
        models[latest != numbers, 3] %= DERIVATIVES + 1  # d has not jumped at each of them
        self._model = models[-1]
        return models

    def _handed_out(self, smoothed: Floats) -> Trajectory:
        """Return the oldest rows with their smoothed estimates; they wait no more."""
        count, n = len(smoothed), self._observer.order
        rows, self._found = self._found.rows(slice(count)), self._found.rows(slice(count, None))
        self.numbers, self._numbers = self._numbers[:count], self._numbers[count:]
        if not count:
            return rows
        rows.z[:], rows.unknown_input[:] = smoothed[:, 0, :n], smoothed[:, 0, n]
        if self._observer.self_tuning:
            rows.standard_deviation[:] = np.sqrt(smoothed[:, 1, : n + 1])
            self.standard_deviation, self.tuning = rows.standard_deviation[-1], rows.tuning[-1]
        self.stamp, self.estimate = int(rows.t[-1]), None
        if self._rows.done > self._rows.began:  # else nothing is due yet since the restart
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
