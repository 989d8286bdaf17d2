# SPDX-License-Identifier: Apache-2.0
"""What the observer gives: after a sample, of a run, and all that it remembers."""

from dataclasses import dataclass
from typing import Any, NamedTuple

from fhaosmo_ros.core.observer.status import flags, open_levels, Status
import numpy as np
from numpy.typing import NDArray


class Estimate(NamedTuple):
    """
    What the observer knows after a sample.

    Attributes
    ----------
    z : (n,) array
        Estimated states; z[0] is z_hat_1, the others follow `estimate_from`.
    unknown_input : float
        Estimated d.
    gamma : float
        Power gamma in use.
    innovation : (N,) array
        eps_i = m_i - z_hat_i.
    word : int
        Status word; see `status` and `open_levels`.

    """

    z: NDArray[np.float64]
    unknown_input: float
    gamma: float
    innovation: NDArray[np.float64]
    word: int

    @property
    def status(self) -> Status:
        """Flags of the step."""
        return flags(self.word)

    @property
    def open_levels(self) -> int:
        """Number of levels that run (the paper's E_i)."""
        return open_levels(self.word)


class Trajectory(NamedTuple):
    """
    Estimates of a run; row k belongs to ``t[k]``. Attributes as in `Estimate`.

    Attributes
    ----------
    t : (K,) array
        Times as given.
    z : (K, n) array
    unknown_input, gamma : (K,) arrays
    innovation : (K, N) array
    status, open_levels : (K,) integer arrays
        Where `every` > 1, a row's flags are those of all samples since the row before it.
    z_hat, z_tilde : (K, N) arrays
        Filtered and internal states; z_tilde[:, i] belongs to z_{i+2}.
    standard_deviation : (K, n + 1) array
        Of the errors of z and, in the last column, of the unknown input, as a self-tuning observer
        expects them; (K, 0) with fixed gains.
    model : (K, 4) array
        The likeliest model of d (D 26) of a self-tuning observer, which a smoother goes by: the
        variance of the noise, if it were white; q; kappa (1/s); the number k of derivatives, or
        k - 3 where d has jumped. 0 before it knows the noise; (K, 0) with fixed gains.
    tuning : (K, 6) array
        What a self-tuning observer has found, with columns as `Tuning.of` takes them; NaN before
        it knows the noise; (K, 0) with fixed gains.

    """

    t: NDArray[Any]
    z: NDArray[np.float64]
    unknown_input: NDArray[np.float64]
    gamma: NDArray[np.float64]
    innovation: NDArray[np.float64]
    status: NDArray[np.int64]
    open_levels: NDArray[np.int64]
    z_hat: NDArray[np.float64]
    z_tilde: NDArray[np.float64]
    standard_deviation: NDArray[np.float64]
    model: NDArray[np.float64]
    tuning: NDArray[np.float64]


@dataclass(frozen=True)
class ObserverState:
    """
    All that an observer remembers; a copy, safe to keep.

    Attributes
    ----------
    levels : (4 + N, N) array
    memory : (MEMORY,) array
        See `fhaosmo_ros.core.observer.arrays`.
    t : float or int or None
        Time of the last sample of `Observer.run`, in its unit (s, or ns for integers).

    """

    levels: NDArray[np.float64]
    memory: NDArray[np.float64]
    t: float | int | None = None
