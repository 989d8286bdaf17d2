# SPDX-License-Identifier: Apache-2.0
"""What a channel reports on /diagnostics: on its input, and on its observer."""

from array import array
from collections.abc import Mapping
from math import inf, nan
from time import perf_counter
from typing import Any, NamedTuple

from fhaosmo_ros.core.online.counters import UNUSED_SAMPLES
from fhaosmo_ros.core.online.events import described
from fhaosmo_ros.core.parameters.units import derivative_unit, titled
from fhaosmo_ros.core.simulation.metrics import high_passed
from fhaosmo_ros.nodes.middleware.diagnostics import ERROR, Report, STALE, WARN
import numpy as np
from numpy.typing import NDArray

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
COUNTED = {
    'restarts': 'restarts {}',
    'stuck': 'stuck {}',
    'late inputs': '{} late inputs, which came after their sample had been used: raise '
    'known_input_wait, or their header stamps are of another clock',
    'samples before any input': '{} samples before any input, whose stamps are all later: are the '
    'header stamps of one clock?',
}
"""What is said of the input where these counters have grown."""


def _words(name: str) -> str:
    return name.replace('_', ' ')


UNUSED = ('samples lost', *map(_words, UNUSED_SAMPLES), 'rejected inputs')
"""Counters of samples that the observer has not taken."""


class Seen(NamedTuple):
    """What was seen of a channel since the reports before."""

    news: Mapping[str, int]  # by how much each counter has grown
    period: float  # mean time between samples in seconds, NaN if there were fewer than two
    periods: NDArray[np.float64]
    durations: NDArray[np.float64]  # of the steps, in seconds
    d: NDArray[np.float64]
    stale: bool


class Health:
    """
    Remembers a few numbers of each sample of a `Channel`, and makes two reports of them.

    Of each sample that was used they are its stamp (ns), the time of its step (s) and d. `latest`
    is the time of the last one on `perf_counter`.
    """

    def __init__(self, channel: Any) -> None:
        self._channel = channel
        self.stamps, self.durations, self.d = array('q'), array('d'), array('d')
        self.latest = nan
        self._before = self._counts()

    def begin(self) -> None:
        """Begin to count: what was lost before does not matter."""
        self._channel.y.source.lost = 0
        self._before = self._counts()

    def _counts(self) -> dict[str, int]:
        channel, y = self._channel, self._channel.y
        counters = channel.estimator.counters
        return {
            'samples accepted': counters.accepted,
            'samples lost': y.source.lost,
            'messages without y': y.lacking,
            'samples rejected': counters.rejected,
            **{_words(name): n for name, n in counters._asdict().items() if name != 'accepted'},
            'restarts': counters.restarts,
            'late inputs': channel.pairing.late,
            'samples before any input': channel.pairing.ahead,
            'events': channel.estimator.events.count,
        }

    def reports(self, stale: bool) -> list[Report]:
        """Return the reports on the time since the last ones."""
        before, self._before = self._before, self._counts()
        stamps, durations, d = map(np.array, (self.stamps, self.durations, self.d))
        for numbers in (self.stamps, self.durations, self.d):
            del numbers[:]
        periods = np.diff(stamps) * NANOSECONDS
        seen = Seen(
            {key: count - before[key] for key, count in self._before.items()},
            float(np.mean(periods)) if len(periods) else nan,
            periods, durations, d, stale,
        )  # fmt: skip
        return [self._input(seen), self._observer(seen)]

    def _report(self, task: str, values: Mapping[str, Any]) -> Report:
        return Report(f'{self._channel.name} {task}'.lstrip(), values)

    def _input(self, seen: Seen) -> Report:
        """Report on the samples."""
        channel, y, limits = self._channel, self._channel.y, self._channel.values
        source, heard, news = y.source, y.source.heard, seen.news
        rate = 1.0 / seen.period if seen.period > 0.0 else nan
        jitter = float(np.std(seen.periods)) * rate if len(seen.periods) else nan
        delay = source.delay * NANOSECONDS if source.delay > -inf else nan
        offset = source.offset * NANOSECONDS if y.stamps == 'header' else 0.0
        age = perf_counter() - self.latest
        report = self._report('input', {
            'topic': source.topic,
            'type': source.message_type or 'not known yet',
            'field': y.field.text if y.field else 'not known yet',
            'stamps': 'clock' if limits['sampling'] == 'clock' else y.stamps or 'not known yet',
            'publishers': ', '.join(sorted(heard.values())) or 'none',
            'sample rate [Hz]': rate,
            'jitter (std / mean of the period)': jitter,
            'longest period [s]': float(np.max(seen.periods)) if len(seen.periods) else nan,
            'longest delay [s]': delay,
            'from stamp to publication [s]': offset,
            'age of the last sample [s]': age,
            **self._before,
        })  # fmt: skip
        report.find(ERROR, y.error, y.error)
        for text in source.unheard.values():
            report.find(WARN if heard else ERROR, text)
        silence = ERROR if y.error or (source.unheard and not heard) else STALE
        since = f'for {age:.3g} s' if age == age else 'yet'
        report.find(silence, f'no usable sample {since}', seen.stale)
        alone = f'no publisher of {source.topic} that can be heard'
        report.find(silence, alone, not heard and not y.error)
        used, lacking = news['samples accepted'], news['messages without y']
        several = f'{len(heard)} publishers, their samples mix'
        report.find(WARN, several, len(heard) > 1 and not lacking)
        report.find(WARN, f'{lacking} messages without y: {y.why}', lacking and not used)
        bad = {key: news[key] for key in UNUSED if news[key]}
        many = sum(bad.values()) > BAD_SHARE * (sum(bad.values()) + used)
        report.find(
            ERROR if many else WARN, ', '.join(f'{key} {n}' for key, n in bad.items()), bad
        )
        spread = news['spread stamps']
        report.find(
            WARN,
            f'/clock ticks once for {used / max(1, used - spread):.0f} samples, which makes their '
            "times inexact: let it tick with each, or do not use sampling 'clock'",
            used < 2 * spread,
        )
        report.find(WARN, f'sample rate {rate:.4g} Hz', rate < limits['warn_rate_below'])
        report.find(WARN, f'jitter {jitter:.3g}', jitter > limits['warn_jitter_above'])
        latest = limits['warn_delay_above']
        report.find(WARN, f'samples arrive {delay:.3g} s after their stamps', delay > latest)
        side = 'before' if offset > 0.0 else 'after'
        report.find(
            WARN,
            f'header stamps lie {abs(offset):.3g} s {side} publication: another clock than the '
            "host's, or an old measurement; dt is not affected",
            not channel.simulated and abs(offset) > latest,
        )
        for name, u in channel.u.items():
            report.find(ERROR, u.error, u.error)
            for text in u.source.unheard.values():
                report.find(WARN, text)
            nobody = not u.source.heard and not u.source.unheard
            report.find(WARN, f'no publisher of {name}', nobody)
        for key, text in COUNTED.items():
            report.find(WARN, text.format(news[key]), news[key])
        return report

    def _observer(self, seen: Seen) -> Report:
        """Report on the estimates and the steps."""
        estimator, limits = self._channel.estimator, self._channel.values
        observer, estimate, offset = estimator.observer, estimator.estimate, estimator.offset
        unit = derivative_unit(limits['measurement_unit'], observer.order)
        gamma, d = (estimate.gamma, estimate.unknown_input) if estimate else (nan, nan)
        levels = estimate.open_levels if estimate else 0
        spread = observer.structure.memory['spread']
        deviation = float(np.std(seen.d)) if len(seen.d) else nan
        index = min(1.0, high_passed(seen.d, WINDOW) / deviation) if deviation > 0.0 else 0.0
        overruns = int(np.sum(seen.durations > seen.period))
        report = self._report('observer', {
            'open levels': f'{levels} of {observer.levels}',
            'gamma': gamma,
            'gamma is held by ~/freeze': estimator.frozen,
            'innovations over those expected': spread,
            'y over z1, since it jumped': offset,
            titled('unknown input', unit): d,
            'chatter index (0 smooth, 1 nothing but chatter)': index,
            'step time, mean [us]': 1e6 * float(np.sum(seen.durations)) / max(1, len(seen.d)),
            'step time, longest [us]': 1e6 * np.max(seen.durations, initial=0.0),
            'overruns': overruns,
        })  # fmt: skip
        if observer.self_tuning:
            tuning, d_error = observer.tuning, float(estimator.standard_deviation[-1])
            report.values |= {
                'noise of y': tuning.noise,
                'correlation of the noise': tuning.correlation,
                'd is followed within [s]': 1.0 / tuning.bandwidth,
                titled('standard deviation of d', unit): d_error,
            }
        if limits['unknown_input_unit']:
            scaled = titled('unknown input, scaled', limits['unknown_input_unit'])
            report.values[scaled] = d * limits['unknown_input_scale']
        event, news = estimator.events.latest, seen.news
        if event is not None and estimator.events.on:
            text, _ = described(event, unit)
            if estimator.events.active and event.begins:
                seconds = (estimator.latest - event.since) * NANOSECONDS
                report.find(WARN, f'event: {text}; it has lasted for {seconds:.3g} s')
            else:
                report.find(WARN, f'{news["events"]} events, the last one {text}', news['events'])
        report.find(STALE, 'no usable samples', seen.stale)
        held = f'levels from {levels + 1} on hold: an innovation is above epsilon'
        closed = estimate is not None and levels < observer.levels
        report.find(WARN, held, closed and not seen.stale)
        diverged, jumps = news['divergences'], news['jumps']
        report.find(ERROR, f'diverged and started again from y, {diverged} times', diverged)
        report.find(WARN, f'y jumped {jumps} times', jumps)
        report.find(WARN, f'y is taken as {offset:.3g} too large since it jumped', offset)
        if observer.configuration.adaptive and not observer.self_tuning:
            away = gamma - observer.parameters['gamma_initial']
            moved = f'gamma is {away:+.2g} away from gamma_initial'
            report.find(WARN, moved, abs(away) > GAMMA_AWAY)
        tuned = observer.parameters['correction_period']
        if tuned and seen.period > 0.0 and observer.configuration.levant:
            rates = f'gains are for {1.0 / tuned:.4g} Hz, y comes at {1.0 / seen.period:.4g} Hz'
            report.find(WARN, rates, not tuned / RATE_RATIO < seen.period < tuned * RATE_RATIO)
        wide = f'innovations are {spread:.3g} times as large as noise_size says'
        report.find(WARN, wide, spread > SPREAD)
        report.find(WARN, f'{overruns} steps took longer than the sampling period', overruns)
        return report
