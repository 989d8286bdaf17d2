# SPDX-License-Identifier: Apache-2.0
"""
Events: d, or its change, is larger than it should be for longer than it may.

An event begins where |s| has exceeded the limit L = max(event_threshold, event_deviations sigma)
for event_duration, and ends where |s| <= event_release L. s is d, or what d lies from its running
mean m by (event_change_time T > 0), which begins with the mean of the first T seconds, in which
nothing is judged:

    m' = (d - m) / T,   s = d - m

sigma is the standard deviation of d. Where that grows, sigma follows with a lag, because what is
not expected makes a self-tuning observer less sure of d at once, and this must not hide it:

    (log sigma)' = (log deviation - log sigma) / (tuning_memory, a quarter of it while |s| > L)

With tuning_memory = 0 the lag is 800 samples.

Rejected samples do not count. After a restart nothing is known, so an event ends there.
"""

from libc.math cimport INFINITY, expm1, fabs, fmax, fmin, isfinite, pow

from fhaosmo_ros.core.observer.status cimport DIVERGED, RESTARTED, UNUSED

from collections import deque
import math
from typing import NamedTuple

from fhaosmo_ros.core.parameters.errors import ConfigurationError
import numpy as np

cdef enum Doing:
    FRESH  # waits for a standard deviation
    LEARNING  # learns the mean
    QUIET  # nothing is beyond the limit
    BEYOND  # it is, not for long enough yet
    ACTIVE  # an event lasts
    LOST  # the estimates of an event that lasted were lost


cdef struct Settings:
    double threshold, deviations, release  # event_threshold, ..
    double duration, change_time  # event_duration, event_change_time (ns)
    double growth  # tuning_memory (ns); 0: GROWTH samples
    long long max_gap  # after a longer time durations begin anew (ns)


cdef struct Memory:
    int event  # what is being done: a `Doing`
    long long event_since  # since when (ns); the time of the first sample of an event
    long long event_stamp  # the stamp of that sample
    long long event_time  # time of the sample that was taken last
    double event_mean  # running mean of d, for events of its change
    double event_deviation  # standard deviation that events are judged by


# The lag of sigma in samples, where `tuning_memory` is 0, and how much quicker it grows while an
# event lasts.
cdef double GROWTH = 800.0, QUICKER = 4.0
# Events that are kept until somebody takes them.
SECOND = 1_000_000_000
LONG = 1e9
MOST = 10_000


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


cdef class EventDetector:
    """
    Finds events in estimates of d; an `OnlineEstimator` has one.

    Parameters
    ----------
    parameters : mapping
        Those whose names begin with ``event_``, and tuning_memory; others are left alone.
    max_gap : float
        After a longer time durations begin anew, in seconds; 0: never.

    Attributes
    ----------
    memory : dict
        What it remembers, for snapshots.
    waiting : deque of Event
        Those that nobody has taken yet, at most the latest 10,000.
    latest : Event or None
    count : int
        Events that have begun.

    """

    cdef Settings settings
    cdef public Memory memory
    cdef readonly bint on  # events are asked for
    cdef readonly object waiting, latest
    cdef readonly long long count
    cdef bint begins  # the event that was found: it begins, else it ends
    cdef double signal, limit  # d or its change, and what it has to exceed

    def __init__(self, parameters, double max_gap=0.0):
        self.waiting = deque(maxlen=MOST)
        self.configure(parameters, max_gap)

    @property
    def active(self):
        """True while an event lasts."""
        return self.memory.event >= ACTIVE

    def configure(self, parameters, double max_gap=0.0):
        """Go on with other parameters; an event that lasts ends if none are asked for."""
        cdef Settings* settings = &self.settings
        cdef double change_time = round(parameters['event_change_time'] * SECOND)
        cdef bint on
        if self.on and change_time != settings.change_time:
            self.reset()
        settings.change_time, settings.max_gap = change_time, round((max_gap or LONG) * SECOND)
        settings.threshold = parameters['event_threshold']
        settings.deviations = parameters['event_deviations']
        settings.release = parameters['event_release']
        settings.duration = round(parameters['event_duration'] * SECOND)
        settings.growth = round(parameters['tuning_memory'] * SECOND)
        on = settings.threshold > 0.0 or settings.deviations > 0.0
        if self.on and not on:
            self.memory.event, self.latest = FRESH, None
        self.on = on

    def reset(self):
        """Expect estimates of a fresh observer: what was known of the mean does not count."""
        self.memory.event = LOST if self.memory.event >= ACTIVE else FRESH

    def take(self, stamps, d, deviations=None, times=None, words=None):
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
        cdef const double[:] d_ = np.asarray(d, dtype=np.float64)
        cdef const long long[:] stamps_ = np.asarray(stamps, dtype=np.int64)
        cdef const long long[:] times_ = stamps_
        cdef const long long[:] words_ = np.zeros(len(d_), dtype=np.int64)
        cdef const double[:] deviations_ = np.zeros(len(d_))
        cdef Py_ssize_t k
        if deviations is not None:
            deviations_ = np.asarray(deviations, dtype=np.float64)
        if times is not None:
            times_ = np.asarray(times, dtype=np.int64)
        if words is not None:
            words_ = np.asarray(words, dtype=np.int64)
        if not (len(stamps_) == len(times_) == len(words_) == len(deviations_) == len(d_)):
            raise ValueError('events: expected arrays of equal length')
        for k in range(len(d_)):
            if words_[k] & UNUSED or not self.judge(
                stamps_[k], times_[k], words_[k] & (RESTARTED | DIVERGED) != 0, d_[k],
                deviations_[k],
            ):
                continue
            self.latest = Event(
                stamps_[k], bool(self.begins), self.memory.event_stamp, self.signal, self.limit,
                math.nan if deviations is None else deviations_[k], k,
            )
            self.waiting.append(self.latest)
            self.count += self.begins

    cdef bint judge(
        self, long long stamp, long long now, bint restarted, double d, double deviation
    ) noexcept:
        """Take one sample; return True if an event has begun or ended."""
        cdef Memory* memory = &self.memory
        cdef Settings* settings = &self.settings
        cdef long long elapsed = now - memory.event_time, past
        cdef double sigma = memory.event_deviation, lag, share
        self.begins = False
        memory.event_time = now
        if restarted:
            self.reset()
        elif not 0 <= elapsed <= settings.max_gap:  # stamps of another clock: see forget_stamp
            memory.event_since += elapsed
            elapsed = 0
        if memory.event == LOST:
            self.signal, self.limit = d, INFINITY
            memory.event = FRESH
            return True
        if memory.event == FRESH or sigma <= 0.0:
            sigma = deviation
        elif deviation > sigma:
            lag = (settings.growth or GROWTH) / (QUICKER if memory.event > QUIET else 1.0)
            share = elapsed if settings.growth > 0.0 else 1.0
            sigma *= pow(deviation / sigma, -expm1(-share / lag))
        sigma = memory.event_deviation = fmin(sigma, deviation)
        if memory.event == FRESH:
            memory.event_since, memory.event_mean = now, d
            if isfinite(deviation):
                memory.event = LEARNING
        if memory.event == LEARNING:
            past = now - memory.event_since
            if past > 0:
                memory.event_mean += fmin(elapsed, past) / past * (d - memory.event_mean)
            if past >= settings.change_time:
                memory.event = QUIET
        self.signal = d
        if settings.change_time > 0.0:
            self.signal = d - memory.event_mean
            if memory.event > LEARNING:
                memory.event_mean -= expm1(-elapsed / settings.change_time) * self.signal
        self.limit = fmax(settings.threshold, settings.deviations * sigma)
        if memory.event == ACTIVE:
            if fabs(self.signal) > settings.release * self.limit:
                return False
            memory.event, memory.event_deviation = QUIET, deviation
            return True
        if memory.event < QUIET:
            return False
        if not fabs(self.signal) > self.limit:
            memory.event = QUIET
            return False
        if memory.event == QUIET:
            memory.event, memory.event_since, memory.event_stamp = BEYOND, now, stamp
        if now - memory.event_since < settings.duration:
            return False
        memory.event, self.begins = ACTIVE, True
        return True

    def taken(self):
        """Return the events that have waited; they wait no more."""
        events = list(self.waiting)
        self.waiting.clear()
        return events

    def __reduce__(self):
        settings, memory, state = self.settings, self.memory, (self.waiting, self.latest)
        return _restored, (settings, memory, self.on, self.count, *state)


def _restored(settings, memory, on, count, waiting, latest):
    """Return a detector with that state."""
    cdef EventDetector found = EventDetector.__new__(EventDetector)
    found.settings, found.memory, found.on, found.count = settings, memory, on, count
    found.waiting, found.latest = deque(waiting, maxlen=MOST), latest
    return found


def described(event, str unit=''):
    """Return an event in words, and its numbers by name, for messages."""
    seconds = (event.stamp - event.since) * 1e-9
    d = ' '.join(filter(None, (f'{event.value:.4g}', unit)))
    if event.begins:
        text = f'unknown input {d}, beyond {event.limit:.4g} for {seconds:.3g} s'
    else:
        text = f'ended after {seconds:.3g} s'
    second, nanosecond = divmod(event.since, SECOND)
    return text, {
        'value': f'{event.value:.9g}',
        'limit': f'{event.limit:.9g}',
        'standard deviation': f'{event.deviation:.9g}',
        'since': f'{second}.{nanosecond:09d}',
    }


def check_events(parameters):
    """Raise ConfigurationError where standard deviations are asked for that nobody knows."""
    k, gains = parameters['event_deviations'], parameters['gains']
    if k and gains != 'self_tuning':
        raise ConfigurationError(
            "parameters 'event_deviations', 'gains': expected gains = 'self_tuning', which knows "
            f'the standard deviation of d, or event_deviations = 0 (event_threshold needs no '
            f'standard deviation), got {k:g} and {gains!r}'
        )
