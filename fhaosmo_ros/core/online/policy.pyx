# SPDX-License-Identifier: Apache-2.0
"""
The policy of time and of bad data, case by case in docs/node.md. Times are in nanoseconds.

A sample that arrives at t tells of the plant at t - `measurement_delay`; its stamp remains t for
the rules of time. A known input that arrives at t acted at t - `input_delay`. So the step to a
sample needs the inputs that arrived a lag of measurement_delay - input_delay before it.
"""

from cpython.pythread cimport PyThread_get_thread_ident
from libc.math cimport INFINITY, fabs, fmin, isfinite, isnan
from libc.string cimport memcpy

from fhaosmo_ros.core.model.prediction cimport MOST_LEVELS
from fhaosmo_ros.core.observer.status cimport (
    DIVERGED, FLAGS_MASK, GAP, HELD, JUMPED, REJECTED, REJECTED_MEASUREMENT, REJECTED_PERIOD,
    REJECTED_SPIKE, REJECTED_STEP, REJECTED_STUCK, REPEATED, RESTARTED, UNUSED
)
from fhaosmo_ros.core.observer.structure cimport Estimate, Memory, MOST_INPUTS, Record, Structure
from fhaosmo_ros.core.online.clock cimport (
    FAR, MOST_CORNERS, Bursts, Clock, Corner, begin_of_burst, clock_time, comes_in_bursts,
    difference
)

from collections import namedtuple

import numpy as np

cdef int WINDOW = 32  # intervals that the running mean remembers
# An interval of more mean intervals than this is a gap.
cdef double GAP_RATIO = 2.0
# Bounds what one sample may cost: a few milliseconds.
cdef int MOST_STEPS = 10_000
# With max_gap = 0 a longer time than so many usual intervals ends a run of samples; so long is the
# usual one (ns) while there is none to compare with.
cdef double MOST_INTERVALS = 500.0, FIRST_INTERVAL = 7.2e9
GAP_SAMPLES = MOST_INTERVALS
cdef double NANOSECONDS = 1e-9
# Parameters that are settings as they are, in nanoseconds.
TIMES = 'nominal_period', 'max_gap', 'stuck_time', 'divergence_time', 'measurement_delay'
# Room for so many different values of the inputs within the delay; older ones are forgotten.
cdef int MOST_PIECES = 512
# y's sensor holds its values if most of so many of late were repeated, until few are.
cdef double CHANGES = 10.0, MOST = 0.75, FEW = 0.25
# A y with noise may repeat itself so often in a row by chance, if it is a float of 32 bits.
cdef int CHANCE_REPEATS = 2
# Larger samples are rejected, larger states are lost: products of several stay finite.
cdef double LIMIT = 1e60
# So many samples in a row may be rejected by spike_gate.
cdef int MOST_SPIKES = 5


cdef struct Settings:
    bint nominal  # dt is `nominal_period`, whatever the stamps say
    bint by_clock  # stamps are the node clock's at reception
    bint to_now  # estimates are carried over the delay, which is not 0
    bint tunes  # the observer is self-tuning: only this one knows whether y has noise
    long long nominal_period
    long long max_gap  # 0: MOST_INTERVALS usual ones
    long long stuck_time  # 0: off
    long long divergence_time  # 0: off
    long long measurement_delay
    long long lag  # how much later than the inputs y is known: measurement_delay - input_delay
    double gate  # a spike is further from its prediction (unit of y); 0: off
    double epsilon  # y is lost while |eps_1| is larger (unit of y)


cdef struct Counts:
    # One number for each case of docs/node.md.
    long long accepted  # samples used
    # Samples that were not used:
    long long rejected_measurements  # y was NaN, infinite or beyond 1e60
    long long rejected_spikes  # beyond spike_gate, or 6 usual deviations, from its prediction
    long long rejected_stuck  # it was unchanged for stuck_time, or repeated although it has noise
    long long rejected_steps  # the step would have left the finite numbers
    long long duplicate_stamps  # the stamp of the sample before
    long long backward_stamps  # older than the sample before, by at most max_gap
    long long zero_stamps  # no time yet: before the first /clock, an unset header
    long long far_stamps  # more than max_gap from the one before: the next sample decides
    # What else has happened:
    long long rejected_inputs  # u was NaN or infinite; the one before is held
    long long gaps  # intervals of more than twice the mean that were bridged in sub-steps
    long long sub_steps  # that these took
    long long spread_stamps  # at the clock time of the one before, or in its burst: spread
    long long bursts  # samples within a tenth of the mean interval after the one before
    long long spikes_believed  # five samples in a row were beyond the gate: a real step of y
    long long stuck  # times that y began to be stuck
    long long restarts_forward  # after a gap longer than max_gap, or a clock that jumped forward
    long long restarts_backward  # after a clock that jumped back
    long long divergences  # times that y was lost, and the observer was restarted from it
    long long jumps  # times that y alone jumped, and the other estimates went on (D 23, D 35)


cdef Counts NOTHING
cdef dict COUNTERS = NOTHING


class Counters(namedtuple('Counters', COUNTERS)):
    """What has happened to the samples so far, by docs/node.md; a reset does not clear them."""

    __slots__ = ()

    @property
    def rejected(self):
        """Samples of y that were not used."""
        return (
            self.rejected_measurements + self.rejected_spikes + self.rejected_stuck
            + self.rejected_steps + self.duplicate_stamps + self.backward_stamps
            + self.zero_stamps + self.far_stamps
        )

    @property
    def restarts(self):
        """Starts from a new sample after a gap or a jump of time."""
        return self.restarts_forward + self.restarts_backward


cdef struct Course:
    # Where the estimator is in the course of the samples.
    bint valid  # there is an estimate, of the time `stamp`
    bint timed  # False: the next sample's stamp is of another clock
    bint held  # a sample far away waits for the next one's word
    bint lost  # eps_1 is above epsilon, or steps fail
    long long stamp  # of the latest sample that was used
    long long latest  # time up to which the observer has been stepped
    long long now  # the clock that counts nominal periods
    long long held_stamp
    long long late_count  # samples in a row that lie before `latest`
    long long lost_since
    long long spikes  # rejected by the gate, in a row
    long long intervals  # number of intervals in the mean
    double held_y
    double mean_interval  # running mean of dt (ns)
    double longest_mean  # longest mean_interval of late; a restart does not forget it (ns)
    int past_place  # of the latest piece of time with the same known inputs, in a ring of them
    int past_count  # of such pieces


cdef struct Sensor:
    # Whether y's sensor is stuck, or holds its values.
    bint stuck
    bint holds  # it holds each value for several samples
    long long seen  # time of the latest sample, used or not
    long long changed  # since when y is what it is
    long long repeats  # samples in a row that repeat the one before
    double sample  # the latest y, used or not
    double repeated  # share of values of late that repeated themselves


cdef class Policy:
    """
    Takes time-stamped samples, and decides what each of them does to an observer.

    In a ``with`` statement a thread has it for itself: another one gets a RuntimeError.
    """

    cdef readonly Structure structure  # the observer
    cdef object parameters
    cdef Settings settings
    cdef public Counts counters
    cdef readonly Course course
    cdef Clock clock
    cdef Bursts bursts
    cdef Sensor sensor
    # The known inputs of late: for the next sample; at the latest one that was used; a ring of
    # pieces of time with the same inputs, each its duration (ns) and these; `Corner`s.
    cdef readonly dict arrays  # by their names in a snapshot
    cdef double[::1] held, present
    cdef double[:, ::1] pieces, below
    cdef unsigned long owner  # thread that has it for itself; 0: none
    cdef double acting[MOST_INPUTS]  # in the latest step; a mean where y is known later

    def __cinit__(self, structure, parameters):
        self.adopt(structure, parameters)
        count, pieces = self.structure.inputs, MOST_PIECES * (self.settings.lag > 0)
        self.arrays = {
            'u': np.zeros(count), 'past_latest': np.zeros(count),
            'past_pieces': np.zeros((pieces, 1 + count)),
            'below_stamps': np.zeros((MOST_CORNERS, 2)),
        }
        self.held, self.present, self.pieces, self.below = self.arrays.values()

    def adopt(self, Structure structure not None, parameters):
        """Go on with an observer and parameters of the same sizes."""
        p, late, c = parameters, parameters['measurement_delay'], structure.configuration
        knows_noise = c.self_tuning or (c.levant and c.schedule is not None)
        if self.parameters is not None and self.parameters['sampling'] != p['sampling']:
            self.course.timed, self.clock.tick_count = False, 0  # stamps of another clock
        self.structure, self.parameters = structure, parameters
        times = {name: p[name] for name in TIMES}
        times['lag'] = (late - p['input_delay']) * bool(c.model.used_inputs)
        self.settings = {name: round(t / NANOSECONDS) for name, t in times.items()} | {
            'nominal': p['sampling'] == 'nominal', 'by_clock': p['sampling'] == 'clock',
            'to_now': p['predict_to_now'] and late > 0.0, 'tunes': c.self_tuning,
            'gate': p['spike_gate'], 'epsilon': INFINITY if knows_noise else p['epsilon'],
        }

    def __enter__(self):
        self.enter()
        self.owner = PyThread_get_thread_ident()

    def __exit__(self, *_):
        self.owner = 0

    cdef void enter(self) except *:
        """Raise RuntimeError while another thread uses this, or the observer."""
        if self.owner != 0 and self.owner != PyThread_get_thread_ident():
            raise RuntimeError('this estimator is in use by another thread: give each its own')
        self.structure.enter()

    # One sample

    cdef int take(self, long long stamp, double y) noexcept nogil:
        """Take any stamp (ns) and y with the known inputs that are held; return a status word."""
        cdef Course* course = &self.course
        cdef Memory* memory = &self.structure.memory
        cdef long long now = stamp, elapsed = 0
        cdef int word
        if self.settings.nominal:
            course.now += self.settings.nominal_period
            now = course.now
        elif stamp != 0:  # else there is no time yet
            now = self.place(stamp, y)
            self.structure.placed = self.settings.by_clock or self.bursts.in_bursts
        word = self.judge(stamp, now, y)
        if not word and not isnan(memory.y):
            elapsed = self.since_latest(now, y, &word)
        if elapsed > 0:
            self.find_acting(elapsed)
            word |= self.step_over(elapsed, y)
        elif not word & UNUSED:  # first sample, or first after a restart
            word |= self.structure.start(y)
            self.begin_time(now, now)
        if elapsed > 0 and not word & REJECTED_SPIKE:
            self.note(elapsed)
            course.latest = now
            if word & DIVERGED:
                course.lost = False
            elif self.has_diverged(word & REJECTED_STEP != 0, now):
                self.refresh()
                self.structure.level[0].z_hat = memory.y = y
                word = word & (FLAGS_MASK ^ REJECTED_STEP) | DIVERGED | self.structure.measure(y)
        if not word & UNUSED:
            course.valid = True
            memcpy(&self.present[0], &self.held[0], self.structure.inputs * sizeof(double))
            course.stamp = stamp if self.settings.nominal else now
        elif not word & REJECTED_STEP:  # the estimate stays that of the latest sample
            if word & JUMPED:  # z_1 has followed y, and only the next sample gives it a time
                course.valid = False
            word |= self.structure.measure(
                self.structure.level[0].z_hat if isnan(memory.y) else memory.y
            )
        self.structure.word = word
        self.counters.accepted += not word & REJECTED
        self.counters.rejected_measurements += word & REJECTED_MEASUREMENT != 0
        self.counters.rejected_spikes += word & REJECTED_SPIKE != 0
        self.counters.rejected_stuck += word & REJECTED_STUCK != 0
        self.counters.rejected_steps += word & REJECTED_STEP != 0
        self.counters.gaps += word & GAP != 0
        self.counters.jumps += word & JUMPED != 0
        self.counters.divergences += word & DIVERGED != 0
        return word

    cdef int judge(self, long long stamp, long long now, double y) noexcept nogil:
        """Return the flag that says why a sample is not used, whatever the observer is like."""
        cdef int word = 0
        if not fabs(y) <= LIMIT:  # also NaN
            return REJECTED_MEASUREMENT
        if stamp == 0 and not self.settings.nominal:
            self.counters.zero_stamps += 1
            return REJECTED_PERIOD
        if self.settings.stuck_time > 0 and self.stands_still(y, now):
            word = REJECTED_STUCK
        elif self.settings.tunes:
            word = self.repetition(y, now)
        if word == REJECTED_STUCK:
            self.counters.stuck += not self.sensor.stuck
            self.sensor.stuck = True
        return word

    # What a sample tells by itself: its time, and whether y can be true

    cdef bint stands_still(self, double y, long long now) noexcept nogil:
        """Return True if y has been seen unchanged for longer than stuck_time."""
        cdef Sensor* sensor = &self.sensor
        cdef Memory* memory = &self.structure.memory
        cdef long long silence = abs(difference(now, sensor.seen))
        sensor.seen = now
        if y - memory.offset != memory.y or silence > self.max_gap():
            sensor.changed, sensor.stuck = now, False
        return difference(now, sensor.changed) > self.settings.stuck_time

    cdef int repetition(self, double y, long long now) noexcept nogil:
        """
        Return the flag of a y that repeats itself although it has noise, else 0.

        The sensor holds its values, being slower than the topic, if most of them are repeated:
        each change would be taken for one of d. Else it is stuck, or at the end of its range.
        """
        cdef Sensor* sensor = &self.sensor
        if self.course.timed and difference(now, self.course.latest) <= 0:
            return 0  # a sample that comes twice is no repetition
        if y != sensor.sample:
            sensor.repeated += ((sensor.repeats > 0) - sensor.repeated) / CHANGES
            if sensor.repeated > MOST and not sensor.holds and self.structure.is_noisy(y):
                sensor.holds = True
                self.structure.begin_afresh()  # with the sensor's own period
            sensor.holds = sensor.holds and sensor.repeated > FEW
            sensor.repeats, sensor.sample, sensor.stuck = 0, y, False
            return 0
        sensor.repeats += 1
        if sensor.holds and 2 * difference(now, self.course.latest) < self.max_gap():
            return REPEATED
        if sensor.stuck or (sensor.repeats > CHANCE_REPEATS and self.structure.is_noisy(y)):
            return REJECTED_STUCK
        return 0

    cdef bint is_spike(self, double innovation) noexcept nogil:
        """Return True if y is too far from its prediction to be believed yet."""
        self.course.spikes += 1
        if fabs(innovation) <= self.settings.gate:
            self.course.spikes = 0
        elif self.course.spikes > MOST_SPIKES:
            self.course.spikes = 0
            self.counters.spikes_believed += 1
        return self.course.spikes > 0

    # Time

    cdef long long place(self, long long stamp, double y) noexcept nogil:
        """
        Return the time of a sample: its stamp, or its place on a line through ticks (clock.pyx).

        Ticks are those of the node's clock, or the bursts in which samples come.
        """
        cdef Clock* clock = &self.clock
        cdef Bursts* bursts = &self.bursts
        cdef Corner* corner
        cdef long long longest = self.max_gap(), spread = 0, reading, latest, placed
        cdef bint before = bursts.in_bursts
        if self.settings.by_clock:
            return clock_time(clock, stamp, FAR, longest, &self.counters.spread_stamps)
        corner = <Corner*>&self.below[0, 0]  # of the line below stamps
        reading = begin_of_burst(bursts, clock, corner, stamp, y, longest)
        latest = stamp + <long long>fmin(clock.spacing, FAR)
        placed = clock_time(clock, reading, latest, longest, &spread)
        bursts.in_bursts = comes_in_bursts(bursts)
        if bursts.in_bursts != before:
            self.course.timed = False
            placed = clock.placed = clock.tick + <long long>clock.on_line
            if not before:
                self.structure.begin_afresh()  # with the true intervals
        if not bursts.in_bursts:
            return stamp
        self.counters.spread_stamps += spread
        return placed

    cdef long long since_latest(self, long long now, double y, int* word) noexcept nogil:
        """Return the time (ns) to step over to a sample, 0 to a first one; add flags to `word`."""
        cdef Course* course = &self.course
        cdef long long elapsed, follow, longest = self.max_gap()
        if not course.timed:  # the stamp is of another clock: it comes as usual
            elapsed = <long long>course.mean_interval or self.settings.nominal_period
            self.begin_time(now, now - elapsed)
        elapsed = difference(now, course.latest)
        if self.settings.nominal:  # nothing was lost where the period is longer
            longest = max(longest, self.settings.nominal_period)
        if 0 < elapsed <= longest:
            course.held = False
            course.late_count = 0
            if self.settings.max_gap == 0 and course.intervals == 1 and (
                MOST_INTERVALS * elapsed < course.mean_interval
            ):  # the interval that led to the sample before was a gap: begin at that sample
                y = self.structure.memory.y + self.structure.memory.offset
                word[0] = self.begin_again(True)
                self.structure.start(y)
            return elapsed
        if self.settings.nominal:
            word[0] = self.begin_again(True)
            return 0
        word[0] = REJECTED_PERIOD
        if elapsed == 0 or (course.held and now == course.held_stamp):
            self.counters.duplicate_stamps += 1
            return 0
        if -self.longest(course.mean_interval) <= elapsed < 0:
            course.late_count += 1
            if course.late_count > MOST_INTERVALS:  # time does not catch up: a short bag loops
                course.late_count = 0
                word[0] = self.begin_again(False)
            self.counters.backward_stamps += word[0] == REJECTED_PERIOD
            return 0
        if not course.held:
            course.held, course.held_stamp, course.held_y = True, now, y
            self.counters.far_stamps += 1
            word[0] |= HELD
            return 0
        word[0] = self.begin_again(elapsed > 0)
        follow = difference(now, course.held_stamp)
        if not 0 < follow <= longest:  # the rate is not known any more
            course.longest_mean = 0.0
            return 0
        if 0 < elapsed <= MOST_INTERVALS * FIRST_INTERVAL:  # the next one like this is none
            course.longest_mean = max(course.longest_mean, 2.0 * elapsed / MOST_INTERVALS)
        self.structure.start(course.held_y)
        course.latest = self.sensor.changed = course.held_stamp
        return follow

    cdef long long max_gap(self) noexcept nogil:
        """Return the longest interval that is stepped over (ns)."""
        return self.longest(self.course.longest_mean or FIRST_INTERVAL)

    cdef long long longest(self, double interval) noexcept nogil:
        """Return how far apart (ns) two stamps of one run may be, if intervals are such."""
        if self.settings.max_gap > 0:
            return self.settings.max_gap
        if self.settings.nominal:
            interval = self.settings.nominal_period
        return <long long>fmin(MOST_INTERVALS * interval, FAR)

    cdef int begin_again(self, bint forward) noexcept nogil:
        """Make a fresh observer as time has jumped, and count it; return flags."""
        self.refresh()
        self.course.past_count = 0
        self.counters.restarts_forward += forward
        self.counters.restarts_backward += not forward
        return RESTARTED

    cdef void begin_time(self, long long now, long long latest) noexcept nogil:
        """Begin to count the time of samples at `now`; the latest one was at `latest`."""
        self.course.latest, self.course.timed = latest, True
        self.course.held = self.course.lost = False
        self.sensor.changed = self.sensor.seen = now

    cdef void refresh(self) noexcept nogil:
        """Make a fresh observer, whose next sample is the first."""
        cdef Course* course = &self.course
        self.structure.reset()
        course.held = course.lost = False
        course.spikes = course.intervals = 0
        course.mean_interval = 0.0

    # Steps

    cdef double* piece(self, int back) noexcept nogil:
        """Return a piece, by its number from the latest one back."""
        cdef int place = (self.course.past_place + MOST_PIECES - back) % MOST_PIECES
        return &self.pieces[place, 0]

    cdef void note(self, long long elapsed) noexcept nogil:
        """Remember that the inputs have been what they are for the latest `elapsed` ns."""
        cdef double* latest
        cdef bint same = self.course.past_count > 0
        cdef int j
        if self.settings.lag == 0:
            return
        latest = self.piece(0)
        for j in range(self.structure.inputs):
            same = same and latest[1 + j] == self.held[j]
        if not same:
            self.course.past_place = (self.course.past_place + 1) % MOST_PIECES
            self.course.past_count = min(self.course.past_count + 1, MOST_PIECES)
            latest = self.piece(0)
            latest[0] = 0.0
            memcpy(latest + 1, &self.held[0], self.structure.inputs * sizeof(double))
        latest[0] += elapsed

    cdef void find_acting(self, long long elapsed) noexcept nogil:
        """Write the mean of the inputs over `elapsed` ns, no piece yet, that ended a lag ago."""
        cdef long long lag = self.settings.lag, age = elapsed, share
        cdef long long covered = max(elapsed - lag, 0)
        cdef const double* piece
        cdef int count = self.course.past_count, k = 0, j
        for j in range(self.structure.inputs):
            self.acting[j] = self.held[j] if covered > 0 or count == 0 else 0.0
        while k < count and covered < elapsed:
            piece = self.piece(k)
            age += <long long>piece[0]
            k += 1
            share = min(age, lag + elapsed) - lag - covered
            if k == count:  # the oldest one known stands for all before it
                share = elapsed - covered
            if share > 0:
                covered += share
                for j in range(self.structure.inputs):
                    self.acting[j] += <double>share / covered * (piece[1 + j] - self.acting[j])

    cdef int step_over(self, long long elapsed, double y) noexcept nogil:
        """
        Step to a sample `elapsed` later, through a gap in sub-steps; return the status word.

        In a gap the observer sees y as the model continues it, plus a straight line that ends in
        the new sample. A scheme that predicts follows the model by itself, in one step.
        """
        cdef Memory* memory = &self.structure.memory
        cdef double mean = self.course.mean_interval, corrected = y - memory.offset
        cdef double bend = 0.0, h, end, sample
        cdef int count = 1, word = 0, k
        cdef bint modelled = True, is_gap = elapsed > GAP_RATIO * mean
        if self.course.intervals < WINDOW or memory.beyond > 0.0:  # after rejected samples
            is_gap = False
        if is_gap and not self.structure.predicting:
            count = <int>fmin(elapsed / mean + 0.5, MOST_STEPS)
        h = elapsed * NANOSECONDS / count
        if count > 1 or self.settings.gate > 0.0:
            self.structure.begin_at_estimates()
            for _ in range(count):
                self.structure.prediction.step(h, self.acting)
            end = self.structure.prediction.z[0]
            modelled = fabs(end) <= LIMIT  # False for NaN
            if not modelled:
                end = memory.y
            if self.settings.gate > 0.0 and self.is_spike(corrected - end):
                return REJECTED_SPIKE
            bend = (corrected - end) / count
            self.structure.begin_at_estimates()
        for k in range(1, count + 1):
            sample = y
            if k < count:  # then the scheme leaves the prediction alone
                if modelled:
                    self.structure.prediction.step(h, self.acting)
                sample = self.structure.prediction.z[0] + k * bend + memory.offset
            word = word & FLAGS_MASK | self.structure.step(sample, h, self.acting)
            if word & REJECTED:
                break
        if word & REJECTED_SPIKE:  # as if it had not come: the next one is stepped to instead
            memory.pending = 0.0
            return word
        if is_gap:
            self.counters.sub_steps += count
            word |= GAP
        if not word & REJECTED:
            self.update_mean(elapsed)
        return word

    cdef void update_mean(self, long long elapsed) noexcept nogil:
        """Take an interval into the running means; a gap can't do more than double them."""
        cdef Course* course = &self.course
        cdef double change = elapsed - course.mean_interval
        if course.intervals == WINDOW:
            self.counters.bursts += elapsed < 0.1 * course.mean_interval
        course.intervals = min(course.intervals + 1, WINDOW)
        if course.intervals == WINDOW:
            change = fmin(change, WINDOW * course.mean_interval)
        course.mean_interval += change / course.intervals
        course.longest_mean = max(
            course.mean_interval, course.longest_mean * (1.0 - 1.0 / MOST_INTERVALS)
        )

    cdef bint has_diverged(self, bint failed, long long now) noexcept nogil:
        """Return True if the state is beyond all bounds, or y lost for divergence_time."""
        cdef Course* course = &self.course
        cdef int i
        for i in range(self.structure.levels):
            if not (fabs(self.structure.level[i].z_hat) <= LIMIT
                    and fabs(self.structure.level[i].z_tilde) <= LIMIT):
                return True
        if not failed and fabs(self.structure.innovation[0]) <= self.settings.epsilon:
            course.lost = False
            return False
        if not course.lost:
            course.lost, course.lost_since = True, now
        return (
            self.settings.divergence_time > 0
            and difference(now, course.lost_since) > self.settings.divergence_time
        )

    cdef void carry(self, double* out) noexcept nogil:
        """Write z_1 .. z_n and d, (n + 1,), at present: the model carries them over the delay."""
        cdef double* z = self.structure.prediction.z
        cdef int i, k, n = self.structure.order, count = self.course.past_count, within = 0
        cdef long long lag = self.settings.lag, age = 0, older = lag
        cdef long long delay = self.settings.measurement_delay
        cdef bint finite = True
        for i in range(self.structure.prediction.n):
            z[i], self.structure.prediction.dz[i] = self.structure.estimate(i), 0.0
        memcpy(out, z, (n + 1) * sizeof(double))
        while within < count and age < lag:
            age += <long long>self.piece(within)[0]
            within += 1
        for k in range(within - 1, -1, -1):  # the oldest one known stands for all before it
            age -= <long long>self.piece(k)[0]
            self.structure.prediction.over((older - age) * NANOSECONDS, self.piece(k) + 1)
            older = age
        if count > 0:
            delay -= lag
        if delay > 0:
            self.structure.prediction.over(delay * NANOSECONDS, &self.present[0])
        for i in range(n + 1):
            finite = finite and isfinite(z[i])
        if finite:  # else the model has left the finite numbers, and the estimates stay
            memcpy(out, z, (n + 1) * sizeof(double))

    # What Python calls

    def advance(self, long long stamp, double y):
        """Take a sample with the known inputs that are held; return the status word."""
        self.enter()
        return self.take(stamp, y)

    def run(self, const long long[::1] stamps, const double[::1] y, const double[:, ::1] u):
        """
        Take K samples, their known inputs where finite; return their record and four arrays.

        These have a row for each: its time, by what places samples in time; z and d where they are
        carried to the present (else none); times of the observer, and the inputs that acted in the
        latest step until then.
        """
        cdef Structure structure = self.structure
        cdef Py_ssize_t k, j, count = y.shape[0], m = structure.inputs
        cdef long long behind
        cdef int word
        cdef Record record = Record(structure, count)
        cdef long long[::1] placed = np.array(stamps)
        cdef double[:, ::1] present = np.empty((count * self.settings.to_now, structure.order + 1))
        cdef long long[::1] times = np.empty(count, dtype=np.int64)
        cdef double[:, ::1] acting = np.empty((count, m))
        self.enter()
        if not (stamps.shape[0] == u.shape[0] == count and u.shape[1] == m):
            raise ValueError('run: arrays of different lengths')
        structure.busy = True
        try:
            with nogil:
                for k in range(count):
                    for j in range(m):
                        if isfinite(u[k, j]):
                            self.held[j] = u[k, j]
                        else:
                            self.counters.rejected_inputs += 1
                    word = self.take(stamps[k], y[k])
                    record.write(structure, k, word)
                    if not word & UNUSED:
                        placed[k] = self.course.stamp
                    if self.settings.to_now:
                        self.carry(&present[k, 0])
                    behind = <long long>(structure.memory.behind / NANOSECONDS)
                    times[k] = self.course.latest - behind
                    memcpy(&acting[k, 0], self.acting, m * sizeof(double))
        finally:
            structure.busy = False
        return (
            record, np.asarray(placed), np.asarray(present), np.asarray(times), np.asarray(acting)
        )

    @property
    def behind(self):
        """How long before the stamp of its sample an estimate belongs (ns)."""
        return 0 if self.settings.to_now else self.settings.measurement_delay

    @property
    def stamp(self):
        """Time of the latest estimate (ns); None while there is none."""
        return self.course.stamp - self.behind if self.course.valid else None

    def report(self):
        """Return the latest estimate as it is published, with the status of the last sample."""
        cdef Estimate estimate = self.structure.report()
        cdef double values[MOST_LEVELS + 1]
        if self.settings.to_now:
            self.enter()
            self.carry(values)
            memcpy(estimate.values, values, self.structure.order * sizeof(double))
            estimate.unknown_input = values[self.structure.order]
        return estimate

    def reset(self):
        """Start afresh: the next sample is the first. Counters go on."""
        self.enter()
        self.refresh()
        self.course.past_count = 0
        self.course.valid = False
        self.clock.tick_count = 0

    @property
    def memory(self):
        """What it remembers by name: members of `Course`, `Clock`, `Bursts`, `Sensor`; arrays."""
        cdef dict course = self.course, clock = self.clock, bursts = self.bursts
        cdef dict sensor = self.sensor
        arrays = {name: array.copy() for name, array in self.arrays.items()}
        return course | clock | bursts | sensor | arrays

    def change(self, **values):
        """Remember other values: those of `memory` by name."""
        cdef dict memory = self.memory | values
        self.enter()
        self.course, self.clock, self.bursts, self.sensor = memory, memory, memory, memory
        for name, array in self.arrays.items():
            array[:] = memory[name]

    def __reduce__(self):
        return Policy, (self.structure, self.parameters), (self.memory, self.counters)

    def __setstate__(self, state):
        memory, self.counters = state
        self.change(**memory)
