# SPDX-License-Identifier: Apache-2.0
"""The truth and the estimates in a recorded run of plant and estimator, and a table of errors."""

from pathlib import Path
from typing import NamedTuple

from fhaosmo_ros.core.parameters.errors import ConfigurationError
from fhaosmo_ros.core.simulation.metrics import chatter, rms, settling_time
from fhaosmo_ros.tools.bags.topics import messages, read_ticks, series, truth_at
from fhaosmo_ros.topics import ESTIMATES
import numpy as np
from numpy.typing import NDArray

BAND = 0.1
"""Half-width of the settling band, as a fraction of the range of the truth."""


class Run(NamedTuple):
    """
    Estimates beside the truth at the time of the sample that each was computed from.

    Attributes
    ----------
    t : (K,) array
        Seconds since the first estimate.
    names : list of str
        z1 .. zn and d.
    truth, estimate : (K, n + 1) arrays
        States, and the unknown input as the last column.
    gamma : (K,) array
    sample_rate : float
        Samples of y a second, as published.
    counters : dict of str to str
        What the estimator reported last in its diagnostics.

    """

    t: NDArray[np.float64]
    names: list[str]
    truth: NDArray[np.float64]
    estimate: NDArray[np.float64]
    gamma: NDArray[np.float64]
    sample_rate: float
    counters: dict[str, str]


def read_run(bag: Path, plant: str = '/plant', estimator: str = '/estimator') -> Run:
    """
    Read a bag that holds a plant's and an estimator's topics.

    Each estimate is compared with the truth of the sample behind it (``~/stamp``), not with that
    of the moment at which it was published.

    Raises
    ------
    ConfigurationError
        The bag holds no estimate with its truth.

    """
    y = series(bag, '/y')
    ticks = read_ticks(bag, estimator, list(ESTIMATES))
    when = ticks['stamp'].astype(np.int64)
    truth = truth_at(bag, plant, when) if len(when) else None
    if truth is None or not truth.known.any():
        raise ConfigurationError('the run ended before an estimate arrived beside its truth')
    known = truth.known
    estimate = np.column_stack([ticks['state'], ticks['unknown_input']])[known]
    t = (when[known] - when[known][0]) * 1e-9
    span = (y.stamps[-1] - y.stamps[0]) * 1e-9
    rate = (len(y.stamps) - 1) / span if span > 0.0 else float('nan')
    names = [*truth.labels, 'd']
    gamma = ticks['gamma'][known]
    return Run(t, names, truth.values[known], estimate, gamma, rate, _counters(bag))


def _counters(bag: Path) -> dict[str, str]:
    last: dict[str, str] = {}
    for _, message in messages(bag, '/diagnostics'):
        for status in message.status:
            if 'estimator' in status.name:
                last |= {pair.key: pair.value for pair in status.values}
    return last


def table(run: Run) -> str:
    """Return the report of a run as text: a row for each state and d, then the samples."""
    half = run.t >= 0.5 * run.t[-1]
    lines = [
        f'{"":4}{"RMS error":>12}{"RMS truth":>12}{"settling":>12}{"chatter":>10}',
        f'{"":4}{"(2nd half)":>12}{"(2nd half)":>12}{f"({BAND:.0%} band)":>12}{"":>10}',
    ]
    for column, name in enumerate(run.names):
        truth, estimate = run.truth[:, column], run.estimate[:, column]
        error = estimate - truth
        settled = settling_time(run.t, error, BAND * max(float(np.ptp(truth)), 1e-300))
        settled_text = f'{settled:.2f} s' if np.isfinite(settled) else 'not yet'
        lines.append(
            f'{name:4}{rms(error[half]):12.3g}{rms(truth[half]):12.3g}'
            f'{settled_text:>12}{chatter(estimate[half], truth[half]):10.3g}'
        )
    counters = run.counters
    lost, accepted = counters.get('samples lost', '?'), counters.get('samples accepted', '?')
    rejected = counters.get('samples rejected', '?')
    lines += [
        '',
        f'sample rate held: {run.sample_rate:.1f} Hz',
        f'samples: {accepted} used, {lost} dropped, {rejected} rejected',
    ]
    return '\n'.join(lines)
