# SPDX-License-Identifier: Apache-2.0
"""
The compiled recursion of every observer with a constant gain: predict by the model, correct by y.

    z_i' = z_{i+1} + Phi_i(z, u),   z_n' = Phi_n(z, u) + d
    d' = d_1 - decay d, d_1' = d_2 - decay d_1, ..., d_{m-1}' = -decay d_{m-1}
    x(t_k) = prediction(t_k) + K (y_k - prediction_1(t_k))

The prediction integrates the whole (nonlinear) model by Runge-Kutta steps, so these observers know
Phi exactly as ours does; for a linear Phi it equals the zero-order-hold discretisation but for an
error that the longest step makes as small as wanted. Each estimate uses the sample of its time.
"""

from fhaosmo_ros.core.borrowed import borrowed
from fhaosmo_ros.core.tape import evaluate, Floats, Ints
from numba import njit


@njit(cache=True, error_model='numpy')
def run(
    tape: Floats, offsets: Ints, work: Floats, stack: Floats, order: int,
    gain: Floats, decay: float, x: Floats,
    y: Floats, h: Floats, u: Floats, longest: float, out: Floats,
) -> None:  # fmt: skip
    """
    Estimate from samples; row k of `out` belongs to ``y[k]``.

    Parameters
    ----------
    tape, offsets, stack : arrays
        Phi; see fhaosmo_ros.core.tape.
    work : (7, n + m) array
        Scratch memory.
    order : int
        Number of states n.
    gain : (n + m,) array
        K.
    decay : float
        See above; 0 for a random walk.
    x : (n + m,) array
        State z, d, d_1 .. at ``y[0]``; in place.
    y, h, u : (K,) arrays
        Samples, the time (s) and the known input of the interval that ends at each; ``h[0]`` is
        not used.
    longest : float
        Longest step of the prediction in seconds; a longer interval takes several.
    out : (K, n + m) array

    """
    tape, offsets, stack, work = borrowed(tape), borrowed(offsets), borrowed(stack), borrowed(work)
    size = x.shape[0]
    # Rows of `work`: 0 and 1 the stage's point and its tangent (always 0), 2 .. 5 the slopes.
    for k in range(y.shape[0]):
        if k > 0:
            steps = int(h[k] / longest) + 1
            step = h[k] / steps
            for _ in range(steps):
                for stage in range(4):
                    reach = 0.0 if stage == 0 else (step if stage == 3 else 0.5 * step)
                    for i in range(size):
                        work[0, i] = x[i]
                        if stage > 0:
                            work[0, i] += reach * work[1 + stage, i]
                    for i in range(size):
                        slope = work[0, i + 1] if i + 1 < size else 0.0
                        if i >= order:
                            slope -= decay * work[0, i]
                        if i < order and offsets[i + 1] > offsets[i]:
                            phi, _ = evaluate(tape, offsets[i], offsets[i + 1], work, u[k], stack)
                            slope += phi
                        work[2 + stage, i] = slope
                for i in range(size):
                    x[i] += (step / 6.0) * (
                        work[2, i] + 2.0 * work[3, i] + 2.0 * work[4, i] + work[5, i]
                    )
            innovation = y[k] - x[0]
            for i in range(size):
                x[i] += gain[i] * innovation
        for i in range(size):
            out[k, i] = x[i]
