# SPDX-License-Identifier: Apache-2.0
"""The messages that an estimator published together, put together again."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from fhaosmo_ros.tools.series import Series, series
import numpy as np
from numpy.typing import NDArray


def read_ticks(path: Path, name: str, parts: Sequence[str]) -> dict[str, NDArray[Any]]:
    """
    Return the values of an estimator's topics, a row for each time that it published all of them.

    A recording may lack some of the topics at its begin and its end, so the k-th messages of two
    topics need not belong together; their stamps in the bag tell.

    Parameters
    ----------
    path : path
        A bag.
    name : str
        Name of the estimator.
    parts : sequence of str
        Topics below it; the last one is published last.

    """
    columns = [series(path, f'{name}/{part}') for part in parts]
    last = columns[-1]
    rows = [_together(column, last.stamps) for column in columns]
    whole = np.all([row >= 0 for row in rows], axis=0)
    return {
        part: column.values[row[whole]]
        for part, column, row in zip(parts, columns, rows, strict=True)
    }


def _together(column: Series, stamps: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the row that belongs to each stamp, -1 where it is missing."""
    times = column.stamps
    if not len(times) or not len(stamps):
        return np.full(len(stamps), -1)
    # Published before; but a recorder that stamps what arrives may have taken it after.
    before = np.searchsorted(times, stamps, side='right') - 1
    after = before + 1
    until = np.concatenate([[np.iinfo(np.int64).min], stamps[:-1]])
    since = np.concatenate([stamps[1:], [np.iinfo(np.int64).max]])
    early = (before >= 0) & (times[before] > until)
    late = (after < len(times)) & (times[after.clip(max=len(times) - 1)] < since)
    lead = np.median((stamps - times[before])[early]) if early.any() else np.inf
    lag = np.median(times[after[late]] - stamps[late]) if late.any() else np.inf
    return np.where(early, before, -1) if lead <= lag else np.where(late, after, -1)
