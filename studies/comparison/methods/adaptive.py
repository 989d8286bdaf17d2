# SPDX-License-Identifier: Apache-2.0
"""
Kalman filters that bend or adapt: Huber weights, a noise found from innovations, several models.

One recursion for all three, with covariances relative to the tuned noise. Huber: an innovation e
beyond `huber` standard deviations sqrt(S) counts as if its noise were larger, so that its
influence is bounded. Noise: R <- R + share (max(e^2 - P_11, R_0 / 10^4) - R), the recursive form
of innovation-based adaptive estimation (A. H. Mohamed and K. P. Schwarz, Journal of Geodesy 73,
1999, doi:10.1007/s001900050236). Several models: the interacting multiple model filter
(H. A. P. Blom and Y. Bar-Shalom, IEEE Transactions on Automatic Control 33(8), 1988,
doi:10.1109/9.1299). Between samples the covariance takes as many steps as there are periods.
"""

from functools import partial
import math
from types import SimpleNamespace

from fhaosmo_ros.core.model.prediction import Prediction
from fhaosmo_ros.core.simulation.recordings import Recording
from fhaosmo_ros.tools.tuning.search import Dimension
import numpy as np
from studies.comparison.methods.filters import several_models
from studies.comparison.methods.linear import (
    each_order,
    LONGEST,
    matern_space,
    SampledModel,
    samples_of,
)
from studies.comparison.methods.method import Estimates, Method, ROBUST, Run, Setting, Values

HUBER, NOISE, IMM = 'Kalman, Huber', 'Kalman, adaptive noise', 'IMM of three bandwidths'


def _prepare(setting: Setting, values: Values) -> Run:
    model, h, derivatives = setting.model, setting.period, int(values.get('derivatives', 0))
    sampled = SampledModel(model, h, derivatives + 1, values['decay'])
    size, spread = sampled.size, values.get('spread', 1.0)
    factors = (1.0,) if spread == 1.0 else (1.0 / spread, 1.0, spread)
    bandwidths = [factor * values['bandwidth'] for factor in factors]
    q = np.array([sampled.process_noise(h * bandwidth ** (2 * size)) for bandwidth in bandwidths])
    scale = h ** np.arange(size) / setting.noise
    about = setting.balance(derivatives) ** np.arange(1.0 + derivatives)
    sizes = np.concatenate([np.ones(model.order), setting.size * about])
    sizes[0] = setting.noise
    bank = SimpleNamespace(
        a=sampled.a, q=q, fresh=np.diag((scale * sizes) ** 2), scale=scale, period=h,
        huber=values.get('huber', math.inf), memory=h / values.get('memory', math.inf),
        switch=h / values.get('stay', 1.0),
    )  # fmt: skip
    longest = min(LONGEST * h, sampled.resolution)
    prediction = Prediction(model.with_unknown_input(values['decay'], derivatives), longest)

    def estimate(r: Recording) -> dict[str, Estimates]:
        out = several_models(prediction, samples_of(r, model), bank)
        return {'filtered': Estimates(out[:, : model.order], out[:, model.order])}

    return estimate


def _method(name: str, *options: Dimension) -> Method:
    def space(setting: Setting) -> tuple[Dimension, ...]:
        return (*matern_space(setting), *options)

    tune = partial(each_order, more=options)
    return Method(name, ROBUST, space, _prepare, tune, needs_noise=True)


ADAPTIVE = (
    _method(HUBER, Dimension('huber', 1.0, 10.0, 2.5)),
    _method(NOISE, Dimension('memory', 0.1, 100.0, 3.0)),
    _method(IMM, Dimension('spread', 1.2, 10.0, 2.0), Dimension('stay', 0.1, 100.0, 3.0)),
)
"""All take d for a Matern process."""
