# SPDX-License-Identifier: Apache-2.0
"""Estimates of the past from time-stamped samples; see core/observer/smoother.py."""

from collections import deque
from collections.abc import Mapping
from typing import Any

from fhaosmo_ros.core.model.bytecode import Floats, Ints
from fhaosmo_ros.core.observer.arrays import COVARIANCE, GAMMA, HAT, MODEL, TILDE
from fhaosmo_ros.core.observer.estimates import Estimate, Trajectory
from fhaosmo_ros.core.observer.observer import make_record, Observer
from fhaosmo_ros.core.observer.self_tuning.members import TUNING
from fhaosmo_ros.core.observer.smoother import Smoother
from fhaosmo_ros.core.observer.status import LEVEL_SHIFT, UNUSED
from fhaosmo_ros.core.observer.step import Record, tell_tuning
from fhaosmo_ros.core.online import memory as at
from fhaosmo_ros.core.online.delay import INPUTS, past_of
from fhaosmo_ros.core.online.memory import EstimatorArrays
from fhaosmo_ros.core.parameters.errors import ConfigurationError
import numpy as np
from numpy.typing import NDArray


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
    tuning : (6,) array
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
        self._planes = [HAT, TILDE, COVARIANCE, MODEL] if observer.self_tuning else [HAT, TILDE]
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
        self._append(found, times, u)
        return self._handed_out(self._smoother.due())

    def take_one(self, e: EstimatorArrays, eps: Floats, word: int, u: Floats) -> None:
        """Take the sample that an estimator has just taken, with its status word."""
        ints, (levels, memory) = e.policy.ints, e.state
        tuning = np.empty((1, len(TUNING) if self._observer.self_tuning else 0))
        if self._observer.self_tuning:
            tell_tuning(e.law.flags, memory, tuning[0])
        record = Record(
            levels[np.newaxis, self._planes], memory[[GAMMA]], eps.copy(), np.array([word]), tuning
        )
        found = self._observer.trajectory(ints[[at.STAMP]] - ints[at.DELAY], record)
        if ints[at.LAG] > 0:
            u = past_of(e.policy, e.state)[INPUTS : INPUTS + len(u)]
        self.take(found, ints[[at.LATEST]], u[np.newaxis].copy())

    def finish(self) -> Trajectory:
        """Return the rows that still wait: nothing comes after them."""
        return self._handed_out(self._smoother.finish())

    def _append(self, found: Trajectory, times: Ints, u: Floats) -> None:
        kept = np.flatnonzero((found.status & UNUSED) == 0)
        numbers = self._taken + kept
        self._taken += len(times)
        kinds = self._smoother.kinds(found.status)
        if len(kept) < len(times):
            found, kinds = part_of(found, kept), kinds[kept]
            times, u = times[kept], u[kept]
        if len(times):
            before = times[0] if self._time is None else self._time
            h = np.diff(times, prepend=before) * 1e-9
            self._time = int(times[-1])
            levels = np.stack([found.z_hat, found.z_tilde], axis=1)
            law, work, _ = self._observer.arrays
            y = found.z_hat[:, 0] + found.innovation[:, 0]  # less its offset (D 23)
            models, deviations = found.model.copy(), found.standard_deviation
            self._smoother.take(law, work, levels, (y, h, u), times, kinds, models, deviations)
            self._parts.append((found, numbers))

    def _handed_out(self, smoothed: NDArray[np.float64]) -> Trajectory:
        """Return the oldest rows with their smoothed estimates."""
        count, n, taken = len(smoothed), self._observer.order, []
        while count:
            part, numbers = self._parts.popleft()
            if len(numbers) > count:
                rest = slice(count, None)
                self._parts.appendleft((part_of(part, rest), numbers[rest]))
                part, numbers = part_of(part, slice(count)), numbers[:count]
            count -= len(numbers)
            taken.append((part, numbers))
        if not taken:
            self.numbers = self.numbers[:0]
            return self._nothing()
        parts = zip(*(part for part, _ in taken), strict=True)
        rows = Trajectory._make(map(np.concatenate, parts))
        self.numbers = np.concatenate([numbers for _, numbers in taken])
        rows = rows._replace(z=smoothed[:, 0, :n], unknown_input=smoothed[:, 0, n])
        if self._observer.self_tuning:
            rows = rows._replace(standard_deviation=np.sqrt(smoothed[:, 1, : n + 1]))
            self.standard_deviation, self.tuning = rows.standard_deviation[-1], rows.tuning[-1]
        word = int(rows.status[-1]) | int(rows.open_levels[-1]) << LEVEL_SHIFT
        self.stamp = int(rows.t[-1])
        self.estimate = Estimate(
            rows.z[-1], float(rows.unknown_input[-1]), float(rows.gamma[-1]),
            rows.innovation[-1], word,
        )  # fmt: skip
        if not self._smoother.goes_on:  # nothing is due yet since the restart
            self.estimate = None
        return rows

    def _nothing(self) -> Trajectory:
        record = make_record(0, self._observer.levels, 0, self._observer.self_tuning)
        return self._observer.trajectory(record.words, record)


def part_of(rows: Trajectory, index: Any) -> Trajectory:
    """Return some rows."""
    return Trajectory._make(column[index] for column in rows)


def check_lag(p: Mapping[str, Any]) -> None:
    """Raise ConfigurationError where estimates of the past and of the present are asked for."""
    if p['predict_to_now']:
        raise ConfigurationError(
            "smoothing, 'predict_to_now': expected estimates of the past or of the present, "
            'got both'
        )
