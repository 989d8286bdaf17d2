# SPDX-License-Identifier: Apache-2.0
"""From a recorded y to the likeliest model of d and of the noise (D 30), and to gains for them."""

from collections.abc import Mapping
import math
from types import SimpleNamespace
from typing import Any, NamedTuple

from fhaosmo_ros.core.model.prediction import Prediction
from fhaosmo_ros.core.model.triangular import TriangularModel
from fhaosmo_ros.core.observer.configuration import usual_step
from fhaosmo_ros.core.observer.kalman import innovations, LinearModel, matern, stationary
from fhaosmo_ros.core.online.policy import GAP_SAMPLES
from fhaosmo_ros.core.parameters.declaration import Parameters
from fhaosmo_ros.core.parameters.errors import ConfigurationError
from fhaosmo_ros.core.parameters.tables import OBSERVER_PARAMETERS
from fhaosmo_ros.tools.cli.command import progress
from fhaosmo_ros.tools.tuning.linear_gains import GAMMA, kalman_gains, rounded, SCHEME, WIDTH
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_opening
from scipy.optimize import brentq, minimize
from scipy.stats import chi2, median_abs_deviation

Floats = NDArray[np.float64]
Recorded = tuple[Floats, Floats, Floats]
"""Stamps from the first one on (s), (K,); y, (K,); known inputs, (K, m)."""
FEWEST = 500  # samples
FEWEST_STEPS = 20  # changes of y that say a quantum
ON_GRID = 0.02  # how close values on a grid are to multiples of the quantum, relatively
SLOWEST, QUICKEST = 1e-5, 3.0  # bandwidths of the filters (rad a sample)
MOTIONS = 300.0  # rate of z over that of the whole recording, at most
FIRST = np.geomspace(2e-4, 2.0, 15)  # at the likeliest of these the search begins
STEPS = np.array([0.3, 0.5])  # sides of the first simplex in ln bandwidth and ln ratio ..
BOUNDS = np.log([[SLOWEST, QUICKEST], [1e-3, 30.0]])  # .. and bounds of these
EVALUATIONS = 120
DERIVATIVES = (0, 1, 2, 3)
WORTH = 3.0  # by so much a richer model must raise the log-likelihood
KEPT = 'noise_size', 'state_sizes', 'unknown_input_decay'  # exactly as the user set them
CLIP = 3.0  # standard deviations from which on innovations count linearly (Huber 1964)
SETTLED = 8.0  # time constants of the filter after which its covariance is steady
LEAST_USED = 0.9  # part of the samples that needs a finite innovation
OUTLIER, LONGEST_RUN, MOST_OUTLIERS = 6.0, 3, 0.05
"""Standard deviations of an outlier's innovation, how many may follow, and their largest share."""
STILL = 0.03  # bandwidth of a filter that takes d for 0, over the bag's length
SURE = 10.0  # a difference of log-likelihoods that is no accident
NO_NOISE = 1e-7  # noise over the size of y below which y is a simulated one without noise
UNSEEN = 0.97  # expected error of d over its size from which on an estimate tells nothing
BEGIN = 0.1  # part of the bag in which the estimates may still be settling
LAGS = 20  # samples, of the autocorrelations of innovations


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
    bandwidth: float  # omega of the filter (rad/s), which says q (D 30)
    decay: float  # kappa, of d (1/s)


class Evaluation(NamedTuple):
    """How well a design predicts y."""

    design: Design
    noise: float  # standard deviation of the noise of y: the likeliest one for this design
    log_likelihood: float  # of all samples that are used; -inf for a filter that diverges
    innovations: Floats  # (K,) over their expected standard deviations; NaN where there is none
    estimates: Floats  # (K, N)


class Identification:
    """
    The likeliest noise and model of d of a recorded y.

    `values` are all parameters of the estimator; those that the user set are `given`, and
    `noise_size`, `unknown_input_derivatives` and `unknown_input_decay` among these are not
    estimated. `best` is the evaluation of the likeliest design on the usable `samples`, of which
    `outliers` were left out. Raises ConfigurationError where there are no gains for this y, and
    says why.
    """

    def __init__(
        self,
        recorded: Recorded,
        values: Parameters,
        given: Mapping[str, Any],
    ) -> None:
        t, y, u = usable(*recorded)
        count, different = len(y), len(np.unique(y))
        if count < FEWEST:
            raise ConfigurationError(f'y: expected at least {FEWEST} samples, got {count}')
        if different < 5 or np.ptp(y) <= 1e-12 * np.abs(y).max():
            raise ConfigurationError(
                f'y: expected a signal that moves, got {count} samples with {different} different '
                f'values ({y.min():.6g} to {y.max():.6g}): it is constant, or stuck, and nothing '
                'can be learned from it. Record while the plant moves'
            )
        h = np.diff(t, prepend=t[0])
        model = self.model = TriangularModel.of(values)
        self._given = given
        self.period = period = float(np.median(h[1:]))  # of sampling (s)
        periods = np.maximum(np.round(h / period), 1.0).astype(np.int64)
        periods[h > max(values['max_gap'] or GAP_SAMPLES * period, 3.0 * period)] = periods[0] = 0
        used = np.ones(count, dtype=bool)
        self.samples = Samples(h, periods, y, np.ascontiguousarray(u), used)
        self._longest = values['prediction_step'] or usual_step(model)
        # How far off z_1 .. z_n may be where the filter begins: a first guess, rather too much.
        self._sizes = np.std(y) * (MOTIONS / (t[-1] - t[0])) ** np.arange(model.order)
        # The noise: a smooth signal vanishes in differences of high order.
        self.quantum = quantum(y)  # 0 for none that shows
        self._rounding = self.quantum / math.sqrt(12.0)
        rough = float(median_abs_deviation(np.diff(y, 4), scale='normal')) / math.sqrt(70.0)
        guess = max(rough, self._rounding, 1e-9 * float(np.std(y)))
        self.fixed = bool(given.get('noise_size'))  # else the noise is estimated, too
        self._noise = given.get('noise_size') or guess
        self._clip = math.inf  # standard deviations, of the innovations by which it corrects
        with progress(unit='filter', desc='likelihood', leave=False) as self._bar:
            start = self._start()
            self.outliers = self._leave_out_outliers(start)
            set_by_user = given.get('unknown_input_derivatives')
            tried = DERIVATIVES if set_by_user is None else [set_by_user]
            self.best, *others = [self._fit(start.design._replace(derivatives=k)) for k in tried]
            for richer in others:
                if richer.log_likelihood > self.best.log_likelihood + WORTH:
                    self.best = richer
            self._refuse()

    def intensity(self, design: Design, noise: float) -> float:
        """Return q of the white noise that drives the last derivative of d."""
        levels = self.model.order + 1 + design.derivatives
        return noise**2 * self.period * design.bandwidth ** (2 * levels)

    def size_of_input(self, design: Design, noise: float) -> float:
        """Return the RMS value D of the Matern process of d (D 17)."""
        of_unit = matern(design.decay, design.derivatives)
        return math.sqrt(self.intensity(design, noise) / of_unit)

    def evaluate(self, design: Design) -> Evaluation:
        """Return how likely y is by a design."""
        self._bar.update()
        expressions = self.model.with_unknown_input(design.decay, design.derivatives)
        prediction = Prediction(expressions, self._longest)
        b, s, x = innovations(prediction, self.samples, self._linear(design))
        with np.errstate(invalid='ignore', over='ignore'):  # of a filter that diverges
            s /= self._noise**2
            r = b / np.sqrt(s)
            used, counted = self.samples.used, np.isfinite(r) & self.samples.used
            if not counted.sum() > LEAST_USED * used.sum():
                return Evaluation(design, math.nan, -math.inf, r, x)
            noise = self._noise
            if not self.fixed:  # an encoder's steps make at least that of their rounding
                noise = max(likeliest_scale(r[counted]), self._rounding)
            size = np.abs(r[counted]) / noise
            loss = np.where(size <= CLIP, size**2, 2.0 * CLIP * size - CLIP**2)
            mean = -0.5 * float(np.mean(loss + np.log(s[counted]))) - math.log(noise)
            return Evaluation(design, noise, mean * int(used.sum()), r / noise, x)

    def _linear(self, design: Design) -> SimpleNamespace:
        """Return the linear model of a period, of N states: z, d and its derivatives."""
        n, noise = self.model.order, self._noise**2
        size, q = n + 1 + design.derivatives, self.intensity(design, self._noise)
        rates = np.eye(size, k=1)
        rates[:n, :n] += self.model.slopes_at_rest
        rates[range(n, size), range(n, size)] = -design.decay
        a, added = LinearModel(rates, q).transition(self.period)
        fresh = np.zeros((size, size))
        fresh[range(1, n), range(1, n)] = np.square(self._sizes[1:])
        fresh[n:, n:] = stationary(design.decay, design.derivatives, q)
        fresh[0, 0] = noise  # the filter begins with z_1 = y
        settled = int(min(SETTLED / (design.bandwidth * self.period), 2.0**40))
        return SimpleNamespace(
            a=a, q=added, fresh=fresh, variance=noise, clip=self._clip, settled=settled
        )

    def _start(self) -> Evaluation:
        """Scan bandwidths, and bring the scale of clipping and the sizes about."""
        designs = [Design(1, speed, 0.5 * speed) for speed in (FIRST / self.period).tolist()]
        best = max(map(self.evaluate, designs), key=lambda e: e.log_likelihood)
        self._clip = CLIP
        for _ in range(2):
            if math.isfinite(best.log_likelihood):
                self._noise = best.noise
                sizes = np.sqrt(np.nanmean(best.estimates[:, : self.model.order] ** 2, axis=0))
                self._sizes = np.where(np.isfinite(sizes), sizes, self._sizes)
            best = self.evaluate(best.design)
        return best

    def _leave_out_outliers(self, start: Evaluation) -> int:
        """Mark lonely samples that no other sample supports; return their number."""
        size = np.abs(np.nan_to_num(start.innovations))
        # Innovations of a first, coarse fit are not normal: their own median says what is usual.
        far = size > OUTLIER * max(float(np.median(size)) / 0.6745, 1.0)
        far &= ~binary_opening(far, np.ones(LONGEST_RUN + 1))  # which keeps longer runs
        if far.mean() > MOST_OUTLIERS:
            return 0
        self.samples.used[far] = False
        return int(far.sum())

    def _fit(self, design: Design) -> Evaluation:
        """Return the likeliest design around this one (Nelder and Mead 1965)."""
        given = self._given.get('unknown_input_decay')

        def at(point: Floats) -> Evaluation:
            """Evaluate at ln bandwidth (rad a sample), and ln ratio of the decay to bandwidth."""
            bandwidth = math.exp(point[0]) / self.period
            decay = given or math.exp(point[1]) * bandwidth
            return self.evaluate(Design(design.derivatives, bandwidth, decay))

        count = 1 if given else 2
        ratio = design.decay / design.bandwidth
        start = np.log([design.bandwidth * self.period, ratio])[:count]
        found = minimize(
            lambda point: min(-at(point).log_likelihood, 1e300), start, method='Nelder-Mead',
            bounds=BOUNDS[:count],
            options={
                'initial_simplex': np.vstack([start, start + np.diag(STEPS[:count])]),
                'xatol': 0.02, 'fatol': 0.1, 'maxfev': EVALUATIONS,
            },
        )  # fmt: skip
        return at(found.x)

    def _refuse(self) -> None:
        """Raise where there are no gains."""
        y, noise, period = self.samples.y, self.best.noise, self.period
        if not math.isfinite(self.best.log_likelihood):
            raise ConfigurationError(
                f'y: expected samples that the model can predict, got none that phi = '
                f'{list(self.model.phi)} follows: its estimates leave the finite numbers'
            )
        silent, bandwidth = noise < NO_NOISE * np.std(y), self.best.design.bandwidth
        quick = bandwidth > 0.9 * QUICKEST / period
        if (quick or (silent and not self.quantum)) and not self.fixed:
            raise ConfigurationError(
                f'y: expected noise, got none that shows ({noise:.1e} in a y of {np.std(y):.3g}; '
                f'the likeliest filter has {bandwidth:.3g} rad/s at {1.0 / period:.4g} Hz). The '
                'less noise, the larger the gains, without limit: say what the sensor will have '
                '(-p noise_size:=...). Or y moves in a way that the model cannot: it jumps, or '
                'order or phi are wrong; then correct the model, or sample faster'
            )
        still = STILL / float(self.samples.h.sum())
        k, _, decay = self.best.design
        without = self.evaluate(Design(k, still, decay / bandwidth * still))
        if self.best.log_likelihood - without.log_likelihood < SURE:
            raise ConfigurationError(
                f'd: expected a y that d moves, got one that the model explains with d = 0 (noise '
                f'{noise:.3g}). Record while the unknown input acts, and longer'
            )

    def whiteness(self) -> tuple[float, float]:
        """
        Return the largest autocorrelation of innovations within `LAGS` samples, and a probability.

        It is that of such correlations, were innovations white (Ljung and Box 1978).
        """
        begin = int(BEGIN * len(self.samples.y))
        r = self.best.innovations[begin:]
        r = np.clip(r[np.isfinite(r) & self.samples.used[begin:]], -CLIP, CLIP)
        r = r - r.mean()
        count, lags = len(r), np.arange(1, LAGS + 1)
        correlations = np.array([r[:-j] @ r[j:] for j in lags]) / (r @ r)
        statistic = count * (count + 2.0) * np.sum(correlations**2 / (count - lags))
        largest = correlations[np.abs(correlations).argmax()]
        return float(largest), float(chi2.sf(statistic, LAGS))

    def gains(self) -> tuple[dict[str, Any], Floats]:
        """
        Return the gains of the steady Kalman filter of what was found (D 17 to D 19).

        They are parameters of the estimator; behind them are the expected standard deviations of
        the errors of z and d, (n + 1,). Raises ConfigurationError where the estimate of d would
        tell nothing, or there is no such filter in floating-point numbers.
        """
        best, order, period = self.best, self.model.order, rounded(self.period)
        noise, begin = rounded(best.noise), int(BEGIN * len(self.samples.y))
        of_d = self.size_of_input(best.design, best.noise)
        states = best.estimates[begin:, :order]
        sizes = np.maximum(np.sqrt(np.nanmean(np.square(states), axis=0)), noise)
        values = {
            **self._given,
            **SCHEME,
            'correction_period': period,
            'noise_size': noise,
            'state_sizes': [rounded(x) for x in sizes],
            'unknown_input_size': rounded(of_d),
            'unknown_input_derivatives': best.design.derivatives,
            'unknown_input_decay': rounded(best.design.decay),
            'fuzzy_widths': [rounded(WIDTH * noise)],
            'gamma_initial': GAMMA,
            **{name: self._given[name] for name in KEPT if self._given.get(name)},
        }
        checked = OBSERVER_PARAMETERS.complete(OBSERVER_PARAMETERS.part_of(values))
        values['lambda'], errors = kalman_gains(checked, period)
        share = errors[order] / of_d
        if share > UNSEEN:
            raise ConfigurationError(
                f'd: it changes too fast to be seen through this noise: the expected error is '
                f'{min(share, 1.0):.2f} of its size, and an estimate of 0 has 1.00. Does y drift '
                'or jump by itself, is its noise correlated from sample to sample (`gains: '
                f'self_tuning` follows that), or is the order ({order}) too high by one? Else a '
                'sensor with less noise, or a higher rate, is needed'
            )
        return values, errors[: order + 1]


def usable(t: Floats, y: Floats, u: Floats) -> Recorded:
    """Return the samples that are finite and later than all before them."""
    finite = np.isfinite(np.column_stack([t, y, u])).all(axis=1)
    latest = np.maximum.accumulate(np.where(finite, t, -np.inf))
    keep = finite & (t > np.append(-np.inf, latest[:-1]))
    return t[keep], y[keep], u[keep]


def quantum(y: Floats) -> float:
    """Return the resolution of y, 0 if its values lie on no grid, or on a very fine one."""
    steps = np.abs(np.diff(y))
    steps = steps[steps > 0.0]
    if len(steps) < FEWEST_STEPS:
        return 0.0
    multiples = steps / np.quantile(steps, 0.01)
    whole = np.round(multiples)
    few = len(np.unique(whole)) < len(steps) / 10
    near = np.abs(multiples - whole) <= ON_GRID * np.maximum(multiples, 1.0)
    return float(np.sum(steps) / np.sum(whole)) if few and near.mean() >= 0.99 else 0.0


def likeliest_scale(r: Floats) -> float:
    """Return the likeliest standard deviation of numbers under Huber's loss."""
    size = np.abs(r)
    mean = float(size.mean())
    if not 0.0 < mean < math.inf:
        return max(mean, math.ulp(0.0) ** 0.5)

    def excess(scale: float) -> float:
        """Return what falls with the scale, and is 0 at the likeliest one."""
        return float(np.mean(np.minimum((size / scale) ** 2, CLIP * size / scale))) - 1.0

    return float(brentq(excess, 0.8 * mean, 1.01 * CLIP * mean, xtol=1e-300, rtol=1e-10))
