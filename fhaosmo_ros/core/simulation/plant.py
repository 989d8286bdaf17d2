# SPDX-License-Identifier: Apache-2.0
"""The simulated plant (paper eq. newsimpledynamics): triangular system, unknown input, sensor."""

from collections.abc import Mapping
from typing import Any, NamedTuple

from fhaosmo_ros.core.model.inputs import Floats, known_inputs
from fhaosmo_ros.core.model.triangular import TriangularModel
from fhaosmo_ros.core.observer.configuration import per_level
from fhaosmo_ros.core.parameters.declaration import Parameters
from fhaosmo_ros.core.parameters.tables import PLANT_PARAMETERS
from fhaosmo_ros.core.simulation.system import Disturbance, System
import numpy as np
from numpy.typing import ArrayLike


class Truth(NamedTuple):
    """The plant at one time, or at K times (arrays with a leading axis)."""

    y: Any  # float or (K,): measured output, with noise and quantisation
    z: Floats  # (n,) or (K, n): states
    unknown_input: Any  # float or (K,): d


class Plant:
    """
    A triangular system driven by an unknown input, on a clock that starts at 0.

    Parameters
    ----------
    parameters : mapping, optional
        Values for the plant's parameters in docs/parameters.md; defaults for the rest.
    **named
        Parameters as keyword arguments, which win.

    Attributes
    ----------
    parameters : Parameters
        All parameters with their present values.
    model : TriangularModel
        Phi, and the names of the known inputs.

    Raises
    ------
    ConfigurationError
        An unknown name, a bad value, or values that do not fit together.

    """

    def __init__(self, parameters: Mapping[str, Any] | None = None, /, **named: Any) -> None:
        p = self.parameters = PLANT_PARAMETERS.complete(parameters, named)
        self.model = TriangularModel.of(p)
        z = per_level(PLANT_PARAMETERS['initial_state'], p['initial_state'], self.model.order)
        self._d = Disturbance(p)
        self._system = System(self.model.expressions, self._d, p['integration_step'], z)
        self._random = np.random.default_rng(p['noise_seed'])

    def prepare(self, changes: Mapping[str, Any]) -> Parameters:
        """
        Return what `adopt` takes for these changes; nothing has changed yet.

        Raises
        ------
        ConfigurationError
            An unknown name, a bad value, or a parameter that can't change live.

        """
        parameters = self.parameters.changed_live(changes, 'plant')
        TriangularModel.of(parameters)  # raises where it can't be used with other constants
        return parameters

    def adopt(self, parameters: Parameters, noise_anew: bool) -> None:
        """Go on with parameters that `prepare` has returned; the noise may begin again."""
        self.parameters = parameters
        self.model, self._d = TriangularModel.of(parameters), Disturbance(parameters)
        self._system.change(self.model.expressions, self._d)
        if noise_anew:
            self._random = np.random.default_rng(parameters['noise_seed'])

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
        self._system.advance(t, known_inputs(u, self.model.inputs)[np.newaxis])

    @property
    def states(self) -> Floats:
        """States at the latest time, (n,); a copy."""
        return np.asarray(self._system.states)

    def unknown_input(self, t: float) -> float:
        """Return d at the time `t`."""
        return float(self._d.along(t)[0])

    def measure(self, t: float) -> float:
        """
        Advance to `t`, with the known inputs of the latest `advance`, and return y.

        This is the quick part of `sample`, for a node: what it takes is jitter of the stamp of y.
        """
        return float(self._measured(self._system.go_on(t)))

    def sample(self, t: float, u: ArrayLike = 0.0) -> Truth:
        """Advance to `t` and measure: y = z_1 + noise, quantised."""
        self.advance(t, u)
        return Truth(self.measure(t), self.states, self.unknown_input(t))

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
            A time that is not finite or before the last one, or u of another shape.

        """
        z = self._system.advance(t, known_inputs(u, self.model.inputs, np.size(t)))
        return Truth(self._measured(z[:, 0]), z, self._d.along(t))

    def _measured(self, z1: Any) -> Any:
        noise = self.parameters['noise_std']
        y = z1 + noise * self._random.standard_normal(np.shape(z1)) if noise > 0.0 else z1
        return quantised(y, self.parameters['quantisation'])


def quantised(y: Any, step: float) -> Any:
    """Return y rounded to multiples of `step`; as it is for 0, or if it has too many of them."""
    if step <= 0.0:
        return y
    with np.errstate(over='ignore', invalid='ignore'):  # y / step may exceed the largest double
        rounded = np.round(y / step) * step
    return np.where(np.isfinite(rounded), rounded, y)


def respond(
    model: TriangularModel,
    initial_state: ArrayLike,
    t: ArrayLike,
    table: ArrayLike,
    spacing: float,
    u: ArrayLike | float = 0.0,
    step: float = 1e-4,
) -> tuple[Floats, Floats]:
    """
    Return states (K, n) and d (K,) of a model driven by any d(t), from t = 0: for training data.

    `t` (K,) are the times (s), not decreasing, from 0 on; `table` (M,) has d at 0, `spacing`,
    2 `spacing`, .. (s), M >= 2, it is linear in between and constant behind the end; `u`, a
    number, (K,) or (K, m), is held during the interval that ends at each time. No step is longer
    than `step` (s).
    """
    d, z = Disturbance({}, table, spacing), np.broadcast_to(initial_state, model.order)
    inputs = known_inputs(u, model.inputs, np.size(t))
    states = System(model.expressions, d, step, z).advance(t, inputs)
    return states, d.along(t)
