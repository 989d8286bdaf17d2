# SPDX-License-Identifier: Apache-2.0
"""The observer: one sample at a time, or arrays of samples, by the same compiled recursion."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from fhaosmo_ros.core.compiled.unowned_arrays import table_of
from fhaosmo_ros.core.model.inputs import known_inputs, known_inputs_of_run
from fhaosmo_ros.core.model.triangular import TriangularModel
from fhaosmo_ros.core.observer import arrays
from fhaosmo_ros.core.observer import step as recursion
from fhaosmo_ros.core.observer.arrays import Law, make_work, State, Work
from fhaosmo_ros.core.observer.configuration import ObserverConfiguration
from fhaosmo_ros.core.observer.estimates import Estimate, ObserverState, Trajectory
from fhaosmo_ros.core.observer.self_tuning.members import TUNING, Tuning
from fhaosmo_ros.core.observer.self_tuning.step import step_address
from fhaosmo_ros.core.observer.smoother import BLOCK, Smoother
from fhaosmo_ros.core.observer.status import FLAGS_MASK, LEVEL_SHIFT, REJECTED
from fhaosmo_ros.core.parameters.declaration import Parameters
from fhaosmo_ros.core.parameters.errors import ConfigurationError
from fhaosmo_ros.core.parameters.files import make_from_file
from fhaosmo_ros.core.parameters.tables import ESTIMATOR_PARAMETERS
import numpy as np
from numpy.typing import ArrayLike, NDArray


def make_record(
    rows: int, levels: int, rows_of_eps: int, self_tuning: bool = False
) -> recursion.Record:
    """Return memory for a compiled run to record into."""
    return recursion.Record(
        np.empty((rows, 4 if self_tuning else 2, levels)),
        np.empty(rows),
        np.empty((rows_of_eps, levels)),
        np.empty(rows, dtype=np.int64),
        np.empty((rows, len(TUNING) if self_tuning else 0)),
    )


class Observer:
    """
    Fuzzy-based super-twisting adaptive-order sliding mode observer.

    Parameters
    ----------
    parameters : mapping, optional
        Values for the parameters in docs/parameters.md; defaults for the rest. Those of the
        estimator that are not the observer's are checked and left out, so that it takes what
        `tune` has written. `Parameters` have been checked and are taken as they are.

    Raises
    ------
    ConfigurationError
        An unknown name, a bad value, or values that do not fit together.

    Examples
    --------
    >>> observer = Observer({'order': 2, 'phi': ['0', '-z2'], 'lambda': 15, 'alpha': 30})
    >>> observer.start(0.1).z
    array([0.1, 0. ])
    >>> observer.step(0.1, dt=0.001).status
    <Status.OK: 0>

    """

    def __init__(self, parameters: Mapping[str, Any] | None = None) -> None:
        if not isinstance(parameters, Parameters):
            parameters = ESTIMATOR_PARAMETERS.complete(parameters)
        self._configuration = ObserverConfiguration(parameters)
        self._state = self._configuration.initial_state()
        self._set_law()
        self._eps = np.zeros((1, self._configuration.levels))
        self._u = np.zeros(len(self.inputs))
        self._t: float | int | None = None
        self._word = 0

    @classmethod
    def from_yaml(cls, path: str | Path, node: str = 'estimator', channel: str = '') -> 'Observer':
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
    def parameters(self) -> dict[str, Any]:
        """All parameters with their present values; a copy."""
        return dict(self._configuration.parameters)

    @property
    def order(self) -> int:
        """Number of states n."""
        return self._configuration.model.order

    @property
    def levels(self) -> int:
        """Number of levels N."""
        return self._configuration.levels

    @property
    def configuration(self) -> ObserverConfiguration:
        """Its parameters, checked as a set, and what follows from them."""
        return self._configuration

    @property
    def law(self) -> Law:
        """What the compiled functions read of the parameters."""
        return self._law

    def make_work(self) -> Work:
        """Return scratch memory for the compiled functions."""
        return make_work(self._law, self._configuration.model.depth)

    @property
    def self_tuning(self) -> bool:
        """True if it finds its gains by itself."""
        return bool(self._configuration.self_tuning)

    @property
    def standard_deviation(self) -> NDArray[np.float64]:
        """
        Standard deviations of the errors of z and d, (n + 1,), as a self-tuning observer expects.

        Infinite before it knows the noise; NaN for an observer with fixed gains.
        """
        variances = self._state.levels[arrays.COVARIANCE, : self.order + 1]
        return np.sqrt(variances) if self.self_tuning else np.full(self.order + 1, np.nan)

    @property
    def tuning(self) -> Tuning:
        """What a self-tuning observer has found; NaN before it knows the noise."""
        found = np.empty(len(TUNING))
        recursion.tell_tuning(self._law.flags, self._state.memory, found)
        return Tuning.of(found)

    @property
    def uses_input(self) -> bool:
        """True if the model uses a known input."""
        return self._configuration.model.uses_input

    @property
    def model(self) -> TriangularModel:
        """Phi, and the names of the known inputs."""
        return self._configuration.model

    @property
    def inputs(self) -> tuple[str, ...]:
        """Names of the known inputs, in the order of their values."""
        return self._configuration.model.inputs

    @property
    def used_inputs(self) -> tuple[str, ...]:
        """Names of those of them that the model uses."""
        return self._configuration.model.used_inputs

    @property
    def started(self) -> bool:
        """True once a sample has arrived."""
        y = self._state.memory[arrays.Y]
        return bool(y == y)  # NaN before the first sample; np.isnan costs half a microsecond

    @property
    def state(self) -> ObserverState:
        """Snapshot of the state."""
        levels, memory = self._state
        return ObserverState(levels.copy(), memory.copy(), self._t)

    def restore(self, state: ObserverState) -> None:
        """
        Go back to a snapshot, of this observer or of another one of the same size.

        Raises
        ------
        ConfigurationError
            The snapshot is of an observer with another number of levels.

        """
        if state.levels.shape != self._state.levels.shape:
            raise ConfigurationError(
                f'state: expected {self.levels} levels, got {state.levels.shape[-1]}'
            )
        self._write(state.levels, state.memory)
        self._t = state.t
        self._fit_memory()

    def prepare(self, changes: Mapping[str, Any]) -> ObserverConfiguration:
        """Return what `adopt` takes for these changes; raise as `configure`, change nothing."""
        return self._configuration.changed(changes)

    def configure(self, changes: Mapping[str, Any]) -> None:
        """
        Change parameters from the next sample on, without a jump of the estimate.

        All or nothing: where anything is wrong, nothing has changed.

        Raises
        ------
        ConfigurationError
            As the constructor, or a change of a parameter that fixes the observer's size.

        """
        self.adopt(self.prepare(changes))

    def adopt(self, configuration: ObserverConfiguration) -> None:
        """Go on with a configuration that `prepare` has returned, from the next sample on."""
        law = self._law
        before, chances = law.flags, law.chances
        self._configuration = configuration
        self._set_law()
        self._fit_memory()
        after = self._law.flags
        step = arrays.PREDICTION_STEP
        same_model = np.array_equal(law.model.code, self._law.model.code)
        if not same_model or law.scalars[step] != self._law.scalars[step]:
            # What self-tuning members know of the model (D 27) is that of another one.
            self._state.memory[[arrays.FLOW_PERIOD, arrays.UNSETTLED]] = 0.0
        if not before[arrays.SENSITIVE] or before[arrays.LEVANT] != after[arrays.LEVANT]:
            self._state.levels[arrays.HAT_SENSITIVITY : arrays.ROWS] = 0.0  # not carried along
        steady = arrays.part(arrays.STEADY, self.levels)
        same = before[arrays.SCHEDULED] == after[arrays.SCHEDULED]
        if not same or not np.array_equal(
            chances[steady], self._law.chances[steady]
        ):  # P is of other sizes
            self._state.memory[arrays.SETTLED] = 1.0

    def _set_law(self) -> None:
        law = self._configuration.law
        law = self._law = law._replace(flags=law.flags.copy())
        self._work = self.make_work()
        flat_law = (law.flags, law.gains, law.curves, law.scalars, law.chances, *law.model)
        self._arguments = (*flat_law, *self._work, *self._state)
        self._set_addresses()

    def _set_addresses(self) -> None:
        if self.self_tuning:
            flags, self._table = self._law.flags, table_of(self._arguments)
            flags[arrays.STEP_AT] = step_address()
            flags[arrays.TABLE_AT] = self._table.ctypes.data

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Complete a copy: its arrays are elsewhere than those that it was made from."""
        self.__dict__.update(state)
        self._set_addresses()

    def _write(self, levels: NDArray[np.float64], memory: NDArray[np.float64]) -> None:
        self._state.levels[:] = levels
        self._state.memory[:] = memory

    def _fit_memory(self) -> None:
        """Bring gamma within its bounds, and forget sensitivities that are not carried along."""
        flags, c, (levels, memory) = self._law.flags, self._law.scalars, self._state
        if flags[arrays.ADAPTIVE]:
            memory[arrays.GAMMA] = np.clip(memory[arrays.GAMMA], c[arrays.MIN], c[arrays.MAX])
        else:
            memory[arrays.GAMMA] = self._configuration.gamma_initial
        if not flags[arrays.SENSITIVE]:
            levels[arrays.HAT_SENSITIVITY : arrays.ROWS] = 0.0
        if not (flags[arrays.SCHEDULED] or flags[arrays.SELF_TUNING]) and memory[arrays.OFFSET]:
            memory[arrays.Y] += memory[arrays.OFFSET]
            memory[arrays.OFFSET] = memory[arrays.JUMPS] = 0.0

    def reset(self) -> None:
        """Go back to the initial state; the next sample is the first."""
        self._write(*self.initial_state())
        self._t = None

    def initial_state(self) -> State:
        """Return the state of this observer before its first sample."""
        return self._configuration.initial_state()

    def start(self, y: float) -> Estimate:
        """Take the first sample: time has not passed yet, so nothing is integrated."""
        self._word = recursion.start(self._law, self._state, float(y), self._eps, 0)
        return self._estimate(self._word)

    def step(self, y: float, dt: float, u: ArrayLike = 0.0) -> Estimate:
        """
        Advance by `dt` to the sample `y`.

        The explicit scheme integrates over the interval with the sample at its beginning, as
        forward Euler does, so that `y` acts from the next step on; the implicit scheme uses `y`.

        Parameters
        ----------
        y : float
            Measured output at the end of the interval.
        dt : float
            Time since the previous call, in seconds, > 0.
        u : number or (m,) array
            Known input, or known inputs, during the interval.

        Returns
        -------
        Estimate
            Bad data does not raise: `Estimate.status` says what was rejected, the state stays as
            it was, and the time of a rejected sample is added to the next step (see `Status`).

        """
        word = self.advance(y, dt, u)
        return self._estimate(word)

    def advance(self, y: float, dt: float, u: ArrayLike = 0.0) -> int:
        """Do what `step` does and return only the status word; see `estimate`."""
        if not self.started and np.isfinite(y):
            self.start(y)
        if type(u) is float and len(self._u) == 1:
            self._u[0] = u
        else:
            self._u[:] = known_inputs(u, self.inputs)
        sample = float(y), float(dt), self._u, self._eps
        self._word = recursion.step_once(*self._arguments, *sample)
        return self._word

    @property
    def estimate(self) -> Estimate:
        """Estimate of the present state, with the status of the last step."""
        return self._estimate(self._word)

    @property
    def unknown_input(self) -> float:
        """The estimate's unknown input alone, which costs less."""
        return float(self._state.levels[self._configuration.unknown_input_at])

    @property
    def unknown_input_address(self) -> int:
        """Where `unknown_input` lies in memory, for compiled functions; until `configure`."""
        row, column = self._configuration.unknown_input_at
        return int(self._state.levels[row, column:].ctypes.data)

    @property
    def arguments(self) -> tuple[Any, ...]:
        """
        Arrays that compiled functions work on, one by one: of law, scratch memory and state.

        For `step_once` and the policy's own entries; valid until the next `configure`.
        """
        return self._arguments

    @property
    def arrays(self) -> tuple[Law, Work, State]:
        """The same as bundles, for runs of many samples."""
        return self._law, self._work, self._state

    @property
    def innovations(self) -> NDArray[np.float64]:
        """Innovations of the last step, (1, N); not a copy."""
        return self._eps

    def report(self, word: int) -> Estimate:
        """Return the estimate of the present state after steps that ended with `word`."""
        self._word = word
        return self._estimate(word)

    def _estimate(self, word: int) -> Estimate:
        z, d = self.select(self._state.levels)
        gamma = float(self._state.memory[arrays.GAMMA])
        return Estimate(z, float(d), gamma, self._eps[0].copy(), word)

    def select(self, levels: NDArray[Any]) -> tuple[NDArray[Any], Any]:
        """Return copies of the estimates of z and d from arrays of shape (..., rows, N)."""
        n = self.order
        hat, tilde = levels[..., arrays.HAT, :], levels[..., arrays.TILDE, :]
        z = hat[..., :n].copy()
        if self._configuration.internal:
            z[..., 1:] = tilde[..., : n - 1]
        return z, levels[(..., *self._configuration.unknown_input_at)].copy()

    def run(
        self, t: ArrayLike, y: ArrayLike, u: ArrayLike | float = 0.0, every: int = 1
    ) -> Trajectory:
        """
        Step through arrays; the state goes on from where it is, so a run can be split.

        Parameters
        ----------
        t : (K,) array
            Sample times, in seconds, or in nanoseconds if integers. A sample that does not lie
            after all samples before it is rejected.
        y : (K,) array
            Samples.
        u : number, (K,) or (K, m) array
            Known input, or known inputs, during the interval that ends at each sample.
        every : int
            Record every `every`-th sample only.

        Returns
        -------
        Trajectory
            Row k is the estimate after sample ``(k + 1) * every - 1``. A fresh observer takes
            the first sample as `start` does, else time goes on from the last run's last sample.

        Raises
        ------
        ConfigurationError
            Arrays whose shapes do not fit, or `every` < 1.

        """
        t, y = np.asarray(t), np.ascontiguousarray(y, dtype=np.float64)
        if t.ndim != 1 or y.shape != t.shape:
            raise ConfigurationError(
                f'run: expected t and y with one dimension and equal length, '
                f'got shapes {t.shape} and {y.shape}'
            )
        if every < 1:
            raise ConfigurationError(f'run: expected every >= 1, got {every}')
        u = known_inputs_of_run(u, len(y), self.inputs)
        first = 0
        if not self.started:
            self._t = None
            good = np.flatnonzero(np.isfinite(recursion.HEADROOM * y))
            first = good[0] + 1 if len(good) else len(y)
        samples = recursion.Samples(y, self._periods(t, first), u)
        rows = len(y) // every
        record = make_record(rows, self.levels, rows + 1, self.self_tuning)
        recursion.run(self._law, self._work, self._state, samples, record, first, every)
        recursion.innovations(self._law, self._state, self._state.memory[arrays.Y], self._eps, 0)
        return self.trajectory(t[every - 1 :: every], record._replace(eps=record.eps[:rows]))

    def smooth(self, t: ArrayLike, y: ArrayLike, u: ArrayLike | float = 0.0) -> Trajectory:
        """
        Estimate each time from the samples before and after it (D 24, D 25).

        A fresh observer goes forward through the samples; this one stays as it is. A sample that
        it rejects (NaN stands for a missing one) does not count, and its time is bridged by those
        on both sides. Nothing is smoothed across a restart.

        Parameters
        ----------
        t, y, u
            As in `run`.

        Returns
        -------
        Trajectory
            A row for each sample, with `z`, `unknown_input` and `standard_deviation` smoothed; the
            rest as `run` has it.

        Raises
        ------
        ConfigurationError
            As `run`; or gains are fixed and `noise_size` is 0, which says how much to trust a
            sample.

        """
        t, y = np.asarray(t), np.asarray(y, dtype=np.float64)
        u = known_inputs_of_run(u, len(t), self.inputs).copy()
        observer = Observer(self._configuration.parameters)
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
            status, inputs = part.status[rows.start - start :], u[rows]
            for k in np.flatnonzero(~np.isfinite(inputs).all(axis=1)):  # the last ones are held
                inputs[k] = inputs[k - 1] if k else held
            times = np.fmax.accumulate(np.append(latest, t[rows]))
            h = np.diff(times) * (1e-9 if np.issubdtype(t.dtype, np.integer) else 1.0)
            latest, held = times[-1], inputs[-1]
            kinds = smoother.kinds(status)
            levels = np.stack([part.z_hat, part.z_tilde], axis=1)[rows.start - start :]
            used = (part.z_hat + part.innovation)[rows.start - start :, 0]
            numbers = np.arange(rows.start, rows.stop)
            models = part.model[rows.start - start :].copy()
            deviations = part.standard_deviation[rows.start - start :]
            smoother.take(
                *observer.arrays[:2], levels, (used, h, inputs), numbers, kinds, models, deviations
            )
            found.append(smoother.due())
        found.append(smoother.finish())
        whole = Trajectory(*(np.concatenate(column) for column in zip(*parts, strict=True)))
        if first is None:
            return whole
        estimates, n = np.concatenate(found), observer.order
        whole.z[first:], whole.unknown_input[first:] = estimates[:, 0, :n], estimates[:, 0, n]
        if observer.self_tuning:
            whole.standard_deviation[first:] = np.sqrt(estimates[:, 1, : n + 1])
        return whole

    def trajectory(self, t: NDArray[Any], record: recursion.Record) -> Trajectory:
        """Return what a compiled run has recorded; the last row is where this observer stands."""
        words, levels = record.words, record.levels
        if len(words):
            self._word = int(words[-1])
        z, d = self.select(levels)
        deviations = model = np.empty((len(words), 0))
        if self.self_tuning:
            deviations = np.sqrt(levels[:, recursion.VARIANCES, : self.order + 1])
            model = levels[:, recursion.LIKELIEST_MODEL, :4]
        return Trajectory(
            t,
            z,
            d,
            record.gamma,
            record.eps,
            words & FLAGS_MASK,
            words >> LEVEL_SHIFT,
            levels[:, arrays.HAT],
            levels[:, arrays.TILDE],
            deviations,
            model,
            record.tuning,
        )

    def _periods(self, t: NDArray[Any], first: int) -> NDArray[np.float64]:
        """Return the time of each sample since the latest sample before it, in seconds."""
        integers = np.issubdtype(t.dtype, np.integer)
        t = t.astype(np.int64 if integers else np.float64)
        known = t if integers else np.where(np.isfinite(t), t, np.nan)
        # Times before the first sample do not count.
        known = known[max(first - 1, 0) :]
        if not len(known):
            return np.zeros(len(t))
        start = self._t if self._t is not None else known[0]
        latest = np.fmax.accumulate(np.concatenate([[start], known]).astype(t.dtype))
        self._t = latest[-1].item()
        h = np.zeros(len(t))
        h[len(t) - len(known) :] = t[len(t) - len(known) :] - latest[:-1]
        return h * 1e-9 if integers else h
