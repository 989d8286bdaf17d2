# SPDX-License-Identifier: Apache-2.0
"""What a channel reports on /diagnostics: on its input, and on its observer."""

from collections import deque
from time import perf_counter
from typing import NamedTuple

from fhaosmo_ros.core.observer.status import Status
from fhaosmo_ros.core.online.counters import UNUSED_SAMPLES
from fhaosmo_ros.core.online.estimator import OnlineEstimator
from fhaosmo_ros.core.parameters.declaration import Parameters
from fhaosmo_ros.core.simulation.metrics import high_passed
from fhaosmo_ros.nodes.middleware.diagnostics import ERROR, Report, STALE, WARN
from fhaosmo_ros.nodes.middleware.publisher_watch import Publishers
import numpy as np
from numpy.typing import NDArray

LIMIT = 20_000
"""Number of latest samples that are remembered for one report."""
WINDOW = 5
"""Samples in the moving average that separates chatter from the signal."""
NANOSECONDS = 1e-9
GAMMA_AWAY = 0.2
"""Distance of gamma from where it began that deserves a warning."""
RATE_RATIO = 1.5
"""Factor between the rate of y and that of the gains that deserves one."""
SPREAD = 3.0
"""Factor between the innovations and those expected that deserves one."""


def _words(name: str) -> str:
    return name.replace('_', ' ')


UNUSED = ('samples lost', *map(_words, UNUSED_SAMPLES), 'rejected inputs')
"""Counters of samples that the observer has not taken."""


class Interval(NamedTuple):
    """
    What happened between two reports.

    Attributes
    ----------
    periods : (K,) array
        Intervals between the samples' stamps, in seconds.
    delays : (K,) array
        Times from the source stamp to the callback, in nanoseconds.
    durations : (K,) array
        Times that the callback took, in seconds.
    unknown_inputs : (K,) array
        Estimates of d.
    counts : dict of str to int
        Counters now.
    news : dict of str to int
        By how much each counter has grown.
    stale : bool
        No estimates are published, because no samples come.

    """

    periods: NDArray[np.float64]
    delays: NDArray[np.float64]
    durations: NDArray[np.float64]
    unknown_inputs: NDArray[np.float64]
    counts: dict[str, int]
    news: dict[str, int]
    stale: bool


class Health:
    """
    Remembers a few numbers of each sample, and makes two reports of them.

    Parameters
    ----------
    estimator : OnlineEstimator
    limits : Parameters
        The channel's; the thresholds warn_* and error_* are among them.

    Attributes
    ----------
    limits : Parameters
        The present ones.
    stamps, delays, durations, unknown_inputs : deque
        To be appended to on each sample: stamp (ns); time from the source stamp to the callback
        (ns); time that the callback took (s); estimate of d.
    lost : int
        Samples missing between the publisher's sequence numbers.

    """

    def __init__(self, estimator: OnlineEstimator, limits: Parameters) -> None:
        self._estimator = estimator
        self.limits = limits
        self.stamps: deque[int] = deque(maxlen=LIMIT)
        self.delays: deque[int] = deque(maxlen=LIMIT)
        self.durations: deque[float] = deque(maxlen=LIMIT)
        self.unknown_inputs: deque[float] = deque(maxlen=LIMIT)
        self.lost = 0
        self.latest = float('nan')
        """Time of the last sample on `perf_counter`."""
        self._before: dict[str, int] = self._counts()

    def reports(self, topic: str, publishers: Publishers, stale: bool, name: str) -> list[Report]:
        """
        Return the reports on the time since the last ones.

        Parameters
        ----------
        topic : str
            Of y.
        publishers : Publishers
            Of `topic`.
        stale : bool
            No estimates are published, because no samples come.
        name : str
            Of the channel, as a prefix of 'input' and 'observer'.

        """
        interval = self._interval(stale)
        return [
            self._input(Report(f'{name}input'), interval, topic, publishers),
            self._observer(Report(f'{name}observer'), interval),
        ]

    def _interval(self, stale: bool) -> Interval:
        """Return what happened since the last call."""
        counts = self._counts()
        news = {key: counts[key] - self._before[key] for key in counts}
        self._before = counts
        periods = np.diff(np.array(self.stamps, dtype=np.int64)) * NANOSECONDS
        delays, durations, d = (
            np.array(column) for column in (self.delays, self.durations, self.unknown_inputs)
        )
        for column in (self.stamps, self.delays, self.durations, self.unknown_inputs):
            column.clear()
        return Interval(periods, delays, durations, d, counts, news, stale)

    def _input(
        self, report: Report, interval: Interval, topic: str, publishers: Publishers
    ) -> Report:
        limits, news = self.limits, interval.news
        periods, delays = interval.periods, interval.delays
        mean = float(np.mean(periods)) if len(periods) else float('nan')
        jitter = float(np.std(periods)) / mean if mean > 0.0 else float('nan')
        delay = float(np.max(delays)) * NANOSECONDS if len(delays) else float('nan')
        age = perf_counter() - self.latest
        names = ', '.join(sorted(publishers.heard.values()))
        report.values = {
            'topic': topic,
            'publishers': names or 'none',
            'sample rate [Hz]': 1.0 / mean if mean > 0.0 else float('nan'),
            'jitter (std / mean of the period)': jitter,
            'longest period [s]': float(np.max(periods)) if len(periods) else float('nan'),
            'longest delay [s]': delay,
            'age of the last sample [s]': age,
            **interval.counts,
        }
        for text in publishers.unheard.values():
            report.find(WARN if names else ERROR, text)
        silence = ERROR if publishers.unheard and not names else STALE
        if interval.stale:
            since = f'for {age:.3g} s' if age == age else 'yet'
            report.find(silence, f'no usable sample {since}')
        if not names:
            report.find(silence, f'no publisher of {topic} that can be heard')
        elif len(publishers.heard) > 1:
            report.find(WARN, f'{len(publishers.heard)} publishers, their samples mix')
        bad = {key: news[key] for key in UNUSED if news[key]}
        if bad:
            share = sum(bad.values()) / (sum(bad.values()) + news['samples accepted'])
            level = ERROR if share > limits['error_bad_share_above'] else WARN
            report.find(level, ', '.join(f'{key} {n}' for key, n in bad.items()))
        used, spread = news['samples accepted'], news['spread stamps']
        if used < 2 * spread:
            report.find(
                WARN,
                f'/clock ticks once for {used / max(1, used - spread):.0f} samples, which makes '
                "their times inexact: let it tick with each, or do not use sampling 'clock'",
            )
        for key in ('restarts', 'stuck'):
            if news[key]:
                report.find(WARN, f'{key} {news[key]}')
        if mean * limits['warn_rate_below'] > 1.0:
            report.find(WARN, f'sample rate {1.0 / mean:.4g} Hz')
        if jitter > limits['warn_jitter_above']:
            report.find(WARN, f'jitter {jitter:.3g}')
        if delay > limits['warn_delay_above']:
            report.find(WARN, f'samples arrive {delay:.3g} s after their stamps')
        return report

    def _observer(self, report: Report, interval: Interval) -> Report:
        observer, estimate = self._estimator.observer, self._estimator.estimate
        periods, durations, d = interval.periods, interval.durations, interval.unknown_inputs
        diverged = interval.news['divergences']
        chatter = high_passed(d, WINDOW)
        spread = float(np.std(d)) if len(d) else float('nan')
        overruns = int(np.sum(durations > np.mean(periods))) if len(periods) else 0
        away, tuned = _gamma_away(self._estimator), observer.parameters['correction_period']
        mean = float(np.mean(periods)) if len(periods) else 0.0
        report.values = {
            'open levels': f'{estimate.open_levels if estimate else 0} of {observer.levels}',
            'gamma': estimate.gamma if estimate else float('nan'),
            'gamma away from gamma_initial': away,
            'gamma at': _bound(self._estimator, estimate.status if estimate else Status.OK),
            'innovations over those expected': self._estimator.spread,
            'unknown input': estimate.unknown_input if estimate else float('nan'),
            'chatter of the unknown input': chatter,
            'chatter index (0 smooth, 1 nothing but chatter)': (
                min(1.0, chatter / spread) if spread > 0.0 else 0.0
            ),
            'step time, mean [us]': 1e6 * float(np.mean(durations)) if len(durations) else 0.0,
            'step time, longest [us]': 1e6 * float(np.max(durations)) if len(durations) else 0.0,
            'overruns': overruns,
        }
        if interval.stale:
            report.find(STALE, 'no usable samples')
        elif estimate is not None and estimate.open_levels < observer.levels:
            first = estimate.open_levels + 1
            report.find(WARN, f'levels from {first} on hold: an innovation is above epsilon')
        if diverged:
            report.find(ERROR, f'diverged and started again from y, {diverged} times')
        if abs(away) > GAMMA_AWAY:
            report.find(WARN, f'gamma is {away:+.2g} away from gamma_initial')
        tuned = tuned if observer.parameters['scheme'] == 'predict_correct' else 0.0
        if tuned and mean and not tuned / RATE_RATIO < mean < tuned * RATE_RATIO:
            report.find(
                WARN, f'gains are for {1.0 / tuned:.4g} Hz, y comes at {1.0 / mean:.4g} Hz'
            )
        if self._estimator.spread > SPREAD:
            report.find(
                WARN,
                f'innovations are {self._estimator.spread:.3g} times as large as noise_size says',
            )
        if overruns:
            report.find(WARN, f'{overruns} steps took longer than the sampling period')
        if 0.0 < self.limits['warn_chatter_above'] < chatter:
            report.find(WARN, f'the estimate of d chatters by {chatter:.3g}')
        return report

    def _counts(self) -> dict[str, int]:
        counters = self._estimator.counters
        return {
            'samples accepted': counters.accepted,
            'samples lost': self.lost,
            'samples rejected': counters.rejected,
            **{_words(name): n for name, n in counters._asdict().items() if name != 'accepted'},
            'restarts': counters.restarts,
        }


def _gamma_away(estimator: OnlineEstimator) -> float:
    estimate, parameters = estimator.estimate, estimator.observer.parameters
    if estimate is None or not parameters['variant'].endswith('_adaptive'):
        return 0.0
    return float(estimate.gamma - parameters['gamma_initial'])


def _bound(estimator: OnlineEstimator, status: Status) -> str:
    if not estimator.observer.parameters['variant'].endswith('_adaptive'):
        return 'a fixed value'
    if estimator.frozen:
        return 'the value that ~/freeze holds'
    if status & Status.GAMMA_AT_MIN:
        return 'gamma_min'
    return 'gamma_max' if status & Status.GAMMA_AT_MAX else 'neither bound'
