# SPDX-License-Identifier: Apache-2.0
"""The update path of time-stamped samples, shared by the node and by replays of bags."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from fhaosmo_ros.core import layout
from fhaosmo_ros.core.observer import Estimate, Observer, ObserverState, Trajectory
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
    starts: int = 0
    """Samples from which the observer started afresh."""
    restarts: int = 0
    """Those of them that followed a gap or a jump of time."""

    @property
    def rejected(self) -> int:
        """Samples of y that were not used."""
        return self.rejected_measurements + self.rejected_stamps + self.rejected_steps


class OnlineEstimator:
    """
    An observer fed with time-stamped samples.

    The policy of time: dt is the difference of two samples' stamps (integer nanoseconds,
    subtracted before they become seconds), or `nominal_period`. A sample that is not later than
    the one before is rejected. After a gap between usable samples longer than `max_gap`, or a jump
    back by more than it, the observer starts afresh from the new sample.

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
        self.stamp: int | None = None
        """Stamp of the sample behind the latest estimate, in nanoseconds."""
        self._latest: int | None = None
        self._unused = 0  # nanoseconds that rejected samples have left to the next step
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
        self._period = round(float(self._sampling['nominal_period']) / NANOSECONDS)
        self._max_gap = round(float(self._sampling['max_gap']) / NANOSECONDS)

    def reset(self) -> None:
        """Start afresh: the next sample is the first. Counters go on."""
        self.observer.reset()
        self._latest = self.stamp = None
        self._unused = 0

    def resume(self, stamp: int, state: ObserverState) -> None:
        """
        Go on from the observer's state after an accepted sample with this stamp.

        Raises
        ------
        ConfigurationError
            The state is of an observer with another number of levels.

        """
        self.observer.restore(state)
        self._latest = self.stamp = stamp
        self._unused = 0

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
        self.advance(stamp, y)
        return self.observer.estimate

    def advance(self, stamp: int, y: float) -> int:
        """Do what `update` does and return only the status word; see `estimate`."""
        observer = self.observer
        fresh = not observer.started
        if fresh:
            word = observer.start(y).word
            self._latest, self._unused = stamp, 0
        else:
            nominal = self._nominal or self._latest is None
            elapsed = self._period if nominal else stamp - (self._latest or 0)
            gap = abs(elapsed) + self._unused
            if gap > self._max_gap and (self._unused or not nominal):
                observer.reset()
                self.stamp = None
                self.counters.restarts += 1
                fresh = True
                word = observer.start(y).word
                self._latest, self._unused = stamp, 0
            else:
                word = observer.advance(y, elapsed * NANOSECONDS, self._u)
                if nominal or elapsed > 0:
                    self._latest = stamp
                    self._unused = gap if word & REJECTED else 0
        if word & REJECTED:
            self._count_rejected(word)
        else:
            self.counters.accepted += 1
            self.counters.starts += fresh
            self.stamp = stamp
        return word

    def run(
        self, stamps: NDArray[np.int64], y: NDArray[np.float64], u: NDArray[np.float64]
    ) -> list[Trajectory]:
        """
        Take many samples, bit for bit as `update` would take one after the other.

        Samples that bring nothing to decide (all finite, in time) go through the kernel at once.
        Where one of them is rejected all the same, or one does not fit, the block is taken again
        from where it began, sample by sample: so there is one policy of time, that of `advance`.

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
            In order; together a row for every sample, whose status says whether it was rejected.
            ``t`` holds the stamps.

        """
        pieces = []
        if not self.observer.started and len(y) > 1:
            pieces.append(self._one_by_one(stamps[:1], y[:1], u[:1]))
            stamps, y, u = stamps[1:], y[1:], u[1:]
        if len(y):
            pieces.append(self._at_once(stamps, y, u) or self._one_by_one(stamps, y, u))
        return pieces

    def _at_once(
        self, stamps: NDArray[np.int64], y: NDArray[np.float64], u: NDArray[np.float64]
    ) -> Trajectory | None:
        """Take samples that are all accepted, or return None and change nothing."""
        if not self.observer.started or self._latest is None or self._unused:
            return None
        if self._nominal:
            elapsed = np.full(len(y), self._period)
        else:
            elapsed = np.diff(stamps, prepend=self._latest)
            if elapsed.min() <= 0 or elapsed.max() > self._max_gap:
                return None
        if not np.isfinite(y).all():
            return None
        before = self.observer.state
        piece = self.observer.step_through(stamps, y, elapsed * NANOSECONDS, u, first=0)
        if (piece.status & REJECTED).any():
            self.observer.restore(before)
            return None
        self.counters.accepted += len(y)
        self._latest = self.stamp = int(stamps[-1])
        self._u = float(u[-1])
        return piece

    def _one_by_one(
        self, stamps: NDArray[np.int64], y: NDArray[np.float64], u: NDArray[np.float64]
    ) -> Trajectory:
        estimates, states = [], []
        for stamp, sample, known in zip(stamps.tolist(), y.tolist(), u.tolist(), strict=True):
            self.set_input(known)
            estimates.append(self.update(stamp, sample))
            states.append(self.observer.state.levels)
        z, d, gamma, innovation, words = (
            np.array(column) for column in zip(*estimates, strict=True)
        )
        levels = np.array(states)
        return Trajectory(
            stamps, z, d, gamma, innovation,
            words & ((1 << LEVEL_SHIFT) - 1), words >> LEVEL_SHIFT,
            levels[:, layout.HAT], levels[:, layout.TILDE],
        )  # fmt: skip

    @property
    def estimate(self) -> Estimate | None:
        """The latest estimate, None before the first sample."""
        return None if self.stamp is None else self.observer.estimate

    def _count_rejected(self, word: int) -> None:
        counters = self.counters
        if word & Status.REJECTED_MEASUREMENT:
            counters.rejected_measurements += 1
        elif word & Status.REJECTED_PERIOD:
            counters.rejected_stamps += 1
        else:
            counters.rejected_steps += 1
