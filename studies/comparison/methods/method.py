# SPDX-License-Identifier: Apache-2.0
"""What every method of the comparison is: parameters with logarithmic ranges, and a run."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

from fhaosmo_ros.core.model.triangular import TriangularModel
from fhaosmo_ros.core.simulation.recordings import Recording
from fhaosmo_ros.tools.tuning.search import Dimension
from studies.comparison.scores import Estimates

ROUNDING = 1e-15
"""Noise of a y about 1."""
DEADBEAT = 3.0
"""Bandwidth times period of an observer that forgets all but the last few samples."""
LINEAR, USUAL, ROBUST = 'linear filter', 'usual Kalman filter', 'adaptive filter'
SLIDING, PAPER, OURS, SELF_TUNING = 'sliding mode', 'paper', 'ours, tuned', 'ours, self-tuning'
KINDS = (LINEAR, USUAL, ROBUST, SLIDING, PAPER, OURS, SELF_TUNING)
"""Kinds of methods; the usual Kalman filter, whose d is a random walk, is one of its own."""
Values = Mapping[str, Any]
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


class Search(NamedTuple):
    """
    What a method is tuned with.

    Attributes
    ----------
    judged : callable
        From values to the objective over all recordings.
    setting : Setting
    recordings : sequence of Recording
    trials : int
        How often an objective may be evaluated.
    seed : int

    """

    judged: Callable[[Values], float]
    setting: Setting
    recordings: Sequence[Recording]
    trials: int
    seed: int


class Method(NamedTuple):
    """
    A way to estimate z and d.

    Attributes
    ----------
    name : str
        Key in results, and head of its column.
    text : str
        What it is, in a line.
    kind : str
        One of `KINDS`.
    space : callable
        Parameters to tune for a setting; empty where none is.
    prepare : callable
        From a setting and values to a run; raises ConfigurationError for values that make no
        observer.
    tune : callable, optional
        A search of its own.
    needs_noise : bool
        True for one that is about the noise, which there has to be.

    """

    name: str
    text: str
    kind: str
    space: Callable[[Setting], tuple[Dimension, ...]]
    prepare: Callable[[Setting, Values], Run]
    tune: Callable[[Search], Values] | None = None
    needs_noise: bool = False


def untuned(setting: Setting) -> tuple[Dimension, ...]:
    """Return the space of a method that has no parameters."""
    del setting
    return ()
