# SPDX-License-Identifier: Apache-2.0
"""Triangular models (paper eq. triangular): z_i' = z_{i+1} + Phi_i(z_1..z_i, u)."""

from collections.abc import Sequence
from itertools import pairwise

from fhaosmo_ros.core.errors import ConfigurationError
from fhaosmo_ros.core.expressions import as_array, parse
from fhaosmo_ros.core.tape import evaluate, INPUT
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
    tape : (T, 2) array
        All expressions' tapes, one after the other.
    offsets : (n + 2,) array
        Phi_i occupies ``offsets[i - 1]:offsets[i]``; the last part is empty, for the level of the
        unknown input (whose Phi is 0).
    depth : int
        Stack size that the tapes need, that of `with_unknown_input` included.

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
        tapes = [parse(text, i + 1) for i, text in enumerate(self.phi)]
        self.tape = as_array([i for part in tapes for i in part])
        self.offsets = np.cumsum([0, *(len(part) for part in tapes), 0], dtype=np.int64)
        self.depth = max([ROOM_FOR_DECAY, *(len(part) for part in tapes)])

    @property
    def uses_input(self) -> bool:
        """True if a Phi uses the known input u."""
        return bool(np.any(self.tape[:, 0] == INPUT))

    def with_unknown_input(self, decay: float, derivatives: int) -> tuple[np.ndarray, np.ndarray]:
        """
        Return tape and offsets with the model of the unknown input behind the states.

        Parameters
        ----------
        decay : float
            kappa in Phi_i = -kappa z_i of every z_i with i > n (D 17).
        derivatives : int
            k: levels n + 1 .. n + 1 + k.

        """
        parts, offsets = [self.tape], list(self.offsets[: self.order + 1])
        for level in range(self.order + 1, self.order + 2 + derivatives):
            part = parse(f'-{decay!r} * z{level}', level) if decay > 0.0 else []
            if part:
                parts.append(as_array(part))
            offsets.append(offsets[-1] + len(part))
        return np.concatenate(parts), np.array(offsets, dtype=np.int64)

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
        pairs = [
            evaluate(self.tape, start, stop, point, float(u), stack)
            for start, stop in pairwise(self.offsets[: self.order + 1])
        ]
        values, slopes = np.array(pairs).T
        return values, slopes
