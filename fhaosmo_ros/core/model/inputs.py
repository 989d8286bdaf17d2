# SPDX-License-Identifier: Apache-2.0
"""Values of the known inputs, brought into the one form that the compiled functions take."""

from collections.abc import Sequence

from fhaosmo_ros.core.parameters.errors import ConfigurationError
import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]


def known_inputs(u: ArrayLike, names: Sequence[str]) -> Floats:
    """
    Return the known inputs of one interval.

    Parameters
    ----------
    u : number or (m,) array
        A number stands for the only input, or is 0.
    names : sequence of str
        Names of the m inputs.

    Returns
    -------
    (m,) array

    Raises
    ------
    ConfigurationError
        Another number of values.

    """
    values = np.asarray(u, dtype=np.float64)
    if values.shape != (len(names),) and not _is_for_all(values, names):
        raise _unfit(f'{len(names)} value{"s" * (len(names) > 1)}', names, values)
    return np.array(np.broadcast_to(values, len(names)))


def known_inputs_of_run(u: ArrayLike, count: int, names: Sequence[str]) -> Floats:
    """
    Return the known inputs of many intervals.

    Parameters
    ----------
    u : number, (K,) or (K, m) array
        A number is constant and stands for the only input, or is 0; so does (K,).
    count : int
        Number K of intervals.
    names : sequence of str
        Names of the m inputs.

    Returns
    -------
    (K, m) array
        Contiguous.

    Raises
    ------
    ConfigurationError
        Another shape.

    """
    values, shape = np.asarray(u, dtype=np.float64), (count, len(names))
    if values.shape == (count,) and len(names) == 1:
        values = values[:, np.newaxis]
    if values.shape != shape and not _is_for_all(values, names):
        allowed = f'shape {shape}'
        if len(names) == 1:
            allowed = f'a number or an array of shape ({count},) or {shape}'
        raise _unfit(allowed, names, values)
    return np.ascontiguousarray(np.broadcast_to(values, shape))


def column(values: ArrayLike) -> NDArray[np.generic]:
    """Return one column of a table, (K, 1), as (K,); anything else as an array of its shape."""
    values = np.asarray(values)
    return values[:, 0] if values.ndim == 2 and values.shape[1] == 1 else values


def _is_for_all(values: Floats, names: Sequence[str]) -> bool:
    return values.shape == () and (len(names) == 1 or values == 0.0)


def _unfit(allowed: str, names: Sequence[str], values: Floats) -> ConfigurationError:
    got = f'shape {values.shape}' if values.shape else f'the number {values}'
    return ConfigurationError(f'u: expected {allowed} (inputs {", ".join(names)}), got {got}')
