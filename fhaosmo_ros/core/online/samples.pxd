# SPDX-License-Identifier: Apache-2.0
"""
What an estimator remembers beside its observer's state, and the rules for single samples.

Times are in nanoseconds.
"""

cdef long long FAR

cdef enum:
    WINDOW = 32  # intervals, or ticks, that a running mean remembers


cdef struct Settings:
    bint nominal  # dt is `period`, whatever the stamps say
    bint by_clock  # stamps are the node clock's at reception
    bint to_now  # estimates are carried over the delay
    long long period  # nominal one
    long long max_gap  # 0: so many intervals as policy.pyx says
    long long stuck_time  # 0: off
    long long divergence_time  # 0: off
    long long delay  # of y
    long long lag  # how much later than the inputs y is known: measurement_delay - input_delay
    double gate  # a spike is further from its prediction (unit of y); 0: off
    double limit  # larger samples are rejected, larger states are lost
    double epsilon  # y is lost while |eps_1| is larger (unit of y)


cdef struct Counters:
    # One for each case of docs/node.md; counters.py says what they mean.
    long long accepted, rejected_measurements, rejected_spikes, rejected_stuck, rejected_steps
    long long duplicate_stamps, backward_stamps, zero_stamps, far_stamps, rejected_inputs
    long long gaps, sub_steps, spread_stamps, bursts, spikes_believed, stuck
    long long restarts_forward, restarts_backward, divergences, jumps


cdef struct Course:
    # Where the estimator is in the course of the samples.
    bint frozen  # gamma is held
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
    double mean_jitter  # running mean of its deviation (ns)
    double usual_interval  # longest mean_interval of late; a restart does not forget it (ns)


cdef struct Clock:
    # A line through the ticks of a clock that stands still between them.
    long long tick  # latest reading
    long long tick_length  # time from the reading before it
    long long tick_count  # samples at it
    long long spacing  # of samples at one reading (ns / FINE); 0: not known yet
    long long placed  # where the latest sample was put
    long long phase  # time of the first sample at that reading
    long long ticks  # that the line remembers; 0: no line; < 0: none for so many ticks
    long long deviation  # running mean of how far ticks are off it
    long long pace  # interval of the times that follow the line (ns / FINE)
    long long fitted  # latest tick that was on the line


cdef struct Sensor:
    # Whether y's sensor is stuck, or holds its values.
    bint stuck
    bint holds  # it holds each value for several samples
    long long seen  # time of the latest sample, used or not
    long long changed  # since when y is what it is
    long long repeats  # samples in a row that repeat the one before
    long long held_for  # how many of them there usually are
    long long regular  # evidence that it holds each value for so long
    double sample  # the latest y, used or not
    double change  # by what it last differed from the one before
    double repeated  # the y that has repeated itself last
    double elsewhere  # share of values of late that repeat themselves, another one each


cdef long long difference(long long a, long long b) noexcept nogil
cdef long long clock_time(
    Clock* clock, long long stamp, long long max_gap, Counters* counters
) noexcept nogil
cdef bint is_stuck(
    Sensor* sensor, const Settings* settings, Counters* counters, double last, double y,
    long long now, long long max_gap
) noexcept nogil
cdef bint is_held(
    Sensor* sensor, long long max_gap, const Course* course, double y, long long now
) noexcept nogil
cdef bint may_have_noise(const Sensor* sensor) noexcept nogil
cdef bint repeats_noise(Sensor* sensor, Counters* counters, double y, bint noisy) noexcept nogil
cdef bint is_spike(
    Course* course, const Settings* settings, Counters* counters, double innovation
) noexcept nogil
