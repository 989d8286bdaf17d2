# SPDX-License-Identifier: Apache-2.0
"""Triangular models (paper eq. triangular): z_i' = z_{i+1} + Phi_i(z_1..z_i, u)."""

from collections.abc import Sequence

from fhaosmo_ros.core.model.bytecode import Bytecode, evaluate, INPUT
from fhaosmo_ros.core.model.expressions import assembled, parse
from fhaosmo_ros.core.parameters.errors import ConfigurationError
import numpy as np

ROOM_FOR_DECAY = 4
"""Stack size that is enough for the expression in `TriangularModel.with_unknown_input`."""


class TriangularModel:
    """
    The functions Phi_1 .. Phi_n of a triangular system, from expressions.

    Parameters
    ----------
    phi : sequence of str
        One expression a state.
    order : int, optional
        Number of states n, to be checked against ``len(phi)``.

    Attributes
    ----------
    order : int
        Number of states n.
    expressions : Bytecode
        Phi_1 .. Phi_n, and an empty one for the level of the unknown input, whose Phi is 0.
    depth : int
        Size of the stack that the expressions need, those of `with_unknown_input` included.

    Raises
    ------
    ConfigurationError
        A wrong number of expressions, or one that is not allowed.

    """

    def __init__(self, phi: Sequence[str], order: int | None = None) -> None:
        if order is not None and len(phi) != order:
            raise ConfigurationError(
                f"parameter 'phi': expected {order} expressions (order = {order}), "
                f'got {len(phi)}: {list(phi)!r}'
            )
        self.phi = tuple(phi)
        self.order = len(self.phi)
        self._parsed = [parse(text, i + 1) for i, text in enumerate(self.phi)]
        self.expressions = assembled([*self._parsed, []])
        self.depth = max(ROOM_FOR_DECAY, *map(len, self._parsed))

    @property
    def uses_input(self) -> bool:
        """True if a Phi uses the known input u."""
        return bool(np.any(self.expressions.code[:, 0] == INPUT))

    def with_unknown_input(self, decay: float, derivatives: int) -> Bytecode:
        """
        Return the expressions with the model of the unknown input behind those of the states.

        Parameters
        ----------
        decay : float
            kappa in Phi_i = -kappa z_i of every z_i with i > n (D 17).
        derivatives : int
            k: levels n + 1 .. n + 1 + k.

        """
        levels = range(self.order + 1, self.order + 2 + derivatives)
        behind = [parse(f'-{decay!r} * z{i}', i) if decay > 0.0 else [] for i in levels]
        return assembled([*self._parsed, *behind])

    def evaluate(self, z: np.ndarray, u: float = 0.0) -> np.ndarray:
        """Return Phi(z, u), shape (n,)."""
        return self._along(z, np.zeros(self.order), u)[0]

    def jacobian(self, z: np.ndarray, u: float = 0.0) -> np.ndarray:
        """Return the exact Jacobian dPhi_i/dz_j, shape (n, n), lower triangular."""
        columns = [self._along(z, e, u)[1] for e in np.eye(self.order)]
        return np.stack(columns, axis=1)

    def _along(self, z: np.ndarray, dz: np.ndarray, u: float) -> tuple[np.ndarray, np.ndarray]:
        point = np.array([z, dz], dtype=np.float64)
        stack = np.empty((2, self.depth))
        pairs = [evaluate(self.expressions, i, point, float(u), stack) for i in range(self.order)]
        values, slopes = np.array(pairs).T
        return values, slopes
