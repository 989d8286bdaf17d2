# SPDX-License-Identifier: Apache-2.0
"""Triangular models (paper eq. triangular): z_i' = z_{i+1} + Phi_i(z_1..z_i, u)."""

from collections.abc import Mapping, Sequence
from typing import Any

from fhaosmo_ros.core.model.expressions import check_names, is_linear, parse
from fhaosmo_ros.core.model.inputs import known_inputs
from fhaosmo_ros.core.model.phi import Expressions, INPUT
from fhaosmo_ros.core.parameters.errors import ConfigurationError
from fhaosmo_ros.core.parameters.tables import CONSTANTS
import numpy as np
from numpy.typing import ArrayLike


class TriangularModel:
    """
    The functions Phi_1 .. Phi_n of a triangular system, from expressions.

    Parameters
    ----------
    phi : sequence of str
        One expression a state.
    order : int, optional
        Number of states n, to be checked against ``len(phi)``.
    inputs : sequence of str
        Names of the known inputs, in the order of their values.
    constants : mapping
        Numbers by name.

    Attributes
    ----------
    order : int
        Number of states n.
    expressions : Expressions
        Phi_1 .. Phi_n.
    inputs : tuple of str
        Names of the known inputs u_1 .. u_m, in the order of their values.
    used_inputs : tuple of str
        Those of them that an expression of Phi uses.
    is_linear : bool
        Every Phi is a linear function of the states, whatever the known inputs.

    Raises
    ------
    ConfigurationError
        A wrong number of expressions, or one that is not allowed.

    """

    def __init__(
        self,
        phi: Sequence[str],
        order: int | None = None,
        inputs: Sequence[str] = ('u',),
        constants: Mapping[str, float] = {},
    ) -> None:
        if order is not None and len(phi) != order:
            raise ConfigurationError(
                f"parameter 'phi': expected {order} expressions (order = {order}), "
                f'got {len(phi)}: {list(phi)!r}'
            )
        self.phi = tuple(phi)
        self.order = len(self.phi)
        check_names(inputs, constants)
        self.inputs = tuple(inputs)
        self._parsed = [parse(text, i + 1, inputs, constants) for i, text in enumerate(self.phi)]
        used = {index for tokens in self._parsed for code, index in tokens if code == INPUT}
        self.used_inputs = tuple(name for k, name in enumerate(self.inputs) if k in used)
        self.is_linear = all(is_linear(tokens) for tokens in self._parsed)
        self.expressions = Expressions(self._parsed, self.order, len(self.inputs))

    @classmethod
    def of(cls, parameters: Mapping[str, Any]) -> 'TriangularModel':
        """Return the model that checked parameters describe."""
        constants = {
            name.removeprefix(CONSTANTS): value
            for name, value in parameters.items()
            if name.startswith(CONSTANTS)
        }
        return cls(parameters['phi'], parameters['order'], parameters['inputs'], constants)

    def with_unknown_input(self, decay: float, derivatives: int) -> Expressions:
        """
        Return the expressions with the model of the unknown input behind those of the states.

        It is Phi_i = -decay z_i (1/s) of the levels i = n + 1 .. n + 1 + derivatives (D 17).
        """
        levels = range(self.order + 1, self.order + 2 + derivatives)
        behind = [parse(f'-{decay!r} * z{i}', i) if decay > 0.0 else [] for i in levels]
        expressions = [*self._parsed, *behind]
        return Expressions(expressions, len(expressions), len(self.inputs))

    def evaluate(self, z: np.ndarray, u: ArrayLike = 0.0) -> np.ndarray:
        """Return Phi(z, u), shape (n,); u is a number or an array (m,)."""
        values, _ = self.expressions.along(z, np.zeros(self.order), known_inputs(u, self.inputs))
        return np.asarray(values)

    def jacobian(self, z: np.ndarray, u: ArrayLike = 0.0) -> np.ndarray:
        """Return the exact Jacobian dPhi_i/dz_j, shape (n, n), lower triangular."""
        inputs = known_inputs(u, self.inputs)
        columns = [self.expressions.along(z, e, inputs)[1] for e in np.eye(self.order)]
        return np.stack(columns, axis=1)

    @property
    def slopes_at_rest(self) -> np.ndarray:
        """The Jacobian at z = 0, with 0 where a slope is not finite."""
        slopes = self.jacobian(np.zeros(self.order))
        return np.asarray(np.nan_to_num(slopes, posinf=0.0, neginf=0.0))
