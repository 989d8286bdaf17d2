# SPDX-License-Identifier: Apache-2.0
"""What a channel reports on /diagnostics: on its input, and on its observer."""

from collections import deque
from math import nan
from time import perf_counter
from typing import NamedTuple

from fhaosmo_ros.core.observer.status import Status
from fhaosmo_ros.core.online.counters import UNUSED_SAMPLES
from fhaosmo_ros.core.online.estimator import OnlineEstimator
from fhaosmo_ros.core.online.events import described
from fhaosmo_ros.core.parameters.declaration import Parameters
from fhaosmo_ros.core.parameters.units import derivative_unit, titled
from fhaosmo_ros.core.simulation.metrics import high_passed
from fhaosmo_ros.nodes.estimator.sources import Listener
from fhaosmo_ros.nodes.middleware.diagnostics import ERROR, Report, STALE, WARN
from fhaosmo_ros.nodes.middleware.publisher_watch import Publishers
import numpy as np

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
    mean, jitter, longest : float
        Of the intervals between the samples' stamps: mean, standard deviation over the mean, and
        longest one; s, NaN without samples.
    counts, news : dict of str to int
        Counters now, and by how much each has grown.
    stale : bool
        No estimates are published, because no samples come.

    """

    mean: float
    jitter: float
    longest: float
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
    simulated : bool
        True if stamps are in simulated time.

    Attributes
    ----------
    limits : Parameters
        The present ones.
    stamps, delays, durations, unknown_inputs : deque
        To be appended to on each sample: stamp (ns); time from the source stamp to the callback
        (ns); time that the callback took (s); estimate of d.
    lost, damaged, lacking : int
        Messages that did not arrive, are shorter than their type, lack the field.
    offset : int
        From the latest sample's stamp to the publication of its message (ns).
    latest : float
        Time of the last sample on `perf_counter`, NaN before the first.

    """

    def __init__(
        self, estimator: OnlineEstimator, limits: Parameters, simulated: bool = False
    ) -> None:
        self._estimator = estimator
        self._simulated = simulated
        self.limits = limits
        self.stamps: deque[int] = deque(maxlen=LIMIT)
        self.delays: deque[int] = deque(maxlen=LIMIT)
        self.durations: deque[float] = deque(maxlen=LIMIT)
        self.unknown_inputs: deque[float] = deque(maxlen=LIMIT)
        self.lost = self.damaged = self.lacking = self.offset = 0
        self.latest = nan
        self._before = self._counts()
        self._events_before = 0

    def reports(self, y: Listener, publishers: Publishers, stale: bool, name: str) -> list[Report]:
        """
        Return the reports on the time since the last ones.

        Parameters
        ----------
        y : Listener
        publishers : Publishers
            Of the topic of y.
        stale : bool
            No estimates are published, because no samples come.
        name : str
            Of the channel, as a prefix of 'input' and 'observer'.

        """
        counts = self._counts()
        news = {key: count - self._before[key] for key, count in counts.items()}
        self._before = counts
        mean = jitter = longest = nan
        periods = np.diff(np.array(self.stamps, dtype=np.int64)) * NANOSECONDS
        if len(periods):
            mean, longest = float(np.mean(periods)), float(np.max(periods))
            jitter = float(np.std(periods)) / mean if mean > 0.0 else nan
        interval = Interval(mean, jitter, longest, counts, news, stale)
        reports = [
            self._input(Report(f'{name}input'), interval, y, publishers),
            self._observer(Report(f'{name}observer'), interval),
        ]
        for column in (self.stamps, self.delays, self.durations, self.unknown_inputs):
            column.clear()
        return reports

    def _input(
        self, report: Report, interval: Interval, y: Listener, publishers: Publishers
    ) -> Report:
        limits, news, mean = self.limits, interval.news, interval.mean
        delay = max(self.delays) * NANOSECONDS if self.delays else nan
        offset = self.offset * NANOSECONDS
        age = perf_counter() - self.latest
        names = ', '.join(sorted(publishers.heard.values()))
        report.values = {
            'topic': y.source.topic,
            'type': y.source.message_type or 'not known yet',
            'field': y.field.text if y.field else 'not known yet',
            'stamps': 'clock' if limits['sampling'] == 'clock' else y.stamps or 'not known yet',
            'publishers': names or 'none',
            'sample rate [Hz]': 1.0 / mean if mean > 0.0 else nan,
            'jitter (std / mean of the period)': interval.jitter,
            'longest period [s]': interval.longest,
            'longest delay [s]': delay,
            'from stamp to publication [s]': offset,
            'age of the last sample [s]': age,
            **interval.counts,
        }
        if y.error:
            report.find(ERROR, y.error)
        for text in publishers.unheard.values():
            report.find(WARN if names else ERROR, text)
        silence = ERROR if publishers.unheard and not names else STALE
        if interval.stale:
            since = f'for {age:.3g} s' if age == age else 'yet'
            report.find(silence, f'no usable sample {since}')
        if not names and not y.error:
            report.find(silence, f'no publisher of {y.source.topic} that can be heard')
        elif len(publishers.heard) > 1 and not news['messages without y']:
            report.find(WARN, f'{len(publishers.heard)} publishers, their samples mix')
        used, spread = news['samples accepted'], news['spread stamps']
        if news['messages without y'] and not used:
            report.find(WARN, f'{news["messages without y"]} messages without y: {y.why}')
        bad = {key: news[key] for key in UNUSED if news[key]}
        if bad:
            share = sum(bad.values()) / (sum(bad.values()) + used)
            level = ERROR if share > limits['error_bad_share_above'] else WARN
            report.find(level, ', '.join(f'{key} {n}' for key, n in bad.items()))
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
        if interval.jitter > limits['warn_jitter_above']:
            report.find(WARN, f'jitter {interval.jitter:.3g}')
        if delay > limits['warn_delay_above']:
            report.find(WARN, f'samples arrive {delay:.3g} s after their stamps')
        by_header = y.stamps == 'header' and not self._simulated
        if by_header and abs(offset) > limits['warn_delay_above']:
            side = 'before' if offset > 0.0 else 'after'
            report.find(
                WARN,
                f'header stamps lie {abs(offset):.3g} s {side} publication: another clock '
                "than the host's, or an old measurement; dt is not affected",
            )
        return report

    def _observer(self, report: Report, interval: Interval) -> Report:
        estimator, limits, mean = self._estimator, self.limits, interval.mean
        observer, estimate, offset = estimator.observer, estimator.estimate, estimator.offset
        unit = derivative_unit(limits['measurement_unit'], observer.order)
        d_now = estimate.unknown_input if estimate else nan
        d, durations = np.array(self.unknown_inputs), np.array(self.durations)
        chatter = high_passed(d, WINDOW)
        deviation = float(np.std(d)) if len(d) else nan
        overruns = int(np.sum(durations > mean))
        away = self._gamma_away()
        report.values = {
            'open levels': f'{estimate.open_levels if estimate else 0} of {observer.levels}',
            'gamma': estimate.gamma if estimate else nan,
            'gamma away from gamma_initial': away,
            'gamma at': self._bound(estimate.status if estimate else Status.OK),
            'innovations over those expected': estimator.spread,
            'y over z1, since it jumped': offset,
            titled('unknown input', unit): d_now,
            'chatter of the unknown input': chatter,
            'chatter index (0 smooth, 1 nothing but chatter)': (
                min(1.0, chatter / deviation) if deviation > 0.0 else 0.0
            ),
            'step time, mean [us]': 1e6 * float(np.mean(durations)) if len(durations) else 0.0,
            'step time, longest [us]': 1e6 * max(self.durations, default=0.0),
            'overruns': overruns,
        }
        if observer.self_tuning:
            tuning, d_error = observer.tuning, float(estimator.standard_deviation[-1])
            report.values |= {
                'noise of y': tuning.noise,
                'correlation of the noise': tuning.correlation,
                'd is followed within [s]': 1.0 / tuning.bandwidth,
                titled('standard deviation of d', unit): d_error,
            }
        self._find_events(report, unit)
        if limits['unknown_input_unit']:
            scaled = titled('unknown input, scaled', limits['unknown_input_unit'])
            report.values[scaled] = d_now * limits['unknown_input_scale']
        if interval.stale:
            report.find(STALE, 'no usable samples')
        elif estimate is not None and estimate.open_levels < observer.levels:
            first = estimate.open_levels + 1
            report.find(WARN, f'levels from {first} on hold: an innovation is above epsilon')
        diverged, jumps = interval.news['divergences'], interval.news['jumps']
        if diverged:
            report.find(ERROR, f'diverged and started again from y, {diverged} times')
        if jumps:
            report.find(WARN, f'y jumped {jumps} times')
        if offset:
            report.find(WARN, f'y is taken as {offset:.3g} too large since it jumped')
        if abs(away) > GAMMA_AWAY:
            report.find(WARN, f'gamma is {away:+.2g} away from gamma_initial')
        tuned = observer.parameters['correction_period']
        by_period = observer.parameters['scheme'] == 'predict_correct' and tuned and mean > 0.0
        if by_period and not tuned / RATE_RATIO < mean < tuned * RATE_RATIO:
            report.find(
                WARN, f'gains are for {1.0 / tuned:.4g} Hz, y comes at {1.0 / mean:.4g} Hz'
            )
        if estimator.spread > SPREAD:
            report.find(
                WARN, f'innovations are {estimator.spread:.3g} times as large as noise_size says'
            )
        if overruns:
            report.find(WARN, f'{overruns} steps took longer than the sampling period')
        if 0.0 < limits['warn_chatter_above'] < chatter:
            report.find(WARN, f'the estimate of d chatters by {chatter:.3g}')
        return report

    def _find_events(self, report: Report, unit: str) -> None:
        """Tell of the event that lasts, or of those since the last report."""
        events = self._estimator.events
        news, self._events_before = events.count - self._events_before, events.count
        if not events.on:
            return
        report.values['events'] = events.count
        latest = events.latest
        if latest is None:
            return
        text, _ = described(latest, unit)
        if events.active and latest.begins:
            seconds = (self._estimator.latest - latest.since) * NANOSECONDS
            report.find(WARN, f'event: {text}; it has lasted for {seconds:.3g} s')
        elif news:
            report.find(WARN, f'{news} events, the last one {text}')

    def _counts(self) -> dict[str, int]:
        counters = self._estimator.counters
        return {
            'samples accepted': counters.accepted,
            'samples lost': self.lost,
            'damaged messages': self.damaged,
            'messages without y': self.lacking,
            'samples rejected': counters.rejected,
            **{_words(name): n for name, n in counters._asdict().items() if name != 'accepted'},
            'restarts': counters.restarts,
        }

    def _gamma_away(self) -> float:
        observer, estimate = self._estimator.observer, self._estimator.estimate
        adaptive = observer.parameters['variant'].endswith('_adaptive')
        if estimate is None or observer.self_tuning or not adaptive:
            return 0.0
        return float(estimate.gamma - observer.parameters['gamma_initial'])

    def _bound(self, status: Status) -> str:
        if not self._estimator.observer.parameters['variant'].endswith('_adaptive'):
            return 'a fixed value'
        if self._estimator.frozen:
            return 'the value that ~/freeze holds'
        if status & Status.GAMMA_AT_MIN:
            return 'gamma_min'
        return 'gamma_max' if status & Status.GAMMA_AT_MAX else 'neither bound'
