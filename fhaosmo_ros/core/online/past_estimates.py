# SPDX-License-Identifier: Apache-2.0
"""Estimates of the past from time-stamped samples; see core/observer/smoother.py."""

from collections import deque
from collections.abc import Mapping
from typing import Any

from fhaosmo_ros.core.observer.configuration import Floats, ObserverConfiguration
from fhaosmo_ros.core.observer.estimates import Estimate, Trajectory, TUNING
from fhaosmo_ros.core.observer.observer import Observer
from fhaosmo_ros.core.observer.record import Record
from fhaosmo_ros.core.observer.smoother import Smoother
from fhaosmo_ros.core.observer.status import LEVEL_SHIFT, UNUSED
from fhaosmo_ros.core.parameters.errors import ConfigurationError
import numpy as np
from numpy.typing import NDArray

Ints = NDArray[np.int64]


class PastEstimates:
    """
    Holds the accepted samples of an estimator until their smoothed estimates are due.

    Parameters
    ----------
    observer : Observer
        Of the estimator.
    lag : int or None
        In nanoseconds; None for all that comes later.

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

    """

    def __init__(self, observer: Observer, lag: int | None) -> None:
        self._observer = observer
        self._smoother = Smoother(observer.configuration, lag)
        self._parts: deque[tuple[Trajectory, Ints]] = deque()
        self._time: int | None = None
        self._taken = 0
        self.estimate: Estimate | None = None
        self.stamp = 0
        self.standard_deviation = np.full(observer.order + 1, np.nan)
        self.tuning = np.full(len(TUNING), np.nan)
        self.numbers = np.zeros(0, dtype=np.int64)

    def configure(self) -> None:
        """Go on with the observer's present parameters."""
        self._smoother.configure(self._observer.configuration)

    def cut(self) -> None:
        """Begin afresh with the next sample: it makes all rows that wait due."""
        self._smoother.cut()
        self.estimate = None

    def take(self, found: Trajectory, times: Ints, u: Floats) -> Trajectory:
        """
        Take the samples of a run; return the rows that are due now.

        Parameters
        ----------
        found : Trajectory
            Of K samples, as the observer estimates them.
        times, u : (K,), (K, m) arrays
            The observer's time (ns) after each, and the inputs that acted until then.

        """
        kept = np.flatnonzero((found.status & UNUSED) == 0)
        numbers = self._taken + kept
        self._taken += len(times)
        kinds = self._smoother.kinds(found.status)[kept]
        if len(kept):
            found, times, u = part_of(found, kept), times[kept], u[kept]
            before = times[0] if self._time is None else self._time
            h = np.diff(times, prepend=before) * 1e-9
            self._time = int(times[-1])
            y = found.z_hat[:, 0] + found.innovation[:, 0]  # less its offset (D 23)
            self._smoother.take(
                found.z_hat, found.z_tilde, (y, h, u), times, kinds, found.model,
                found.standard_deviation,
            )  # fmt: skip
            self._parts.append((found, numbers))
        return self._handed_out(self._smoother.due())

    def finish(self) -> Trajectory:
        """Return the rows that still wait: nothing comes after them."""
        return self._handed_out(self._smoother.finish())

    def _handed_out(self, smoothed: Floats) -> Trajectory:
        """Return the oldest rows with their smoothed estimates."""
        count, n, taken = len(smoothed), self._observer.order, []
        if not count:
            structure, self.numbers = self._observer.structure, self.numbers[:0]
            return Trajectory.of(structure, self.numbers, Record(structure, 0))
        while count:
            part, numbers = self._parts.popleft()
            if len(numbers) > count:
                rest = slice(count, None)
                self._parts.appendleft((part_of(part, rest), numbers[rest]))
                part, numbers = part_of(part, slice(count)), numbers[:count]
            count -= len(numbers)
            taken.append((part, numbers))
        parts = zip(*(part for part, _ in taken), strict=True)
        rows = Trajectory._make(map(np.concatenate, parts))
        self.numbers = np.concatenate([numbers for _, numbers in taken])
        rows.z[:], rows.unknown_input[:] = smoothed[:, 0, :n], smoothed[:, 0, n]
        if self._observer.self_tuning:
            rows.standard_deviation[:] = np.sqrt(smoothed[:, 1, : n + 1])
            self.standard_deviation, self.tuning = rows.standard_deviation[-1], rows.tuning[-1]
        self.stamp, self.estimate = int(rows.t[-1]), None
        if self._smoother.goes_on:  # else nothing is due yet since the restart
            word = int(rows.status[-1]) | int(rows.open_levels[-1]) << LEVEL_SHIFT
            self.estimate = Estimate(
                rows.z[-1], rows.unknown_input[-1], rows.gamma[-1], rows.innovation[-1], word
            )
        return rows


def part_of(rows: Trajectory, index: Any) -> Trajectory:
    """Return some rows."""
    return Trajectory._make(column[index] for column in rows)


def check_lag(p: Mapping[str, Any], configuration: ObserverConfiguration) -> None:
    """Raise ConfigurationError where these can not be smoothed."""
    if p['predict_to_now']:
        raise ConfigurationError(
            "smoothing, 'predict_to_now': expected estimates of the past or of the present, "
            'got both'
        )
    Smoother(configuration)
