# SPDX-License-Identifier: Apache-2.0
"""The response of a triangular model to any d(t), compiled: what training data are made of."""

from fhaosmo_ros.core.disturbance import disturbance, SAMPLED
from fhaosmo_ros.core.model import TriangularModel
from fhaosmo_ros.core.plant import make_work, rk4, System, Work
from fhaosmo_ros.core.tape import Floats
from numba import njit
import numpy as np
from numpy.typing import ArrayLike


@njit(cache=True, error_model='numpy')
def _respond(
    system: System, work: Work, z: Floats, t: Floats, h: float, u: Floats, states: Floats,
    d: Floats,
) -> None:  # fmt: skip
    for k in range(t.shape[0]):
        begin = t[k - 1] if k > 0 else 0.0
        count = max(1, int(np.ceil((t[k] - begin) / h - 1e-9)))
        step = (t[k] - begin) / count
        for j in range(count):
            if step > 0.0:
                rk4(system, work, z, begin + j * step, step, u[k])
        for i in range(z.shape[0]):
            states[k, i] = z[i]
        d[k] = disturbance(system.kind, system.wave, t[k])


def respond(
    model: TriangularModel,
    initial_state: ArrayLike,
    t: ArrayLike,
    table: ArrayLike,
    spacing: float,
    u: ArrayLike | float = 0.0,
    step: float = 1e-4,
) -> tuple[Floats, Floats]:
    """
    Integrate paper eq. triangular from t = 0 by classical Runge-Kutta steps.

    Parameters
    ----------
    model : TriangularModel
    initial_state : (n,) array
        z at t = 0.
    t : (K,) array
        When to look, in seconds, not decreasing, not below 0.
    table : (M,) array
        d at 0, spacing, 2 spacing, ...; linear in between, constant behind the end. M >= 2.
    spacing : float
        Seconds.
    u : (K,) array or float
        Known input, held during the interval that ends at each time.
    step : float
        Longest step in seconds; each interval is divided evenly.

    Returns
    -------
    z : (K, n) array
    d : (K,) array
        The unknown input at the times `t`.

    """
    t = np.ascontiguousarray(t, dtype=np.float64)
    wave = np.concatenate([[spacing], np.asarray(table, dtype=np.float64)])
    system = System(model.tape, model.offsets, SAMPLED, wave)
    u = np.ascontiguousarray(np.broadcast_to(np.asarray(u, dtype=np.float64), t.shape))
    z = np.array(np.broadcast_to(initial_state, model.order), dtype=np.float64)
    states, d = np.empty((len(t), model.order)), np.empty(len(t))
    _respond(system, make_work(model.order, model.depth), z, t, step, u, states, d)
    return states, d
