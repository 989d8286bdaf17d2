# SPDX-License-Identifier: Apache-2.0
"""
Events: d, or its change, is larger than it should be for longer than it may.

An event begins where |s| has exceeded the limit L = max(event_threshold, event_deviations sigma)
for event_duration, and ends where |s| <= L / 2. s is d, or what d lies from its running
mean m by (event_change_time T > 0), which begins with the mean of the first T seconds, in which
nothing is judged:

    m' = (d - m) / T,   s = d - m

sigma is the standard deviation of d. Where that grows, sigma follows with a lag, because what is
not expected makes a self-tuning observer less sure of d at once, and this must not hide it:

    (log sigma)' = (log deviation - log sigma) / (800 samples, a quarter of it while |s| > L)

Rejected samples do not count. After a restart nothing is known, so an event ends there.
"""

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
import math
from typing import Any, NamedTuple

from fhaosmo_ros.core.observer.status import AFRESH, UNUSED
from fhaosmo_ros.core.parameters.tables import ESTIMATOR_PARAMETERS
import numpy as np
from numpy.typing import ArrayLike

SECOND = 1_000_000_000
LONG = 1e9
"""Seconds that max_gap = 0 stands for."""
GROWTH, QUICKER = 800.0, 4.0
"""The lag of sigma in samples; how much quicker while an event lasts."""
RELEASE = 0.5
"""An event ends below this part of what it has to exceed (hysteresis)."""
EARLIEST = -(2**63)
# What a detector does: it waits for a standard deviation; learns the mean; nothing is beyond the
# limit; it is, not for long enough yet; an event lasts; the estimates of one were lost.
FRESH, LEARNING, QUIET, BEYOND, ACTIVE, LOST = range(6)


class Event(NamedTuple):
    """
    Begin or end of an event.

    Attributes
    ----------
    stamp : int
        Of the estimate at which it was found, in nanoseconds.
    begins : bool
    since : int
        Stamp of the first estimate beyond the limit, in nanoseconds.
    value : float
        d, or its change.
    limit : float
        What it has to exceed; infinite where the estimates were lost.
    deviation : float
        Standard deviation of d; NaN where it is not known.
    sample : int
        Number of the sample among those that were given at once.

    """

    stamp: int
    begins: bool
    since: int
    value: float
    limit: float
    deviation: float
    sample: int = 0


@dataclass
class Progress:
    """What a detector remembers, as in snapshots."""

    event: int = FRESH  # what is being done
    event_since: int = 0  # by the times of samples (ns)
    event_stamp: int = 0  # the same by their stamps (ns)
    event_time: int = 0  # of the latest sample (ns)
    event_mean: float = 0.0  # running mean of d
    event_deviation: float = 0.0  # that events are judged by


class EventDetector:
    """
    Finds events in estimates of d; an `OnlineEstimator` has one.

    Parameters
    ----------
    parameters : mapping
        Values for those of an `OnlineEstimator`; defaults for the rest. Used are those whose names
        begin with ``event_``, and max_gap: after a longer time durations begin anew (0: never).

    Attributes
    ----------
    on : bool
        True if events are asked for.
    waiting : deque of Event
        Those that nobody has taken yet, at most the latest 10,000.
    count : int
        Events that have begun.
    memory : Progress

    """

    def __init__(self, parameters: Mapping[str, Any]) -> None:
        self.waiting: deque[Event] = deque(maxlen=10_000)
        self.on, self.count = False, 0
        self.memory, self._change_time = Progress(), 0
        self.configure(parameters)

    @property
    def active(self) -> bool:
        """True while an event lasts."""
        return self.memory.event >= ACTIVE

    def configure(self, parameters: Mapping[str, Any]) -> None:
        """Go on with other parameters; an event that lasts ends if none are asked for."""
        p, was_on = ESTIMATOR_PARAMETERS.complete(parameters), self.on
        change_time = round(p['event_change_time'] * SECOND)
        if was_on and change_time != self._change_time:
            self.reset()
        self._change_time = change_time
        self._duration = round(p['event_duration'] * SECOND)
        self._max_gap = round((p['max_gap'] or LONG) * SECOND)
        self._threshold, self._deviations = p['event_threshold'], p['event_deviations']
        self.on = self._threshold > 0.0 or self._deviations > 0.0
        if was_on and not self.on:
            m = self.memory
            if self.active:
                end = m.event_stamp + m.event_time - m.event_since
                self.waiting.append(Event(end, False, m.event_stamp, math.nan, math.inf, math.nan))
            m.event = FRESH

    def reset(self) -> None:
        """Expect estimates of a fresh observer: what was known of the mean does not count."""
        self.memory.event = LOST if self.active else FRESH

    def take(
        self,
        stamps: ArrayLike,
        d: ArrayLike,
        deviations: ArrayLike | None = None,
        times: ArrayLike | None = None,
        words: ArrayLike | None = None,
    ) -> None:
        """
        Take estimates in order; events go to `waiting`.

        Parameters
        ----------
        stamps : (K,) array of int
            Times of the estimates in nanoseconds, that events are to have.
        d, deviations : (K,) arrays
            Estimates of d; their standard deviations, infinite where not known yet. Without them
            event_deviations has no effect.
        times : (K,) array of int, optional
            By which durations are measured, in nanoseconds; the stamps, else.
        words : (K,) array of int, optional
            Status words of the samples.

        """
        zeros = np.zeros(np.size(d))
        times = stamps if times is None else times
        words = zeros.astype(int) if words is None else words
        sigmas = zeros if deviations is None else deviations
        columns = map(np.asarray, (stamps, times, words, d, sigmas))
        rows = zip(*(column.tolist() for column in columns), strict=True)
        for k, (stamp, time, word, value, deviation) in enumerate(rows):
            if word & UNUSED:
                continue
            found = self._judge(stamp, time, word & AFRESH != 0, value, deviation)
            if found is not None:
                sigma = math.nan if deviations is None else deviation
                begins = self.memory.event == ACTIVE
                since = self.memory.event_stamp
                self.waiting.append(Event(stamp, begins, since, *found, sigma, k))
                self.count += begins

    def _judge(
        self, stamp: int, now: int, restarted: bool, d: float, deviation: float
    ) -> tuple[float, float] | None:
        """Take an estimate; where an event begins or ends, return s and L."""
        m = self.memory
        elapsed, m.event_time = now - m.event_time, now
        if restarted:
            self.reset()
        elif not 0 <= elapsed <= self._max_gap:  # stamps of another clock: see `adopt`
            m.event_since = max(m.event_since + elapsed, EARLIEST)
            elapsed = 0
        if m.event == LOST:
            m.event = FRESH
            return d, math.inf
        m.event_deviation = self._sigma(deviation)
        if m.event == FRESH:
            m.event_since, m.event_mean = now, d
            if math.isfinite(deviation):
                m.event = LEARNING
        if m.event == LEARNING:
            past = now - m.event_since
            if past > 0:
                m.event_mean += min(elapsed, past) / past * (d - m.event_mean)
            if past >= self._change_time:
                m.event = QUIET
        signal = d - m.event_mean if self._change_time > 0 else d
        if m.event < QUIET:
            return None
        if self._change_time > 0:
            m.event_mean -= math.expm1(-elapsed / self._change_time) * signal
        limit = max(self._threshold, self._deviations * m.event_deviation)
        lasts = m.event == ACTIVE
        if abs(signal) > (RELEASE * limit if lasts else limit):
            if m.event == QUIET:
                m.event, m.event_since, m.event_stamp = BEYOND, now, stamp
            if lasts or now - m.event_since < self._duration:
                return None
            m.event = ACTIVE
        else:
            m.event = QUIET
            if not lasts:
                return None
            m.event_deviation = deviation
        return signal, limit

    def _sigma(self, deviation: float) -> float:
        """Return the standard deviation that events are judged by from now on."""
        sigma = self.memory.event_deviation
        if self.memory.event == FRESH or sigma <= 0.0:
            return deviation
        if deviation > sigma:
            lag = GROWTH / (QUICKER if self.memory.event > QUIET else 1.0)
            sigma *= math.pow(deviation / sigma, -math.expm1(-1.0 / lag))
        return min(sigma, deviation)

    def taken(self) -> list[Event]:
        """Return the events that have waited; they wait no more."""
        events = list(self.waiting)
        self.waiting.clear()
        return events


def described(event: Event, unit: str = '') -> tuple[str, dict[str, str]]:
    """Return an event in words, and its numbers by name, for messages."""
    seconds, (second, nanosecond) = event.stamp - event.since, divmod(event.since, SECOND)
    text = f'ended after {seconds * 1e-9:.3g} s'
    if event.begins:
        d = f'{event.value:.4g} {unit}'.rstrip()
        text = f'unknown input {d}, beyond {event.limit:.4g} for {seconds * 1e-9:.3g} s'
    return text, {
        'value': f'{event.value:.9g}',
        'limit': f'{event.limit:.9g}',
        'standard deviation': f'{event.deviation:.9g}',
        'since': f'{second}.{nanosecond:09d}',
    }
