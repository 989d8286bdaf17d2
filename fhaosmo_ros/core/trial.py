# SPDX-License-Identifier: Apache-2.0
"""
How good an observer is on recordings whose truth is known: one compiled call, no trajectories.

It releases the GIL and allocates nothing that grows with the recordings, so that trials run in as
many threads as there are cores. Samples take the way of `OnlineEstimator`: a gap longer than
`max_gap` starts afresh. A shorter one is one step, as it is there for predict_correct; the other
schemes are bridged there (docs/operation.md) and so do a little better than is said here.
"""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from fhaosmo_ros.core import kernels, layout
from fhaosmo_ros.core.borrowed import borrowed
from fhaosmo_ros.core.errors import ConfigurationError
from fhaosmo_ros.core.family import Recording
from fhaosmo_ros.core.metrics import total_variation
from fhaosmo_ros.core.observer import Observer
from fhaosmo_ros.core.parameters import ONLINE_PARAMETERS
from fhaosmo_ros.core.tape import Floats, Ints
from numba import njit
import numpy as np
from numpy.typing import NDArray

CHOICES = ('internal', 'filtered')
"""Values of `estimate_from`; both are judged in the same run."""
TRANSIENT, VARIATION = range(2)


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

    error: NDArray[np.float64]
    transient: NDArray[np.float64]
    variation: NDArray[np.float64]


@njit(cache=True, error_model='numpy', nogil=True)
def _judge(
    flags: Ints, gains: Floats, curves: Floats, scalars: Floats, tape: Floats, offsets: Ints,
    x: Floats, m: Floats, stack: Floats, levels: Floats, memory: Floats,
    start_levels: Floats, start_memory: Floats,
    t: Floats, y: Floats, u: Floats, truth: Floats, begins: Ints,
    max_gap: float, settled: float, band: float, pick: Ints,
    squares: Floats, extra: Floats, last: Floats, eps: Floats,
) -> None:  # fmt: skip
    """Run through all recordings; add up in `squares` (R, 2, n + 1) and `extra` (R, 2, 2)."""
    flags, gains, curves, scalars = (
        borrowed(flags), borrowed(gains), borrowed(curves), borrowed(scalars)
    )  # fmt: skip
    tape, offsets = borrowed(tape), borrowed(offsets)
    x, m, stack, eps = borrowed(x), borrowed(m), borrowed(stack), borrowed(eps)
    levels, memory = borrowed(levels), borrowed(memory)
    count = truth.shape[1]
    n = levels.shape[1]
    for r in range(begins.shape[0] - 1):
        origin = t[begins[r]]
        for k in range(begins[r], begins[r + 1]):
            first = k == begins[r]
            h = 0.0 if first else t[k] - t[k - 1]
            if first or h > max_gap:
                for row in range(levels.shape[0]):
                    for i in range(n):
                        levels[row, i] = start_levels[row, i]
                for i in range(memory.shape[0]):
                    memory[i] = start_memory[i]
                kernels.start(flags, scalars, levels, memory, y[k], eps, 0)
            else:
                kernels.step(
                    flags, gains, curves, scalars, tape, offsets, x, m, stack,
                    levels, memory, y[k], h, u[k], eps, 0,
                )  # fmt: skip
            time = t[k] - origin
            late = time >= settled
            for choice in range(2):
                value = 0.0
                for j in range(count):
                    index = pick[choice, j]
                    value = levels[index // n, index % n]
                    if late:
                        wrong = value - truth[k, j]
                        squares[r, choice, j] += wrong * wrong
                if late:
                    if not first and last[choice] == last[choice]:
                        extra[r, choice, VARIATION] += abs(value - last[choice])
                    last[choice] = value
                else:
                    last[choice] = np.nan
                    if not abs(value - truth[k, count - 1]) <= band:
                        extra[r, choice, TRANSIENT] = time


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
        values = ONLINE_PARAMETERS.defaults() | ONLINE_PARAMETERS.coerce(parameters)
        self._max_gap = values['max_gap']
        self.recordings = list(recordings)
        self._settled, self._band = float(settled), float(band)
        self._fixed = {k: v for k, v in values.items() if k in Observer().parameters}
        observer = Observer(self._fixed)
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
        rows = self.recordings
        self._t, self._y, self._u = (np.concatenate([part[k] for part in rows]) for k in range(3))
        self.truth = np.concatenate([np.column_stack([r.z, r.d]) for r in rows])
        self._begins = np.cumsum([0, *(len(r.t) for r in rows)])
        late = [r.t - r.t[0] >= settled for r in rows]
        self._counts = np.array([mask.sum() for mask in late])
        self.variation = np.array(
            [total_variation(r.d[mask]) for r, mask in zip(rows, late, strict=True)]
        )
        squares = np.square(self.truth[np.concatenate(late)])
        self.scale = np.sqrt(squares.mean(axis=0))
        places = np.arange(layout.ROWS * observer.levels).reshape(layout.ROWS, observer.levels)
        self._pick = np.array([self._places(choice, places) for choice in CHOICES])

    def _places(self, choice: str, places: NDArray[np.int64]) -> list[int]:
        observer = Observer(self._fixed | {'estimate_from': choice})
        z, d = observer.select(places)
        return [*z.tolist(), int(d)]

    def __call__(self, changes: Mapping[str, Any]) -> Scores:
        """
        Judge the fixed parameters with some changed.

        Raises
        ------
        ConfigurationError
            As `Observer`.

        """
        observer = Observer(self._fixed | dict(changes))
        state = observer.state
        quantities, recordings = self.truth.shape[1], len(self.recordings)
        squares = np.zeros((recordings, 2, quantities))
        extra = np.zeros((recordings, 2, 2))
        _judge(
            *observer.law, *observer.make_work(), state.levels.copy(), state.memory.copy(),
            state.levels, state.memory, self._t, self._y, self._u, self.truth, self._begins,
            self._max_gap, self._settled, self._band, self._pick,
            squares, extra, np.zeros(2), np.zeros((1, observer.levels)),
        )  # fmt: skip
        error = np.sqrt(squares / self._counts[:, None, None])
        return Scores(error, extra[:, :, TRANSIENT], extra[:, :, VARIATION])
