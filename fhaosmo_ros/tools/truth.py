# SPDX-License-Identifier: Apache-2.0
"""The truth that a simulated plant published beside its samples."""

from pathlib import Path
from typing import NamedTuple

from fhaosmo_ros.tools.series import series
import numpy as np
from numpy.typing import NDArray

LATE = 0.75
"""Intervals of the plant's by which the truth may follow its sample."""


class Truth(NamedTuple):
    """
    States and unknown input at some times.

    Attributes
    ----------
    values : (K, n + 1) array
        z_1 .. z_n and d; a row of NaN where the bag does not tell.
    labels : list of str
        Names of the states, where the messages have a label.

    """

    values: NDArray[np.float64]
    labels: list[str]

    @property
    def known(self) -> NDArray[np.bool_]:
        """Return the rows that the bag tells."""
        return np.asarray(np.isfinite(self.values).all(axis=1))


def truth_at(bag: Path, plant: str, when: NDArray[np.int64]) -> Truth | None:
    """
    Return the truth that belongs to samples of y.

    The plant publishes y, then its states, then d: what belongs to a sample is the first message
    behind it, unless that is another sample's.

    Parameters
    ----------
    bag : Path
    plant : str
        Full name of the node.
    when : (K,) array
        Stamps of the samples in nanoseconds.

    Returns
    -------
    Truth or None
        None if the bag has no message of one of the topics.

    """
    columns = []
    labels: list[str] = []
    for topic in (f'{plant}/state', f'{plant}/unknown_input'):
        found = series(bag, topic)
        if not len(found.stamps):
            return None
        row = np.searchsorted(found.stamps, when)
        behind = row < len(found.stamps)
        row = row.clip(max=len(found.stamps) - 1)
        if len(found.stamps) > 1:
            behind &= found.stamps[row] - when <= LATE * np.median(np.diff(found.stamps))
        values = found.values[row].astype(np.float64).reshape(len(row), -1)
        columns.append(np.where(behind[:, None], values, np.nan))
        labels = labels or found.labels
    return Truth(np.column_stack(columns), labels)
