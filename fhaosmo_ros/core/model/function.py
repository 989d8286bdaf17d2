# SPDX-License-Identifier: Apache-2.0
"""A Phi that is a Python function, for use offline."""

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]
Of = Callable[[Floats, Floats], Any]
STEP = 1e-6
"""Of a central difference, in parts of the size of z."""


class Function(str):
    """
    A Python function as Phi_i, where an expression does not do: a measured table, for instance.

    It stands in the list `phi`. For the library only, as a parameter file is text; a step takes
    some 10 us for each call instead of 0.1. An exception in it ends the run or the step.

    Parameters
    ----------
    function : callable
        f(z, u), with arrays of z_1 .. z_i and of all known inputs; returns Phi_i.
    gradient : callable, optional
        g(z, u) returns the derivatives by z_1 .. z_i. Without it they are central differences.

    Attributes
    ----------
    failed : BaseException or None
        What the function raised last, until it is raised to the caller of the observer.

    Examples
    --------
    >>> import numpy as np
    >>> friction = Function(lambda z, u: -np.interp(z[1], [-1, 0, 1], [-0.2, 0, 0.3]))
    >>> from fhaosmo_ros.core import Observer
    >>> Observer(order=2, phi=['0', friction], gains='self_tuning').order
    2

    """

    function: Of
    gradient: Of | None
    failed: BaseException | None

    def __new__(cls, function: Of, gradient: Of | None = None) -> 'Function':
        """Return one whose text is the function's name."""
        self = super().__new__(cls, f'<function {getattr(function, "__name__", function)}>')
        self.function, self.gradient, self.failed = function, gradient, None
        return self

    def __getnewargs__(self) -> Any:
        return self.function, self.gradient

    def along(self, z: ArrayLike, dz: ArrayLike, u: ArrayLike) -> tuple[float, float]:
        """Return Phi_i(z, u) and its derivative along dz; NaN from the first exception on."""
        if self.failed is not None:
            return np.nan, np.nan
        z, dz, u = (np.asarray(values, dtype=np.float64) for values in (z, dz, u))
        try:
            value = float(self.function(z, u))
            if not dz.any():
                return value, 0.0
            if self.gradient is not None:
                return value, float(np.dot(self.gradient(z, u), dz))
            step = STEP * (1.0 + np.abs(z).max()) / np.abs(dz).max()
            ahead, behind = (float(self.function(z + s * dz, u)) for s in (step, -step))
            return value, (ahead - behind) / (2.0 * step)
        except BaseException as error:  # Ctrl-C, too: it comes out where the observer was called
            self.failed = error
            return np.nan, np.nan
