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

Rejected samples do not count. After a restart nothing is known, so an event ends there.
"""

from collections import deque
from collections.abc import Mapping
import math
from typing import Any, NamedTuple

from fhaosmo_ros.core.compiled.cache import compiled
from fhaosmo_ros.core.model.bytecode import Floats, Ints
from fhaosmo_ros.core.observer.status import DIVERGED, RESTARTED, UNUSED
from fhaosmo_ros.core.online import memory as at
from fhaosmo_ros.core.parameters.errors import ConfigurationError
import numpy as np
from numpy.typing import ArrayLike

FRESH, LEARNING, QUIET, BEYOND, ACTIVE, LOST = range(6)
"""
What the detector is doing (`memory.EVENT`): waits for a standard deviation; learns the mean;
nothing is beyond the limit; it is, not for long enough yet; an event lasts; the estimates of an
event that lasted were lost.
"""
NAMES = (
    'event_threshold', 'event_deviations', 'event_duration', 'event_release', 'event_change_time',
    'tuning_memory',
)  # fmt: skip
THRESHOLD, DEVIATIONS, DURATION, RELEASE, CHANGE, GROWTH = range(len(NAMES))
BEGINS, SIGNAL, LIMIT = range(3)
"""Columns of what `detect` finds."""
QUICKER = 4.0
"""Factor on how quickly sigma grows while an event lasts."""
MOST = 10_000
"""Events that are kept until somebody takes them."""


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


@compiled(forceinline=True)
def write_event(
    found: Ints,
    numbers: Floats,
    index: int,
    sample: int,
    ints: Ints,
    begins: float,
    signal: float,
    limit: float,
) -> None:
    """Write what `detect` returns of an event to row `index` of its arrays."""
    found[index, 0], found[index, 1] = sample, ints[at.EVENT_STAMP]
    numbers[index, BEGINS], numbers[index, SIGNAL], numbers[index, LIMIT] = begins, signal, limit


@compiled()
def detect(
    settings: Floats,
    ints: Ints,
    reals: Floats,
    stamps: Ints,
    times: Ints,
    words: Ints,
    d: Floats,
    deviations: Floats,
    found: Ints,
    numbers: Floats,
) -> int:
    """
    Take K samples in order; return how many events have begun or ended.

    Parameters
    ----------
    settings : (6,) array
        Values of `NAMES`; times in nanoseconds.
    ints, reals : arrays
        Of the `Policy`, which remembers.
    stamps, times, words : (K,) arrays
        Stamps of the estimates and times of the observer (ns), and status words.
    d, deviations : (K,) arrays
        Estimates of d, and their standard deviations.
    found : (K, 2) array
        For each event: the number of its sample, and the stamp of its begin (ns).
    numbers : (K, 3) array
        Whether it begins (else it ends), the signal and its limit.

    """
    count, change = 0, settings[CHANGE]
    for k in range(d.shape[0]):
        if words[k] & UNUSED:
            continue
        doing, now, x = ints[at.EVENT], times[k], d[k]
        elapsed = now - ints[at.EVENT_TIME]
        ints[at.EVENT_TIME] = now
        if words[k] & (RESTARTED | DIVERGED):
            doing = LOST if doing == ACTIVE else FRESH
        elif not 0 <= elapsed <= ints[at.MAX_GAP]:  # stamps of another clock: see forget_stamp
            ints[at.EVENT_SINCE] += elapsed
            elapsed = 0
        if doing == LOST:
            write_event(found, numbers, count, k, ints, 0.0, x, math.inf)
            count += 1
            ints[at.EVENT] = FRESH
            continue
        sigma = reals[at.EVENT_DEVIATION]
        if doing == FRESH or sigma <= 0.0:
            sigma = deviations[k]
        elif deviations[k] > sigma:
            lag = settings[GROWTH] / (QUICKER if doing > QUIET else 1.0)
            sigma *= (deviations[k] / sigma) ** -math.expm1(-elapsed / lag)
        sigma = reals[at.EVENT_DEVIATION] = min(sigma, deviations[k])
        if doing == FRESH:
            ints[at.EVENT_SINCE], reals[at.EVENT_MEAN] = now, x
            if math.isfinite(deviations[k]):
                doing = LEARNING
        if doing == LEARNING:
            past = now - ints[at.EVENT_SINCE]
            if past > 0:
                reals[at.EVENT_MEAN] += elapsed / past * (x - reals[at.EVENT_MEAN])
            if past >= change:
                doing = QUIET
        signal = x
        if change > 0.0:
            signal = x - reals[at.EVENT_MEAN]
            if doing > LEARNING:
                reals[at.EVENT_MEAN] -= math.expm1(-elapsed / change) * signal
        limit = max(settings[THRESHOLD], settings[DEVIATIONS] * sigma)
        if doing == ACTIVE:
            if not abs(signal) > settings[RELEASE] * limit:
                write_event(found, numbers, count, k, ints, 0.0, signal, limit)
                count += 1
                doing = QUIET
                reals[at.EVENT_DEVIATION] = deviations[k]
        elif doing >= QUIET:
            if not abs(signal) > limit:
                doing = QUIET
            else:
                if doing == QUIET:
                    ints[at.EVENT_SINCE], ints[at.EVENT_STAMP] = now, stamps[k]
                    doing = BEYOND
                if now - ints[at.EVENT_SINCE] >= settings[DURATION]:
                    write_event(found, numbers, count, k, ints, 1.0, signal, limit)
                    count += 1
                    doing = ACTIVE
        ints[at.EVENT] = doing
    return count


class EventDetector:
    """
    Finds events in estimates of d; an `OnlineEstimator` has one.

    Parameters
    ----------
    parameters : mapping
        Those whose names begin with ``event_``, and tuning_memory; others are left alone.
    policy : Policy, optional
        Arrays that remember what it is doing: those of an estimator, for its snapshots.

    Attributes
    ----------
    waiting : deque of Event
        Those that nobody has taken yet, at most the latest 10,000.
    latest : Event or None
    count : int
        Events that have begun.

    """

    def __init__(self, parameters: Mapping[str, Any], policy: at.Policy | None = None) -> None:
        if policy is None:
            policy = at.Policy(np.zeros(at.COUNTERS, dtype=np.int64), np.zeros(at.STATES))
            policy.ints[at.MAX_GAP] = 2**62
        self._ints, self._reals = policy
        self.waiting: deque[Event] = deque(maxlen=MOST)
        self.latest: Event | None = None
        self.count = 0
        self._on = False
        self._settings = np.zeros(len(NAMES))
        self.configure(parameters)

    @property
    def on(self) -> bool:
        """True if events are asked for."""
        return self._on

    @property
    def active(self) -> bool:
        """True while an event lasts."""
        return bool(self._ints[at.EVENT] in (ACTIVE, LOST))

    def configure(self, parameters: Mapping[str, Any]) -> None:
        """Go on with other parameters; an event that lasts ends if none are asked for."""
        p = [parameters[name] for name in NAMES]
        for index in (DURATION, CHANGE, GROWTH):
            p[index] = round(p[index] * 1e9)
        settings = np.array(p, dtype=np.float64)
        if self._on and settings[CHANGE] != self._settings[CHANGE]:
            self.reset()
        self._settings = settings
        on = bool(settings[THRESHOLD] or settings[DEVIATIONS])
        if self._on and not on:
            self._ints[at.EVENT] = FRESH
            self.latest = None
        self._on = on

    def reset(self) -> None:
        """Expect estimates of a fresh observer: what was known of the mean does not count."""
        self._ints[at.EVENT] = LOST if self.active else FRESH

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
        stamps = np.ascontiguousarray(stamps, dtype=np.int64)
        d = np.ascontiguousarray(d, dtype=np.float64)
        times = stamps if times is None else np.asarray(times, dtype=np.int64)
        words = np.zeros(len(d), dtype=np.int64) if words is None else np.asarray(words, np.int64)
        known = deviations is not None
        sigma = np.ascontiguousarray(deviations if known else np.zeros(len(d)), dtype=np.float64)
        found, numbers = np.empty((len(d), 2), dtype=np.int64), np.empty((len(d), 3))
        count = detect(
            self._settings, self._ints, self._reals, stamps, times, words, d, sigma, found, numbers
        )
        for (k, since), (begins, value, limit) in zip(
            found[:count].tolist(), numbers[:count].tolist(), strict=True
        ):
            stamp = int(stamps[k])
            deviation = float(sigma[k]) if known else math.nan
            event = Event(stamp, begins > 0.0, since, value, limit, deviation, k)
            self.waiting.append(event)
            self.latest = event
            self.count += event.begins

    def taken(self) -> list[Event]:
        """Return the events that have waited; they wait no more."""
        events = list(self.waiting)
        self.waiting.clear()
        return events


def described(event: Event, unit: str = '') -> tuple[str, dict[str, str]]:
    """Return an event in words, and its numbers by name, for messages."""
    seconds = (event.stamp - event.since) * 1e-9
    d = ' '.join(filter(None, (f'{event.value:.4g}', unit)))
    if event.begins:
        text = f'unknown input {d}, beyond {event.limit:.4g} for {seconds:.3g} s'
    else:
        text = f'ended after {seconds:.3g} s'
    second, nanosecond = divmod(event.since, 1_000_000_000)
    return text, {
        'value': f'{event.value:.9g}',
        'limit': f'{event.limit:.9g}',
        'standard deviation': f'{event.deviation:.9g}',
        'since': f'{second}.{nanosecond:09d}',
    }


def check_events(parameters: Mapping[str, Any]) -> None:
    """Raise ConfigurationError where standard deviations are asked for that nobody knows."""
    k, gains = parameters['event_deviations'], parameters['gains']
    if k and gains != 'self_tuning':
        raise ConfigurationError(
            "parameters 'event_deviations', 'gains': expected gains = 'self_tuning', which knows "
            f'the standard deviation of d, or event_deviations = 0 (event_threshold needs no '
            f'standard deviation), got {k:g} and {gains!r}'
        )
