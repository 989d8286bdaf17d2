# SPDX-License-Identifier: Apache-2.0
"""Smoothed estimates in the order of their samples, with bounded memory; see smoothing.pyx."""

from typing import Any

from fhaosmo_ros.core.model.inputs import known_inputs_of_run
from fhaosmo_ros.core.observer.configuration import DERIVATIVES, Floats, ObserverConfiguration
from fhaosmo_ros.core.observer.estimates import Trajectory
from fhaosmo_ros.core.observer.smoothing import BEGINS, JUMPS, MEASURED, Rows, UNMEASURED
from fhaosmo_ros.core.observer.status import DIVERGED, JUMPED, REJECTED, RESTARTED, UNUSED
import numpy as np
from numpy.typing import ArrayLike, NDArray

Ints = NDArray[np.int64]
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
    recording, when later samples can no longer change it by more than 1e-9 standard deviations.

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
        self._rows = Rows(configuration)
        self._lag, self._tunes = lag, configuration.self_tuning
        self._held: list[NDArray[Any]] | None = None
        self._model: Floats | None = None  # the latest one of a self-tuning observer
        self._wait = BLOCK
        self._expected = {JUMPS: 0, BEGINS: 1}

    def configure(self, configuration: ObserverConfiguration) -> None:
        """Go on with other parameters from the next row on; raise as the constructor."""
        self._rows.configure(configuration)

    def cut(self) -> None:
        """Let the next row begin: it has nothing to do with those before it."""
        self._expected[BEGINS] = 1

    def kinds(self, status: Ints) -> Ints:
        """
        Return what the rows of samples are, by the status flags of an observer.

        A jump of y, and a restart, are those of the next sample that is used.
        """
        kinds: Ints = np.where(status & UNUSED, UNMEASURED, MEASURED)
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
        return bool(self._rows.done > self._rows.began)

    @property
    def waiting(self) -> int:
        """Number of rows that have not been handed out."""
        return int(self._rows.count - self._rows.done)

    def take(
        self,
        z_hat: Floats,
        z_tilde: Floats,
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
        z_hat, z_tilde : (K, N) arrays
            Levels of the observer after each.
        samples : (y, h, u)
            (K,), (K,) and (K, m) arrays: samples less their offset (D 23), time since the row
            before (s), and known inputs meanwhile.
        times, kinds : (K,) arrays
            In ns; see `kinds`.
        models, deviations : (K, 4), (K, n + 1) or (K, 0) arrays
            `model` and `standard_deviation` of a `Trajectory`.

        """
        estimates = z_hat.copy()
        if self._rows.configuration.internal:
            estimates[:, 1:] = z_tilde[:, :-1]
        columns = [estimates, *samples, times, kinds, models.copy(), deviations]
        if self._held is not None:
            columns = [np.concatenate(pair) for pair in zip(self._held, columns, strict=True)]
            self._held = None
        if self._tunes and self._model is None:
            early = self._lag is None and len(columns[0]) <= BEGINNING
            if early or not columns[6].any():
                self._held = columns
                return
        self._go(columns)

    def _go(self, columns: list[NDArray[Any]]) -> None:
        """Go forward through rows."""
        estimates, y, h, u, times, kinds, models, deviations = columns
        if self._tunes:
            self._complete(estimates, models)
        self._rows.append(estimates, (y, h, u), times, kinds, models, deviations)

    def _complete(self, estimates: Floats, models: Floats) -> None:
        """Let what a self-tuning observer knows stand for what it did not know before (D 34)."""
        known = models[:, 1] > 0.0  # it has a q
        if self._model is None:
            first = int(np.argmax(known))
            estimates[:first, 1:] = estimates[first, 1:]
            stands = first if self._lag is not None else min(BEGINNING, len(models) - 1)
            models[:stands], known[:stands] = models[stands], True
            models[:stands, 3] %= DERIVATIVES + 1  # d has not jumped at each of them
            self._model = models[stands]
        for k in np.flatnonzero(~known):
            models[k] = models[k - 1] if k else self._model
        if len(models):
            self._model = models[-1].copy()
        estimates[:, -DERIVATIVES:] = 0.0  # those of d are not relied on

    def due(self) -> Floats:
        """
        Return the estimates that have become final since the last call.

        Returns
        -------
        (K, 1 or 2, N) array
            With the variances of their errors, for a self-tuning observer.

        """
        rows, end = self._rows, self._rows.done
        if self._lag is not None:
            return rows.smooth_lagging(self._lag)  # type: ignore[no-any-return]
        if self.waiting >= self._wait:
            end = rows.settled()
            self._wait = rows.count - end + BLOCK
        return rows.smooth(end)  # type: ignore[no-any-return]

    def finish(self) -> Floats:
        """Return the estimates of all rows that wait, as `due` does: nothing comes after them."""
        if self._held is not None:
            columns, self._held = self._held, None
            estimates = columns[0]
            if not columns[6].any():  # the observer knows nothing but y
                return np.stack([estimates, np.full_like(estimates, np.inf)], axis=1)
            self._go(columns)
        return self._rows.smooth(self._rows.count)  # type: ignore[no-any-return]

    def innovations(self) -> tuple[Floats, Floats]:
        """Return e and S of the samples that are remembered, for their likelihood."""
        return self._rows.innovations()  # type: ignore[no-any-return]


def smooth(observer: Any, t: ArrayLike, y: ArrayLike, u: ArrayLike | float = 0.0) -> Trajectory:
    """
    Let a fresh observer go forward through samples; estimate each from all of them.

    See `Observer.smooth`.
    """
    t, y = np.asarray(t), np.asarray(y, dtype=np.float64)
    u = known_inputs_of_run(u, len(t), observer.inputs).copy()
    smoother = Smoother(observer.configuration)
    parts = [observer.run(t[:0], y[:0], u[:0])]
    found, first = [], None
    for start in range(0, len(t), BLOCK):
        block = slice(start, start + BLOCK)
        part = observer.run(t[block], y[block], u[block])
        parts.append(part)
        if first is None and observer.started:
            first = start + int(np.argmax((part.status & REJECTED) == 0))
            latest, held = t[first], u[first]
        if first is None:
            continue
        rows = slice(max(first, start), start + len(part.t))
        part = Trajectory._make(column[rows.start - start :] for column in part)
        inputs = u[rows]
        for k in np.flatnonzero(~np.isfinite(inputs).all(axis=1)):  # the last ones are held
            inputs[k] = inputs[k - 1] if k else held
        times = np.fmax.accumulate(np.append(latest, t[rows]))
        h = np.diff(times) * (1e-9 if np.issubdtype(t.dtype, np.integer) else 1.0)
        latest, held = times[-1], inputs[-1]
        samples = (part.z_hat + part.innovation)[:, 0], h, inputs
        smoother.take(
            part.z_hat, part.z_tilde, samples, np.arange(rows.start, rows.stop),
            smoother.kinds(part.status), part.model, part.standard_deviation,
        )  # fmt: skip
        found.append(smoother.due())
    found.append(smoother.finish())
    whole = Trajectory(*(np.concatenate(column) for column in zip(*parts, strict=True)))
    if first is not None:
        estimates, n = np.concatenate(found), observer.order
        whole.z[first:], whole.unknown_input[first:] = estimates[:, 0, :n], estimates[:, 0, n]
        if observer.self_tuning:
            whole.standard_deviation[first:] = np.sqrt(estimates[:, 1, : n + 1])
    return whole
