# SPDX-License-Identifier: Apache-2.0
"""The members of the self-tuning observer: which they are, and what they remember (D 26)."""

from fhaosmo_ros.core.vectors cimport VECTORISED

cdef enum:
    ORDERS = 4  # d and its derivatives, of the members that have them
    IN_BAND = 3  # members of each bandwidth: k = 0, 1, 3
    BANDS = 40  # bandwidths omega of the members of each k
    COLOURS = 4  # colours of the noise; the first is white
    HALF = BANDS * IN_BAND  # members with white noise, and with coloured noise
    COUNT = 2 * HALF
    MOST_ORDER = 12
    MOST_STATES = MOST_ORDER + ORDERS
    PAIRS = 78  # of MOST_ORDER states, each with itself too
    DIFFERENCES = MOST_ORDER + 2  # of y: order 0 to n + 1
    CLOCKS = 2  # samples may be evenly spaced in time, or as their stamps say
    WINDOW = 32  # a jump of y is looked for in so many samples (D 35)
    FIRST_SAMPLES = 50  # so many tell the period and the noise before the members begin

ctypedef double[COUNT] Line  # a number of each member


cdef struct Grid:
    # Which the members are.
    int band[COUNT]  # number of the bandwidth, from the slowest
    double bandwidth[COUNT]  # omega (rad a sample)
    int order[COUNT]  # k
    int colour[COUNT]  # of the noise, 0: white
    int white[COUNT]  # the first member with white noise of the same bandwidth and k
    int first[COLOURS]  # first member of each colour
    double correlation[COLOURS]  # a, at the period of the first samples


cdef struct Estimates:
    Line z[MOST_ORDER]
    Line d[ORDERS]  # (D + kappa)^j d, j = 0, 1, ..; 0 where the member does not have it


cdef struct Covariances:
    # Of `Estimates`: upper triangles.
    Line zz[PAIRS]  # of z_i and z_j at `pair(i, j)`
    Line zd[MOST_ORDER][ORDERS]
    Line dd[ORDERS][ORDERS]


cdef struct Sample:
    # What is known of a sample before it is used or passed over.
    double y  # less the offset (D 23)
    double before  # the sample before
    double h  # time since then (s)
    double since_jump  # time since a jump of d (s), where `has_jumped` says that there was one
    double off  # by what it is off the prediction of the mean
    double quanta  # variance of the error of rounding; 0: y is not quantised (D 29)
    double roughness  # square of its difference over the usual one
    double roughness_before  # mean of those before
    double uneven  # square of the highest difference, as a variance of y, and of its stamps
    double largest  # variance of the innovations with which a member can judge it
    double average  # number of samples to average the noise over


cdef struct Work:
    # What a step needs for itself.
    Line b  # innovations
    Line s  # their variances over that of the noise
    Line believed  # the same, as far as it is believed
    Line noise  # variance of each member's noise at this sample
    Line inverse  # P C' times this are gains
    Line taken  # P loses P C' C P times this
    Line size  # standard deviation of z_1 - y where y is quantised
    Line chance, mean, lost  # see `intervals.truncate`
    Line ratio  # squared innovations over their variances
    Line d[ORDERS]  # d and its derivatives
    Line one, two  # for any use within a function
    Estimates x  # predictions
    Estimates pc  # P C'
    Covariances p, q  # predictions, and what the intensities add to them
    Line product_z[MOST_ORDER][MOST_ORDER]  # A P, of z
    Line product_d[MOST_ORDER][ORDERS]
    Line chain[MOST_ORDER][ORDERS]  # what (D + kappa)^j d does to each z
    Sample sample
    double now[COLOURS]  # variance of the noise of each colour at this sample
    int first, last  # members whose covariances move, and the one behind them
    double q_interval  # what `q` holds for: h (0: nothing yet),
    int q_first, q_last  # and members


cdef struct Shared:
    # What all members share.
    int samples  # gathered; more than FIRST_SAMPLES once the members run
    int active  # members that take part: all, or HALF where y is quantised; 0 before they begin
    int likeliest  # the likeliest member
    int told  # the member whose model a smoother goes by (D 34)
    int followed  # the member whose innovations are looked at for a jump of y (D 35)
    int since_mark  # samples since `score_before[0]`, and WINDOW more from the second one on
    double unsettled  # time since covariances began to move (s)
    double steady_period  # interval that they are those of (s)
    double usual_interval  # between samples that were not stamped late (s)
    double gathered, waiting  # time since it was last followed (s), and samples
    double flow_period  # interval that the flow is that of (s)
    double first_noise  # variance of the noise when the members began
    double first_period  # mean interval of the first samples (s)
    double roughness  # short mean of the squared differences of y, over their usual size
    double grown  # how much larger than expected innovations and differences are of late, >= 1
    double jitter  # variance that the intervals of late say the stamps have at most (s^2)
    double of_stamps  # variance that it makes of y at the latest sample
    double quantum  # step of y of which the others may be multiples (unit of y)
    double lattice  # of late, the share of the steps of y that are
    double goes_back  # of late, the share of the steps of y that go back at once
    double growing  # unlikely samples in a row that are farther and farther off (D 33)
    double size_of_d  # mean square of d of late, by its estimates and their variances
    double first_off  # how far off the first of the unlikely samples in a row was
    double first_off_after  # time until then from the last likely sample (s)
    double latest_off  # how far off the latest sample was
    double latest_off_after  # time until then from the last likely sample before it (s)
    double uneven  # mean square of the highest difference of y in these samples
    double first_rough  # what `roughness` was before the first of them
    double recent  # samples left that count as part of a jump of d (D 33)


cdef struct Members:
    # Lines come first, so that they begin where vectors of the processor do.
    Line kappa  # rate at which d decays (1/s)
    Line correlation  # a, of samples a period apart
    Line decayed  # exp(-kappa h)
    Line drive[ORDERS]  # intensity q, in the row of the member's k; 0 elsewhere
    Line prior  # log-likelihood without samples
    Line score  # log-likelihood relative to the best
    Line weight
    Line variance  # S of the innovations over that of the noise
    Line log_variance
    Line residual  # last y - z_1
    Line far  # samples in a row beyond the gate
    Line short_mean  # short mean of squared innovations over S
    Line score_before[2]  # scores of two earlier samples, WINDOW apart
    Estimates x
    Estimates gain  # by what an innovation corrects them
    Covariances p
    Work work
    int n  # states of the model
    Shared shared
    double first_y[FIRST_SAMPLES]  # the first samples
    double first_h[FIRST_SAMPLES]  # and the intervals before them (s)
    double sizes[MOST_ORDER]  # mean squares of z; at first larger by the factor DOUBT^2
    double noise[COLOURS]  # variance of the noise of each colour, but for that of stamps
    double late[COLOURS]  # share of `jitter` that is error of the stamps (D 29)
    double used_noise[COLOURS]  # the one that P counts on
    double latest_y[DIFFERENCES]  # the latest samples, from the last one on
    double ages[DIFFERENCES]  # by their stamps, from the last one back (s)
    double difference[CLOCKS][DIFFERENCES]  # of order 1 to n + 1 at the last sample
    double rough[CLOCKS][COLOURS][DIFFERENCES]  # what these say that noise is at most
    double flow[MOST_STATES][MOST_STATES]  # derivative of the prediction to the next sample
    double window[WINDOW]  # innovations over their standard deviations, of one member (D 35)


cdef Grid GRID
cdef double BAND_STEP, DECAY  # omega of a band over that of the one before; kappa / omega
cdef double EXACT, HUBER, INEXACT

cdef inline int pair(int i, int j) noexcept nogil:
    """Return the place of the covariance of z_i and z_j."""
    return j * (j + 1) // 2 + i if i < j else i * (i + 1) // 2 + j

cdef inline double* entry(Covariances* p, int n, int i, int j) noexcept nogil:
    """Return P_ij of z_1 .. z_n and d behind them."""
    if i > j:
        i, j = j, i
    if j < n:
        return p.zz[pair(i, j)]
    if i < n:
        return p.zd[i][j - n]
    return p.dd[i - n][j - n]

cdef inline double* state(Estimates* x, int n, int i) noexcept nogil:
    """Return state i of z_1 .. z_n and d behind them."""
    if i < n:
        return x.z[i]
    return x.d[i - n]

cdef inline double leeway(double far) noexcept nogil:
    """Return how much farther off a sample may be: `far` in a row are no outliers (D 28)."""
    return 1.0 + (far - 1.0) * (far - 1.0) if far > 1.0 else 1.0

cdef VECTORISED fill(double* values, const double* of_colours) noexcept nogil
cdef double largest(const double* values, Py_ssize_t count) noexcept nogil
cdef double factorial(int i) noexcept nogil
cdef double power(double x, int count) noexcept nogil
cdef void by_binomials(double* chain, int count, double more) noexcept nogil
cdef void put(Members* m, int g, const double* estimate) noexcept nogil
cdef void go_on_from(Members* m, int g, int other) noexcept nogil
cdef VECTORISED predict_states(
    Members* m, const double* mean, const double* predicted
) noexcept nogil
cdef VECTORISED expect(Members* m) noexcept nogil
cdef VECTORISED correct(Members* m, bint by_interval) noexcept nogil
cdef VECTORISED correct_states(Members* m) noexcept nogil
