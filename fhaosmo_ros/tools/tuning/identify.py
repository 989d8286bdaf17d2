# SPDX-License-Identifier: Apache-2.0
"""From a recorded y to the likeliest model of d and of the noise (D 30), and to gains for them."""

from collections.abc import Callable, Mapping
import math
from typing import Any, NamedTuple

from fhaosmo_ros.core.model.triangular import TriangularModel
from fhaosmo_ros.core.observer.configuration import usual_step
from fhaosmo_ros.core.online.policy import GAP_SAMPLES
from fhaosmo_ros.core.parameters.declaration import Parameters
from fhaosmo_ros.core.parameters.errors import ConfigurationError
from fhaosmo_ros.core.parameters.tables import OBSERVER_PARAMETERS
from fhaosmo_ros.core.simulation.metrics import rms
from fhaosmo_ros.tools.cli.command import progress
from fhaosmo_ros.tools.tuning.likelihood import CLIP, Design, Evaluation, Likelihood, Samples
from fhaosmo_ros.tools.tuning.linear_gains import GAMMA, kalman_gains, rounded, SCHEME, WIDTH
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_opening
from scipy.optimize import minimize
from scipy.stats import chi2, median_abs_deviation

Floats = NDArray[np.float64]
Recorded = tuple[Floats, Floats, Floats]
Evaluate = Callable[[Design], Evaluation]
DERIVATIVES = (0, 1, 2, 3)
FIRST = [Design(1, float(w), 0.5) for w in np.geomspace(2e-4, 2.0, 15)]
"""Where the search begins: at the likeliest of these, with bandwidths in rad a sample."""
SLOWEST, QUICKEST = 1e-5, 3.0
"""Bandwidths of the filters, in rad a sample."""
STEPS = np.array([0.3, 0.5])
"""Sides of the first simplex in ln bandwidth (rad a sample) and ln ratio."""
BOUNDS = np.log([[SLOWEST, QUICKEST], [1e-3, 30.0]])
"""Of these."""
EVALUATIONS = 120
WORTH = 3.0
"""By so much a richer model must raise the log-likelihood."""
OUTLIER, LONGEST_RUN = 6.0, 3
"""An outlier has an innovation of so many standard deviations; so many of them may follow."""
MOST_OUTLIERS = 0.05
STILL = 0.03
"""Bandwidth of a filter that takes d for 0, over the bag's length."""
LAGS = 20
SURE = 10.0
"""A difference of log-likelihoods that is no accident."""
FEWEST = 500
"""Samples."""
FEWEST_STEPS = 20
"""Changes of y that say a quantum."""
ON_GRID = 0.02
"""Values count as quantised if they are this close to multiples of the quantum, relatively."""
UNSEEN = 0.97
"""Expected error of d over its size from which on an estimate tells nothing."""
NO_NOISE = 1e-7
"""Noise over the size of y below which y is a simulated one without noise."""
BEGIN = 0.1
"""Part of the bag in which the estimates may still be settling."""


class Identified(NamedTuple):
    """What a recorded y shows."""

    likelihood: Likelihood
    best: Evaluation  # of the likeliest design
    outliers: int  # samples that were left out
    quantum: float  # of y; 0 for none that shows

    @property
    def size_of_input(self) -> float:
        """The RMS value D of the Matern process of d (D 17)."""
        return self.likelihood.size_of_input(self.best.design, self.best.noise)


class Gains(NamedTuple):
    """Parameters of the estimator, and what is to be expected if the model holds."""

    parameters: dict[str, Any]
    expected: Floats  # (n + 1,) standard deviations of the errors of z and d


def identify_input(
    recorded: Recorded, model: TriangularModel, values: Parameters, given: Mapping[str, Any]
) -> Identified:
    """
    Find the likeliest noise and model of d.

    Parameters
    ----------
    recorded : arrays
        Stamps from the first one on (s), (K,); y, (K,); known inputs, (K, m).
    model : TriangularModel
    values : Parameters
        Of the estimator, complete.
    given : mapping
        Those of them that the user set: `noise_size`, `unknown_input_derivatives` and
        `unknown_input_decay` are not estimated then.

    Raises
    ------
    ConfigurationError
        There are no gains for this y; the text says why.

    """
    likelihood = _prepared(recorded, model, values, given)
    decay, tried = given.get('unknown_input_decay') or None, DERIVATIVES
    if 'unknown_input_derivatives' in given:
        tried = (given['unknown_input_derivatives'],)
    with progress(unit='filter', desc='likelihood', leave=False) as bar:

        def evaluate(design: Design) -> Evaluation:
            bar.update()
            return likelihood(design)

        start = _start(likelihood, evaluate)
        outliers = _leave_out_outliers(likelihood, start)
        designs = [start.design._replace(derivatives=k) for k in tried]
        best, *others = [_fit(evaluate, d, likelihood.period, decay) for d in designs]
        for richer in others:
            if richer.log_likelihood > best.log_likelihood + WORTH:
                best = richer
        still = STILL / float(likelihood.samples.h.sum())
        without = evaluate(best.design._replace(bandwidth=still))
    found = Identified(likelihood, best, outliers, quantum(likelihood.samples.y))
    _refuse(found, best.log_likelihood - without.log_likelihood)
    return found


def _refuse(found: Identified, fall: float) -> None:
    """Raise where there are no gains; `fall`: of the log-likelihood if d were 0."""
    likelihood, y, noise = found.likelihood, found.likelihood.samples.y, found.best.noise
    period, bandwidth = likelihood.period, found.best.design.bandwidth
    if not math.isfinite(found.best.log_likelihood):
        raise ConfigurationError(
            f'y: expected samples that the model can predict, got none that phi = '
            f'{list(likelihood.model.phi)} follows: its estimates leave the finite numbers'
        )
    silent = noise < NO_NOISE * float(np.std(y)) and not found.quantum
    if (silent or bandwidth > 0.9 * QUICKEST / period) and not likelihood.fixed:
        raise ConfigurationError(
            f'y: expected noise, got none that shows ({noise:.1e} in a y of {np.std(y):.3g}; the '
            f'likeliest filter has {bandwidth:.3g} rad/s at {1.0 / period:.4g} Hz). The '
            'less noise, the larger the gains, without limit: say what the sensor will have (-p '
            'noise_size:=...). Or y moves in a way that the model cannot: it jumps, or order or '
            'phi are wrong; then correct the model, or sample faster'
        )
    if fall < SURE:
        raise ConfigurationError(
            f'd: expected a y that d moves, got one that the model explains with d = 0 (noise '
            f'{noise:.3g}). Record while the unknown input acts, and longer'
        )


def make_gains(found: Identified, given: Mapping[str, Any]) -> Gains:
    """
    Return the gains of the steady Kalman filter of what was found (D 17 to D 19).

    Raises
    ------
    ConfigurationError
        The estimate of d would tell nothing, or there is no such filter in floating-point numbers.

    """
    likelihood, design = found.likelihood, found.best.design
    order, period = likelihood.model.order, rounded(likelihood.period)
    noise, begin = rounded(found.best.noise), int(BEGIN * len(likelihood.samples.y))
    states = found.best.estimates[begin:, :order]
    sizes = np.maximum(np.sqrt(np.nanmean(np.square(states), axis=0)), noise)
    values = {
        **SCHEME,
        'correction_period': period,
        'noise_size': noise,
        'state_sizes': [rounded(x) for x in sizes],
        'unknown_input_size': rounded(found.size_of_input),
        'unknown_input_derivatives': design.derivatives,
        'unknown_input_decay': rounded(design.decay),
        'fuzzy_widths': [rounded(WIDTH * noise)],
        'gamma_initial': GAMMA,
        **given,
    }
    checked = OBSERVER_PARAMETERS.complete(OBSERVER_PARAMETERS.part_of(values))
    lambdas, k, p, variance = kalman_gains(checked, period)
    values['lambda'] = [rounded(x) for x in lambdas]
    errors = np.sqrt(np.maximum(np.diag(p) - k**2 * variance, 0.0))
    share = errors[order] / found.size_of_input
    if share > UNSEEN:
        raise ConfigurationError(
            f'd: it changes too fast to be seen through this noise: the expected error is '
            f'{min(share, 1.0):.2f} of its size, and an estimate of 0 has 1.00. Does y drift or '
            'jump by itself, is its noise correlated from sample to sample (`gains: self_tuning` '
            f'follows that), or is the order ({order}) too high by one? Else a '
            'sensor with less noise, or a higher rate, is needed'
        )
    return Gains(values, errors[: order + 1])


def whiteness(found: Identified) -> tuple[float, float]:
    """
    Return the largest autocorrelation of the innovations within `LAGS` samples, and a probability.

    It is that of such correlations, were innovations white (Ljung and Box 1978).
    """
    begin = int(BEGIN * len(found.best.innovations))
    r = found.best.innovations[begin:]
    r = np.clip(r[np.isfinite(r) & found.likelihood.samples.used[begin:]], -CLIP, CLIP)
    r = r - r.mean()
    count, lags = len(r), np.arange(1, LAGS + 1)
    correlations = np.array([r[:-j] @ r[j:] for j in lags]) / (r @ r)
    statistic = count * (count + 2.0) * np.sum(correlations**2 / (count - lags))
    largest = correlations[np.abs(correlations).argmax()]
    return float(largest), float(chi2.sf(statistic, LAGS))


def _prepared(
    recorded: Recorded, model: TriangularModel, values: Parameters, given: Mapping[str, Any]
) -> Likelihood:
    """Return the likelihood of the usable samples, with a first guess of noise and states."""
    t, y, u = usable(*recorded)
    count, different = len(y), len(np.unique(y))
    if count < FEWEST:
        raise ConfigurationError(f'y: expected at least {FEWEST} samples, got {count}')
    if different < 5 or np.ptp(y) <= 1e-12 * np.abs(y).max():
        raise ConfigurationError(
            f'y: expected a signal that moves, got {count} samples with {different} different '
            f'values ({y.min():.6g} to {y.max():.6g}): it is constant, or stuck, and nothing can '
            'be learned from it. Record while the plant moves'
        )
    h = np.diff(t, prepend=t[0])
    period = float(np.median(h[1:]))
    periods = np.maximum(np.round(h / period), 1.0).astype(np.int64)
    periods[h > max(values['max_gap'] or GAP_SAMPLES * period, 3.0 * period)] = periods[0] = 0
    samples = Samples(h, periods, y, np.ascontiguousarray(u), np.ones(count, dtype=bool))
    block = max(count // 300, 1)
    slow = y[: count // block * block].reshape(-1, block).mean(axis=1)
    sizes = [rms(slow)]
    for _ in range(1, model.order):
        slow = np.diff(slow) / (block * period)
        sizes.append(3.0 * rms(slow))
    rounding = quantum(y) / math.sqrt(12.0)
    # A smooth signal vanishes in differences of high order.
    rough = median_abs_deviation(np.diff(y, 4), scale='normal') / math.sqrt(70.0)
    noise = max(float(rough), rounding, 1e-9 * float(np.std(y)))
    known = given.get('noise_size')
    return Likelihood(
        model, period, samples, np.array(sizes), known or noise, fixed=bool(known),
        longest=values['prediction_step'] or usual_step(model), least_noise=rounding,
    )  # fmt: skip


def usable(t: Floats, y: Floats, u: Floats) -> Recorded:
    """Return the samples that are finite and later than all before them."""
    finite = np.isfinite(np.column_stack([t, y, u])).all(axis=1)
    latest = np.maximum.accumulate(np.where(finite, t, -np.inf))
    keep = finite & (t > np.concatenate([[-np.inf], latest[:-1]])[: len(t)])
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


def _leave_out_outliers(likelihood: Likelihood, start: Evaluation) -> int:
    """Mark lonely samples that no other sample supports; return their number."""
    size = np.abs(np.nan_to_num(start.innovations))
    # Innovations of a first, coarse fit are not normal: their own median says what is usual.
    far = size > OUTLIER * max(float(np.median(size)) / 0.6745, 1.0)
    far &= ~binary_opening(far, np.ones(LONGEST_RUN + 1))  # which keeps longer runs
    if far.mean() > MOST_OUTLIERS:
        return 0
    likelihood.samples.used[far] = False
    return int(far.sum())


def _start(likelihood: Likelihood, evaluate: Evaluate) -> Evaluation:
    """Scan bandwidths, and bring the scale of clipping and the sizes about."""
    designs = (d._replace(bandwidth=d.bandwidth / likelihood.period) for d in FIRST)
    best = max(map(evaluate, designs), key=lambda e: e.log_likelihood)
    likelihood.clip = CLIP
    for _ in range(2):
        if math.isfinite(best.log_likelihood):
            likelihood.noise = best.noise
            states = best.estimates[:, : len(likelihood.sizes)]
            sizes = np.sqrt(np.nanmean(states**2, axis=0))
            likelihood.sizes = np.where(np.isfinite(sizes), sizes, likelihood.sizes)
        best = evaluate(best.design)
    return best


def _fit(evaluate: Evaluate, design: Design, period: float, decay: float | None) -> Evaluation:
    """Return the likeliest design around this one (Nelder and Mead 1965)."""

    def at(point: Floats) -> Evaluation:
        """Evaluate at ln bandwidth (rad a sample) and, unless decay is given, ln ratio."""
        bandwidth = math.exp(point[0]) / period
        ratio = decay / bandwidth if decay else math.exp(point[1])
        return evaluate(design._replace(bandwidth=bandwidth, ratio=ratio))

    count = 1 if decay else 2
    start = np.log([design.bandwidth * period, design.ratio])[:count]
    found = minimize(
        lambda point: min(-at(point).log_likelihood, 1e300), start, method='Nelder-Mead',
        bounds=BOUNDS[:count],
        options={
            'initial_simplex': np.vstack([start, start + np.diag(STEPS[:count])]),
            'xatol': 0.02, 'fatol': 0.1, 'maxfev': EVALUATIONS,
        },
    )  # fmt: skip
    return at(found.x)
