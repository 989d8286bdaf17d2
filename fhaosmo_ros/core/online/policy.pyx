# SPDX-License-Identifier: Apache-2.0
"""
The policy of time and of bad data: one function for node, replay and trials.

What it does, case by case, is in docs/node.md; its memory is described in samples.pxd.
"""

from libc.math cimport fabs, fmin, isfinite, isnan
from libc.string cimport memcpy

from fhaosmo_ros.core.model.prediction cimport MOST_LEVELS
from fhaosmo_ros.core.observer.self_tuning.observer cimport SelfTuning
from fhaosmo_ros.core.observer.status cimport (
    DIVERGED, FLAGS_MASK, GAP, HELD, JUMPED, REJECTED, REJECTED_MEASUREMENT, REJECTED_PERIOD,
    REJECTED_SPIKE, REJECTED_STEP, REJECTED_STUCK, REPEATED, RESTARTED, UNUSED
)
from fhaosmo_ros.core.observer.structure cimport Estimate, Memory, Record, Structure
from fhaosmo_ros.core.online.delay cimport NANOSECONDS, PastInputs
from fhaosmo_ros.core.online.samples cimport (
    FAR, WINDOW, Clock, Counters, Course, Sensor, Settings, clock_time, difference, is_held,
    is_spike, is_stuck, may_have_noise, repeats_noise
)

import numpy as np

# An interval of more mean intervals than this is a gap.
cdef double GAP_RATIO = 2.0
# Bounds what one sample may cost: a few milliseconds.
cdef int MOST_STEPS = 10_000
MOST_SUB_STEPS = MOST_STEPS
# With max_gap = 0 an interval of more usual ones is a gap; one of more nanoseconds while there
# is none to compare it with.
cdef double MOST_INTERVALS = 500.0, FIRST_GAP = 3.6e12
GAP_SAMPLES = MOST_INTERVALS


cdef class Policy:
    """
    Takes time-stamped samples, and decides what each of them does to an observer.

    Parameters
    ----------
    structure : Structure
        The observer.
    settings : dict
        Values of `Settings`.

    """

    cdef readonly Structure structure  # the observer; another one after a live change
    cdef SelfTuning tuner  # the same, where it is self-tuning, else None
    cdef readonly Settings settings
    cdef public Counters counters
    cdef readonly Course course
    cdef Clock clock
    cdef Sensor sensor
    cdef readonly PastInputs past

    def __cinit__(self, Structure structure not None, dict settings):
        self.past = PastInputs(structure.inputs, settings['lag'] > 0)
        self.configure(structure, settings)

    def configure(self, Structure structure not None, dict settings):
        """Go on with an observer that has taken over, and with these settings."""
        cdef Settings new = settings
        if structure.inputs != self.past.inputs or (new.lag > 0) != self.past.is_late:
            raise ValueError('policy: expected an observer and a past of the same known inputs')
        if self.structure is not None:
            self.structure.enter()
        self.structure, self.settings = structure, new
        self.tuner = structure if isinstance(structure, SelfTuning) else None

    # One sample

    cdef int take(self, long long stamp, double y, const double* u) noexcept nogil:
        """
        Take one sample; return a status word (status.py).

        Parameters
        ----------
        stamp : int
            Nanoseconds.
        y : float
            Sample, any number.
        u : (m,) array
            Known inputs, finite.

        """
        cdef Course* course = &self.course
        cdef Counters* counters = &self.counters
        cdef Memory* memory = &self.structure.memory
        cdef long long now = stamp, elapsed = 0
        cdef int word
        if self.settings.nominal:
            course.now += self.settings.period
            now = course.now
        elif self.settings.by_clock:
            now = clock_time(&self.clock, stamp, self.max_gap(), counters)
        word = self.judge(stamp, now, y)
        if not word and not isnan(memory.y):
            elapsed = self.since_latest(now, y, &word)
        if elapsed > 0:
            word |= self.step_to(elapsed, y, u)
        elif not word & UNUSED:  # first sample, or first after a restart
            word |= self.structure.start(y)
            course.latest = self.sensor.changed = self.sensor.seen = now
            course.timed = True
        if elapsed > 0 and not word & REJECTED_SPIKE:
            course.latest = now
            if word & DIVERGED:
                counters.divergences += 1
                course.lost = False
            elif self.has_diverged(word & REJECTED_STEP != 0, now):
                self.refresh()
                self.structure.level[0].z_hat = memory.y = y
                counters.divergences += 1
                word = word & (FLAGS_MASK ^ REJECTED_STEP) | DIVERGED | self.structure.measure(y)
        if word & REPEATED:  # the estimate stays that of the sample which it repeats
            counters.accepted += 1
            word |= self.structure.measure(memory.y)
        elif not word & REJECTED:
            counters.accepted += 1
            course.valid = True
            memcpy(self.past.present, u, self.structure.inputs * sizeof(double))
            course.stamp = stamp if self.settings.nominal else now
        elif word & REJECTED_STEP:
            counters.rejected_steps += 1
        else:
            if word & JUMPED:  # z_1 has followed y, and only the next sample gives it a time
                course.valid = False
            word |= self.structure.measure(
                self.structure.level[0].z_hat if isnan(memory.y) else memory.y
            )
        self.structure.word = word
        return word

    cdef int judge(self, long long stamp, long long now, double y) noexcept nogil:
        """Return the flag that says why a sample is not used, whatever the observer is like."""
        cdef Memory* memory = &self.structure.memory
        cdef bint held, held_before = self.sensor.holds, noisy
        if not fabs(y) <= self.settings.limit:  # also NaN
            self.counters.rejected_measurements += 1
            return REJECTED_MEASUREMENT
        if stamp == 0 and not self.settings.nominal:
            self.counters.zero_stamps += 1
            return REJECTED_PERIOD
        if self.settings.stuck_time and is_stuck(
            &self.sensor, &self.settings, &self.counters, memory.y, y - memory.offset, now,
            self.max_gap(),
        ):
            return REJECTED_STUCK
        if self.tuner is None:
            return 0
        held = is_held(&self.sensor, self.max_gap(), &self.course, y, now)
        if self.sensor.holds and not held_before:
            self.tuner.begin_afresh()  # with the sensor's own period
        if held:
            return REPEATED
        noisy = may_have_noise(&self.sensor) and self.tuner.is_noisy(self.sensor.sample)
        return REJECTED_STUCK * repeats_noise(&self.sensor, &self.counters, y, noisy)

    cdef long long since_latest(self, long long now, double y, int* word) noexcept nogil:
        """Return the time since the latest sample, 0 where there is none; add flags to `word`."""
        cdef long long elapsed
        if not self.course.timed:
            self.forget_clock(now)
        elapsed = difference(now, self.course.latest)
        if not 0 < elapsed <= self.max_gap():
            return self.settle(now, elapsed, y, word)
        self.course.held = False
        self.course.late_count = 0
        if self.settings.max_gap == 0 and self.course.intervals == 1 and (
            MOST_INTERVALS * elapsed < self.course.mean_interval
        ):  # the interval that led to the sample before was a gap: begin at that sample
            y = self.structure.memory.y + self.structure.memory.offset
            word[0] = self.begin_again(&self.counters.restarts_forward)
            self.structure.start(y)
        return elapsed

    cdef long long settle(
        self, long long now, long long elapsed, double y, int* word
    ) noexcept nogil:
        """
        Decide about a sample that does not follow the one before it within max_gap.

        Returns
        -------
        int
            Time to step over. Where it is 0 and no flag rejects, the observer is fresh and the
            sample is its first.

        """
        cdef Course* course = &self.course
        cdef Counters* counters = &self.counters
        cdef bint again = course.held and now == course.held_stamp
        cdef long long follow
        if self.settings.nominal:
            if 0 < elapsed <= self.settings.period:
                return elapsed  # nothing was lost: the period itself is longer than max_gap
            word[0] = self.begin_again(&counters.restarts_forward)
            return 0
        word[0] = REJECTED_PERIOD
        if elapsed == 0 or again:
            counters.duplicate_stamps += 1
            return 0
        if -self.max_late() <= elapsed < 0:
            course.late_count += 1
            if course.late_count > MOST_INTERVALS:  # time does not catch up: a short bag loops
                course.late_count = 0
                word[0] = self.begin_again(&counters.restarts_backward)
            else:
                counters.backward_stamps += 1
            return 0
        if not course.held:
            course.held, course.held_stamp, course.held_y = True, now, y
            counters.far_stamps += 1
            word[0] |= HELD
            return 0
        follow = difference(now, course.held_stamp)
        again = 0 < follow <= self.max_gap()
        word[0] = self.begin_again(
            &counters.restarts_forward if elapsed > 0 else &counters.restarts_backward
        )
        if not again:  # the rate is not known any more
            course.usual_interval = 0.0
            return 0
        if 0 < elapsed <= FIRST_GAP:  # the next one like this is none
            course.usual_interval = max(
                course.usual_interval, 2.0 * elapsed / MOST_INTERVALS
            )
        self.structure.start(course.held_y)
        course.latest = self.sensor.changed = course.held_stamp
        return follow

    cdef long long max_gap(self) noexcept nogil:
        """Return the longest interval that is stepped over (ns)."""
        if self.settings.max_gap > 0:
            return self.settings.max_gap
        if self.settings.nominal:
            return <long long>(MOST_INTERVALS * self.settings.period)
        if self.course.usual_interval > 0.0:
            return <long long>fmin(MOST_INTERVALS * self.course.usual_interval, FAR)
        return <long long>FIRST_GAP

    cdef long long max_late(self) noexcept nogil:
        """Return how far back a stamp may lie whose clock has not been set back (ns)."""
        if self.settings.max_gap > 0 or self.settings.nominal:
            return self.max_gap()
        return <long long>fmin(MOST_INTERVALS * self.course.mean_interval, FAR)

    cdef int begin_again(self, long long* counter) noexcept nogil:
        """Make a fresh observer, and count it; return flags."""
        self.refresh()
        self.past.ring.past_count = 0
        counter[0] += 1
        return RESTARTED

    cdef void forget_clock(self, long long now) noexcept nogil:
        """Let the sample at `now`, of another clock, follow the one before as usual."""
        cdef Course* course = &self.course
        course.latest = now - (
            <long long>course.mean_interval if course.intervals else self.settings.period
        )
        self.sensor.changed = self.sensor.seen = now
        course.held = course.lost = False
        course.timed = True

    cdef void refresh(self) noexcept nogil:
        """Make a fresh observer, whose next sample is the first; a frozen gamma stays."""
        cdef Course* course = &self.course
        cdef double gamma = self.structure.memory.gamma
        self.structure.reset()
        if course.frozen:
            self.structure.memory.gamma = gamma
        course.held = course.lost = False
        course.spikes = course.intervals = 0
        course.mean_interval = course.mean_jitter = 0.0

    cdef void forget_samples(self) noexcept nogil:
        """Start afresh: the next sample is the first. Counters go on."""
        self.refresh()
        self.past.ring.past_count = 0
        self.course.valid = False
        self.clock.tick_count = self.clock.spacing = 0

    # Steps

    cdef int step_to(self, long long elapsed, double y, const double* u) noexcept nogil:
        """Step to a sample with the inputs that acted until it was measured."""
        cdef int word
        if self.settings.lag == 0:
            return self.step_over(elapsed, y, u)
        self.past.note(elapsed, u)
        word = self.step_over(elapsed, y, self.past.before(self.settings.lag, elapsed, u))
        if word & REJECTED_SPIKE:
            self.past.withdraw(elapsed)
        return word

    cdef int step_over(self, long long elapsed, double y, const double* u) noexcept nogil:
        """
        Step to a sample `elapsed` later, through a gap in sub-steps; return the status word.

        In a gap the observer sees y as the model continues it from the last sample and the
        internal estimates, plus a straight line that ends in the new sample. A scheme that
        predicts follows the model by itself, so it takes a gap in one step.
        """
        cdef Counters* counters = &self.counters
        cdef Memory* memory = &self.structure.memory
        cdef double mean = self.course.mean_interval, corrected = y - memory.offset
        cdef double gamma = memory.gamma, bend = 0.0, h, end, sample
        cdef int count = 1, word = 0, k
        cdef bint is_gap, modelled = True
        # After rejected samples it is none.
        is_gap = self.course.intervals == WINDOW and memory.beyond == 0.0 and (
            elapsed > GAP_RATIO * mean
        )
        if is_gap and not self.structure.predicting:
            count = <int>fmin(elapsed / mean + 0.5, MOST_STEPS)
        h = elapsed * NANOSECONDS / count
        if count > 1 or self.settings.gate > 0.0:
            self.structure.begin_at_estimates()
            for _ in range(count):
                self.structure.prediction.step(h, u)
            end = self.structure.prediction.z[0]
            modelled = fabs(end) <= self.settings.limit  # False for NaN
            if not modelled:
                end = memory.y
            if self.settings.gate > 0.0 and is_spike(
                &self.course, &self.settings, counters, corrected - end
            ):
                return REJECTED_SPIKE
            bend = (corrected - end) / count
            self.structure.begin_at_estimates()
        for k in range(1, count + 1):
            sample = y
            if k < count:  # then the scheme leaves the prediction alone
                if modelled:
                    self.structure.prediction.step(h, u)
                sample = self.structure.prediction.z[0] + k * bend + memory.offset
            word = word & FLAGS_MASK | self.structure.step(sample, h, u)
            if word & REJECTED:
                break
            if self.course.frozen:
                memory.gamma = gamma
        counters.jumps += word & JUMPED != 0
        if word & REJECTED_SPIKE:  # as if it had not come: the next one is stepped to instead
            memory.pending = 0.0
            counters.rejected_spikes += 1
            return word
        if is_gap:
            counters.gaps += 1
            counters.sub_steps += count
            word |= GAP
        if not word & REJECTED:
            self.update_mean(elapsed)
        return word

    cdef void update_mean(self, long long elapsed) noexcept nogil:
        """Take an interval into the running means; a gap can't do more than double them."""
        cdef Course* course = &self.course
        cdef double change = elapsed - course.mean_interval
        if course.intervals < WINDOW:
            course.intervals += 1
        elif elapsed < 0.1 * course.mean_interval:
            self.counters.bursts += 1
        if course.intervals == WINDOW:
            change = fmin(change, WINDOW * course.mean_interval)
        course.mean_interval += change / course.intervals
        course.usual_interval = max(
            course.mean_interval, course.usual_interval * (1.0 - 1.0 / MOST_INTERVALS)
        )
        if course.intervals > 1:
            course.mean_jitter += (fabs(change) - course.mean_jitter) / course.intervals

    cdef bint has_diverged(self, bint failed, long long now) noexcept nogil:
        """Return True if the state is beyond divergence_limit, or y lost for divergence_time."""
        cdef Course* course = &self.course
        cdef double limit = self.settings.limit
        cdef int i
        for i in range(self.structure.levels):
            if not (fabs(self.structure.level[i].z_hat) <= limit
                    and fabs(self.structure.level[i].z_tilde) <= limit):
                return True
        if not failed and fabs(self.structure.innovation[0]) <= self.settings.epsilon:
            course.lost = False
            return False
        if not course.lost:
            course.lost, course.lost_since = True, now
            return False
        return (
            self.settings.divergence_time > 0
            and difference(now, course.lost_since) > self.settings.divergence_time
        )

    cdef void carry(self, double* out) noexcept nogil:
        """Write z_1 .. z_n and d, (n + 1,), carried over the delay to the present."""
        cdef double* z = self.structure.prediction.z
        cdef int i, n = self.structure.order
        cdef bint finite = True
        for i in range(self.structure.prediction.n):
            z[i], self.structure.prediction.dz[i] = self.structure.estimate(i), 0.0
        memcpy(out, z, (n + 1) * sizeof(double))
        self.past.carry(self.structure.prediction, self.settings.lag, self.settings.delay)
        for i in range(n + 1):
            finite = finite and isfinite(z[i])
        if finite:  # else the model has left the finite numbers, and the estimates stay
            memcpy(out, z, (n + 1) * sizeof(double))

    # What Python calls

    def advance(self, long long stamp, double y, const double[::1] u):
        """Take a sample with its known inputs, all finite; return the status word."""
        self.check(u.shape[0])
        return self.take(stamp, y, &u[0])

    cdef void check(self, Py_ssize_t inputs) except *:
        """Raise where another thread runs this, or where there are other known inputs."""
        self.structure.enter()
        if inputs != self.structure.inputs:
            raise ValueError(f'expected {self.structure.inputs} known inputs, got {inputs}')

    def run(
        self, const long long[::1] stamps, const double[::1] y, const double[:, ::1] u,
        bint watched
    ):
        """
        Take K samples; return their record and arrays with a row for each of them.

        These are z and d where they are carried to the present; and, if `watched`, times of the
        observer, and the inputs that acted until then. Else they have no rows.
        """
        cdef Structure structure = self.structure
        cdef PastInputs past = self.past
        cdef Py_ssize_t k, count = y.shape[0], m = structure.inputs
        cdef Record record = Record(structure, count)
        cdef bint carried = self.settings.to_now and self.settings.delay > 0
        cdef double[:, ::1] present = np.empty((count * carried, structure.order + 1))
        cdef long long[::1] times = np.empty(count * watched, dtype=np.int64)
        cdef double[:, ::1] acting = np.empty((count * watched, m))
        cdef const double* inputs
        self.check(u.shape[1])
        if not stamps.shape[0] == u.shape[0] == count:
            raise ValueError('run: arrays of different lengths')
        structure.busy = True
        try:
            with nogil:
                for k in range(count):
                    record.write(structure, k, self.take(stamps[k], y[k], &u[k, 0]))
                    if carried:
                        self.carry(&present[k, 0])
                    if watched:
                        times[k] = self.course.latest
                        inputs = &u[k, 0]
                        if self.settings.lag > 0:
                            inputs = past.acting
                        memcpy(&acting[k, 0], inputs, m * sizeof(double))
        finally:
            structure.busy = False
        return record, np.asarray(present), np.asarray(times), np.asarray(acting)

    def report(self):
        """Return the latest estimate as it is published, with the status of the last sample."""
        cdef Estimate estimate = self.structure.report()
        cdef double values[MOST_LEVELS + 1]
        if self.settings.to_now and self.settings.delay > 0:
            self.structure.enter()
            self.carry(values)
            memcpy(estimate.values, values, self.structure.order * sizeof(double))
            estimate.unknown_input = values[self.structure.order]
        return estimate

    def reset(self):
        """Start afresh: the next sample is the first. Counters go on."""
        self.structure.enter()
        self.forget_samples()

    @property
    def memory(self):
        """What it remembers: the members of `Course`, `Clock`, `Sensor` and `Ring` by name."""
        cdef dict course = self.course, clock = self.clock, sensor = self.sensor
        return course | clock | sensor | self.past.ring

    def change(self, **numbers):
        """Remember other numbers: members of `memory` by name."""
        cdef dict memory = self.memory | numbers
        self.structure.enter()
        self.past.ring = memory
        self.course, self.clock, self.sensor = memory, memory, memory

    def __reduce__(self):
        state = self.memory, self.counters, self.past.latest, self.past.pieces
        return Policy, (self.structure, self.settings), state

    def __setstate__(self, state):
        memory, self.counters, self.past.latest[:], self.past.pieces[:] = state
        self.change(**memory)
