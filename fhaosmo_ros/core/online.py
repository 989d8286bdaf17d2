# SPDX-License-Identifier: Apache-2.0
"""The update path of time-stamped samples, shared by the node and by replays of bags."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from fhaosmo_ros.core import kernels
from fhaosmo_ros.core.observer import Estimate, Observer, Trajectory
from fhaosmo_ros.core.parameters import OBSERVER_PARAMETERS, ONLINE_PARAMETERS
from fhaosmo_ros.core.status import LEVEL_SHIFT, REJECTED, Status
import numpy as np
from numpy.typing import NDArray

NANOSECONDS = 1e-9


@dataclass
class Counters:
    """What has happened to the samples so far."""

    accepted: int = 0
    rejected_measurements: int = 0
    """y was NaN or infinite."""
    rejected_stamps: int = 0
    """The stamp was not later than that of the sample before."""
    rejected_inputs: int = 0
    """u was NaN or infinite."""
    rejected_steps: int = 0
    """The step would have left the finite numbers."""
    restarts: int = 0
    """Starts from a new sample after a gap or a jump of time."""

    @property
    def rejected(self) -> int:
        """Samples of y that were not used."""
        return self.rejected_measurements + self.rejected_stamps + self.rejected_steps


class OnlineEstimator:
    """
    An observer fed with time-stamped samples.

    The policy of time: dt is the difference of two samples' stamps (integer nanoseconds,
    subtracted before they become seconds), or `nominal_period`. A sample that is not later than
    the one before is rejected. After a gap longer than `max_gap`, or a jump back by more than it,
    the observer starts afresh from the new sample.

    Parameters
    ----------
    parameters : mapping, optional
        Values for the observer's and the sampling parameters in docs/parameters.md.

    Raises
    ------
    ConfigurationError
        An unknown name, a bad value, or values that do not fit together.

    """

    def __init__(self, parameters: Mapping[str, Any] | None = None) -> None:
        values = ONLINE_PARAMETERS.defaults() | ONLINE_PARAMETERS.coerce(parameters or {})
        self.observer = Observer({k: v for k, v in values.items() if k in OBSERVER_PARAMETERS})
        self._set_sampling(values)
        self.counters = Counters()
        self.estimate: Estimate | None = None
        """The latest estimate, None before the first sample."""
        self.stamp: int | None = None
        """Stamp of the sample behind the latest estimate, in nanoseconds."""
        self._latest: int | None = None
        self._u = 0.0

    @property
    def uses_stamps(self) -> bool:
        """True if dt comes from the samples' stamps."""
        return not self._nominal

    def check(self, changes: Mapping[str, Any]) -> None:
        """Raise what `configure` would raise, and change nothing."""
        values = ONLINE_PARAMETERS.coerce(changes)
        self.observer.check({k: v for k, v in values.items() if k in OBSERVER_PARAMETERS})

    def configure(self, changes: Mapping[str, Any]) -> None:
        """
        Change live parameters from the next sample on, without a jump; all or nothing.

        Raises
        ------
        ConfigurationError
            An unknown name, a bad value, or a parameter that can't change live.

        """
        values = ONLINE_PARAMETERS.coerce(changes)
        self.observer.configure({k: v for k, v in values.items() if k in OBSERVER_PARAMETERS})
        self._set_sampling(self._sampling | values)

    def _set_sampling(self, values: Mapping[str, Any]) -> None:
        self._sampling = {k: v for k, v in values.items() if k not in OBSERVER_PARAMETERS}
        self._nominal = self._sampling['sampling'] == 'nominal'
        self._period = float(self._sampling['nominal_period'])
        self._max_gap = round(float(self._sampling['max_gap']) / NANOSECONDS)

    def reset(self) -> None:
        """Start afresh: the next sample is the first. Counters go on."""
        self.observer.reset()
        self._latest = self.stamp = self.estimate = None

    def forget_stamp(self) -> None:
        """Expect stamps of another clock: the next sample takes the nominal period."""
        self._latest = None

    def set_input(self, u: float) -> bool:
        """Hold `u` as the known input from now on; return False if it is not finite."""
        if not np.isfinite(u):
            self.counters.rejected_inputs += 1
            return False
        self._u = float(u)
        return True

    def update(self, stamp: int, y: float) -> Estimate:
        """
        Take one sample.

        Parameters
        ----------
        stamp : int
            Time of the sample in nanoseconds, of any clock.
        y : float
            Measured output; NaN and infinity are rejected and counted.

        Returns
        -------
        Estimate
            Of this sample, or the previous state's with the reason of the rejection.

        """
        observer = self.observer
        if not observer.started:
            estimate = observer.start(y)
            self._latest = stamp
        elif self._nominal or self._latest is None:
            self._latest = stamp
            estimate = observer.step(y, self._period, self._u)
        else:
            elapsed = stamp - self._latest
            if abs(elapsed) > self._max_gap:
                observer.reset()
                self.counters.restarts += 1
                estimate = observer.start(y)
                self._latest = stamp
            else:
                estimate = observer.step(y, elapsed * NANOSECONDS, self._u)
                if elapsed > 0:
                    self._latest = stamp
        self._count(estimate.word)
        if not estimate.word & REJECTED:
            self.stamp, self.estimate = stamp, estimate
        return estimate

    def run(
        self, stamps: NDArray[np.int64], y: NDArray[np.float64], u: NDArray[np.float64]
    ) -> list[Trajectory]:
        """
        Take many samples, bit for bit as `update` would take one after the other.

        Parameters
        ----------
        stamps : (K,) array of int
            Times of the samples in nanoseconds.
        y : (K,) array
            Samples.
        u : (K,) array of finite numbers
            Known input of the interval that ends at each sample.

        Returns
        -------
        list of Trajectory
            Pieces between restarts, in order; together a row for every sample, whose status says
            whether it was rejected. ``t`` holds the stamps.

        """
        pieces = []
        while len(y):
            fresh = not self.observer.started
            first, h = self._periods(stamps, y)
            jumps = np.flatnonzero(np.isnan(h))
            end = int(jumps[0]) if len(jumps) else len(y)
            if end:
                pieces.append(
                    self.observer.advance(stamps[:end], y[:end], h[:end], u[:end], min(first, end))
                )
                self._remember(pieces[-1], fresh)
                self._u = float(u[end - 1])
            if end < len(y):
                self.observer.reset()
                self.counters.restarts += 1
            stamps, y, u = stamps[end:], y[end:], u[end:]
        return pieces

    def _periods(
        self, stamps: NDArray[np.int64], y: NDArray[np.float64]
    ) -> tuple[int, NDArray[np.float64]]:
        """Return how many samples start the observer, and periods: NaN where time jumps."""
        h, first = np.full(len(y), self._period), 0
        if not self.observer.started:
            good = np.flatnonzero(np.isfinite(kernels.HEADROOM * y))
            first = int(good[0]) + 1 if len(good) else len(y)
            h[:first] = 0.0
        if not self._nominal and first < len(y):
            if first:
                known, rest = int(stamps[first - 1]), first
            elif self._latest is None:  # this one takes the nominal period
                known, rest = int(stamps[0]), 1
            else:
                known, rest = self._latest, 0
            latest = np.maximum.accumulate(np.concatenate([[known], stamps[rest:]]))
            elapsed = stamps[rest:] - latest[:-1]
            h[rest:] = elapsed * NANOSECONDS
            h[rest:][np.abs(elapsed) > self._max_gap] = np.nan
        return first, h

    def _remember(self, piece: Trajectory, fresh: bool) -> None:
        """Count the samples of a piece without a jump, and keep its last estimate and stamp."""
        rejected = piece.status & REJECTED
        accepted = np.flatnonzero(rejected == 0)
        counters = self.counters
        counters.accepted += len(accepted)
        measurement = (rejected & Status.REJECTED_MEASUREMENT) != 0
        period = ~measurement & ((rejected & Status.REJECTED_PERIOD) != 0)
        counters.rejected_measurements += int(measurement.sum())
        counters.rejected_stamps += int(period.sum())
        counters.rejected_steps += int(((rejected != 0) & ~measurement & ~period).sum())
        self._latest = self._last_stamp(piece.t, accepted, fresh)
        if len(accepted):
            k = int(accepted[-1])
            word = int(piece.open_levels[k] << LEVEL_SHIFT | piece.status[k])
            self.stamp = int(piece.t[k])
            self.estimate = Estimate(
                piece.z[k].copy(), float(piece.unknown_input[k]), float(piece.gamma[k]),
                piece.innovation[k].copy(), word,
            )  # fmt: skip

    def _last_stamp(
        self, stamps: NDArray[np.int64], accepted: NDArray[np.intp], fresh: bool
    ) -> int:
        """Return the stamp from which the next sample's period counts."""
        if self._nominal or (fresh and not len(accepted)):
            return int(stamps[-1])
        if fresh:
            return int(stamps[accepted[0] :].max())
        if self._latest is None:
            return int(stamps.max())
        return max(self._latest, int(stamps.max()))

    def _count(self, word: int) -> None:
        counters = self.counters
        if not word & REJECTED:
            counters.accepted += 1
        elif word & Status.REJECTED_MEASUREMENT:
            counters.rejected_measurements += 1
        elif word & Status.REJECTED_PERIOD:
            counters.rejected_stamps += 1
        else:
            counters.rejected_steps += 1
