# SPDX-License-Identifier: Apache-2.0
"""The observer: one sample at a time, or arrays of samples, by the same compiled recursion."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

from fhaosmo_ros.core import kernels, law, layout
from fhaosmo_ros.core.configuration import FIXED_GAMMA, ObserverConfiguration
from fhaosmo_ros.core.errors import ConfigurationError
from fhaosmo_ros.core.law import Law, make_work, Work
from fhaosmo_ros.core.status import flags, LEVEL_SHIFT, open_levels, Status
import numpy as np
from numpy.typing import ArrayLike, NDArray


class Estimate(NamedTuple):
    """
    What the observer knows after a sample.

    Attributes
    ----------
    z : (n,) array
        Estimated states; z[0] is z_hat_1, the others follow `estimate_from`.
    unknown_input : float
        Estimated d.
    gamma : float
        Power gamma in use.
    innovation : (N,) array
        eps_i = m_i - z_hat_i.
    word : int
        Status word; see `status` and `open_levels`.

    """

    z: NDArray[np.float64]
    unknown_input: float
    gamma: float
    innovation: NDArray[np.float64]
    word: int

    @property
    def status(self) -> Status:
        """Flags of the step."""
        return flags(self.word)

    @property
    def open_levels(self) -> int:
        """Number of levels that run (the paper's E_i)."""
        return open_levels(self.word)


class Trajectory(NamedTuple):
    """
    Estimates of a run; row k belongs to ``t[k]``. Attributes as in `Estimate`.

    Attributes
    ----------
    t : (K,) array
        Times as given.
    z : (K, n) array
    unknown_input, gamma : (K,) arrays
    innovation : (K, N) array
    status, open_levels : (K,) integer arrays
        Where `every` > 1, a row's flags are those of all samples since the row before it.
    z_hat, z_tilde : (K, N) arrays
        Filtered and internal states; z_tilde[:, i] belongs to z_{i+2}.

    """

    t: NDArray[Any]
    z: NDArray[np.float64]
    unknown_input: NDArray[np.float64]
    gamma: NDArray[np.float64]
    innovation: NDArray[np.float64]
    status: NDArray[np.int64]
    open_levels: NDArray[np.int64]
    z_hat: NDArray[np.float64]
    z_tilde: NDArray[np.float64]


@dataclass(frozen=True)
class ObserverState:
    """
    All that an observer remembers; a copy, safe to keep.

    Attributes
    ----------
    levels : (4, N) array
    memory : (4,) array
        See `fhaosmo_ros.core.layout`.
    t : float or int or None
        Time of the last sample of `Observer.run`, in its unit (s, or ns for integers).

    """

    levels: NDArray[np.float64]
    memory: NDArray[np.float64]
    t: float | int | None = None


class Observer:
    """
    Fuzzy-based super-twisting adaptive-order sliding mode observer.

    Parameters
    ----------
    parameters : mapping, optional
        Values for the parameters in docs/parameters.md; defaults for the rest.

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
        self._configuration = ObserverConfiguration(parameters or {})
        self._law = self._configuration.law
        count = self._configuration.levels
        self._levels = np.zeros((layout.ROWS, count))
        self._memory = np.zeros(layout.SCALARS)
        self._work = self.make_work()
        self._eps = np.zeros((1, count))
        self._t: float | int | None = None
        self._word = 0
        self.reset()

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
    def law(self) -> Law:
        """What the kernels read of the parameters."""
        return self._law

    def make_work(self) -> Work:
        """Return scratch memory for the kernels."""
        return make_work(self.law, self._configuration.model.depth)

    @property
    def uses_input(self) -> bool:
        """True if the model uses the known input u."""
        return self._configuration.model.uses_input

    @property
    def started(self) -> bool:
        """True once a sample has arrived."""
        y = self._memory[layout.Y]
        return bool(y == y)  # NaN before the first sample

    @property
    def state(self) -> ObserverState:
        """Snapshot of the state."""
        return ObserverState(self._levels.copy(), self._memory.copy(), self._t)

    def restore(self, state: ObserverState) -> None:
        """
        Go back to a snapshot, of this observer or of another one of the same size.

        Raises
        ------
        ConfigurationError
            The snapshot is of an observer with another number of levels.

        """
        if state.levels.shape != self._levels.shape:
            raise ConfigurationError(
                f'state: expected {self.levels} levels, got {state.levels.shape[-1]}'
            )
        self._levels[:] = state.levels
        self._memory[:] = state.memory
        self._t = state.t
        self._fit_memory()

    def check(self, changes: Mapping[str, Any]) -> None:
        """Raise what `configure` would raise, and change nothing."""
        self._configuration.changed(changes)

    def configure(self, changes: Mapping[str, Any]) -> None:
        """
        Change parameters from the next sample on, without a jump of the estimate.

        All or nothing: where anything is wrong, nothing has changed.

        Raises
        ------
        ConfigurationError
            As the constructor, or a change of a parameter that fixes the observer's size.

        """
        self._adopt(self._configuration.changed(changes))

    def _adopt(self, configuration: ObserverConfiguration) -> None:
        before = self._law.flags
        self._configuration = configuration
        self._law = configuration.law
        self._fit_memory()
        after = self._law.flags
        if not before[law.SENSITIVE] or before[law.LEVANT] != after[law.LEVANT]:
            self._levels[layout.HAT_SENSITIVITY :] = 0.0  # they were not carried along

    def _fit_memory(self) -> None:
        flags, c = self._law.flags, self._law.scalars
        gamma = self._memory[layout.GAMMA]
        self._memory[layout.GAMMA] = (
            np.clip(gamma, c[law.MIN], c[law.MAX]) if flags[law.ADAPTIVE] else FIXED_GAMMA
        )
        if not flags[law.SENSITIVE]:
            self._levels[layout.HAT_SENSITIVITY :] = 0.0

    def reset(self) -> None:
        """Go back to the initial state; the next sample is the first."""
        self._levels[:] = 0.0
        self._levels[layout.HAT] = self._configuration.initial_estimate
        self._levels[layout.TILDE] = self._configuration.initial_internal
        self._memory[:] = 0.0
        self._memory[layout.Y] = np.nan
        self._t = None
        self._memory[layout.GAMMA] = self._configuration.gamma_initial

    def start(self, y: float) -> Estimate:
        """Take the first sample: time has not passed yet, so nothing is integrated."""
        flags, scalars = self._law.flags, self._law.scalars
        self._word = kernels.start(
            flags, scalars, self._levels, self._memory, float(y), self._eps, 0
        )
        return self._estimate(self._word)

    def step(self, y: float, dt: float, u: float = 0.0) -> Estimate:
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
        u : float
            Known input during the interval.

        Returns
        -------
        Estimate
            Bad data does not raise: `Estimate.status` says what was rejected, the state stays as
            it was, and the time of a rejected sample is added to the next step (see `Status`).

        """
        word = self.advance(y, dt, u)
        return self._estimate(word)

    def advance(self, y: float, dt: float, u: float = 0.0) -> int:
        """Do what `step` does and return only the status word; see `estimate`."""
        if not self.started and np.isfinite(y):
            self.start(y)
        self._word = kernels.step_once(
            *self._law, *self._work, self._levels, self._memory,
            float(y), float(dt), float(u), self._eps,
        )  # fmt: skip
        return self._word

    @property
    def estimate(self) -> Estimate:
        """Estimate of the present state, with the status of the last step."""
        return self._estimate(self._word)

    @property
    def unknown_input(self) -> float:
        """The estimate's unknown input alone, which costs less."""
        return float(self._levels[self._configuration.unknown_input_at])

    @property
    def unknown_input_address(self) -> int:
        """Where `unknown_input` lies in memory, for compiled functions; until `configure`."""
        row, column = self._configuration.unknown_input_at
        return int(self._levels[row, column:].ctypes.data)

    @property
    def arguments(self) -> tuple[Any, ...]:
        """
        Arrays that compiled functions work on: law, scratch, levels, memory.

        For the policy, which steps this observer itself; valid until the next `configure`.
        """
        return (*self._law, *self._work, self._levels, self._memory)

    @property
    def innovations(self) -> NDArray[np.float64]:
        """Innovations of the last step, (1, N); not a copy."""
        return self._eps

    def report(self, word: int) -> Estimate:
        """Return the estimate of the present state after steps that ended with `word`."""
        self._word = word
        return self._estimate(word)

    def _estimate(self, word: int) -> Estimate:
        z, d = self.select(self._levels)
        gamma = float(self._memory[layout.GAMMA])
        return Estimate(z, float(d), gamma, self._eps[0].copy(), word)

    def select(self, levels: NDArray[Any]) -> tuple[NDArray[Any], Any]:
        """Return copies of the estimates of z and d from arrays of shape (..., rows, N)."""
        n = self.order
        hat, tilde = levels[..., layout.HAT, :], levels[..., layout.TILDE, :]
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
        u : (K,) array or float
            Known input during the interval that ends at each sample.
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
        u = np.asarray(u, dtype=np.float64)
        if u.shape not in ((), y.shape):
            raise ConfigurationError(
                f'run: expected u to be a number or an array as long as y, got shapes {u.shape} '
                f'and {y.shape}'
            )
        u = np.ascontiguousarray(np.broadcast_to(u, y.shape))
        first = 0
        if not self.started:
            self._t = None
            good = np.flatnonzero(np.isfinite(kernels.HEADROOM * y))
            first = good[0] + 1 if len(good) else len(y)
        return self.step_through(t, y, self._periods(t, first), u, first, every)

    def step_through(
        self, t: NDArray[Any], y: NDArray[np.float64], h: NDArray[np.float64],
        u: NDArray[np.float64], first: int, every: int = 1,
    ) -> Trajectory:  # fmt: skip
        """
        Step through arrays whose periods are known: what `run` and a replay have in common.

        Bit for bit what `start` does with the samples before index `first`, and `step` with those
        from it on.

        Parameters
        ----------
        t : (K,) array
            Goes to the trajectory as it is.
        y, h, u : (K,) contiguous arrays
            Samples, the time (s) and the known input of the interval that ends at each.
        first : int
            Number of samples that are taken before any time passes.
        every : int
            As in `run`.

        """
        rows, n = len(y) // every, self.levels
        out, eps = np.empty((rows, 2, n)), np.empty((rows + 1, n))
        gamma, words = np.empty(rows), np.empty(rows, dtype=np.int64)
        kernels.run(
            *self._law, *self._work, self._levels, self._memory,
            y, h, u, out, gamma, eps, words, first, every,
        )  # fmt: skip
        y_last = self._memory[layout.Y]
        kernels.innovations(self._law.scalars, self._levels, y_last, self._eps, 0)
        return self.trajectory(t[every - 1 :: every], out, gamma, eps[:rows], words)

    def trajectory(
        self, t: NDArray[Any], out: NDArray[np.float64], gamma: NDArray[np.float64],
        eps: NDArray[np.float64], words: NDArray[np.int64],
    ) -> Trajectory:  # fmt: skip
        """Return what a compiled run has recorded; the last row is where this observer stands."""
        if len(words):
            self._word = int(words[-1])
        z, d = self.select(out)
        return Trajectory(
            t, z, d, gamma, eps, words & ((1 << LEVEL_SHIFT) - 1), words >> LEVEL_SHIFT,
            out[:, layout.HAT], out[:, layout.TILDE],
        )  # fmt: skip

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
