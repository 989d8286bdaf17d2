# SPDX-License-Identifier: Apache-2.0
"""What every method of the comparison is: parameters with logarithmic ranges, and a run."""

from collections.abc import Callable, Mapping
from typing import NamedTuple

from fhaosmo_ros.core.model.triangular import TriangularModel
from fhaosmo_ros.core.simulation.recordings import Recording
from fhaosmo_ros.tools.tuning.search.minimise import Dimension
from studies.comparison.scores import Estimates

ROUNDING = 1e-15
"""Noise of a y about 1."""
DEADBEAT = 3.0
"""Bandwidth times period of an observer that forgets all but the last few samples."""
Values = Mapping[str, float]
Run = Callable[[Recording], dict[str, Estimates]]
"""Estimates by readout: one method may offer several (filtered and internal states)."""


class Setting(NamedTuple):
    """
    What a user knows before tuning.

    Attributes
    ----------
    model : TriangularModel
    period : float
        Nominal sampling period in seconds.
    size : float
        About how large d is.
    noise : float
        Standard deviation of the noise on y, in its unit, with that of its rounding.

    """

    model: TriangularModel
    period: float
    size: float
    noise: float

    @property
    def speed(self) -> float:
        """Where searches begin: the bandwidth (rad/s) at which noise weighs as much as d."""
        fastest = 0.5 / self.period
        return fastest if self.noise <= 0.0 else min(self.balance(0), fastest)

    def balance(self, derivatives: int) -> float:
        """
        Return the bandwidth (rad/s) at which noise weighs as much as d, for N levels.

        Noise of density noise^2 period leaves noise sqrt(period w^(2 N - 1)) in the N-th level.
        Without any there is rounding.
        """
        levels = self.model.order + 1 + derivatives
        ratio = self.size / (max(self.noise, ROUNDING) * self.period**0.5)
        return float(min(ratio ** (1.0 / (levels - 0.5)), DEADBEAT / self.period))


class Method(NamedTuple):
    """
    A way to estimate z and d.

    Attributes
    ----------
    name : str
        Key in results, and head of its column.
    text : str
        What it is, in a line.
    linear : bool
        True for a linear peer.
    space : callable
        Parameters to tune for a setting; empty where none is.
    prepare : callable
        From a setting and values to a run; raises ConfigurationError for values that make no
        observer.
    tune : callable, optional
        A search of its own: from an objective, a setting, a number of trials and a seed to
        values.

    """

    name: str
    text: str
    linear: bool
    space: Callable[[Setting], tuple[Dimension, ...]]
    prepare: Callable[[Setting, Values], Run]
    tune: Callable[[Callable[[Values], float], Setting, int, int], dict[str, float]] | None = None
