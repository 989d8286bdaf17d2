# SPDX-License-Identifier: Apache-2.0
"""The simulated plant (paper eq. newsimpledynamics): triangular system, unknown input, sensor."""

from collections.abc import Mapping
import math
from typing import Any, NamedTuple

from fhaosmo_ros.core.configuration import per_level
from fhaosmo_ros.core.disturbance import disturbance, KINDS, NAMES
from fhaosmo_ros.core.errors import ConfigurationError
from fhaosmo_ros.core.model import TriangularModel
from fhaosmo_ros.core.parameters import PLANT_PARAMETERS
from fhaosmo_ros.core.tape import evaluate, Floats, Ints
from numba import njit
import numpy as np
from numpy.typing import ArrayLike, NDArray


class Truth(NamedTuple):
    """
    The plant at one time, or at many (arrays with a leading axis).

    Attributes
    ----------
    y : float or (K,) array
        Measured output, with noise and quantisation.
    z : (n,) or (K, n) array
        States.
    unknown_input : float or (K,) array
        d.

    """

    y: Any
    z: NDArray[np.float64]
    unknown_input: Any


class System(NamedTuple):
    """What drives the compiled integration: model tape and d(t)."""

    tape: Floats
    offsets: Ints
    kind: int
    wave: Floats


class Work(NamedTuple):
    """Scratch memory of the integration."""

    point: Floats  # (2, n): where the field is evaluated, and a tangent that stays 0
    slopes: Floats  # (4, n)
    stack: Floats  # (2, depth)


def make_work(order: int, depth: int) -> Work:
    """Return scratch memory for a model of this order, whose tapes need this stack depth."""
    return Work(np.zeros((2, order)), np.zeros((4, order)), np.zeros((2, depth)))


NODES = (0.0, 0.5, 0.5, 1.0)
WEIGHTS = (1.0 / 6.0, 1.0 / 3.0, 1.0 / 3.0, 1.0 / 6.0)


@njit(cache=True, error_model='numpy')
def rk4(system: System, work: Work, z: Floats, t: float, h: float, u: float) -> None:
    """One classical Runge-Kutta step of paper eq. triangular, in place."""
    n = z.shape[0]
    for stage in range(4):
        c = NODES[stage]
        for i in range(n):
            work.point[0, i] = z[i]
            if stage > 0:
                work.point[0, i] += c * h * work.slopes[stage - 1, i]
        for i in range(n):
            phi, _ = evaluate(
                system.tape, system.offsets[i], system.offsets[i + 1], work.point, u, work.stack
            )
            if i + 1 < n:
                work.slopes[stage, i] = work.point[0, i + 1] + phi
            else:
                d = disturbance(system.kind, system.wave, t + c * h)
                work.slopes[stage, i] = phi + d
    for i in range(n):
        for stage in range(4):
            z[i] += h * WEIGHTS[stage] * work.slopes[stage, i]


@njit(cache=True, error_model='numpy')
def _advance(
    system: System, work: Work, z: Floats, at: Floats, step: int, t: float, h: float, u: float
) -> int:
    """
    Bring the grid state `z` (at time step * h) up to `t`, and `at` to `t` itself.

    Only whole steps of the fixed grid change `z`; the rest of the way to `t` is taken on a copy,
    so that the trajectory doesn't depend on the times at which somebody looks.
    """
    while (step + 1) * h <= t:
        rk4(system, work, z, step * h, h, u)
        step += 1
    for i in range(z.shape[0]):
        at[i] = z[i]
    if t > step * h:
        rk4(system, work, at, step * h, t - step * h, u)
    return step


@njit(cache=True, error_model='numpy')
def _simulate(
    system: System, work: Work, z: Floats, step: int, t: Floats, h: float, u: Floats,
    states: Floats, d: Floats,
) -> int:  # fmt: skip
    for k in range(t.shape[0]):
        step = _advance(system, work, z, states[k], step, t[k], h, u[k])
        d[k] = disturbance(system.kind, system.wave, t[k])
    return step


class Plant:
    """
    A triangular system driven by an unknown input, on a clock that starts at 0.

    Parameters
    ----------
    parameters : mapping, optional
        Values for the plant's parameters in docs/parameters.md; defaults for the rest.

    Raises
    ------
    ConfigurationError
        An unknown name, a bad value, or values that do not fit together.

    """

    def __init__(self, parameters: Mapping[str, Any] | None = None) -> None:
        self._parameters: dict[str, Any] = PLANT_PARAMETERS.defaults() | PLANT_PARAMETERS.coerce(
            parameters or {}
        )
        p = self._parameters
        self._model = TriangularModel(p['phi'], p['order'])
        n = self._model.order
        self._h = float(p['integration_step'])
        self._z = per_level(PLANT_PARAMETERS['initial_state'], p['initial_state'], n)
        self._at = self._z.copy()
        self._step = 0
        self._work = make_work(n, self._model.depth)
        self._random = np.random.default_rng(p['noise_seed'])
        self._system = self._make_system()

    @property
    def parameters(self) -> dict[str, Any]:
        """All parameters with their present values; a copy."""
        return dict(self._parameters)

    @property
    def order(self) -> int:
        """Number of states n."""
        return self._model.order

    @property
    def uses_input(self) -> bool:
        """True if the model uses the known input u."""
        return self._model.uses_input

    def configure(self, changes: Mapping[str, Any]) -> None:
        """
        Change live parameters from now on; all or nothing.

        Raises
        ------
        ConfigurationError
            An unknown name, a bad value, or a parameter that can't change live.

        """
        changes = self.check(changes)
        self._parameters |= changes
        self._system = self._make_system()
        if 'noise_seed' in changes:
            self._random = np.random.default_rng(self._parameters['noise_seed'])

    def check(self, changes: Mapping[str, Any]) -> dict[str, Any]:
        """Return the changes in their own types; raise as `configure` does, change nothing."""
        changes = PLANT_PARAMETERS.coerce(changes)
        for name, value in changes.items():
            if not PLANT_PARAMETERS[name].live and value != self._parameters[name]:
                raise ConfigurationError(
                    f"parameter '{name}': can't change in a running plant "
                    f'(it is {self._parameters[name]!r}), got {value!r}'
                )
        return dict(changes)

    def _make_system(self) -> System:
        p, model = self._parameters, self._model
        wave = np.array([p[f'disturbance_{name}'] for name in NAMES], dtype=np.float64)
        kind = KINDS.index(p['disturbance'])
        return System(model.tape, model.offsets, kind, wave)

    def advance(self, t: float, u: float = 0.0) -> None:
        """
        Integrate up to the time `t` (s since the start), with the known input `u` held.

        Raises
        ------
        ConfigurationError
            A time that is not finite.

        """
        if not math.isfinite(t):
            raise ConfigurationError(f'plant: expected a finite time, got {t}')
        self._step = _advance(
            self._system, self._work, self._z, self._at, self._step, float(t), self._h, float(u)
        )

    def sample(self, t: float, u: float = 0.0) -> Truth:
        """Advance to `t` and measure: y = z_1 + noise, quantised."""
        self.advance(t, u)
        d = disturbance(self._system.kind, self._system.wave, float(t))
        return Truth(float(self._measured(self._at[:1])[0]), self._at.copy(), float(d))

    def simulate(self, t: ArrayLike, u: ArrayLike | float = 0.0) -> Truth:
        """
        Measure at many times.

        Parameters
        ----------
        t : (K,) array
            Times since the start, in seconds, not decreasing.
        u : (K,) array or float
            Known input during the interval that ends at each time.

        Returns
        -------
        Truth
            Arrays with K rows.

        Raises
        ------
        ConfigurationError
            A time that is not finite.

        """
        t = np.ascontiguousarray(t, dtype=np.float64)
        if not np.all(np.isfinite(t)):
            raise ConfigurationError('plant: expected finite times, got some that are not')
        u = np.ascontiguousarray(np.broadcast_to(np.asarray(u, dtype=np.float64), t.shape))
        z, d = np.empty((len(t), self.order)), np.empty(len(t))
        self._step = _simulate(self._system, self._work, self._z, self._step, t, self._h, u, z, d)
        return Truth(self._measured(z[:, 0]), z, d)

    def _measured(self, z1: Floats) -> Floats:
        p = self._parameters
        y = z1 + p['noise_std'] * self._random.standard_normal(len(z1))
        return quantised(y, p['quantisation'])


def quantised(y: Floats, step: float) -> Floats:
    """Return y rounded to multiples of `step`, or as it is for 0."""
    return np.round(y / step) * step if step > 0.0 else y
