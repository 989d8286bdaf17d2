# SPDX-License-Identifier: Apache-2.0
"""The simulated plant (paper eq. newsimpledynamics): triangular system, unknown input, sensor."""

from collections.abc import Mapping
import math
from typing import Any, NamedTuple

from fhaosmo_ros.core.compiled.cache import compiled
from fhaosmo_ros.core.model.bytecode import Bytecode, Floats
from fhaosmo_ros.core.model.inputs import known_inputs, known_inputs_of_run
from fhaosmo_ros.core.model.integrate import (
    begin_step,
    CLASSICAL,
    NOW,
    take_slope,
    triangular_rates,
)
from fhaosmo_ros.core.model.triangular import TriangularModel
from fhaosmo_ros.core.observer.configuration import per_level
from fhaosmo_ros.core.parameters.declaration import Parameters
from fhaosmo_ros.core.parameters.errors import ConfigurationError
from fhaosmo_ros.core.parameters.tables import PLANT_PARAMETERS
from fhaosmo_ros.core.simulation.disturbance import (
    disturbance,
    disturbances,
    KINDS,
    NAMES,
    SAMPLED,
)
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
    """
    What the compiled integration works on.

    Attributes
    ----------
    model : Bytecode
        Phi_1 .. Phi_n.
    kind, wave : int, array
        Of d(t); see disturbance.py.
    stages, stack : arrays
        Scratch memory; see core/model/integrate.py.

    """

    model: Bytecode
    kind: int
    wave: Floats
    stages: Floats
    stack: Floats


def make_system(model: TriangularModel, kind: int, wave: Floats) -> System:
    """Return a plant with this model and unknown input."""
    stages = np.zeros((4, 2, model.order))
    return System(model.expressions, kind, wave, stages, np.zeros((2, model.depth)))


@compiled()
def integrate_step(system: System, z: Floats, t: float, h: float, u: Floats) -> None:
    """Take one step of P triangular by the classical Runge-Kutta method, in place."""
    stages, n = system.stages, z.shape[0]
    for i in range(n):
        stages[NOW, 0, i] = z[i]
    begin_step(stages)
    for stage in range(CLASSICAL.nodes.size):
        d = disturbance(system.kind, system.wave, t + CLASSICAL.nodes[stage] * h)
        triangular_rates(system.model, d, u, system.stack, stages)
        take_slope(CLASSICAL, stage, h, stages)
    for i in range(n):
        z[i] = stages[NOW, 0, i]


@compiled()
def _advance(
    system: System, z: Floats, at: Floats, step: int, t: float, h: float, u: Floats
) -> int:
    """
    Bring the grid state `z` (at time step * h) up to `t`, and `at` to `t` itself.

    Only whole steps of the fixed grid change `z`; the rest of the way to `t` is taken on a copy,
    so that the trajectory doesn't depend on the times at which somebody looks.
    """
    while (step + 1) * h <= t:
        integrate_step(system, z, step * h, h, u)
        step += 1
    for i in range(z.shape[0]):
        at[i] = z[i]
    if t > step * h:
        integrate_step(system, at, step * h, t - step * h, u)
    return step


@compiled()
def _simulate(
    system: System, z: Floats, step: int, t: Floats, h: float, u: Floats, states: Floats
) -> int:
    """Write the states at many times; return the number of the grid's step."""
    for k in range(t.shape[0]):
        step = _advance(system, z, states[k], step, t[k], h, u[k])
    return step


@compiled()
def _respond(system: System, z: Floats, t: Floats, h: float, u: Floats, states: Floats) -> None:
    """Write the states at many times; each interval is divided evenly."""
    for k in range(t.shape[0]):
        begin = t[k - 1] if k > 0 else 0.0
        count = max(1, int(np.ceil((t[k] - begin) / h - 1e-9)))
        step = (t[k] - begin) / count
        for j in range(count):
            if step > 0.0:
                integrate_step(system, z, begin + j * step, step, u[k])
        for i in range(z.shape[0]):
            states[k, i] = z[i]


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
        p = self._parameters = PLANT_PARAMETERS.complete(parameters)
        self._model = TriangularModel.of(p)
        n = self._model.order
        self._h = float(p['integration_step'])
        self._z = per_level(PLANT_PARAMETERS['initial_state'], p['initial_state'], n)
        self._at = self._z.copy()
        self._step = 0
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
    def model(self) -> TriangularModel:
        """Phi, and the names of the known inputs."""
        return self._model

    @property
    def uses_input(self) -> bool:
        """True if the model uses a known input."""
        return self._model.uses_input

    def configure(self, changes: Mapping[str, Any]) -> None:
        """
        Change live parameters from now on; all or nothing.

        Raises
        ------
        ConfigurationError
            An unknown name, a bad value, or a parameter that can't change live.

        """
        self.adopt(self.prepare(changes))
        if 'noise_seed' in changes:
            self._random = np.random.default_rng(self._parameters['noise_seed'])

    def prepare(self, changes: Mapping[str, Any]) -> Parameters:
        """Return what `adopt` takes for these changes; raise as `configure`, change nothing."""
        parameters = self._parameters.changed_live(changes, 'plant')
        TriangularModel.of(parameters)  # raises where it can't be used with other constants
        return parameters

    def adopt(self, parameters: Parameters) -> None:
        """Go on with parameters that `prepare` has returned."""
        self._parameters = parameters
        self._model = TriangularModel.of(parameters)
        self._system = self._make_system()

    def _make_system(self) -> System:
        return make_system(self._model, *unknown_input(self._parameters))

    def advance(self, t: float, u: ArrayLike = 0.0) -> None:
        """
        Integrate up to the time `t` (s since the start), with known inputs held.

        Parameters
        ----------
        t : float
        u : number or (m,) array
            Known inputs.

        Raises
        ------
        ConfigurationError
            A time that is not finite, or another number of inputs.

        """
        if not math.isfinite(t):
            raise ConfigurationError(f'plant: expected a finite time, got {t}')
        inputs = known_inputs(u, self._model.inputs)
        self._step = _advance(
            self._system, self._z, self._at, self._step, float(t), self._h, inputs
        )

    @property
    def finite(self) -> bool:
        """False once the states have left the finite numbers."""
        return bool(np.isfinite(self._at).all())

    def sample(self, t: float, u: ArrayLike = 0.0) -> Truth:
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
        u : number, (K,) or (K, m) array
            Known input, or known inputs, during the interval that ends at each time.

        Returns
        -------
        Truth
            Arrays with K rows.

        Raises
        ------
        ConfigurationError
            A time that is not finite, or u of another shape.

        """
        t = np.ascontiguousarray(t, dtype=np.float64)
        if not np.all(np.isfinite(t)):
            raise ConfigurationError('plant: expected finite times, got some that are not')
        u = known_inputs_of_run(u, len(t), self._model.inputs)
        z = np.empty((len(t), self.order))
        self._step = _simulate(self._system, self._z, self._step, t, self._h, u, z)
        d = disturbances(self._system.kind, self._system.wave, t)
        return Truth(self._measured(z[:, 0]), z, d)

    def _measured(self, z1: Floats) -> Floats:
        p = self._parameters
        y = z1 + p['noise_std'] * self._random.standard_normal(len(z1))
        return quantised(y, p['quantisation'])


def quantised(y: Floats, step: float) -> Floats:
    """Return y rounded to multiples of `step`; as it is for 0, or if it has too many of them."""
    if step <= 0.0:
        return y
    with np.errstate(over='ignore', invalid='ignore'):  # y / step may exceed the largest double
        rounded = np.round(y / step) * step
    return np.where(np.isfinite(rounded), rounded, y)


def unknown_input(p: Mapping[str, Any]) -> tuple[int, Floats]:
    """Return kind and numbers of d(t) from a plant's parameters; see disturbance.py."""
    wave = np.array([p[f'disturbance_{name}'] for name in NAMES], dtype=np.float64)
    return KINDS.index(p['disturbance']), wave


class Response(NamedTuple):
    """States (K, n) and unknown input (K,) at some times."""

    z: Floats
    d: Floats


def respond(
    model: TriangularModel,
    initial_state: ArrayLike,
    t: ArrayLike,
    table: ArrayLike,
    spacing: float,
    u: ArrayLike | float = 0.0,
    step: float = 1e-4,
) -> Response:
    """
    Return the response of a model to any d(t), integrated from t = 0: for training data.

    Parameters
    ----------
    model : TriangularModel
    initial_state : (n,) array
        z at t = 0.
    t : (K,) array
        When to look, in seconds, not decreasing, not below 0.
    table : (M,) array
        d at 0, spacing, 2 spacing, ...; linear in between, constant behind the end. M >= 2.
    spacing : float
        Seconds.
    u : number, (K,) or (K, m) array
        Known input, or known inputs, held during the interval that ends at each time.
    step : float
        Longest step in seconds; each interval is divided evenly.

    """
    t = np.ascontiguousarray(t, dtype=np.float64)
    wave = np.concatenate([[spacing], np.asarray(table, dtype=np.float64)])
    u = known_inputs_of_run(u, len(t), model.inputs)
    z = np.array(np.broadcast_to(initial_state, model.order), dtype=np.float64)
    states = np.empty((len(t), model.order))
    _respond(make_system(model, SAMPLED, wave), z, t, step, u, states)
    return Response(states, disturbances(SAMPLED, wave, t))
