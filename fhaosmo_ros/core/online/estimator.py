# SPDX-License-Identifier: Apache-2.0
"""The update path of time-stamped samples, shared by the node and by replays of bags."""

from collections.abc import Mapping
from typing import Any, NamedTuple

from fhaosmo_ros.core.observer import arrays
from fhaosmo_ros.core.observer.configuration import ObserverConfiguration
from fhaosmo_ros.core.observer.observer import (
    Estimate,
    make_record,
    Observer,
    ObserverState,
    Trajectory,
)
from fhaosmo_ros.core.online import memory as at
from fhaosmo_ros.core.online import policy
from fhaosmo_ros.core.online.counters import Counters
from fhaosmo_ros.core.online.memory import completed, EstimatorArrays, make_policy, Memory
from fhaosmo_ros.core.online.stamps import forget_samples
from fhaosmo_ros.core.parameters.declaration import Parameters
from fhaosmo_ros.core.parameters.errors import ConfigurationError
from fhaosmo_ros.core.parameters.tables import ONLINE_PARAMETERS
import numpy as np
from numpy.typing import ArrayLike, NDArray

NANOSECONDS = 1e-9
LARGEST_STAMP = 2**63 - 1


class Change(NamedTuple):
    """A live change of parameters that has been checked; see `OnlineEstimator.prepare`."""

    parameters: Parameters
    configuration: ObserverConfiguration


class OnlineEstimator:
    """
    An observer fed with time-stamped samples.

    Bad data does not raise and never makes an estimate that is not finite: it is rejected or
    survived, counted, and told by the status word. The policy, case by case, is in
    docs/operation.md; it is compiled (policy.py), and this class holds its memory.

    Parameters
    ----------
    parameters : mapping, optional
        Values for the observer's and the sampling parameters in docs/parameters.md; defaults for
        the rest. `Parameters` have been checked and are taken as they are.

    Attributes
    ----------
    observer : Observer
        To read parameters, sizes and state from; samples go through this class.

    Raises
    ------
    ConfigurationError
        An unknown name, a bad value, or values that do not fit together.

    """

    def __init__(self, parameters: Mapping[str, Any] | None = None) -> None:
        self._parameters = ONLINE_PARAMETERS.complete(parameters)
        self.observer = Observer(self._parameters)
        self._policy = make_policy(self.observer.initial_state())
        self._ints, self._reals = self._policy
        self._eps = self.observer.innovations
        self._u = 0.0
        self._word = 0
        self._write_settings()

    @property
    def arguments(self) -> tuple[NDArray[Any], ...]:
        """
        Arrays that `policy.take_once` works on, in its order.

        Always the same tuple until `configure`, which makes another one.
        """
        return self._arguments

    def taken(self, word: int) -> None:
        """Remember the status word of a sample that `policy.take_once` was given by others."""
        self._word = word

    @property
    def arrays(self) -> EstimatorArrays:
        """The same arrays, and its settings and memory, as bundles: for runs of many samples."""
        return self._arrays

    @property
    def uses_stamps(self) -> bool:
        """True if dt comes from the samples' stamps."""
        return not self._ints[at.NOMINAL]

    @property
    def parameters(self) -> dict[str, Any]:
        """All parameters with their present values; a copy."""
        return dict(self._parameters)

    @property
    def counters(self) -> Counters:
        """What has happened to the samples so far."""
        return Counters(*self._ints[at.COUNTERS :].tolist())

    @property
    def stamp(self) -> int | None:
        """Stamp of the sample behind the latest estimate, in nanoseconds."""
        return int(self._ints[at.STAMP]) if self._ints[at.VALID] else None

    @property
    def period(self) -> float:
        """Running mean of the intervals between samples, in seconds; 0 before there are any."""
        return float(self._reals[at.INTERVAL]) * NANOSECONDS

    @property
    def jitter(self) -> float:
        """Running mean of the intervals' distance from their mean, in seconds."""
        return float(self._reals[at.JITTER]) * NANOSECONDS

    @property
    def spread(self) -> float:
        """Size of the innovations over that expected from noise_size, at least 1 (D 21)."""
        return float(self._arrays.state.memory[arrays.SPREAD])

    def prepare(self, changes: Mapping[str, Any]) -> Change:
        """Return what `adopt` takes for these changes; raise as `configure`, change nothing."""
        parameters = self._parameters.changed(changes)
        return Change(parameters, self.observer.prepare(parameters))

    def adopt(self, change: Change) -> None:
        """Go on with a change that `prepare` has returned, from the next sample on."""
        before = self._parameters['sampling']
        self._parameters = change.parameters
        self.observer.adopt(change.configuration)
        if change.parameters['sampling'] != before:
            self.forget_stamp()
        self._write_settings()

    def configure(self, changes: Mapping[str, Any]) -> None:
        """
        Change live parameters from the next sample on, without a jump; all or nothing.

        Raises
        ------
        ConfigurationError
            An unknown name, a bad value, or a parameter that can't change live.

        """
        self.adopt(self.prepare(changes))

    def _write_settings(self) -> None:
        """Write what the compiled policy reads."""
        p, ints, reals = self._parameters, self._ints, self._reals
        ints[at.NOMINAL] = p['sampling'] == 'nominal'
        ints[at.CLOCK] = p['sampling'] == 'clock'
        for index, name in (
            (at.PERIOD, 'nominal_period'), (at.MAX_GAP, 'max_gap'), (at.MAX_STEP, 'max_step'),
            (at.STUCK_TIME, 'stuck_time'), (at.DIVERGENCE_TIME, 'divergence_time'),
        ):  # fmt: skip
            ints[index] = round(p[name] / NANOSECONDS)
        ints[at.GATE_SAMPLES] = p['spike_gate_samples']
        reals[at.GATE] = p['spike_gate']
        reals[at.LIMIT] = p['divergence_limit']
        reals[at.EPSILON] = p['epsilon']
        ints[at.BRIDGED] = 0  # the state before a gap is that of the parameters before
        levels, memory = self.observer.initial_state()
        size = levels.size + memory.size
        reals[at.STATES : at.STATES + size] = np.concatenate([levels.ravel(), memory])
        self._arguments = (self._eps, ints, reals, *self.observer.arguments)
        self._arrays = EstimatorArrays(*self.observer.arrays, self._policy)

    def reset(self) -> None:
        """Start afresh: the next sample is the first. Counters go on, and so does `freeze`."""
        forget_samples(self._policy, self._arrays.state)

    @property
    def latest(self) -> int | None:
        """Stamp of the latest sample that was used, in nanoseconds; a reset does not forget it."""
        return int(self._ints[at.STAMP]) or None

    @property
    def memory(self) -> Memory:
        """All that it remembers; a copy."""
        state = self.observer.state
        size = state.levels.size + state.memory.size
        return Memory(
            integers=self._ints[at.FROZEN : at.COUNTERS].copy(),
            reals=self._reals[at.INTERVAL : at.STATES].copy(),
            before=self._reals[at.STATES + size :].copy(),
            now=np.concatenate([state.levels.ravel(), state.memory]),
            u=self._u,
        )

    def remember(self, memory: Memory) -> None:
        """
        Go on where an estimator was that had this memory; parameters and counters stay.

        Raises
        ------
        ConfigurationError
            The memory is of an observer with another number of levels.

        """
        levels = self._arrays.state.levels
        size = levels.size + self._arrays.state.memory.size
        fresh = self._reals[at.STATES : at.STATES + size]
        now, before = completed(memory.now, fresh), completed(memory.before, fresh)
        if size != len(now):
            raise ConfigurationError(
                f'memory: expected that of {self.observer.levels} levels, got {len(now)} numbers'
            )
        self._ints[at.FROZEN : at.COUNTERS] = memory.integers
        self._reals[at.INTERVAL : at.STATES] = memory.reals
        self._reals[at.STATES + size :] = before
        state, scalars = now[: levels.size], now[levels.size :]
        self.observer.restore(ObserverState(state.reshape(levels.shape), scalars))
        self._u = memory.u

    def seed(self, z: ArrayLike, unknown_input: float) -> None:
        """
        Put the estimate there at once, as if the observer had converged; time and gamma go on.

        Before the first sample, or after `reset`, it is where the observer starts from; with
        start_from_measurement the first sample still sets z_1.

        Parameters
        ----------
        z : (n,) array
            States z_1 .. z_n.
        unknown_input : float
            d.

        Raises
        ------
        ConfigurationError
            A wrong number of values, or one that is not finite or beyond divergence_limit.

        """
        n, limit = self.observer.order, self._parameters['divergence_limit']
        values = np.append(np.asarray(z, dtype=np.float64), unknown_input)
        if values.shape != (n + 1,) or not (np.abs(values) <= limit).all():
            raise ConfigurationError(
                f'seed: expected {n} states and an unknown input, finite and of at most '
                f'{limit:g} (divergence_limit), got {z!r} and {unknown_input!r}'
            )
        levels, scalars = self._arrays.state
        levels[: arrays.ROWS] = 0.0
        scalars[arrays.SETTLED] = 1.0
        known = min(n + 1, self.observer.levels)  # derivatives of d, behind it, are 0
        levels[arrays.HAT, :known] = values[:known]
        levels[arrays.TILDE, :n] = values[1:]
        self._ints[at.BRIDGED] = 0

    def freeze(self, held: bool) -> None:
        """Hold gamma where it is, or let it adapt again; no parameter changes."""
        self._ints[at.FROZEN] = held
        self._ints[at.BRIDGED] = 0  # the state before a gap has another gamma

    @property
    def frozen(self) -> bool:
        """True while gamma is held."""
        return bool(self._ints[at.FROZEN])

    def forget_stamp(self) -> None:
        """Expect stamps of another clock: the next sample takes the usual period."""
        self._ints[at.TIMED] = self._ints[at.TICK_COUNT] = 0

    @property
    def input(self) -> float:
        """The known input u that is held."""
        return self._u

    def set_input(self, u: float) -> bool:
        """Hold `u` as the known input from now on; return False if it is not finite."""
        if not np.isfinite(u):
            self.reject_inputs(1)
            return False
        self._u = float(u)
        return True

    def reject_inputs(self, count: int) -> None:
        """Count values of u that were not finite."""
        self._ints[at.REJECTED_INPUTS] += count

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
        return self.observer.report(self.advance(int(stamp), y))

    def advance(self, stamp: int, y: float) -> int:
        """Do what `update` does and return only the status word; see `estimate`."""
        try:
            word: int = policy.take_once(stamp, float(y), self._u, *self._arguments)
        except OverflowError:  # beyond 64 bits
            limit = LARGEST_STAMP if stamp > 0 else -LARGEST_STAMP
            word = policy.take_once(limit, float(y), self._u, *self._arguments)
        self._word = word
        return word

    def run(
        self, stamps: NDArray[np.int64], y: NDArray[np.float64], u: NDArray[np.float64]
    ) -> Trajectory:
        """
        Take many samples, bit for bit as `update` would take one after the other.

        Parameters
        ----------
        stamps : (K,) array of int
            Times of the samples in nanoseconds.
        y : (K,) array
            Samples.
        u : (K,) array
            Known input of the interval that ends at each sample.

        Returns
        -------
        Trajectory
            A row for every sample, whose status says whether it was rejected. ``t`` holds the
            stamps.

        """
        count, n = len(y), self.observer.levels
        u = np.array(u, dtype=np.float64)
        for k in np.flatnonzero(~np.isfinite(u)):
            u[k] = u[k - 1] if k else self._u
            self.reject_inputs(1)
        record = make_record(count, n, count)
        stamps = np.ascontiguousarray(stamps, dtype=np.int64)
        policy.run(self._arrays, stamps, np.ascontiguousarray(y, dtype=np.float64), u, record)
        if count:
            self._u, self._word = float(u[-1]), int(record.words[-1])
            self._eps[0] = record.eps[-1]
        return self.observer.trajectory(stamps, record)

    @property
    def estimate(self) -> Estimate | None:
        """The latest estimate, None before the first sample."""
        return self.observer.report(self._word) if self._ints[at.VALID] else None
