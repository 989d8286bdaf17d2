# SPDX-License-Identifier: Apache-2.0
"""The truth and the estimates in a recorded run of plant and estimator, and a table of errors."""

from pathlib import Path
from typing import NamedTuple

from fhaosmo_ros.core.parameters.errors import ConfigurationError
from fhaosmo_ros.core.simulation.metrics import chatter, rms, settling_time
from fhaosmo_ros.tools.bags.reader import BagReader
from fhaosmo_ros.tools.bags.topics import messages, read_ticks, series, truth_at
from fhaosmo_ros.topics import ESTIMATES, SELF_TUNED, STANDARD_DEVIATION
import numpy as np
from numpy.typing import NDArray

RECENT = 50
"""Estimates over which the true noise is averaged."""
SETTLED = 1.0
"""Seconds of the start that do not count for the share of the band."""
BAND = 0.1
"""Half-width of the settling band, as a fraction of the range of the truth."""


class Tuned(NamedTuple):
    """
    What a self-tuning estimator knows beside its estimates, and the noise that there was.

    Attributes
    ----------
    deviation : (K, n + 1) array
        Standard deviations of the estimates; infinite while they are not known.
    noise, true_noise : (K,) arrays
        Standard deviation of the noise on y that it has found, and that of the latest samples.
    bandwidth : (K,) array
        How fast d is followed, in rad/s.

    """

    deviation: NDArray[np.float64]
    noise: NDArray[np.float64]
    true_noise: NDArray[np.float64]
    bandwidth: NDArray[np.float64]


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
    origin : int
        Stamp of the first estimate, in nanoseconds.
    tuned : Tuned or None
        Of a self-tuning estimator.

    """

    t: NDArray[np.float64]
    names: list[str]
    truth: NDArray[np.float64]
    estimate: NDArray[np.float64]
    gamma: NDArray[np.float64]
    sample_rate: float
    counters: dict[str, str]
    origin: int
    tuned: Tuned | None


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
    with BagReader(bag) as reader:
        tuned = all(reader.count(f'{estimator}/{part}') for part in SELF_TUNED)
    ticks = read_ticks(bag, estimator, [*(SELF_TUNED if tuned else {}), *ESTIMATES])
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
    of_tuning = None
    if tuned:
        place = np.searchsorted(y.stamps, when[known]).clip(max=len(y.stamps) - 1)
        wrong = y.values[place] - truth.values[known][:, 0]
        mean = np.convolve(wrong**2, np.full(RECENT, 1.0 / RECENT))[: len(wrong)]
        share = np.minimum(1.0, np.arange(1, len(wrong) + 1) / RECENT)
        noise, _, bandwidth, *_ = ticks['tuning'][known].T
        of_tuning = Tuned(
            ticks[STANDARD_DEVIATION][known], noise, np.sqrt(mean / share), bandwidth
        )
    origin = int(when[known][0])
    counters = _counters(bag)
    return Run(t, names, truth.values[known], estimate, gamma, rate, counters, origin, of_tuning)


def _found(run: Run, tuned: Tuned) -> list[str]:
    """Return what a self-tuning estimator has found, in words."""
    known = np.isfinite(tuned.deviation[:, -1]) & (run.t > SETTLED)
    if not known.any():
        return ['the run was too short for the estimator to find the noise']
    error = np.abs(run.estimate[:, -1] - run.truth[:, -1])[known]
    share = float(np.mean(error <= 2.0 * tuned.deviation[known, -1]))
    return [
        f'd lay within two standard deviations of its estimate for {share:.0%} of the time',
        f'noise on y at the end: found {tuned.noise[-1]:.2g}, true {tuned.true_noise[-1]:.2g}; '
        f'd is followed within {1.0 / tuned.bandwidth[-1]:.2g} s',
    ]


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
    if run.tuned is not None:
        lines += ['', *_found(run, run.tuned)]
    counters = run.counters
    lost, accepted = counters.get('samples lost', '?'), counters.get('samples accepted', '?')
    rejected = counters.get('samples rejected', '?')
    lines += [
        '',
        f'sample rate held: {run.sample_rate:.1f} Hz',
        f'samples: {accepted} used, {lost} dropped, {rejected} rejected',
    ]
    return '\n'.join(lines)
