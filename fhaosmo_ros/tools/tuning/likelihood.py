# SPDX-License-Identifier: Apache-2.0
"""The likelihood of a recorded y under a model of d and of the noise (D 30)."""

from dataclasses import dataclass
import math
from typing import NamedTuple

from fhaosmo_ros.core.model.prediction import Prediction
from fhaosmo_ros.core.model.triangular import TriangularModel
from fhaosmo_ros.core.observer.kalman import innovations, LinearModel, stationary
import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
CLIP = 3.0
"""Standard deviations from which on an innovation counts linearly (Huber 1964)."""
SETTLED = 8.0
"""Time constants of the filter after which its covariance is steady."""
SLOWEST, QUICKEST = 1e-5, 3.0
"""Bandwidths of the filters, in rad a sample."""
LEAST_RATIO, MOST_RATIO = 1e-3, 30.0
"""Of kappa to the bandwidth."""
LEAST_USED = 0.9
"""Part of the samples that needs a finite innovation."""
SCALE_STEPS = 50


class Samples(NamedTuple):
    """
    A recorded y.

    Attributes
    ----------
    h : (K,) array
        Time since the sample before (s); 0 for the first one.
    periods : (K,) array
        The same in sampling periods, rounded; 0 where the filter begins afresh.
    y : (K,) array
    u : (K, m) array
        Known inputs of the interval that ends at each sample.
    used : (K,) array of bool
        False for samples that do not correct: outliers.

    """

    h: Floats
    periods: NDArray[np.int64]
    y: Floats
    u: Floats
    used: NDArray[np.bool_]


class Linear(NamedTuple):
    """
    The linear model of a sampling period, of N + 1 states: z, d, its derivatives, and v.

    What each member is stands with `kalman.innovations`, which takes them.
    """

    a: Floats
    q: Floats
    fresh: Floats
    variance: float
    clip: float
    settled: int


class Design(NamedTuple):
    """
    A model of d and of the noise, but for the size of both.

    Attributes
    ----------
    derivatives : int
        k of D 17.
    bandwidth : float
        omega of the filter in rad/s: q = noise^2 h omega^(2 N), with the noise at low frequencies.
    ratio : float
        kappa / omega.
    colour : float
        a of the noise v_j = a v_{j-1} + w_j; 0 for white noise.
    shaken : int
        State that white noise drives as well, counted from 1; 0 for none.
    shake : float
        Its intensity, over noise^2 h omega^(2 `shaken`).

    """

    derivatives: int
    bandwidth: float
    ratio: float
    colour: float = 0.0
    shaken: int = 0
    shake: float = 0.0

    @property
    def decay(self) -> float:
        """Rate kappa (1/s) of d."""
        return self.ratio * self.bandwidth


@dataclass(frozen=True)
class Evaluation:
    """
    How well a design predicts y.

    Attributes
    ----------
    design : Design
    noise : float
        Standard deviation of the white noise w: the likeliest one for this design.
    log_likelihood : float
        Of all samples that are used; -inf for a filter that diverges.
    innovations : (K,) array
        Divided by their expected standard deviations; NaN where there is none.
    estimates : (K, N) array

    """

    design: Design
    noise: float
    log_likelihood: float
    innovations: Floats
    estimates: Floats

    @property
    def low_noise(self) -> float:
        """Standard deviation of the white noise that has as much power at low frequencies."""
        return self.noise / (1.0 - self.design.colour)


@dataclass
class Likelihood:
    """
    The likelihood of designs for one recording.

    Attributes
    ----------
    model : TriangularModel
    period : float
        Sampling period (s).
    samples : Samples
    sizes : (n,) array
        How far off z_1 .. z_n may be where the filter begins.
    noise : float
        Standard deviation that innovations are clipped by; see `Linear`.
    fixed : bool
        The noise is given: it is not estimated.
    longest : float
        Longest Runge-Kutta step (s).
    least_noise : float
        The estimated noise is not smaller: that of an encoder's steps.
    clip : float
        In standard deviations.

    """

    model: TriangularModel
    period: float
    samples: Samples
    sizes: Floats
    noise: float
    fixed: bool = False
    longest: float = 0.0025
    least_noise: float = 0.0
    clip: float = math.inf

    def __post_init__(self) -> None:
        self._jacobian = self.model.jacobian(np.zeros(self.model.order))

    def intensity(self, design: Design, noise: float) -> float:
        """Return q of the white noise that drives the last derivative of d."""
        density = (noise / (1.0 - design.colour)) ** 2 * self.period
        return density * design.bandwidth ** (2 * (self.model.order + 1 + design.derivatives))

    def __call__(self, design: Design) -> Evaluation:
        """Evaluate a design."""
        model = self.model.with_unknown_input(design.decay, design.derivatives)
        prediction = Prediction(model, self.longest)
        b, s, x = innovations(prediction, self.samples, self._linear(design))
        with np.errstate(invalid='ignore', over='ignore'):  # of a filter that diverges
            return self._evaluation(design, b, s / self.noise**2, x)

    def _linear(self, design: Design) -> Linear:
        n, noise = self.model.order, self.noise**2
        size, q = n + 1 + design.derivatives, self.intensity(design, self.noise)
        rates = np.eye(size, k=1)
        rates[:n, :n] += self._jacobian
        rates[range(n, size), range(n, size)] = -design.decay
        a, added, fresh = (np.zeros((size + 1, size + 1)) for _ in range(3))
        a[:size, :size], added[:size, :size] = LinearModel(rates, q).transition(self.period)
        if design.shaken:
            i = design.shaken
            density = noise / (1.0 - design.colour) ** 2 * self.period
            w = design.shake * density * design.bandwidth ** (2 * i)
            added[:i, :i] += LinearModel(rates[:i, :i], w).transition(self.period)[1]
        fresh[range(1, n), range(1, n)] = np.square(self.sizes[1:])
        fresh[n:size, n:size] = stationary(rates[n:, n:], q)
        fresh[0, 0] = noise / (1.0 - design.colour**2)
        if design.colour > 0.0:  # y = z_1 + v, and the filter begins with z_1 = y
            a[size, size], added[size, size] = design.colour, noise
            fresh[size, size] = fresh[0, 0]
            fresh[0, size] = fresh[size, 0] = -fresh[0, 0]
            noise = 0.0
        settled = int(min(SETTLED / (design.bandwidth * self.period), 2.0**40))
        return Linear(a, added, fresh, noise, self.clip, settled)

    def _evaluation(self, design: Design, b: Floats, s: Floats, x: Floats) -> Evaluation:
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
