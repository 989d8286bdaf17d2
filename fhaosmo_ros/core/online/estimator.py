# SPDX-License-Identifier: Apache-2.0
"""The update path of time-stamped samples, shared by the node and by replays of bags."""

from collections.abc import Mapping
import math
from pathlib import Path
from typing import Any, NamedTuple

from fhaosmo_ros.core.model.inputs import known_inputs_of_run
from fhaosmo_ros.core.observer import arrays
from fhaosmo_ros.core.observer.configuration import ObserverConfiguration
from fhaosmo_ros.core.observer.estimates import Estimate, ObserverState, Trajectory
from fhaosmo_ros.core.observer.observer import make_record, Observer
from fhaosmo_ros.core.observer.self_tuning.members import Tuning
from fhaosmo_ros.core.observer.smoothing import make_problem
from fhaosmo_ros.core.online import delay, policy
from fhaosmo_ros.core.online import memory as at
from fhaosmo_ros.core.online.counters import Counters
from fhaosmo_ros.core.online.events import check_events, EventDetector
from fhaosmo_ros.core.online.memory import EstimatorArrays, make_policy, Memory
from fhaosmo_ros.core.online.past_estimates import check_lag, PastEstimates
from fhaosmo_ros.core.online.stamps import forget_samples
from fhaosmo_ros.core.parameters.declaration import Parameters
from fhaosmo_ros.core.parameters.errors import ConfigurationError
from fhaosmo_ros.core.parameters.files import make_from_file
from fhaosmo_ros.core.parameters.tables import ESTIMATOR_PARAMETERS, ONLINE_PARAMETERS
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
    events : EventDetector
        Judges each estimate of d, as it is before any smoothing; `events.taken()` returns what has
        begun or ended since it was called last.

    Raises
    ------
    ConfigurationError
        An unknown name, a bad value, or values that do not fit together.

    """

    def __init__(self, parameters: Mapping[str, Any] | None = None) -> None:
        if not isinstance(parameters, Parameters):
            parameters = ESTIMATOR_PARAMETERS.complete(parameters)
        self._parameters = ONLINE_PARAMETERS.complete(parameters)
        self.observer = Observer(self._parameters)
        p = self._parameters
        if p['input_delay'] > p['measurement_delay']:
            raise ConfigurationError(
                "parameters 'input_delay', 'measurement_delay': expected each at most the next "
                f'one, got {p["input_delay"]} and {p["measurement_delay"]}'
            )
        check_events(p)
        self._smoothing: PastEstimates | None = None
        if p['smoothing_lag'] > 0.0:
            check_lag(p)
            self._smoothing = PastEstimates(self.observer, round(p['smoothing_lag'] / NANOSECONDS))
        self._lag = 0
        if self.observer.uses_input:
            self._lag = round((p['measurement_delay'] - p['input_delay']) / NANOSECONDS)
        past = np.zeros(0)
        if self.observer.uses_input and p['measurement_delay']:
            past = delay.make_past(len(self.observer.inputs), self._lag)
        self._policy = make_policy(self.observer.initial_state(), past)
        self._ints, self._reals = self._policy
        self.events = EventDetector(p, self._policy)
        self._eps = self.observer.innovations
        self._u = np.zeros(len(self.observer.inputs))
        self._word = 0
        self._write_settings()

    @classmethod
    def from_yaml(
        cls, path: str | Path, node: str = 'estimator', channel: str = ''
    ) -> 'OnlineEstimator':
        """
        Return one with the parameters of a file for ROS, such as the `gains.yaml` of `tune`.

        Parameters
        ----------
        path : path
            A YAML file of the form ``estimator: {ros__parameters: {...}}``.
        node : str
            Whose sections to take, such as '/rig/estimator'.
        channel : str
            Name of the channel, of a node that has several.

        Raises
        ------
        ConfigurationError
            As the constructor, or a file that can't be used; the message begins with its path.

        """
        return make_from_file(cls, path, node, channel)

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
    def smooths(self) -> bool:
        """True if estimates are of the past."""
        return self._smoothing is not None

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
        """
        Time of the latest estimate in nanoseconds; None where `estimate` is None.

        The stamp of its sample, less `measurement_delay` unless the estimate is carried over it.
        With `smoothing_lag` its sample is the one that is so old.
        """
        if self._smoothing is not None:
            return self._smoothing.stamp if self._smoothing.estimate else None
        return int(self._ints[at.STAMP]) - self._behind if self._ints[at.VALID] else None

    @property
    def _behind(self) -> int:
        """How long before the stamp of its sample an estimate belongs, in nanoseconds."""
        return 0 if self._ints[at.TO_NOW] else int(self._ints[at.DELAY])

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

    @property
    def offset(self) -> float:
        """What y is taken to be too large by, since a jump that the model contradicts (D 23)."""
        return float(self._arrays.state.memory[arrays.OFFSET])

    def prepare(self, changes: Mapping[str, Any]) -> Change:
        """Return what `adopt` takes for these changes; raise as `configure`, change nothing."""
        parameters = self._parameters.changed_live(changes, 'observer')
        configuration = self.observer.prepare(parameters)
        check_events(parameters)
        if self._smoothing is not None:
            check_lag(parameters)
            make_problem(configuration)
        return Change(parameters, configuration)

    def adopt(self, change: Change) -> None:
        """Go on with a change that `prepare` has returned, from the next sample on."""
        before = self._parameters['sampling']
        self._parameters = change.parameters
        self.observer.adopt(change.configuration)
        if self._smoothing is not None:
            self._smoothing.configure()
        self.events.configure(change.parameters)
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
            (at.DELAY, 'measurement_delay'),
        ):  # fmt: skip
            ints[index] = round(p[name] / NANOSECONDS)
        ints[at.LAG] = self._lag
        ints[at.TO_NOW] = p['predict_to_now']
        ints[at.FILTERED] = p['estimate_from'] == 'filtered'
        ints[at.GATE_SAMPLES] = p['spike_gate_samples']
        reals[at.GATE] = p['spike_gate']
        reals[at.LIMIT] = p['divergence_limit']
        reals[at.EPSILON] = math.inf if self.observer.self_tuning else p['epsilon']
        ints[at.BRIDGED] = 0  # the state before a gap is that of the parameters before
        levels, memory = self.observer.initial_state()
        size = levels.size + memory.size
        reals[at.STATES : at.STATES + size] = np.concatenate([levels.ravel(), memory])
        self._arguments = (self._eps, ints, reals, *self.observer.arguments)
        self._arrays = EstimatorArrays(*self.observer.arrays, self._policy)

    def reset(self) -> None:
        """Start afresh: the next sample is the first. Counters go on, and so does `freeze`."""
        forget_samples(self._policy, self._arrays.state)
        self.events.reset()
        if self._smoothing is not None:
            self._smoothing.cut()

    def smooth(self) -> None:
        """
        Let `run` return smoothed estimates, each once later samples no longer matter to it.

        To be called before the first sample; `finish` returns the rest. The samples that come
        later matter for some time constants of the observer, so memory stays bounded.

        Raises
        ------
        ConfigurationError
            `noise_size` is 0, which says how much to trust a sample; or `predict_to_now`.

        """
        check_lag(self._parameters)
        self._smoothing = PastEstimates(self.observer, None)

    @property
    def due(self) -> NDArray[np.int64]:
        """Which samples, counted from 0, the rows are of that `run` or `finish` returned last."""
        return np.zeros(0, dtype=np.int64) if self._smoothing is None else self._smoothing.numbers

    def finish(self) -> Trajectory:
        """Return the smoothed estimates that still wait: nothing comes after them."""
        if self._smoothing is None:
            raise ConfigurationError('finish: expected smoothing_lag > 0, or a call of `smooth`')
        return self._smoothing.finish()

    @property
    def latest(self) -> int | None:
        """Stamp of the latest sample that was used, in nanoseconds; a reset does not forget it."""
        return int(self._ints[at.STAMP]) or None

    @property
    def memory(self) -> Memory:
        """All that it remembers; a copy."""
        state, named = self.observer.state, self._named
        size = state.levels.size + state.memory.size
        before = self._reals[at.STATES + size : at.STATES + 2 * size]
        levels = state.levels.ravel()
        return Memory(
            integers=self._ints[at.FROZEN : at.COUNTERS].copy(),
            reals=self._reals[at.INTERVAL : at.STATES].copy(),
            before=np.concatenate([before[:named], before[levels.size :]]),
            now=np.concatenate([levels[:named], state.memory]),
            u=self._u.copy(),
            past=self._reals[at.STATES + 2 * size :].copy(),
            members=levels[named:],
        )

    @property
    def _named(self) -> int:
        """How many of the state's levels are not those of members."""
        n = self.observer.levels
        return (arrays.ROWS + n) * n

    def remember(self, memory: Memory) -> None:
        """
        Go on where an estimator was that had this memory; parameters and counters stay.

        Raises
        ------
        ConfigurationError
            The memory is of an observer with another number of levels, or of known inputs.

        """
        levels, scalars = self._arrays.state
        named, size = self._named, levels.size + scalars.size
        if (
            len(memory.now) + len(memory.members) != size
            or len(memory.now) != named + scalars.size
        ):
            raise ConfigurationError(
                f'memory: expected that of {self.observer.levels} levels and '
                f'{levels.size - named} numbers of members, got {len(memory.now)} and '
                f'{len(memory.members)} numbers'
            )
        if len(memory.u) != len(self._u):
            raise ConfigurationError(
                f'memory: expected {len(self._u)} known inputs, got {len(memory.u)}'
            )
        past = self._reals[at.STATES + 2 * size :]
        if memory.past.shape != past.shape:
            raise ConfigurationError(
                'memory: expected the past of the known inputs for measurement_delay = '
                f'{self._parameters["measurement_delay"]:g} s ({len(past)} numbers), got '
                f'{len(memory.past)} numbers'
            )
        self._ints[at.FROZEN : at.COUNTERS] = memory.integers
        self._reals[at.INTERVAL : at.STATES] = memory.reals
        saved = self._reals[at.STATES + size : at.STATES + 2 * size]
        saved[:named], saved[levels.size :] = memory.before[:named], memory.before[named:]
        past[:] = memory.past
        state = np.concatenate([memory.now[:named], memory.members])
        self.observer.restore(ObserverState(state.reshape(levels.shape), memory.now[named:]))
        self._u[:] = memory.u
        if self._smoothing is not None:
            self._smoothing.cut()

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
        if self._smoothing is not None:
            self._smoothing.cut()

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
    def inputs(self) -> tuple[float, ...]:
        """The known inputs that are held, in the order of `Observer.inputs`."""
        return tuple(self._u.tolist())

    def set_input(self, u: float, index: int = 0) -> bool:
        """
        Hold a known input from now on.

        Parameters
        ----------
        u : float
        index : int
            Which one, in the order of `Observer.inputs`.

        Returns
        -------
        bool
            False if it is not finite: then the one before is held, and this one counted.

        """
        if not np.isfinite(u):
            self.reject_inputs(1)
            return False
        self._u[index] = u
        return True

    def reject_inputs(self, count: int) -> None:
        """Count values of u that were not finite."""
        self._ints[at.REJECTED_INPUTS] += count

    def update(self, stamp: int, y: float) -> Estimate | None:
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
            Of this sample, or the previous state's with the reason of the rejection. With
            `smoothing_lag` that of the time so long ago; None while there is none.

        """
        word = self.advance(int(stamp), y)
        return self._published(word) if self._smoothing is None else self.estimate

    def advance(self, stamp: int, y: float) -> int:
        """Do what `update` does and return only the status word; see `estimate`."""
        try:
            word: int = policy.take_once(stamp, float(y), self._u, *self._arguments)
        except OverflowError:  # beyond 64 bits
            stamp = LARGEST_STAMP if stamp > 0 else -LARGEST_STAMP
            word = policy.take_once(stamp, float(y), self._u, *self._arguments)
        self._word = word
        if self.events.on:
            self._judge_one(stamp, word)
        if self._smoothing is not None:
            self._smoothing.take_one(self._arrays, self._eps, word, self._u)
        return word

    def _judge_one(self, stamp: int, word: int) -> None:
        observer = self.observer
        deviation = observer.standard_deviation[-1:] if observer.self_tuning else None
        now = self._ints[[at.LATEST]]
        self.events.take([stamp - self._behind], [observer.unknown_input], deviation, now, [word])

    def run(self, stamps: ArrayLike, y: ArrayLike, u: ArrayLike | None = None) -> Trajectory:
        """
        Take many samples, bit for bit as `update` would take one after the other.

        Parameters
        ----------
        stamps : (K,) array of int
            Times of the samples in nanoseconds.
        y : (K,) array
            Samples.
        u : number, (K,) or (K, m) array, optional
            Known input, or known inputs, of the interval that ends at each sample; without it,
            those that are held.

        Returns
        -------
        Trajectory
            A row for every sample, whose status says whether it was rejected. ``t`` holds the
            times of the estimates: the stamps, less `measurement_delay` unless `predict_to_now`.
            With `smoothing_lag`, or after `smooth`, a row for each used sample whose estimate has
            become final.

        Raises
        ------
        ConfigurationError
            Arrays whose shapes do not fit.

        """
        stamps = np.ascontiguousarray(stamps, dtype=np.int64)
        y = np.ascontiguousarray(y, dtype=np.float64)
        if y.ndim != 1 or stamps.shape != y.shape:
            raise ConfigurationError(
                'run: expected stamps and y with one dimension and equal length, got shapes '
                f'{stamps.shape} and {y.shape}'
            )
        count, n = len(y), self.observer.levels
        inputs = np.tile(self._u, (count, 1))
        if u is not None:
            inputs = known_inputs_of_run(u, count, self.observer.inputs).copy()
            for k, j in np.argwhere(~np.isfinite(inputs)):
                inputs[k, j] = inputs[k - 1, j] if k else self._u[j]
                self.reject_inputs(1)
        record = make_record(count, n, count, self.observer.self_tuning)
        carried = bool(self._ints[at.TO_NOW] and self._ints[at.DELAY])
        present = np.empty((count if carried else 0, self.observer.order + 1))
        rows = count if self.events.on or self._smoothing is not None else 0
        times, acting = np.empty(rows, dtype=np.int64), np.empty((rows, len(self._u)))
        policy.run(self._arrays, stamps, y, inputs, record, present, times, acting)
        if count:
            self._u[:], self._word = inputs[-1], int(record.words[-1])
            self._eps[0] = record.eps[-1]
        found = self.observer.trajectory(stamps - self._behind, record)
        if self.events.on:
            deviations = found.standard_deviation[:, -1] if self.observer.self_tuning else None
            self.events.take(found.t, found.unknown_input, deviations, times, record.words)
        if carried:
            found = found._replace(z=present[:, :-1], unknown_input=present[:, -1])
        if self._smoothing is not None:
            return self._smoothing.take(found, times, acting)
        return found

    @property
    def estimate(self) -> Estimate | None:
        """
        The latest estimate.

        None before the first sample (that is `smoothing_lag` old), and from a jump of y, which z_1
        follows at once, until the next sample that is used.
        """
        if self._smoothing is not None:
            return self._smoothing.estimate
        return self._published(self._word) if self._ints[at.VALID] else None

    @property
    def standard_deviation(self) -> NDArray[np.float64]:
        """
        Standard deviations of the errors of `estimate`: of z and d, (n + 1,).

        As a self-tuning observer expects them; NaN with fixed gains.
        """
        if self._smoothing is not None:
            return self._smoothing.standard_deviation
        return self.observer.standard_deviation

    @property
    def tuning(self) -> Tuning:
        """What a self-tuning observer had found at the sample of `estimate`."""
        if self._smoothing is not None:
            return Tuning.of(self._smoothing.tuning)
        return self.observer.tuning

    def _published(self, word: int) -> Estimate:
        estimate = self.observer.report(word)
        if not (self._ints[at.TO_NOW] and self._ints[at.DELAY]):
            return estimate
        present = np.empty(self.observer.order + 1)
        delay.published_once(self._arrays, present)
        return estimate._replace(z=present[:-1], unknown_input=float(present[-1]))
