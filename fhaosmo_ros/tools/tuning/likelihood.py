# SPDX-License-Identifier: Apache-2.0
"""The likelihood of a recorded y under a model of d and of the noise (D 30)."""

from dataclasses import dataclass
import math
from types import SimpleNamespace
from typing import NamedTuple

from fhaosmo_ros.core.model.prediction import Prediction
from fhaosmo_ros.core.model.triangular import TriangularModel
from fhaosmo_ros.core.observer.kalman import innovations, LinearModel, matern, stationary
import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
CLIP = 3.0
"""Standard deviations from which on an innovation counts linearly (Huber 1964)."""
SETTLED = 8.0
"""Time constants of the filter after which its covariance is steady."""
LEAST_USED = 0.9
"""Part of the samples that needs a finite innovation."""
SCALE_STEPS = 50


class Samples(NamedTuple):
    """A recorded y, of K samples."""

    h: Floats  # (K,) time since the sample before (s); 0 for the first one
    periods: NDArray[np.int64]  # (K,) the same in sampling periods; 0: the filter begins afresh
    y: Floats  # (K,)
    u: Floats  # (K, m) known inputs of the interval that ends at each sample
    used: NDArray[np.bool_]  # (K,) False for samples that do not correct: outliers


class Design(NamedTuple):
    """A model of d and of the noise, but for the size of both."""

    derivatives: int  # k of D 17
    bandwidth: float  # omega of the filter in rad/s, which says q (D 30)
    ratio: float  # kappa / omega

    @property
    def decay(self) -> float:
        """Rate kappa (1/s) of d."""
        return self.ratio * self.bandwidth


class Evaluation(NamedTuple):
    """How well a design predicts y."""

    design: Design
    noise: float  # standard deviation of the noise of y: the likeliest one for this design
    log_likelihood: float  # of all samples that are used; -inf for a filter that diverges
    innovations: Floats  # (K,) over their expected standard deviations; NaN where there is none
    estimates: Floats  # (K, N)


@dataclass
class Likelihood:
    """The likelihood of designs for one recording."""

    model: TriangularModel
    period: float  # of sampling (s)
    samples: Samples
    sizes: Floats  # (n,) how far off z_1 .. z_n may be where the filter begins
    noise: float  # standard deviation that innovations are clipped by
    fixed: bool = False  # the noise is given: it is not estimated
    longest: float = 0.0025  # Runge-Kutta step (s)
    least_noise: float = 0.0  # the estimated noise is not smaller: that of an encoder's steps
    clip: float = math.inf  # in standard deviations

    def __post_init__(self) -> None:
        self._jacobian = self.model.jacobian(np.zeros(self.model.order))

    def intensity(self, design: Design, noise: float) -> float:
        """Return q of the white noise that drives the last derivative of d."""
        levels = self.model.order + 1 + design.derivatives
        return noise**2 * self.period * design.bandwidth ** (2 * levels)

    def size_of_input(self, design: Design, noise: float) -> float:
        """Return the RMS value of the Matern process of d."""
        of_unit = matern(design.decay, design.derivatives)
        return math.sqrt(self.intensity(design, noise) / of_unit)  # D 17

    def __call__(self, design: Design) -> Evaluation:
        """Evaluate a design."""
        model = self.model.with_unknown_input(design.decay, design.derivatives)
        prediction = Prediction(model, self.longest)
        b, s, x = innovations(prediction, self.samples, self._linear(design))
        with np.errstate(invalid='ignore', over='ignore'):  # of a filter that diverges
            s /= self.noise**2
            r = b / np.sqrt(s)
            used, counted = self.samples.used, np.isfinite(r) & self.samples.used
            if not counted.sum() > LEAST_USED * used.sum():
                return Evaluation(design, math.nan, -math.inf, r, x)
            noise = self.noise
            if not self.fixed:
                noise = max(likeliest_scale(r[counted]), self.least_noise)
            size = np.abs(r[counted]) / noise
            loss = np.where(size <= CLIP, size**2, 2.0 * CLIP * size - CLIP**2)
            mean = -0.5 * float(np.mean(loss + np.log(s[counted]))) - math.log(noise)
            return Evaluation(design, noise, mean * int(used.sum()), r / noise, x)

    def _linear(self, design: Design) -> SimpleNamespace:
        """Return the linear model of a period, of N states: z, d and its derivatives."""
        n, noise = self.model.order, self.noise**2
        size, q = n + 1 + design.derivatives, self.intensity(design, self.noise)
        rates = np.eye(size, k=1)
        rates[:n, :n] += self._jacobian
        rates[range(n, size), range(n, size)] = -design.decay
        a, added = LinearModel(rates, q).transition(self.period)
        fresh = np.zeros((size, size))
        fresh[range(1, n), range(1, n)] = np.square(self.sizes[1:])
        fresh[n:, n:] = stationary(rates[n:, n:], q)
        fresh[0, 0] = noise  # the filter begins with z_1 = y
        settled = int(min(SETTLED / (design.bandwidth * self.period), 2.0**40))
        return SimpleNamespace(
            a=a, q=added, fresh=fresh, variance=noise, clip=self.clip, settled=settled
        )


def likeliest_scale(r: Floats) -> float:
    """Return the likeliest standard deviation of numbers under Huber's loss."""
    size = np.abs(r)
    scale = float(np.sqrt(np.mean(np.minimum(size, np.quantile(size, 0.9)) ** 2)))
    for _ in range(SCALE_STEPS):
        if not scale > 0.0:
            return math.ulp(0.0) ** 0.5
        change = float(np.mean(np.minimum((size / scale) ** 2, CLIP * size / scale)))
        scale *= math.sqrt(change)
        if abs(change - 1.0) < 1e-9:
            break
    return scale
