# SPDX-License-Identifier: Apache-2.0
"""Triangular models (paper eq. triangular): z_i' = z_{i+1} + Phi_i(z_1..z_i, u)."""

from collections.abc import Sequence
from itertools import pairwise

from fhaosmo_ros.core.errors import ConfigurationError
from fhaosmo_ros.core.expressions import as_array, parse
from fhaosmo_ros.core.tape import evaluate, INPUT
import numpy as np

ROOM_FOR_DECAY = 4
"""Stack size that is enough for the expression in `TriangularModel.with_decay`."""


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
        Stack size that the tapes need, that of `with_decay` included.

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

    def with_decay(self, rate: float) -> tuple[np.ndarray, np.ndarray]:
        """Return tape and offsets with Phi_{n+1} = -rate z_{n+1} for the unknown input (D 15)."""
        level = self.order + 1
        part = as_array(parse(f'-{rate!r} * z{level}', level))
        offsets = self.offsets.copy()
        offsets[level] += len(part)
        return np.concatenate([self.tape, part]), offsets

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
