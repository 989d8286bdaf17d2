# SPDX-License-Identifier: Apache-2.0
"""What a set of gains is worth: error, chatter and settling as one number; its damping."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from fhaosmo_ros.core.observer.configuration import deadbeat_shares
from fhaosmo_ros.core.observer.kalman import Uncertainty
from fhaosmo_ros.core.observer.observer import Observer
from fhaosmo_ros.core.parameters.errors import ConfigurationError
from fhaosmo_ros.core.parameters.tables import ONLINE_PARAMETERS
from fhaosmo_ros.core.simulation.recordings import Recording
from fhaosmo_ros.core.simulation.scoring import CHOICES, Scores, Trial
from fhaosmo_ros.tools.tuning.parameters import TUNE_PARAMETERS
import numpy as np
from scipy.linalg import expm

SMALLEST = 1e-12
"""Relative errors below this one count as this one, so that their logarithm is finite."""


SIZES = (0.0, 0.5, 1.0, 2.0, 4.0, 8.0, 12.0, 16.0)
"""
Of innovations, in the standard deviations of what is expected. With a d that is faster than
expected their spread grows, and so do the limits of D 21 and D 32.
"""
STILL = 1e-3
"""Stands for an innovation of 0."""
DEADBEAT = 1e-12
"""Poles (z) that are smaller, or rates, count as 0."""


class Evaluation(NamedTuple):
    """
    How good one set of parameters is.

    Attributes
    ----------
    objective : float
        error + chatter_weight * chatter + settling_weight * settling.
    error : float
        Weighted RMS error relative to the RMS of the truth; geometric mean over the recordings,
        so that an error smaller by a tenth counts the same on an easy recording and on a hard one.
    chatter : float
        Powers of ten between the total variation of the estimate of d and that of d; at least 0.
    settling : float
        Mean share of the time `settled` that the estimate of d needs to settle.
    estimate_from : str
        Which variables are the estimates: 'internal' or 'filtered'.
    scores : Scores
    choice : int
        Index of `estimate_from` in the scores.

    """

    objective: float
    error: float
    chatter: float
    settling: float
    estimate_from: str
    scores: Scores
    choice: int


class Objective:
    """
    Evaluates parameters of the estimator on recordings.

    Parameters
    ----------
    recordings : sequence of Recording
    fixed : mapping
        Parameters of the estimator that do not change.
    tuning : mapping
        Of `TUNING`, complete.
    choose : bool
        Take the better of the internal and the filtered variables, instead of what `fixed` says.
    scale : array, optional
        RMS values that errors are divided by; by default those of the truth of these recordings.

    """

    def __init__(
        self,
        recordings: Sequence[Recording],
        fixed: Mapping[str, Any],
        tuning: Mapping[str, Any],
        choose: bool,
        scale: Any = None,
    ) -> None:
        online = ONLINE_PARAMETERS.complete(fixed)
        d = np.concatenate([r.d for r in recordings])
        band = tuning['settling_band'] * float(np.sqrt(np.mean(d**2)))
        self.trial = Trial(recordings, online, tuning['settled'], band)
        self.scale = self.trial.scale if scale is None else scale
        self._tuning = tuning
        quantities = len(self.scale)
        weights = tuning['weights']
        if len(weights) == 1:
            weights = [0.0] * (quantities - 1) + weights
        if len(weights) != quantities or not sum(weights) > 0.0:
            raise TUNE_PARAMETERS['weights'].error(
                tuning['weights'], f'1 or {quantities} numbers, not all of them 0'
            )
        weighted = np.array(weights) > 0.0
        if not (self.scale[weighted] > 0.0).all():
            raise ConfigurationError(
                'recordings: expected a truth that is not 0 throughout where its weight is not 0, '
                f'got RMS values {self.scale.tolist()}'
            )
        self._weighted = np.flatnonzero(weighted)
        self._weights = np.array(weights)[weighted] / np.sum(weights)
        # A d that is constant has no variation: its size takes the place of it.
        self._truth_varies = np.maximum(self.trial.variation, self.scale[-1] or 1.0)
        self._choices = (0, 1) if choose else (CHOICES.index(online['estimate_from']),)

    def __call__(self, parameters: Mapping[str, Any]) -> Evaluation:
        """Evaluate the fixed parameters with these; `estimate_from` among them decides."""
        scores = self.trial(parameters)
        choices = self._choices
        if 'estimate_from' in parameters:
            choices = (CHOICES.index(parameters['estimate_from']),)
        return min(
            (self._evaluate(scores, choice) for choice in choices),
            key=lambda evaluation: evaluation.objective,
        )

    def _evaluate(self, scores: Scores, choice: int) -> Evaluation:
        # An estimate that is not finite is infinitely wrong, not undefined.
        wrong = np.nan_to_num(scores.error[:, choice, self._weighted], nan=np.inf)
        with np.errstate(over='ignore'):
            each = np.sqrt(np.square(wrong / self.scale[self._weighted]) @ self._weights)
        error = float(np.exp(np.mean(np.log(np.maximum(each, SMALLEST)))))
        tenfold = np.log10(np.maximum(scores.variation[:, choice] / self._truth_varies, 1.0))
        chatter = float(np.mean(np.nan_to_num(tenfold, nan=np.inf)))
        settled = self._tuning['settled']
        settling = float(np.mean(scores.transient[:, choice]) / settled) if settled > 0.0 else 0.0
        objective = (
            error
            + self._tuning['chatter_weight'] * chatter
            + self._tuning['settling_weight'] * settling
        )
        return Evaluation(objective, error, chatter, settling, CHOICES[choice], scores, choice)


def least_damping(observer: Observer) -> float:
    """
    Return the smallest damping ratio of the errors' dynamics, linearised at rest (D 18).

    For each of `SIZES` the corrections count as linear: K_i is what they are over the innovation.
    Below 0 the errors grow by themselves. 1 without `noise_size` or with another scheme, where
    other rules hold.
    """
    c = observer.configuration
    if not c.predicting or c.schedule is None:
        return 1.0
    n, h = c.levels, c.parameters['correction_period']
    rates = Uncertainty(c.model, c.parameters, c.state_sizes).rates
    transition, shares = expm(rates * h), deadbeat_shares(n)
    level, grid = np.arange(n), np.linspace(0.0, 1.0, c.curves.shape[1])
    power = 2.0 * c.gamma_initial * (n - 1 - level) / n
    expected = np.sqrt(c.schedule.steady[0, 0] + c.schedule.variance)
    worst = 1.0
    for size in SIZES:
        a = max(size, STILL) * expected
        inputs = np.minimum(a / c.widths, 1.0)
        psi = np.array([np.interp(x, grid, y) for x, y in zip(inputs, c.curves, strict=True)])
        slopes = c.lambdas * a ** (power - 1.0) * psi
        wanted = np.array(
            [sum(shares[j, i] * h ** (j - i + 1) * slopes[j] for j in range(i, n)) for i in level]
        )
        k = wanted / (1.0 + wanted[0])
        errors = transition - np.outer(k, transition[0])
        if not np.isfinite(errors).all():
            return -1.0
        poles = np.linalg.eigvals(errors).astype(complex)
        rates = np.log(poles[np.abs(poles) > DEADBEAT])
        worst = min(worst, *(-rates.real / np.maximum(np.abs(rates), DEADBEAT)).tolist())
    return worst
