# SPDX-License-Identifier: Apache-2.0
"""
The compiled recursion of every observer with a constant gain: predict by the model, correct by y.

    z_i' = z_{i+1} + Phi_i(z, u),   z_n' = Phi_n(z, u) + d
    d' = d_1 - decay d, d_1' = d_2 - decay d_1, ..., d_{m-1}' = -decay d_{m-1}
    x(t_k) = prediction(t_k) + K (y_k - prediction_1(t_k))

The prediction integrates the whole (nonlinear) model by Runge-Kutta steps, so these observers know
Phi exactly as ours does. For a linear Phi it equals the zero-order-hold discretisation, up to an
error that decreases with the longest step. Each estimate uses the sample of its own time.
"""

from fhaosmo_ros.core.compiled.cache import compiled
from fhaosmo_ros.core.compiled.unowned_arrays import unowned
from fhaosmo_ros.core.model.bytecode import Bytecode, Floats
from fhaosmo_ros.core.model.inputs import known_inputs_of_run
from fhaosmo_ros.core.model.integrate import (
    begin_step,
    CLASSICAL,
    NOW,
    take_slope,
    triangular_rates,
)
from fhaosmo_ros.core.model.triangular import TriangularModel
from fhaosmo_ros.core.observer.step import Samples
from fhaosmo_ros.core.simulation.recordings import Recording
import numpy as np


@compiled()
def _run(
    model: Bytecode,
    stack: Floats,
    stages: Floats,
    gain: Floats,
    samples: Samples,
    longest: float,
    out: Floats,
) -> None:
    """
    Estimate from samples; row k of `out` belongs to sample k.

    Parameters
    ----------
    model : Bytecode
        Phi, and the model of d behind it; see `TriangularModel.with_unknown_input`.
    stack : (2, depth) array
        Scratch memory.
    stages : (4, 2, n + m) array
        ``stages[NOW, 0]`` is the state z, d, d_1 .. at the first sample; the rest is scratch
        memory, 0 at first.
    gain : (n + m,) array
        K.
    samples : Samples
        The first period is not used.
    longest : float
        Longest step of the prediction in seconds; a longer interval takes several.
    out : (K, n + m) array

    """
    model, stack, stages = unowned(model), unowned(stack), unowned(stages)
    u = unowned(samples.u)
    x, size = stages[NOW, 0], stages.shape[2]
    for k in range(samples.y.shape[0]):
        if k > 0:
            steps = int(samples.h[k] / longest) + 1
            for _ in range(steps):
                begin_step(stages)
                for stage in range(CLASSICAL.nodes.size):
                    triangular_rates(model, 0.0, u[k], stack, stages)
                    take_slope(CLASSICAL, stage, samples.h[k] / steps, stages)
            innovation = samples.y[k] - x[0]
            for i in range(size):
                x[i] += gain[i] * innovation
        for i in range(size):
            out[k, i] = x[i]


def estimates(
    model: TriangularModel, gain: Floats, decay: float, recording: Recording, longest: float
) -> Floats:
    """
    Return the estimates of z, d, d_1, .. of a recording, a row for each sample.

    Parameters
    ----------
    model : TriangularModel
    gain : (n + m,) array
        K.
    decay : float
        See the top of this file; 0 for a random walk.
    recording : Recording
    longest : float
        Longest step of the prediction in seconds; a longer interval takes several.

    """
    size = len(gain)
    expressions = model.with_unknown_input(decay, size - model.order - 1)
    stages, stack = np.zeros((4, 2, size)), np.zeros((2, model.depth))
    stages[NOW, 0, 0] = recording.y[0]
    periods = np.diff(recording.t, prepend=recording.t[0])
    u = known_inputs_of_run(recording.u, len(recording.y), model.inputs)
    samples = Samples(recording.y, periods, u)
    out = np.empty((len(recording.y), size))
    _run(expressions, stack, stages, gain, samples, longest, out)
    return out
