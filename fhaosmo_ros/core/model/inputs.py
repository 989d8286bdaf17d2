# SPDX-License-Identifier: Apache-2.0
"""Values of the known inputs, brought into the one form that the compiled functions take."""

from collections.abc import Sequence
from typing import Any

from fhaosmo_ros.core.parameters.errors import ConfigurationError
import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]


def known_inputs(u: ArrayLike, names: Sequence[str], count: int | None = None) -> Floats:
    """
    Return the known inputs of one interval, (m,), or of `count` intervals, (count, m).

    `u` is of that shape, or (count,) of the only input; a number is the only input's, always, or 0
    for any of them. Raises ConfigurationError for another shape.
    """
    values, single = _doubles(u), len(names) == 1
    shape = (len(names),) if count is None else (count, len(names))
    if single and values.shape == (count,):
        values = values[:, np.newaxis]
    if values.shape != shape and not (values.shape == () and (single or values == 0.0)):
        allowed = f'a number or an array of shape {(count,)} or {shape}'
        if count is None or not single:
            allowed = 'a number' if single else f'an array of shape {shape}'
        got = f'shape {values.shape}' if values.shape else f'the number {values}'
        raise ConfigurationError(f'u: expected {allowed} (inputs {", ".join(names)}), got {got}')
    return np.array(np.broadcast_to(values, shape), order='C')


def samples_of_run(t: ArrayLike, y: ArrayLike) -> tuple[NDArray[Any], Floats]:
    """
    Return times and samples as contiguous arrays (K,) of 64-bit numbers; integers stay integers.

    Dates and durations (datetime64, timedelta64) become nanoseconds. Columns of a table, (K, 1),
    are taken as well. Raises ConfigurationError for more dimensions, or different lengths.
    """
    columns: list[NDArray[Any]] = []
    t = np.asarray(t)
    if t.dtype.kind in 'mM':
        t = t.astype(f'{t.dtype.kind}8[ns]').astype(np.int64)
    for values in (t, _doubles(y)):
        column = values[:, 0] if values.ndim == 2 and values.shape[1] == 1 else values
        kind = np.int64 if np.issubdtype(column.dtype, np.integer) else np.float64
        columns.append(np.ascontiguousarray(column, dtype=kind))
    t, y = columns
    if t.ndim != 1 or t.shape != y.shape:
        raise ConfigurationError(
            'run: expected times and y with one dimension and equal length, got shapes '
            f'{t.shape} and {y.shape}'
        )
    return t, y


def _doubles(values: Any) -> Floats:
    """Return values as an array of doubles, NaN where an array has masked them."""
    if hasattr(values, 'filled'):
        values = values.astype(np.float64).filled(np.nan)
    return np.asarray(values, dtype=np.float64)
