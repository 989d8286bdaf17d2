# SPDX-License-Identifier: Apache-2.0
"""
How good an observer is on recordings whose truth is known: one compiled call, no trajectories.

Samples take the way of the node's, through the policy of core/online. The call releases the GIL,
so that trials run in as many threads as there are cores.
"""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from fhaosmo_ros.core.model.inputs import Floats, known_inputs_of_run
from fhaosmo_ros.core.online.estimator import OnlineEstimator
from fhaosmo_ros.core.parameters.errors import ConfigurationError
from fhaosmo_ros.core.parameters.tables import ONLINE_PARAMETERS
from fhaosmo_ros.core.simulation.judgement import judge
from fhaosmo_ros.core.simulation.metrics import total_variation
from fhaosmo_ros.core.simulation.recordings import Recording
import numpy as np
from numpy.typing import NDArray

CHOICES = ('internal', 'filtered')
"""Values of `estimate_from`; both are judged in the same run."""
NANOSECONDS = 1e-9
FIRST_STAMP = 1_000_000_000
"""Stamp (ns) of a recording's first sample; 0 would stand for a stamp that is not set."""


class Truth(NamedTuple):
    """
    Recordings one behind the other.

    Attributes
    ----------
    stamps, y : (K,) arrays
        Samples (ns).
    u : (K, m) array
        Known inputs.
    truth : (K, n + 1) array
        z_1 .. z_n and d.
    begins : (R + 1,) array
        Where each recording begins, and where the last one ends.

    """

    stamps: NDArray[np.int64]
    y: Floats
    u: Floats
    truth: Floats
    begins: NDArray[np.int64]


class Scores(NamedTuple):
    """
    Errors of a trial on R recordings, for both CHOICES.

    Attributes
    ----------
    error : (R, 2, n + 1) array
        RMS of the errors of z_1 .. z_n and d, from `settled` on.
    transient : (R, 2) array
        Time of the last sample before `settled` at which d was wrong by more than `band`, s.
    variation : (R, 2) array
        Total variation of the estimate of d, from `settled` on; beside `Trial.variation` it tells
        the chatter.

    """

    error: Floats
    transient: Floats
    variation: Floats


class Trial:
    """
    Judges parameters on a fixed set of recordings; safe to call from several threads.

    Parameters
    ----------
    recordings : sequence of Recording
        Each longer than `settled`.
    parameters : mapping
        Of the estimator (observer and sampling); those that do not change.
    settled : float
        Errors count from this time of a recording on, s.
    band : float
        See `Scores.transient`.

    Attributes
    ----------
    scale : (n + 1,) array
        RMS of z_1 .. z_n and d over all recordings, from `settled` on.
    variation : (R,) array
        Total variation of d, from `settled` on.

    Raises
    ------
    ConfigurationError
        No recording, one that is too short, or parameters of another model.

    """

    def __init__(
        self,
        recordings: Sequence[Recording],
        parameters: Mapping[str, Any],
        settled: float,
        band: float,
    ) -> None:
        self._fixed = ONLINE_PARAMETERS.complete(parameters)
        self.recordings = list(recordings)
        observer = OnlineEstimator(self._fixed).observer
        for r in self.recordings:
            if r.t[-1] - r.t[0] <= settled:
                raise ConfigurationError(
                    f'recording: expected more than {settled:g} s (until which an estimate '
                    f'settles), got {r.t[-1] - r.t[0]:g} s'
                )
            if r.z.shape[1] != observer.order:
                raise ConfigurationError(
                    f'recording: expected the {observer.order} states of the model (order), '
                    f'got {r.z.shape[1]}'
                )
        if not self.recordings:
            raise ConfigurationError('trial: expected at least one recording, got none')
        p = self._fixed
        behind = 0.0 if p['predict_to_now'] else p['measurement_delay']
        samples = [_as_samples(r, observer.inputs, behind) for r in self.recordings]
        stamps, y, u, truth = (np.concatenate(part) for part in zip(*samples, strict=True))
        self.truth = truth
        begins = np.cumsum([0, *(len(r.t) for r in self.recordings)])
        self._data = Truth(stamps, y, u, truth, begins)
        late = [(row[0] - row[0][0]) * NANOSECONDS >= settled for row in samples]
        self._counts = np.array([mask.sum() for mask in late])
        self.variation = np.array(
            [total_variation(r.d[m]) for r, m in zip(self.recordings, late, strict=True)]
        )
        squares = np.square(self.truth[np.concatenate(late)])
        self.scale = np.sqrt(squares.mean(axis=0))
        self._settled, self._band = settled, band

    def __call__(self, changes: Mapping[str, Any]) -> Scores:
        """
        Judge the fixed parameters with some changed.

        Raises
        ------
        ConfigurationError
            As `OnlineEstimator`.

        """
        policy = OnlineEstimator(self._fixed.changed(changes)).policy
        squares, *others = judge(policy, self._data, self._settled, self._band)
        return Scores(np.sqrt(squares / self._counts[:, None, None]), *others)


def _as_samples(
    r: Recording, inputs: Sequence[str], behind: float
) -> tuple[NDArray[np.int64], Floats, Floats, Floats]:
    """Return stamps, y, u of a recording, and the truth `behind` seconds before each sample."""
    stamps = FIRST_STAMP + np.round((r.t - r.t[0]) / NANOSECONDS).astype(np.int64)
    u = known_inputs_of_run(r.u, len(r.t), inputs)
    truth = np.column_stack([r.z, r.d])
    if behind > 0.0:
        truth = np.column_stack([np.interp(r.t - behind, r.t, column) for column in truth.T])
    return stamps, r.y, u, truth
