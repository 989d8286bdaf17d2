# SPDX-License-Identifier: Apache-2.0
"""The self-tuning observer: members side by side, weighted by how well they predict y (D 26)."""

from libc.math cimport INFINITY, NAN, exp, fabs, fmax, fmin, log, pow, sqrt
from libc.stdlib cimport calloc, free
from libc.string cimport memcpy, memset

from fhaosmo_ros.core.model.phi cimport evaluate
from fhaosmo_ros.core.model.prediction cimport MOST_LEVELS
from fhaosmo_ros.core.observer.self_tuning.intervals cimport choose_members, take_interval
from fhaosmo_ros.core.observer.self_tuning.jumps cimport (
    SMOOTHEST, allow_jump, begin_growth, follow_innovations, follow_jump, has_jumped,
    samples_since_jump, shift, watch
)
from fhaosmo_ros.core.observer.self_tuning.members cimport (
    BANDS, CLOCKS, COLOURS, COUNT, DECAY, DIFFERENCES, EXACT, FIRST_SAMPLES, GRID, HALF, HUBER,
    IN_BAND, INEXACT, MOST_ORDER, MOST_STATES, ORDERS, WINDOW, Line, Members, Sample, Shared, Work,
    correct, correct_states, entry, expect, go_on_from, predict_states, put
)
from fhaosmo_ros.core.observer.self_tuning.noise cimport (
    APART, FADED, LATTICE_SHARE, ROUNDED, STEADY, bound_of_noise, fill_noise, find_knowing,
    follow_differences, follow_noise, follow_quantum, follow_stamps, follow_usual_interval,
    is_even, is_likely, rounding, usual_speed
)
from fhaosmo_ros.core.observer.self_tuning.weights cimport (
    Model, find_tuning, gather, judge, mix, tell_model, weigh
)
from fhaosmo_ros.core.observer.status cimport JUMPED
from fhaosmo_ros.core.observer.structure cimport (
    GATE, LOST_SAMPLES, Memory, Structure, has_drifted
)

from fhaosmo_ros.core.observer.numbers import array_of
from fhaosmo_ros.core.parameters.errors import ConfigurationError
import numpy as np

cdef enum:
    CACHE_LINE = 64  # bytes; a vector of the processor that crosses two takes twice as long
cdef double NOISE_SAMPLES = 1000.0  # the noise is averaged over so many
# What is beyond 3 sigma in so many samples after a jump of d is due to it, too.
cdef double JUMP_SAMPLES = 10.0
# P is not the steady one after an interval of so many usual ones; after shorter ones nearly.
cdef double GAP = 2.5
# Covariances of so many members, or of a multiple, move: whole vectors of the processor.
cdef int EVEN = 16
# A y has noise if its differences are all more than this part of its first difference, and of the
# noise at the start, RMS.
cdef double LEAST_NOISE = 1e-3
cdef double LARGEST = 1e300  # no number of a snapshot is larger, nor is an error of a prediction
# Ranges of the numbers of a snapshot; others are from 0 to LARGEST.
RANGES = {'likeliest': (0, COUNT - 1), 'told': (0, COUNT - 1), 'followed': (0, COUNT - 1)}
RANGES |= {'samples': (0, NOISE_SAMPLES + 1), 'active': (0, COUNT)}
RANGES |= {'since_mark': (0, 2 * WINDOW - 1), 'correlation': (0, 1)}
RANGES |= dict.fromkeys((
    'first_y', 'latest_y', 'difference', 'flow', 'window', 'prior', 'score', 'log_variance',
    'residual', 'score_before', 'z', 'd', 'gain_z', 'gain_d', 'p_zz', 'p_zd', 'p_dd',
), (-LARGEST, LARGEST))
# What counts before the members run, too.
EARLY = 'first_y', 'first_h'


cdef class SelfTuning(Structure):
    """
    An observer that finds its gains by itself (D 26 to D 36); nothing is given but the model.

    Parameters
    ----------
    configuration : ObserverConfiguration

    """

    # What the parameters say.
    cdef bint is_linear  # the model
    # What it remembers.
    cdef void* block  # of memory, which holds the members
    cdef Members* members
    cdef Model model  # the likeliest model of d, which a smoother goes by (D 34)
    cdef double variances[MOST_LEVELS]  # of the errors of z, d, ..; infinite before it begins
    cdef bint y_jumped  # a sample tells that y has jumped (D 35)
    # A step's own.
    cdef Model trial_model
    cdef double trial_variances[MOST_LEVELS]

    def __cinit__(self, configuration):
        if self.order > MOST_ORDER:
            raise ConfigurationError(
                f"parameter 'order': expected at most {MOST_ORDER}, got {self.order}"
            )
        self.is_linear = configuration.model.is_linear
        self.block = calloc(1, sizeof(Members) + CACHE_LINE)
        if self.block == NULL:
            raise MemoryError
        self.members = <Members*>((<size_t>self.block // CACHE_LINE + 1) * CACHE_LINE)

    def __dealloc__(self):
        free(self.block)

    cdef void reset(self) noexcept nogil:
        """Go back to the state before any sample."""
        cdef int i
        Structure.reset(self)
        self.begin_afresh()
        memset(&self.model, 0, sizeof(self.model))
        for i in range(self.levels):
            self.variances[i] = INFINITY

    cdef bint has_begun(self) noexcept nogil:
        """Return True once the members run."""
        return self.members.shared.samples > FIRST_SAMPLES

    cdef void begin_afresh(self) noexcept nogil:
        """Let the members begin afresh, by the next samples."""
        memset(self.members, 0, sizeof(Members))
        self.members.n, self.memory.beyond, self.memory.behind = self.order, 0.0, 0.0

    cdef bint is_noisy(self, double y) noexcept nogil:
        """Return True if all differences of y show noise, so that it does not repeat itself."""
        cdef Members* m = self.members
        cdef double least = fmax(m.shared.first_noise, bound_of_noise(m, 0, 1)), rough
        cdef int p
        for p in range(1, self.order + 2):
            rough = bound_of_noise(m, 0, p)
            if not rough > fmax(LEAST_NOISE * LEAST_NOISE * least, ROUNDED * y * (ROUNDED * y)):
                return False
        # Else y is quantised, and may repeat itself by chance, or none has begun.
        return m.shared.active == COUNT and m.shared.lattice < LATTICE_SHARE

    # What a structure implements

    cdef void advance(self, double y, double h, const double* u) noexcept nogil:
        """See `Structure.advance`."""
        cdef Sample* sample = &self.members.work.sample
        cdef int i, n = self.levels
        self.trial_model, self.y_jumped = self.model, False
        sample.y, sample.before, sample.h = y, self.memory.y, h
        if self.has_begun():
            memcpy(self.trial_variances, self.variances, sizeof(self.variances))
            self.step_members(h, u)
        else:
            for i in range(n):
                self.level[i].z_hat, self.trial_variances[i] = 0.0, INFINITY
            self.level[0].z_hat = y
            gather(self.members)
            if self.has_begun():
                self.begin_at_rest(u)
        for i in range(n):  # the internal states stand for the estimates
            self.level[i].z_tilde = self.level[i + 1].z_hat if i + 1 < n else 0.0

    cdef int accept(self, double y, double h) noexcept nogil:
        cdef int word = JUMPED if self.y_jumped else 0, i
        cdef double square, size, count = fmin(self.members.shared.samples, NOISE_SAMPLES)
        for i in range(self.order if self.has_begun() else 0):
            square, size = self.level[i].z_hat * self.level[i].z_hat, self.members.sizes[i]
            self.members.sizes[i] = size + (square - size) / count
        memcpy(self.variances, self.trial_variances, sizeof(self.variances))
        self.model = self.trial_model
        return word

    cdef void restart(self, double y) noexcept nogil:
        """Begin afresh from `y`: z is not known any more, d and the noise are (D 29)."""
        cdef Members* m = self.members
        cdef Shared* shared = &m.shared
        cdef Memory* memory = &self.memory
        cdef int n = self.order, i, j, g
        cdef double size, z, a
        memory.pending = memory.offset = memory.watched = memory.drift = memory.beyond = 0.0
        memory.behind = 0.0
        shared.unsettled = shared.growing = shared.recent = 0.0
        self.level[0].z_hat = memory.y = y
        if not self.has_begun():
            self.begin_afresh()
            return
        watch(m, shared.told)
        self.variances[0] = m.work.now[0]
        for i in range(n):
            z = self.level[i].z_hat
            size = fmax(m.sizes[i], z * z)
            if i > 0:
                self.variances[i] = size
            for j in range(i, n + ORDERS):
                for g in range(COUNT):
                    entry(&m.p, n, i, j)[g] = size if i == j else 0.0
        for g in range(COUNT):
            a = m.correlation[g]
            m.x.z[0][g], m.p.zz[0][g] = y, m.work.now[GRID.colour[g]] / (1.0 - a * a)
            m.residual[g], m.far[g], m.short_mean[g] = 0.0, 0.0, 1.0

    cdef double innovation_variance(self) noexcept nogil:
        """Return the variance that the latest innovation was expected to have."""
        return self.trial_variances[0]

    cdef double most_change(self, int i) noexcept nogil:
        """Return how much Phi_{i+1} may change in a jump of y that it does not contradict."""
        if i + 1 == self.levels:
            return INFINITY
        return HUBER * sqrt(self.trial_variances[i + 1])

    cdef void go_on_after_jump(self, double of_state) noexcept nogil:
        """Let the members go on after y has jumped (D 23)."""
        shift(self.members, of_state, self.memory.miss, self.trial_variances[0])

    cdef double variance(self, int i) noexcept nogil:
        """Return the variance of the error of z_{i+1}, or of d for i = n."""
        return self.variances[i]

    cdef void tell(self, double* model, double* tuning) noexcept nogil:
        """Write the likeliest model of d, and what has been found; NaN before it is known."""
        cdef int i
        model[0], model[1] = self.model.noise, self.model.drive
        model[2], model[3] = self.model.loss, self.model.derivatives
        if self.has_begun():
            find_tuning(self.members, tuning)
        else:
            for i in range(3 + ORDERS):
                tuning[i] = NAN

    cdef void begin_at_rest(self, const double* u) noexcept nogil:
        """
        Let the members begin as if z stood still (D 28).

        Then z_{i+1} is -Phi_i; it is off that by z_i', whose size differences of y have told, and
        by what Phi_i changes with the states before it, which are off as well.
        """
        cdef Members* m = self.members
        cdef double along[MOST_LEVELS]
        cdef double* z = self.prediction.z
        cdef double slope
        cdef int n = self.order, i, j, g
        memset(along, 0, sizeof(along))
        z[0] = self.level[0].z_hat
        for i in range(1, n):
            z[i] = -evaluate(self.prediction.phi, i - 1, z, along, u).value
            for j in range(1, i):
                along[j] = sqrt(m.sizes[j])
                slope = evaluate(self.prediction.phi, i - 1, z, along, u).slope
                m.sizes[i] += slope * slope
                along[j] = 0.0
            if not (fabs(z[i]) <= LARGEST and m.sizes[i] <= LARGEST):
                z[i] = m.sizes[i] = 0.0
            self.level[i].z_hat = z[i]
            for g in range(COUNT):
                m.x.z[i][g], entry(&m.p, n, i, i)[g] = z[i], m.sizes[i]

    # A step of all members

    cdef void step_members(self, double h, const double* u) noexcept nogil:
        """
        Advance the members, and the estimates, to a sample.

        A sample that is too far off is counted in `Memory.beyond`, and changes no member.
        """
        cdef Members* m = self.members
        cdef Shared* shared = &m.shared
        cdef Work* w = &m.work
        cdef Sample* sample = &w.sample
        cdef Memory* memory = &self.memory
        cdef double mean[MOST_STATES]
        cdef double expected, speed, change, late, gate
        cdef bint goes_on, likely, begins, jumped, rough, even, timed
        cdef int i, since_jump
        sample.quanta = rounding(m)
        if choose_members(m):
            weigh(m)
        change = self.follow_interval(h - memory.behind)
        follow_differences(m, sample.y, memory.interval)
        follow_stamps(m, memory.interval, change)
        even, rough = is_even(m), sample.roughness > HUBER * HUBER
        sample.average = fmin(shared.samples, NOISE_SAMPLES)
        speed = self.look(h, u)
        late = fabs(speed * change) if memory.beyond == 0.0 and not even else 0.0
        sample.uneven += fmax(shared.jitter, change * change) * speed * speed
        shared.samples = <int>sample.average + 1
        goes_on = (
            memory.beyond > 0.0 and (sample.off < 0.0) == (memory.miss < 0.0)
            and not rough and shared.roughness < HUBER
        )
        gate = HUBER if goes_on else GATE
        likely = is_likely(m, gate, late)
        if even and not self.placed and (not likely or self.may_have_waited(change)):
            likely = self.is_likely_when_even(h, u, gate)
        if likely and memory.beyond == 0.0:
            follow_usual_interval(m, self.passed)
        # How large a jump is, nobody knows where it is not known how much time has passed.
        timed = fabs(memory.behind) <= shared.usual_interval
        begins = has_jumped(m, memory.beyond) and timed and not likely
        expected = w.believed[shared.likeliest] * w.noise[shared.likeliest]
        shared.recent = fmax(shared.recent - 1.0, 0.0)
        # After a jump y moves less smoothly than before, but farther than noise would put it off;
        # behind a sample that was passed over it is off for another reason.
        jumped = begins or (shared.recent > 0.0 and memory.beyond == 0.0 and (
            not rough or fabs(sample.off) > SMOOTHEST * sqrt(sample.uneven)
        ))
        if not likely and not jumped:
            self.pass_over()
            self.trial_variances[0] = expected
            return
        memory.beyond = 0.0
        if not jumped and sample.quanta == 0.0 and has_drifted(
            memory, sample.off / sqrt(expected)
        ):
            memory.beyond = INFINITY
            return
        if jumped:
            if begins:
                shared.recent = JUMP_SAMPLES
            allow_jump(m, sample.since_jump if begins else 0.0)
            memset(m.far, 0, sizeof(m.far))
            memcpy(w.believed, w.s, sizeof(Line))
            shared.unsettled = 0.0
        self.take_sample()
        follow_quantum(m)
        since_jump = 0 if jumped else samples_since_jump(m)
        if since_jump > 2:  # two outliers are no jump
            follow_jump(m, since_jump)
            self.y_jumped = True
            weigh(m)
        mix(m, mean, self.trial_variances)
        for i in range(self.levels):
            self.level[i].z_hat = mean[i]
        tell_model(m, jumped, &self.trial_model)
        for i in range(shared.active):
            if m.far[i] > LOST_SAMPLES:  # far off for long
                m.far[i] = 0.0
                put(m, i, mean)
            if m.variance[i] <= INEXACT:  # rounding has made z_1 more than certain
                go_on_from(m, i, shared.likeliest)
                shared.unsettled = 0.0

    cdef double look(self, double h, const double* u) noexcept nogil:
        """Predict the members over h, and by what the sample is off; return y's speed, RMS."""
        cdef Members* m = self.members
        cdef Shared* shared = &m.shared
        cdef Work* w = &m.work
        cdef Sample* sample = &w.sample
        cdef double mean[MOST_STATES]
        cdef double speed
        cdef bint same = fabs(h - shared.flow_period) <= EXACT * shared.flow_period
        cdef int i, moving
        sample.h = h
        self.carry_flow(h, u, same)
        speed = (self.prediction.z[0] - self.level[0].z_hat) / h
        speed = sqrt(speed * speed + self.variances[1])
        if not shared.jitter * speed * speed <= LARGEST:  # of a prediction that has overflowed
            speed = sqrt(usual_speed(m))
        shared.of_stamps = shared.jitter * speed * speed
        fill_noise(m)
        moving = self.follow_period(h, same)
        if self.memory.beyond > 0.0 or shared.recent > 0.0 or sample.quanta > 0.0:
            moving = HALF
        if sample.quanta > 0.0:  # P depends on the samples
            shared.unsettled = 0.0
        w.first, w.last = HALF - moving, min(HALF + moving, shared.active)
        sample.off = sample.y - self.prediction.z[0]
        # A sample that is not likely changes no member: what it makes of them stands apart.
        for i in range(self.levels):
            mean[i] = self.level[i].z_hat
        predict_states(m, mean, self.prediction.z)
        expect(m)
        find_knowing(m, self.memory.beyond > 0.0)
        return speed

    cdef bint may_have_waited(self, double change) noexcept nogil:
        """
        Return True if an interval, and its change, are those of a sample that has waited (D 29).

        No host hangs at each sample, and samples wait only where one did: else the rate is new.
        """
        cdef Shared* shared = &self.members.shared
        cdef double usual = shared.usual_interval
        cdef double off = fabs(self.memory.interval - usual)
        if self.memory.interval > usual or self.memory.behind <= 0.0:
            off = fmin(off, fabs(change))
        return off > fmax(0.5 * usual, HUBER * sqrt(2.0 * shared.jitter))

    cdef bint is_likely_when_even(self, double h, const double* u, double gate) noexcept nogil:
        """
        Take an evenly spaced sample at the likeliest of its times; return True if it is likely.

        Samples wait for a busy host, which stamps them as it reads them. So the time since the
        last sample that was used may be the usual one; or, if that sample was late, the one of the
        stamps alone, where this is nearly the usual one. Where all are late, times still go with
        the stamps in the mean.
        """
        cdef Memory* memory = &self.memory
        cdef double usual = (memory.beyond + 1.0) * self.members.shared.usual_interval
        cdef double late = fmax(fmin(memory.behind, usual), -usual), most = self.likelihood()
        cdef double[2] others = [usual + late / NOISE_SAMPLES, h - memory.behind]
        cdef bint nearly = memory.behind != 0.0 and 0.5 * usual < others[1] < 2.0 * usual
        cdef int i
        for i in range(2 if nearly else 1):
            self.look(others[i], u)
            if self.likelihood() > most:
                most, self.passed = self.likelihood(), others[i]
        self.look(self.passed, u)
        return is_likely(self.members, gate, 0.0)

    cdef double likelihood(self) noexcept nogil:
        """Return twice the log-likelihood of the sample, for the likeliest member."""
        cdef Work* w = &self.members.work
        cdef int g = self.members.shared.likeliest
        cdef double variance = w.s[g] * w.noise[g]
        return -w.b[g] * w.b[g] / variance - log(variance / self.members.shared.first_noise)

    cdef int follow_period(self, double h, bint same) noexcept nogil:
        """Find what depends on the period, and of how many members of a half P moves (D 27)."""
        cdef Members* m = self.members
        cdef Shared* shared = &m.shared
        cdef double of_colours[COLOURS]
        cdef double mean = self.memory.period if self.memory.period > 0.0 else h, ratio, limit
        cdef double noisiest = shared.first_noise, slowed, unsettled
        cdef int g, c, moving = 0
        cdef bint changed
        if not same:
            for g in range(HALF):  # kappa does not depend on k
                m.decayed[g] = m.decayed[g - 1] if GRID.order[g] > 0 else exp(-m.kappa[g] * h)
            for c in range(COLOURS):
                of_colours[c] = pow(GRID.correlation[c], h / shared.first_period)
            for g in range(HALF, COUNT):
                m.decayed[g] = m.decayed[GRID.white[g]]
                m.correlation[g] = of_colours[GRID.colour[g]]
        ratio = mean / shared.steady_period
        changed = not 1.0 / STEADY < ratio < STEADY or h > GAP * shared.steady_period
        for c in range(COLOURS):
            ratio = m.work.now[c] / m.used_noise[c]
            limit = STEADY if c == GRID.colour[shared.likeliest] else APART
            changed = changed or not 1.0 / limit < ratio < limit
        if changed:
            m.used_noise = m.work.now
        if changed or not self.is_linear:
            shared.unsettled, shared.steady_period = 0.0, mean
        unsettled = shared.unsettled + h
        for c in range(COLOURS):
            noisiest = fmax(noisiest, m.used_noise[c])
        slowed = pow(shared.first_noise / noisiest, 0.5 / (self.order + 1))
        for c in range(BANDS):
            g = HALF + c * IN_BAND
            if m.kappa[g] / DECAY * slowed * unsettled < FADED:
                moving += IN_BAND
        return min((moving + EVEN - 1) // EVEN * EVEN, HALF)

    cdef void carry_flow(self, double h, const double* u, bint same) noexcept nogil:
        """Predict the mean, with its derivative by each of its entries (D 27)."""
        cdef Shared* shared = &self.members.shared
        cdef int i, j
        for j in range(self.levels - 1 if self.is_linear and same else 0, self.levels):
            for i in range(self.levels):
                self.prediction.z[i], self.prediction.dz[i] = self.level[i].z_hat, 0.0
            self.prediction.dz[j] = 1.0
            self.prediction.over(h, u)
            for i in range(self.levels):
                self.members.flow[i][j] = self.prediction.dz[i]
        if not same:
            shared.flow_period = h

    cdef void pass_over(self) noexcept nogil:
        """Count a sample that is not likely; where it may be noise that has grown, follow that."""
        cdef Members* m = self.members
        cdef Shared* shared = &m.shared
        cdef Sample* sample = &m.work.sample
        cdef Memory* memory = &self.memory
        cdef bint other_side = memory.beyond > 0.0 and (sample.off < 0.0) != (memory.miss < 0.0)
        if other_side:
            begin_growth(m)
            memory.beyond = 0.0
        memory.beyond += 1.0
        memory.miss = fmax(fmin(sample.off, LARGEST), -LARGEST)
        if memory.beyond == 1.0:  # two errors are not alike where a prediction has overflowed
            memory.first_miss = sample.off if sample.off == memory.miss else -memory.miss
        # A y that is off is so on one side, and evenly.
        if other_side or (shared.roughness > HUBER and shared.recent == 0.0):
            follow_noise(m)

    cdef void take_sample(self) noexcept nogil:
        """Correct the members by a sample, and weigh them."""
        cdef Members* m = self.members
        cdef Sample* sample = &m.work.sample
        cdef bint quantised = sample.quanta > 0.0
        m.shared.unsettled += sample.h
        follow_noise(m)
        follow_innovations(m)
        if quantised:
            take_interval(m)
        correct(m, quantised)
        if not quantised:
            judge(m, sample.roughness <= HUBER * HUBER)
        correct_states(m)
        weigh(m)

    # Snapshots and copies

    cdef dict places(self):
        """Return where the arrays lie: name -> (address, shape)."""
        cdef Members* m = self.members
        n = self.order
        found = {
            'kappa': <size_t>m.kappa, 'weight': <size_t>m.weight,
            'correlation': <size_t>m.correlation, 'decayed': <size_t>m.decayed,
            'prior': <size_t>m.prior, 'score': <size_t>m.score, 'far': <size_t>m.far,
            'variance': <size_t>m.variance, 'log_variance': <size_t>m.log_variance,
            'residual': <size_t>m.residual, 'short_mean': <size_t>m.short_mean,
        }
        return {name: (at, (COUNT,)) for name, at in found.items()} | {
            'score_before': (<size_t>m.score_before, (2, COUNT)),
            'drive': (<size_t>m.drive, (ORDERS, COUNT)),
            'z': (<size_t>m.x.z, (n, COUNT)),
            'd': (<size_t>m.x.d, (ORDERS, COUNT)),
            'gain_z': (<size_t>m.gain.z, (n, COUNT)),
            'gain_d': (<size_t>m.gain.d, (ORDERS, COUNT)),
            'p_zz': (<size_t>m.p.zz, (n * (n + 1) // 2, COUNT)),
            'p_zd': (<size_t>m.p.zd, (n, ORDERS, COUNT)),
            'p_dd': (<size_t>m.p.dd, (ORDERS, ORDERS, COUNT)),
            'first_y': (<size_t>m.first_y, (FIRST_SAMPLES,)),
            'first_h': (<size_t>m.first_h, (FIRST_SAMPLES,)),
            'sizes': (<size_t>m.sizes, (n,)),
            'noise': (<size_t>m.noise, (COLOURS,)),
            'late': (<size_t>m.late, (COLOURS,)),
            'used_noise': (<size_t>m.used_noise, (COLOURS,)),
            'latest_y': (<size_t>m.latest_y, (DIFFERENCES,)),
            'ages': (<size_t>m.ages, (DIFFERENCES,)),
            'difference': (<size_t>m.difference, (CLOCKS, DIFFERENCES)),
            'rough': (<size_t>m.rough, (CLOCKS, COLOURS, DIFFERENCES)),
            'window': (<size_t>m.window, (WINDOW,)),
        } | ({'flow': (<size_t>m.flow, (MOST_STATES, MOST_STATES))} if self.is_linear else {})

    def state_dict(self):
        """
        Return all that it remembers: name -> number or array.

        Arrays of `COUNT` columns have one for each member; there are none before the members run.
        """
        cdef dict shared = self.members.shared, model = self.model
        whole, found = Structure.state_dict(self), {}
        for name, (at, shape) in self.places().items():
            numbers = np.frombuffer((<char*><size_t>at)[:8 * int(np.prod(shape))])
            found[name] = numbers.reshape(shape)
        early = {name: found[name] for name in EARLY}
        if shared['samples'] <= FIRST_SAMPLES:
            found = early
        if not all((np.abs(numbers) <= LARGEST).all() for numbers in found.values()):
            shared['samples'], found = 0, early  # members are lost, as the next step would find
        found |= shared
        for name, numbers in found.items():
            found[name] = np.clip(np.nan_to_num(numbers), *RANGES.get(name, (0.0, LARGEST)))
        found['model'] = np.clip(np.nan_to_num([*model.values()]), -LARGEST, LARGEST)
        found['variances'] = np.array([self.variances[i] for i in range(self.levels)])
        return whole | found

    def load_state_dict(self, values):
        """Go on where an observer of the same size was; see `Structure.load_state_dict`."""
        cdef Shared shared = self.members.shared
        cdef int i
        self.enter()
        shared = {name: within(values, name, ()).item() for name in (<dict>shared)}
        names = self.places()
        if shared.samples <= FIRST_SAMPLES:
            names = {name: names[name] for name in EARLY}
        if shared.active % HALF > 0 or (shared.samples > FIRST_SAMPLES and shared.active == 0):
            raise ConfigurationError(
                f"snapshot: 'active': expected {HALF} or {COUNT} members, got {shared.active}"
            )
        found = {name: within(values, name, shape) for name, (_, shape) in names.items()}
        variances = array_of(values, 'variances', (self.levels,), 0.0, INFINITY)
        numbers = array_of(values, 'model', (4,))
        Structure.load_state_dict(self, values)
        if shared.samples <= FIRST_SAMPLES:
            self.begin_afresh()
        self.members.shared, self.members.work.q_interval = shared, 0.0
        self.model = Model(numbers[0], numbers[1], numbers[2], numbers[3])
        for name, number in found.items():
            data = number.tobytes()
            memcpy(<void*><size_t>names[name][0], <char*>data, len(data))
        for i in range(self.levels):
            self.variances[i] = variances[i]


cdef within(values, str name, tuple shape):
    """Return what a snapshot has of a name, after a check that it is within its range."""
    return array_of(values, name, shape, *RANGES.get(name, (0.0, LARGEST)))
