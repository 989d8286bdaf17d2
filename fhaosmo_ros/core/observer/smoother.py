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
        self._held: list[NDArray[Any]] = []  # rows that wait for a self-tuning observer's model
        self._model: Floats | None = None  # the latest one
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
        own = np.full((len(z_hat), 1 + self._tunes, z_hat.shape[1]), np.inf)
        own[:, 0] = z_hat
        if self._rows.configuration.internal:
            own[:, 0, 1:] = z_tilde[:, :-1]
        if self._tunes:
            own[:, 1, : deviations.shape[1]] = deviations**2
        rows = [own, *samples, times, kinds, models]
        if self._held:
            rows = [np.concatenate(pair) for pair in zip(self._held, rows, strict=True)]
        self._held, early = rows, self._lag is None and len(rows[0]) <= BEGINNING
        if not self._tunes or self._model is not None or (rows[-1].any() and not early):
            self._go()

    def _go(self) -> None:
        """Go forward through the rows that are held."""
        (own, y, h, u, times, kinds, models), self._held = self._held, []
        if self._tunes and len(models):
            models = self._completed(own, models)
        self._rows.append(own, (y, h, u), times, kinds, models)

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

    def due(self) -> Floats:
        """
        Return the estimates that have become final since the last call.

        Returns
        -------
        (K, 1 or 2, N) array
            With the variances of their errors, for a self-tuning observer.

        """
        rows = self._rows
        if self._lag is not None:
            return rows.smooth(rows.count, self._lag)  # type: ignore[no-any-return]
        end = rows.done
        if self.waiting >= self._wait:
            end = rows.settled()
            self._wait = rows.count - end + BLOCK
        return rows.smooth(end)  # type: ignore[no-any-return]

    def finish(self) -> Floats:
        """Return the estimates of all rows that wait, as `due` does: nothing comes after them."""
        if self._held and not self._held[-1].any():  # the observer knows nothing but y
            own, self._held = self._held[0], []
            return own
        if self._held:
            self._go()
        return self._rows.smooth(self._rows.count)  # type: ignore[no-any-return]

    def innovations(self) -> tuple[Floats, Floats]:
        """Return e and S of the samples that are remembered, for their likelihood."""
        return self._rows.innovations()  # type: ignore[no-any-return]


def smooth(observer: Any, t: ArrayLike, y: ArrayLike, u: ArrayLike | None = None) -> Trajectory:
    """
    Let a fresh observer go forward through samples; estimate each from all of them.

    See `Observer.smooth`.
    """
    whole: Trajectory = observer.run(t, y, u)
    if not observer.started:
        return whole
    first = int(np.argmax((whole.status & REJECTED) == 0))
    rows = Trajectory._make(column[first:] for column in whole)
    u = known_inputs_of_run(0.0 if u is None else u, len(whole.t), observer.inputs)
    inputs = u[first:].copy()
    for k in np.flatnonzero(~np.isfinite(inputs).all(axis=1)).tolist():  # the last ones are held
        inputs[k] = inputs[max(k - 1, 0)]
    scale = 1e-9 if np.issubdtype(rows.t.dtype, np.integer) else 1.0
    h = np.diff(rows.t, prepend=rows.t[0]) * scale
    smoother, found = Smoother(observer.configuration), []
    columns: tuple[Any, ...] = (
        rows.z_hat, rows.z_tilde, rows.z_hat[:, 0] + rows.innovation[:, 0], h, inputs,
        np.arange(len(h)), smoother.kinds(rows.status), rows.model, rows.standard_deviation,
    )  # fmt: skip
    for start in range(0, len(h), BLOCK):
        z_hat, z_tilde, *samples, times, kinds, model, deviation = (
            column[start : start + BLOCK] for column in columns
        )
        smoother.take(z_hat, z_tilde, tuple(samples), times, kinds, model, deviation)
        found.append(smoother.due())
    found.append(smoother.finish())
    estimates, n = np.concatenate(found), observer.order
    rows.z[:], rows.unknown_input[:] = estimates[:, 0, :n], estimates[:, 0, n]
    if observer.self_tuning:
        rows.standard_deviation[:] = np.sqrt(estimates[:, 1, : n + 1])
    return whole
