# SPDX-License-Identifier: Apache-2.0
"""Smoothed estimates in the order of their samples, with bounded memory; see smoothing.py."""

from typing import Any

from fhaosmo_ros.core.model.bytecode import Floats, Ints
from fhaosmo_ros.core.observer.arrays import DERIVATIVES, DRIVE, HAT, Law, MEMORY, TILDE, Work
from fhaosmo_ros.core.observer.configuration import ObserverConfiguration
from fhaosmo_ros.core.observer.self_tuning.members import ORDERS
from fhaosmo_ros.core.observer.smoothing import (
    BEGINS,
    JUMPS,
    make_problem,
    MEASURED,
    Rows,
    settled_row,
    smooth_lagging,
    smooth_rows,
    take_rows,
    UNMEASURED,
)
from fhaosmo_ros.core.observer.status import DIVERGED, JUMPED, RESTARTED, UNUSED
import numpy as np
from numpy.typing import NDArray

BLOCK = 8192
"""Rows after which a recording is smoothed as far as later samples no longer matter."""
BEGINNING = 1000
"""
First rows of a recording for which a self-tuning observer's model is what it knows after them.
"""


class Smoother:
    """
    Smoothed estimates of an observer's samples, handed out in their order.

    Memory is bounded: a row is dropped once its estimate is final, `lag` later or, for a whole
    recording, when later samples can no longer change it by more than `TOLERANCE`.

    Parameters
    ----------
    configuration : ObserverConfiguration
    lag : int or None
        In nanoseconds; None for all that comes later.

    Raises
    ------
    ConfigurationError
        The parameters do not say how large noise and d are.

    """

    def __init__(self, configuration: ObserverConfiguration, lag: int | None = None) -> None:
        self.configure(configuration)
        self._lag, levels = lag, configuration.levels
        self._planes = 2 if configuration.self_tuning else 1
        self._held: tuple[Law, Work, tuple[Any, ...]] | None = None
        self._model: Floats | None = None
        self._rows = Rows.empty(64, levels)
        self._memory, self._point = np.zeros(MEMORY), np.zeros((4 + levels, levels))
        self._count = self._done = self._new = self._began = 0
        self._wait = BLOCK
        self._expected = {JUMPS: 0, BEGINS: 1}

    def configure(self, configuration: ObserverConfiguration) -> None:
        """Go on with other parameters from the next row on."""
        self._problem = make_problem(configuration)
        self._internal = configuration.internal

    def cut(self) -> None:
        """Let the next row begin: it has nothing to do with those before it."""
        self._expected[BEGINS] = 1

    def kinds(self, status: Ints) -> Ints:
        """
        Return what the rows of samples are, by the status flags of an observer.

        A jump of y, and a restart, are those of the next sample that is used.
        """
        kinds = np.where(status & UNUSED, UNMEASURED, MEASURED)
        used = np.flatnonzero(kinds == MEASURED)
        for kind, flags in ((JUMPS, JUMPED), (BEGINS, RESTARTED | DIVERGED)):
            marks = self._expected[kind] + np.cumsum((status & flags) > 0)
            kinds[used[np.diff(marks[used], prepend=0) > 0]] = kind
            latest = marks[used[-1]] if len(used) else 0
            self._expected[kind] = int(len(status) > 0 and marks[-1] > latest)
        return kinds

    @property
    def goes_on(self) -> bool:
        """True if a row has been handed out since the latest one that begins."""
        return self._done > self._began

    @property
    def waiting(self) -> int:
        """Number of rows that have not been handed out."""
        return self._count - self._done

    def take(
        self,
        law: Law,
        work: Work,
        levels: Floats,
        samples: tuple[Floats, Floats, Floats],
        times: Ints,
        kinds: Ints,
        models: Floats,
        deviations: Floats,
    ) -> None:
        """
        Append rows.

        Parameters
        ----------
        levels : (K, 2, N) array
            `HAT` and `TILDE` of the observer after each.
        samples : (y, h, u)
            As `Samples` of a run, with y less its offset (D 23).
        times, kinds : (K,) arrays
            As in `Rows`; see `kinds`.
        models, deviations : (K, 4), (K, n + 1) or (K, 0) arrays
            `model`, a copy, and `standard_deviation` of a `Trajectory`.

        """
        estimates = levels[:, HAT].copy()
        if self._internal:
            estimates[:, 1:] = levels[:, TILDE, :-1]
        columns: tuple[Any, ...] = (estimates, *samples, times, kinds, deviations, models)
        if self._held is not None:
            columns = tuple(map(np.concatenate, zip(self._held[2], columns, strict=True)))
            self._held = None
        if self._planes > 1 and self._model is None:
            known = np.flatnonzero(columns[-1][:, DRIVE])
            enough = 0 if self._lag is not None else BEGINNING
            if not len(known) or len(columns[-1]) <= enough:
                self._held = law, work, columns
                return
        self._go(law, work, columns)

    def _go(self, law: Law, work: Work, columns: tuple[Any, ...]) -> None:
        """Go forward through rows: estimates, y, h, u, times, kinds, deviations, models."""
        if self._planes > 1:
            self._complete(columns[0], columns[-1])
        estimates, y, h, u, times, kinds, deviations, models = columns
        count = len(times)
        if not count:
            return
        self._make_room(count)
        part = slice(self._count, self._count + count)
        self._rows.times[part], self._rows.kinds[part] = times, kinds
        take_rows(
            law, work, self._problem, self._rows, self._count, estimates, h, y, u, models,
            deviations, self._memory, self._point,
        )  # fmt: skip
        began = np.flatnonzero(kinds == BEGINS)
        if len(began):
            self._began = self._count + int(began[-1])
        self._new = self._count
        self._count += count

    def _complete(self, estimates: Floats, models: Floats) -> None:
        """Let what a self-tuning observer knows stand for what it did not know before (D 34)."""
        known = models[:, DRIVE] > 0.0
        if self._model is None:
            first = int(np.argmax(known))
            estimates[:first, 1:] = estimates[first, 1:]
            stands = first if self._lag is not None else min(BEGINNING, len(models) - 1)
            models[:stands], known[:stands] = models[stands], True
            models[:stands, DERIVATIVES] %= ORDERS  # d has not jumped at each of them
            self._model = models[stands]
        for k in np.flatnonzero(~known):
            models[k] = models[k - 1] if k else self._model
        if len(models):
            self._model = models[-1].copy()
        estimates[:, self._rows.base.shape[1] - ORDERS + 1 :] = 0.0  # derivatives of d

    def _make_room(self, count: int) -> None:
        """Drop rows that are done, all but two to go on from, and get more memory if needed."""
        drop = max(min(self._done, self._count - 2), 0)
        room = len(self._rows.times)
        if self._count + count > room:
            kept = self._count - drop
            rows = self._rows
            if kept + count > room // 2:
                rows = Rows.empty(2 * (kept + count), rows.base.shape[1])
            for target, source in zip(rows, self._rows, strict=True):
                target[:kept] = source[drop : self._count].copy()
            self._rows = rows
            self._count, self._done = kept, self._done - drop
            self._began -= drop

    def due(self) -> Floats:
        """
        Return the estimates that have become final since the last call.

        Returns
        -------
        (K, 1 or 2, N) array
            With the variances of their errors, for a self-tuning observer.

        """
        if self._lag is not None:
            out = self._room(self._count - self._done)
            done = smooth_lagging(self._rows, self._new, self._count, self._done, self._lag, out)
            out = out[: done - self._done]
            self._done, self._new = done, self._count
            return out
        if self.waiting < self._wait:
            return self._smooth(self._done)
        settled = settled_row(self._rows, self._count - 1, self._done)
        out = self._smooth(settled + 1)
        self._wait = self.waiting + BLOCK
        return out

    def finish(self) -> Floats:
        """Return the estimates of all rows that wait, as `due` does: nothing comes after them."""
        if self._held is not None:
            law, work, columns = self._held
            self._held, estimates = None, columns[0]
            if not columns[-1].any():  # the observer knows nothing but y
                out = self._room(len(estimates))
                out[:, 0], out[:, 1] = estimates, np.inf
                return out
            self._go(law, work, columns)
        return self._smooth(self._count)

    def _smooth(self, end: int) -> Floats:
        """Return the estimates of the rows before `end` that wait, by all that is known."""
        out = self._room(end - self._done)
        if len(out):
            smooth_rows(self._rows, self._count - 1, self._done, end - 1, out)
        self._done = end
        return out

    def _room(self, count: int) -> Floats:
        return np.empty((count, self._planes, self._rows.base.shape[1]))

    def innovations(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return e and S of the samples that are remembered, for their likelihood."""
        rows = slice(0, self._count)
        used = self._rows.certainty[rows] > 0.0
        variance = 1.0 / self._rows.certainty[rows][used]
        return self._rows.pull[rows][used] * variance, variance
