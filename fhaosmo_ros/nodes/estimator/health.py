# SPDX-License-Identifier: Apache-2.0
"""What a channel reports on /diagnostics: on its input, and on its observer."""

from array import array
from collections.abc import Mapping
from math import inf, nan
from time import perf_counter
from typing import Any

from fhaosmo_ros.core.parameters.units import derivative_unit, titled
from fhaosmo_ros.nodes.middleware.diagnostics import ERROR, Report, STALE, WARN
import numpy as np

NANOSECONDS = 1e-9
BAD_SHARE = 0.5
"""Share of samples lost or rejected that is an error; any at all deserves a warning."""
JITTER = 0.5
"""Standard deviation of the sampling period over its mean that deserves a warning."""
DELAY = 0.1
"""Seconds between stamp and arrival that deserve one: a slow host, or clocks that differ."""
RATE_RATIO = 1.5
"""Factor between the rate of y and that of the gains that deserves one."""
SPREAD = 3.0
"""Factor between the innovations and those expected that deserves one."""
UNUSED = {
    'samples lost': '{n} samples lost: they did not arrive, or were damaged',
    'rejected measurements': '{n} samples rejected: y was NaN, infinite or beyond 1e60',
    'rejected spikes': '{n} samples rejected: y was further than spike_gate, or 6 usual '
    'deviations, from its prediction',
    'rejected stuck': '{n} samples rejected: y repeats itself, for longer than stuck_time or '
    'although it has noise: its sensor is stuck',
    'rejected steps': '{n} samples rejected: the estimate would have become infinite',
    'duplicate stamps': '{n} samples rejected: their stamps were those of the ones before',
    'backward stamps': '{n} samples rejected: their stamps were older than those before',
    'zero stamps': '{n} samples rejected: {zero}',
    'far stamps': '{n} samples held back: stamps more than max_gap from the one before; the next '
    'sample decides',
    'rejected inputs': '{n} known inputs rejected: expected finite numbers; the last one is held',
}
"""What is said of the samples that were not used, by counter; `zero`: why stamps are 0."""
ZERO = {
    'clock': 'nothing on /clock yet',
    'header': 'their stamps are 0: nobody fills the header; input_stamp: source does without it',
}
HOST_TIME = (
    "use_sim_time with sampling = source_stamp: the middleware's stamps know nothing of /clock, "
    "so dt is in the host's time; set sampling to clock for simulation time"
)


class Health:
    """
    Makes two reports of the samples of a `Channel`.

    It remembers the stamp (ns) of each sample that was used, as `latest` when the last one came,
    on `perf_counter`, and as `stepping` how long the steps took in all (s).
    """

    def __init__(self, channel: Any) -> None:
        self._channel = channel
        self.stamps = array('q')
        self.latest, self.stepping = nan, 0.0
        self._before, self._closed = self._counts(), False

    def begin(self) -> None:
        """Begin to count: what was lost before does not matter."""
        self._channel.y.source.numbers.lost = 0
        self._before = self._counts()

    def _counts(self) -> dict[str, int]:
        channel, y = self._channel, self._channel.y
        counters = channel.estimator.counters
        own = {name.replace('_', ' '): count for name, count in counters._asdict().items()}
        return {
            'samples accepted': own.pop('accepted'),
            'samples lost': y.source.numbers.lost,
            'messages without y': y.lacking,
            'samples rejected': counters.rejected,
            **own,
            'restarts': counters.restarts,
            'events': channel.estimator.events.count,
        }

    def reports(self) -> list[Report]:
        """Return the reports on the time since the last ones."""
        before, self._before = self._before, self._counts()
        news = {key: count - before[key] for key, count in self._before.items()}
        periods = np.diff(np.array(self.stamps)) * NANOSECONDS
        period = float(np.mean(periods)) if len(periods) else nan
        jitter = float(np.std(periods)) / period if period > 0.0 else nan
        reports = [self._input(news, period, jitter), self._observer(news, period)]
        del self.stamps[:]
        self.stepping = 0.0
        return reports

    def _input(self, news: Mapping[str, int], period: float, jitter: float) -> Report:
        """Report on the samples; `news` is by how much each counter has grown."""
        channel, y, limits = self._channel, self._channel.y, self._channel.values
        source, heard, names = y.source, y.source.heard, ', '.join(sorted(y.source.heard))
        simulated = channel.clock.ros_time_is_active
        rate = 1.0 / period if period > 0.0 else nan
        delay = source.delay * NANOSECONDS if source.delay > -inf else nan
        offset = source.offset * NANOSECONDS if y.stamps == 'header' else 0.0
        age = perf_counter() - self.latest
        stamps = 'clock' if limits['sampling'] == 'clock' else y.stamps
        report = Report(f'{channel.name} input'.lstrip(), {
            'topic': source.topic,
            'type': source.message_type or 'not known yet',
            'field': y.field.text if y.field else 'not known yet',
            'stamps': stamps or 'not known yet',
            'publishers': names or 'none',
            'sample rate [Hz]': rate,
            'jitter (std / mean of the period)': jitter,
            'longest delay [s]': delay,
            'from stamp to publication [s]': offset,
            **self._before,
        })  # fmt: skip
        report.find(ERROR, y.error, y.error)
        for text in source.unheard:
            report.find(WARN if heard else ERROR, text)
        silence = ERROR if y.error or (source.unheard and not heard) else STALE
        since = f'for {age:.3g} s' if age == age else 'yet'
        report.find(silence, f'no usable sample {since}', channel.stale)
        alone = f'no publisher of {source.topic} that can be heard'
        report.find(silence, alone, not heard and not y.error)
        used, lacking = news['samples accepted'], news['messages without y']
        several = f'{len(heard)} publishers, their samples mix: {names}'
        report.find(WARN, several, len(heard) > 1 and not lacking)
        report.find(WARN, f'{lacking} messages without y: {y.why}', lacking and not used)
        bad = sum(news[key] for key in UNUSED)
        zero = ZERO.get(stamps, 'their stamps are 0')
        level = ERROR if bad > BAD_SHARE * (bad + used) else WARN
        for key, text in UNUSED.items():
            report.find(level, text.format(n=news[key], zero=zero), news[key])
        restarts = f'{news["restarts"]} restarts: stamps jumped by more than max_gap; where y '
        restarts += 'always comes so slowly, set max_gap to several of its periods'
        report.find(WARN, restarts, news['restarts'])
        spread = news['spread stamps']
        many = f'{used / max(1, used - spread):.0f}'
        by_clock, shared = limits['sampling'] == 'clock', used < 2 * spread
        report.find(WARN, f'/clock ticks once for {many} samples', by_clock and shared)
        bursts = 'samples come in bursts and are taken to be evenly spaced: if they are, set '
        bursts += f'sampling to nominal and nominal_period to {period:.4g}'
        report.find(WARN, bursts, spread > 0 and not by_clock)
        uneven = f'intervals between samples differ by {jitter:.3g} of their mean: if the sensor '
        uneven += f'samples evenly, set sampling to nominal and nominal_period to {period:.4g}'
        even = (spread > 0 and not by_clock) or limits['sampling'] == 'nominal'
        report.find(WARN, uneven, jitter > JITTER and not even)
        report.find(WARN, f'samples arrive {delay:.3g} s after their stamps', delay > DELAY)
        side = 'before' if offset > 0.0 else 'after'
        apart = f'header stamps lie {abs(offset):.3g} s {side} publication'
        report.find(WARN, apart, not simulated and abs(offset) > DELAY)
        of_host = limits['sampling'] == 'source_stamp' and y.stamps == 'source'
        report.find(WARN, HOST_TIME, simulated and of_host)
        for name, u in channel.u.items():
            report.find(ERROR, u.error, u.error)
            for text in u.source.unheard:
                report.find(WARN, text)
            nobody = not u.source.heard and not u.source.unheard
            report.find(WARN, f'no publisher of {name}', nobody)
        return report

    def _observer(self, news: Mapping[str, int], period: float) -> Report:
        """Report on the estimates and the steps."""
        channel, limits = self._channel, self._channel.values
        estimator = channel.estimator
        observer, estimate, offset = estimator.observer, estimator.estimate, estimator.offset
        unit = derivative_unit(limits['measurement_unit'], observer.order)
        gamma, d = (estimate.gamma, estimate.unknown_input) if estimate else (nan, nan)
        levels = estimate.open_levels if estimate else 0
        spread = observer.structure.memory['spread']
        step = self.stepping / max(1, len(self.stamps))
        report = Report(f'{channel.name} observer'.lstrip(), {
            'open levels': f'{levels} of {observer.levels}',
            'gamma': gamma,
            'innovations over those expected': spread,
            titled('unknown input', unit): d,
            'step time, mean [us]': 1e6 * step,
        })  # fmt: skip
        if observer.self_tuning:
            tuning, d_error = observer.tuning, float(estimator.standard_deviation[-1])
            report.values |= {
                'noise of y': tuning.noise,
                'correlation of the noise': tuning.correlation,
                'd is followed within [s]': 1.0 / tuning.bandwidth,
                titled('standard deviation of d', unit): d_error,
            }
        report.find(STALE, 'no usable samples', channel.stale)
        held = f'levels from {levels + 1} on hold: an innovation is above epsilon'
        before, self._closed = self._closed, estimate is not None and levels < observer.levels
        # Twice: a sample that the host has stamped late closes them for a moment.
        report.find(WARN, held, before and self._closed and not channel.stale)
        diverged, jumps = news['divergences'], news['jumps']
        again = f'diverged {diverged} times and started again from y: gains or model do not fit'
        report.find(ERROR, again, diverged)
        report.find(WARN, f'y jumped {jumps} times: all estimates but that of z1 go on', jumps)
        report.find(WARN, f'y is taken as {offset:.3g} too large since it jumped', offset)
        tuned = observer.parameters['correction_period']
        if tuned and period > 0.0 and observer.configuration.levant:
            rates = f'gains are for {1.0 / tuned:.4g} Hz, y comes at {1.0 / period:.4g} Hz'
            report.find(WARN, rates, not tuned / RATE_RATIO < period < tuned * RATE_RATIO)
        wide = f'innovations are {spread:.3g} times as large as noise_size says'
        report.find(WARN, wide, spread > SPREAD)
        return report
