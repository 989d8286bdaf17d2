# SPDX-License-Identifier: Apache-2.0
"""What a set of gains is worth: its errors as one number; and the parameters of `tune` itself."""

from collections.abc import Mapping, Sequence
from typing import Any

from fhaosmo_ros.core.online.estimator import OnlineEstimator
from fhaosmo_ros.core.parameters.declaration import Parameter, ParameterTable
from fhaosmo_ros.core.parameters.errors import ConfigurationError
from fhaosmo_ros.core.parameters.tables import MODEL, ONLINE_PARAMETERS
from fhaosmo_ros.core.simulation.metrics import rms
from fhaosmo_ros.core.simulation.recordings import FAMILY, Recording, SENSOR, SHARED
import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
FIRST_STAMP = 1_000_000_000
"""Stamp (ns) of a recording's first sample; 0 would stand for a stamp that is not set."""
SMALLEST = 1e-12
"""Relative errors below this one count as this one, so that their logarithm is finite."""

TUNING = (
    Parameter('recordings', 36, 'Number of recordings that the search sees.', lower=1,
              upper=10_000, live=False),
    Parameter('held_out', 36,
              'Number of other recordings, with other seeds, that only the report sees.', lower=1,
              upper=10_000, live=False),
    Parameter('settled', 5.0, 'Errors count from this time of a recording on.', unit='s',
              lower=0.0, upper=1e5, live=False),
    Parameter('weights', [1.0],
              'Weight of the error of each estimate, squared and relative to the RMS of its '
              'truth.', lower=0.0, upper=1e9, live=False,
              lengths='1 (d alone) or n + 1 (z1 .. zn, d)'),
)  # fmt: skip
TUNE_PARAMETERS = ParameterTable(MODEL, SENSOR, SHARED, FAMILY, TUNING)
"""All that `tune` takes beside the estimator's parameters."""


class Objective:
    """
    Evaluates parameters of the estimator on recordings, by the node's code.

    Parameters
    ----------
    recordings : sequence of Recording
        To train on, each longer than `settled`.
    tuning : mapping
        Of `TUNING`, complete.

    Attributes
    ----------
    scale : (n + 1,) array
        RMS values of their z and d that errors are divided by.

    Raises
    ------
    ConfigurationError
        A recording that is too short, or weights that do not fit.

    """

    def __init__(self, recordings: Sequence[Recording], tuning: Mapping[str, Any]) -> None:
        self.recordings, self._settled = recordings, tuning['settled']
        shortest = min(r.t[-1] - r.t[0] for r in recordings)
        if shortest <= self._settled:
            raise ConfigurationError(
                f'recording: expected more than {self._settled:g} s (settled), got {shortest:g} s'
            )
        late = [np.column_stack([r.z, r.d])[r.t - r.t[0] >= self._settled] for r in recordings]
        self.scale = rms(np.concatenate(late))
        weights, count = tuning['weights'], len(self.scale)
        if len(weights) not in (1, count) or not sum(weights) > 0.0:
            raise TUNE_PARAMETERS['weights'].error(
                weights, f'1 or {count} numbers, not all of them 0'
            )
        self._weights = np.zeros(count)
        self._weights[-len(weights) :] = np.array(weights) / sum(weights)

    def __call__(
        self, parameters: Mapping[str, Any], held_out: Sequence[Recording] = ()
    ) -> tuple[float, Floats]:
        """
        Evaluate parameters of the estimator on these recordings, or on those held out.

        Returns
        -------
        float
            Weighted RMS error relative to the RMS of the truth; geometric mean over the
            recordings, so that an error smaller by a tenth counts the same on an easy recording
            and on a hard one.
        (R, n + 1) array
            RMS errors of z_1 .. z_n and d of each recording.

        Raises
        ------
        ConfigurationError
            As `OnlineEstimator`, or parameters of another model than that of the recordings.

        """
        estimator = OnlineEstimator(ONLINE_PARAMETERS.part_of(parameters))
        order, states = estimator.observer.order, len(self.scale) - 1
        if order != states:
            raise ConfigurationError(
                f"'order': expected {states}, the states of the plant's recordings, got {order}"
            )
        errors = np.array([self._judge(estimator, r) for r in held_out or self.recordings])
        used = self._weights > 0.0
        with np.errstate(over='ignore', divide='ignore'):  # of a truth that is 0 throughout
            relative = np.square(errors[:, used] / self.scale[used])
        each = np.sqrt(relative @ self._weights[used])
        return float(np.exp(np.mean(np.log(np.maximum(each, SMALLEST))))), errors

    def _judge(self, estimator: OnlineEstimator, r: Recording) -> Floats:
        """Return the errors of z and d."""
        estimator.reset()
        u = r.u if estimator.observer.used_inputs else None
        found = estimator.run(stamps_of(r.t - r.t[0]), r.y, u)
        t = r.t[0] + (found.t - FIRST_STAMP) * 1e-9  # before the sample's, if that is delayed
        late = t - r.t[0] >= self._settled
        truth = np.column_stack([np.interp(t[late], r.t, x) for x in (*r.z.T, r.d)])
        with np.errstate(over='ignore', invalid='ignore'):
            errors = rms(np.column_stack([found.z, found.unknown_input])[late] - truth)
        # An estimate that is not finite is infinitely wrong, not undefined.
        return np.nan_to_num(errors, nan=np.inf)


def stamps_of(t: Floats) -> NDArray[np.int64]:
    """Return stamps (ns) for times since the first sample."""
    return FIRST_STAMP + np.round(t * 1e9).astype(np.int64)
