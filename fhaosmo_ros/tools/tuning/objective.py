# SPDX-License-Identifier: Apache-2.0
"""What a set of gains is worth: error, chatter and settling as one number."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from fhaosmo_ros.core.parameters.errors import ConfigurationError
from fhaosmo_ros.core.parameters.tables import ONLINE_PARAMETERS
from fhaosmo_ros.core.simulation.recordings import Recording
from fhaosmo_ros.core.simulation.scoring import CHOICES, Scores, Trial
from fhaosmo_ros.tools.tuning.parameters import TUNE_PARAMETERS
import numpy as np

SMALLEST = 1e-12
"""Relative errors below this one count as this one, so that their logarithm is finite."""


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
