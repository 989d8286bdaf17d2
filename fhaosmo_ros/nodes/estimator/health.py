# SPDX-License-Identifier: Apache-2.0
"""What a channel reports on /diagnostics: on its input, and on its observer."""

from collections import deque
from collections.abc import Mapping
from math import inf, nan
from time import perf_counter
from typing import Any

from fhaosmo_ros.core.observer.status import Status
from fhaosmo_ros.core.online.counters import UNUSED_SAMPLES
from fhaosmo_ros.core.online.events import described
from fhaosmo_ros.core.parameters.units import derivative_unit, titled
from fhaosmo_ros.core.simulation.metrics import high_passed
from fhaosmo_ros.nodes.middleware.diagnostics import ERROR, Report, STALE, WARN
import numpy as np
from numpy.typing import NDArray

LIMIT = 20_000
"""Number of latest samples that are remembered for one report."""
WINDOW = 5
"""Samples in the moving average that separates chatter from the signal."""
NANOSECONDS = 1e-9
BAD_SHARE = 0.5
"""Share of samples lost or rejected that is an error; any at all deserves a warning."""
GAMMA_AWAY = 0.2
"""Distance of gamma from where it began that deserves a warning."""
RATE_RATIO = 1.5
"""Factor between the rate of y and that of the gains that deserves one."""
SPREAD = 3.0
"""Factor between the innovations and those expected that deserves one."""


def _words(name: str) -> str:
    return name.replace('_', ' ')


UNPAIRED = {
    'late inputs': ', which came after their sample had been used: raise known_input_wait, or '
    'their header stamps are of another clock',
    'samples before any input': ', whose stamps are all later: are the header stamps of one '
    'clock?',
}
"""What is said of known inputs and samples that do not find each other."""
UNUSED = ('samples lost', *map(_words, UNUSED_SAMPLES), 'rejected inputs')
"""Counters of samples that the observer has not taken."""


class Health:
    """
    Remembers a few numbers of each sample of a `Channel`, and makes two reports of them.

    `samples` has the stamp (ns), the time of the step (s) and d of each sample that was used.
    `latest` is the time of the last one on `perf_counter`. `delay` is the longest time from the
    publication of a sample to its callback, and `offset` that from its stamp to its publication
    (ns).
    """

    def __init__(self, channel: Any) -> None:
        self._channel = channel
        self.samples: deque[tuple[int, float, float]] = deque(maxlen=LIMIT)
        self.delay, self.offset = -inf, 0
        self.latest = nan
        self._before = self._counts()
        self._events_before = 0

    def begin(self) -> None:
        """Begin to count: what was lost before does not matter."""
        self._channel.y.source.lost = 0
        self._before = self._counts()

    def reports(self, stale: bool) -> list[Report]:
        """Return the reports on the time since the last ones."""
        counts = self._counts()
        news = {key: count - self._before[key] for key, count in counts.items()}
        self._before = counts
        stamps, durations, d = zip(*self.samples, strict=True) if self.samples else ((), (), ())
        periods = np.diff(np.array(stamps, dtype=np.int64)) * NANOSECONDS
        mean = float(np.mean(periods)) if len(periods) else nan
        title = f'{self._channel.name} '.lstrip()
        reports = [Report(f'{title}input'), Report(f'{title}observer')]
        self._input(reports[0], periods, mean, news, stale)
        self._observer(reports[1], mean, np.array(durations), np.array(d), news, stale)
        self.samples.clear()
        self.delay = -inf
        return reports

    def _input(
        self,
        report: Report,
        periods: NDArray[np.float64],
        mean: float,
        news: Mapping[str, int],
        stale: bool,
    ) -> None:
        """Report on the samples; `news`: by how much the counters have grown."""
        channel, y, limits = self._channel, self._channel.y, self._channel.values
        source, heard = y.source, y.source.heard
        rate = 1.0 / mean if mean > 0.0 else nan
        jitter = float(np.std(periods)) * rate if len(periods) else nan
        delay = self.delay * NANOSECONDS if self.delay > -inf else nan
        offset = self.offset * NANOSECONDS
        age = perf_counter() - self.latest
        stamps = 'clock' if limits['sampling'] == 'clock' else y.stamps
        report.values = {
            'topic': source.topic,
            'type': source.message_type or 'not known yet',
            'field': y.field.text if y.field else 'not known yet',
            'stamps': stamps or 'not known yet',
            'publishers': ', '.join(sorted(heard.values())) or 'none',
            'sample rate [Hz]': rate,
            'jitter (std / mean of the period)': jitter,
            'longest period [s]': float(np.max(periods)) if len(periods) else nan,
            'longest delay [s]': delay,
            'from stamp to publication [s]': offset,
            'age of the last sample [s]': age,
            **self._before,
        }
        report.find(ERROR, y.error, y.error)
        for text in source.unheard.values():
            report.find(WARN if heard else ERROR, text)
        silence = ERROR if source.unheard and not heard else STALE
        since = f'for {age:.3g} s' if age == age else 'yet'
        report.find(silence, f'no usable sample {since}', stale)
        alone = f'no publisher of {source.topic} that can be heard'
        report.find(silence, alone, not heard and not y.error)
        used, lacking, spread = (
            news[key] for key in ('samples accepted', 'messages without y', 'spread stamps')
        )
        several = f'{len(heard)} publishers, their samples mix'
        report.find(WARN, several, len(heard) > 1 and not lacking)
        report.find(WARN, f'{lacking} messages without y: {y.why}', lacking and not used)
        bad = {key: news[key] for key in UNUSED if news[key]}
        share = sum(bad.values()) / max(1, sum(bad.values()) + used)
        level = ERROR if share > BAD_SHARE else WARN
        report.find(level, ', '.join(f'{key} {n}' for key, n in bad.items()), bad)
        report.find(
            WARN,
            f'/clock ticks once for {used / max(1, used - spread):.0f} samples, which makes their '
            "times inexact: let it tick with each, or do not use sampling 'clock'",
            used < 2 * spread,
        )
        for key in ('restarts', 'stuck'):
            report.find(WARN, f'{key} {news[key]}', news[key])
        report.find(WARN, f'sample rate {rate:.4g} Hz', rate < limits['warn_rate_below'])
        report.find(WARN, f'jitter {jitter:.3g}', jitter > limits['warn_jitter_above'])
        latest = limits['warn_delay_above']
        report.find(WARN, f'samples arrive {delay:.3g} s after their stamps', delay > latest)
        side = 'before' if offset > 0.0 else 'after'
        report.find(
            WARN,
            f'header stamps lie {abs(offset):.3g} s {side} publication: another clock than the '
            "host's, or an old measurement; dt is not affected",
            y.stamps == 'header' and not channel.simulated and abs(offset) > latest,
        )
        for name, u in channel.u.items():
            for text in [u.error] if u.error else u.source.unheard.values():
                report.find(ERROR if u.error else WARN, text)
            nobody = not u.source.heard and not u.source.unheard
            report.find(WARN, f'no publisher of {name}', nobody)
        for key, text in UNPAIRED.items():
            report.find(WARN, f'{news[key]} {key}{text}', news[key])

    def _observer(
        self,
        report: Report,
        mean: float,
        durations: NDArray[np.float64],
        d: NDArray[np.float64],
        news: Mapping[str, int],
        stale: bool,
    ) -> None:
        estimator, limits = self._channel.estimator, self._channel.values
        observer, estimate, offset = estimator.observer, estimator.estimate, estimator.offset
        unit = derivative_unit(limits['measurement_unit'], observer.order)
        d_now = estimate.unknown_input if estimate else nan
        spread = observer.structure.memory['spread']
        chatter = high_passed(d, WINDOW)
        deviation = float(np.std(d)) if len(d) else nan
        overruns = int(np.sum(durations > mean))
        away = 0.0
        if estimate and observer.configuration.adaptive and not observer.self_tuning:
            away = estimate.gamma - observer.parameters['gamma_initial']
        report.values = {
            'open levels': f'{estimate.open_levels if estimate else 0} of {observer.levels}',
            'gamma': estimate.gamma if estimate else nan,
            'gamma away from gamma_initial': away,
            'gamma at': self._bound(estimate.status if estimate else Status.OK),
            'innovations over those expected': spread,
            'y over z1, since it jumped': offset,
            titled('unknown input', unit): d_now,
            'chatter of the unknown input': chatter,
            'chatter index (0 smooth, 1 nothing but chatter)': (
                min(1.0, chatter / deviation) if deviation > 0.0 else 0.0
            ),
            'step time, mean [us]': 1e6 * float(np.mean(durations)) if len(durations) else 0.0,
            'step time, longest [us]': 1e6 * np.max(durations, initial=0.0),
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
        report.find(STALE, 'no usable samples', stale)
        first = estimate.open_levels + 1 if estimate else observer.levels + 1
        held = f'levels from {first} on hold: an innovation is above epsilon'
        report.find(WARN, held, first <= observer.levels and not stale)
        diverged, jumps = news['divergences'], news['jumps']
        report.find(ERROR, f'diverged and started again from y, {diverged} times', diverged)
        report.find(WARN, f'y jumped {jumps} times', jumps)
        report.find(WARN, f'y is taken as {offset:.3g} too large since it jumped', offset)
        moved = f'gamma is {away:+.2g} away from gamma_initial'
        report.find(WARN, moved, abs(away) > GAMMA_AWAY)
        tuned = observer.parameters['correction_period']
        if tuned and mean > 0.0 and observer.configuration.levant:
            rates = f'gains are for {1.0 / tuned:.4g} Hz, y comes at {1.0 / mean:.4g} Hz'
            report.find(WARN, rates, not tuned / RATE_RATIO < mean < tuned * RATE_RATIO)
        wide = f'innovations are {spread:.3g} times as large as noise_size says'
        report.find(WARN, wide, spread > SPREAD)
        report.find(WARN, f'{overruns} steps took longer than the sampling period', overruns)

    def _find_events(self, report: Report, unit: str) -> None:
        """Tell of the event that lasts, or of those since the last report."""
        estimator = self._channel.estimator
        events = estimator.events
        news, self._events_before = events.count - self._events_before, events.count
        if not events.on:
            return
        report.values['events'] = events.count
        latest = events.latest
        if latest is None:
            return
        text, _ = described(latest, unit)
        if events.active and latest.begins:
            seconds = (estimator.latest - latest.since) * NANOSECONDS
            report.find(WARN, f'event: {text}; it has lasted for {seconds:.3g} s')
        elif news:
            report.find(WARN, f'{news} events, the last one {text}')

    def _counts(self) -> dict[str, int]:
        channel, y = self._channel, self._channel.y
        counters, source, pairing = channel.estimator.counters, y.source, channel.pairing
        return {
            'samples accepted': counters.accepted,
            'samples lost': source.lost,
            'damaged messages': source.damaged,
            'messages without y': y.lacking,
            'samples rejected': counters.rejected,
            **{_words(name): n for name, n in counters._asdict().items() if name != 'accepted'},
            'restarts': counters.restarts,
            'late inputs': pairing.late,
            'samples before any input': pairing.ahead,
        }

    def _bound(self, status: Status) -> str:
        estimator = self._channel.estimator
        if not estimator.observer.configuration.adaptive:
            return 'a fixed value'
        if estimator.frozen:
            return 'the value that ~/freeze holds'
        if status & Status.GAMMA_AT_MIN:
            return 'gamma_min'
        return 'gamma_max' if status & Status.GAMMA_AT_MAX else 'neither bound'
