# SPDX-License-Identifier: Apache-2.0
"""
What is known of each time by all of a recording (D 24, D 25, D 34).

An extended Kalman filter goes forward, with D 17 as the model of d; the recursion of Rauch, Tung
and Striebel goes back, in the form of Bierman, which inverts no matrix. The observer says which
samples are used, where it begins afresh, and, if it tunes itself, the noise and the model of d of
its likeliest member at each sample. Its estimates stand where numbers overflow.

Rauch, Tung and Striebel 1965, doi:10.2514/3.3166; Bierman 1973, Int. J. Control 18 (1).
"""

from libc.math cimport INFINITY, exp, fabs, isfinite, sqrt
from libc.string cimport memcpy, memset

from fhaosmo_ros.core.model.prediction cimport MOST_LEVELS, Prediction
from fhaosmo_ros.core.observer.kalman cimport (
    Row, add_drive, carry, correct, multiply, sub_steps, usual
)
from fhaosmo_ros.core.observer.self_tuning.members cimport by_binomials, ORDERS
from fhaosmo_ros.core.observer.self_tuning.weights cimport Model
from fhaosmo_ros.core.observer.sliding_mode cimport HUBER, spread_after
from fhaosmo_ros.core.observer.status cimport DIVERGED, JUMPED, RESTARTED, UNUSED
from fhaosmo_ros.core.observer.structure cimport MOST_INPUTS

from fhaosmo_ros.core.observer.kalman import LinearModel, STATES_DOUBT, Uncertainty
from fhaosmo_ros.core.parameters.errors import ConfigurationError
import numpy as np

# What later samples may still change, in standard deviations of the filter's errors.
cdef double TOLERANCE = 1e-9
# A model of d that ends has been wrong if it has so much smaller a variance than the observer.
cdef double SURER = 4.0
# Part of a number that rounding may change.
cdef double ROUNDING = 1e-12
# At the start states count as so many times larger than `state_sizes`, or than their estimates.
cdef double DOUBT = STATES_DOUBT


cpdef enum Kind:
    # Of a row.
    MEASURED  # a sample that was used
    UNMEASURED  # a time at which none was used
    JUMPS  # the first sample that was used after a jump of y alone (D 23)
    BEGINS  # the first one of a fresh start
    OVERFLOWS  # begins at the observer's estimate: numbers have overflowed


cdef struct Point:
    # A row: what is given.
    double y  # sample, less its offset (D 23)
    double h  # time since the row before (s)
    long long time  # ns
    int kind  # MEASURED .. OVERFLOWS
    int last  # the level that white noise drives; found by going forward
    double u[MOST_INPUTS]  # known inputs since the row before
    Row own[2]  # the observer's estimates; if it tunes itself, their variances
    Model model  # 0 stands for that of the row before, or for the one of fixed gains
    # What going forward finds.
    double spread  # size of the innovations over that expected, at least 1 (D 21)
    double pull  # e / S; this and the next two are 0 without a sample
    double certainty  # 1 / S
    double noise  # variance that the sample is taken to have
    double x[MOST_LEVELS]  # z, d and its derivatives, predicted from the rows before
    Row p[MOST_LEVELS]  # P of its errors
    Row f[MOST_LEVELS]  # F from the row before; 0 where a row begins

cdef Point example
POINT = np.asarray(<Point[:1]> &example).dtype


def kinds_of(const long long[:] status, long long flags):
    """
    Return what the rows of samples are, by their status flags, and the flags of later rows.

    A jump of y, and a restart, are those of the next sample that is used; `flags` are those of
    the samples since the last one that was.
    """
    cdef int[::1] kinds = np.full(len(status), UNMEASURED, dtype=np.intc)
    cdef Py_ssize_t k
    for k in range(status.shape[0]):
        flags |= status[k]
        if not status[k] & UNUSED:
            kinds[k] = JUMPS if flags & JUMPED else MEASURED
            if flags & (RESTARTED | DIVERGED):
                kinds[k] = BEGINS
            flags = 0
    return np.asarray(kinds), flags


cdef class Passes:
    """
    The ways forward and back through rows, which are arrays of the type `POINT`.

    It is made from an `ObserverConfiguration`, and raises ConfigurationError where the parameters
    do not say how large noise and d are.
    """

    cdef readonly object configuration
    cdef bint tunes  # a self-tuning observer: the model of d is another one in each row
    cdef Model model  # of each row, with fixed gains; kappa is 0, as phi has it
    cdef Prediction prediction
    cdef int n, order  # levels; states of the model
    cdef bint from_measurement  # z_1 begins at the first sample
    cdef double fastest  # rate of the fastest motion at rest (1/s)
    cdef double[::1] first  # estimates of a fresh observer
    cdef double[::1] state_sizes
    cdef double[:, ::1] fresh  # P of a fresh observer with fixed gains

    def __cinit__(self, configuration):
        p, model = configuration.parameters, configuration.model
        self.configuration, self.tunes = configuration, configuration.self_tuning
        self.n, self.order = configuration.levels, model.order
        if self.tunes:
            self.fastest = LinearModel(model.slopes_at_rest + np.eye(self.order, k=1), 0.0).fastest
        elif p['noise_size'] > 0.0 and p['unknown_input']:
            its = Uncertainty(model, p, configuration.state_sizes)
            self.fastest, self.fresh = its.linear.fastest, its.fresh
            self.model = Model(its.variance, its.linear.intensity, 0.0, self.n - 1 - self.order)
        else:
            raise ConfigurationError(
                "smoothing: expected 'noise_size' > 0 (standard deviation of the noise on y; "
                f"`tune` writes it) and 'unknown_input' = true, got {p['noise_size']:g} and "
                f'{str(p["unknown_input"]).lower()}'
            )
        self.prediction = Prediction(configuration.expressions, configuration.prediction_step)
        self.from_measurement = self.tunes or p['start_from_measurement']
        self.first, self.state_sizes = configuration.initial_estimate, configuration.state_sizes

    def __reduce__(self):
        return Passes, (self.configuration,)

    # Forward

    def forward(self, Point[::1] rows):
        """Go forward through rows (D 24); the first one either begins, or was the last before."""
        cdef Point* now
        cdef Py_ssize_t k
        for k in range(rows.shape[0]):
            now = &rows[k]
            if not self.tunes:
                now.model = self.model
            elif now.model.drive == 0.0 and k > 0:
                now.model = rows[k - 1].model
                now.model.derivatives = <int>now.model.derivatives & (ORDERS - 1)
            now.last = self.order + (<int>now.model.derivatives & (ORDERS - 1))
            if now.kind == BEGINS:
                self.begin(now, &self.first[0])
                now.spread = 1.0
                if self.from_measurement:
                    now.x[0] = now.y
            elif k > 0:
                now.spread = rows[k - 1].spread
                self.predict(&rows[k - 1], now)
                self.take(now)

    cdef void begin(self, Point* now, const double* x) noexcept nogil:
        """Begin at a row with an estimate: nothing before it matters."""
        cdef int i, j, d = self.order, chain = now.last - d
        cdef double size
        memset(now.p, 0, sizeof(now.p))
        memset(now.f, 0, sizeof(now.f))
        memcpy(now.x, x, self.n * sizeof(double))
        if not self.tunes:
            for i in range(self.n):
                memcpy(now.p[i], &self.fresh[i, 0], self.n * sizeof(double))
            return
        now.p[0][0] = now.model.noise
        for i in range(1, d):
            size = DOUBT * max(self.state_sizes[i], fabs(now.own[0][i]))
            now.p[i][i] = size * size
            if size * size < now.own[1][i] < INFINITY:
                now.p[i][i] = now.own[1][i]
        for i in range(chain + 1):
            for j in range(chain + 1):
                now.p[d + i][d + j] = usual(
                    chain - i, chain - j, now.model.loss, now.model.drive
                )

    cdef void predict(self, const Point* before, Point* now) noexcept nogil:
        """Predict a row from the one before (D 24); if that can't be, begin at the observer's."""
        cdef Row slope[MOST_LEVELS]
        cdef int i, j, n = self.n, count
        cdef bint finite
        count = sub_steps(now.h, max(self.fastest, now.model.loss))
        memcpy(now.p, before.p, sizeof(now.p))
        memset(now.f, 0, sizeof(now.f))
        for i in range(n):
            now.x[i], now.f[i][i] = before.x[i] + now.p[i][0] * before.pull, 1.0
        if before.certainty > 0.0:
            correct(n, now.p, before.noise)
        if now.model.loss != before.model.loss or now.last != before.last:
            self.change_model(before, now)
        for _ in range(count):
            self.step(now, now.h / count, slope)
            multiply(n, slope, now.f)
            carry(n, slope, now.p)
            add_drive(now.last, now.model.drive, now.h / count, now.p)
        finite = now.p[0][0] + now.model.noise > 0.0
        for i in range(n):
            for j in range(i):
                now.p[i][j] = now.p[j][i] = 0.5 * (now.p[i][j] + now.p[j][i])
            finite = finite and isfinite(now.x[i] * now.x[i]) and isfinite(now.p[i][i])
        if not finite:
            now.kind = OVERFLOWS
            self.begin(now, now.own[0])

    cdef void step(self, Point* now, double h, Row* slope) noexcept nogil:
        """Go on by `h` with x of a row; write the exact derivative of the Runge-Kutta steps."""
        cdef double* z = self.prediction.z
        cdef double* dz = self.prediction.dz
        cdef double kappa = now.model.loss
        cdef int i, j, n = self.n, d = self.order
        for j in range(n):
            for i in range(n):
                z[i], dz[i] = now.x[i], 1.0 if i == j else 0.0
            if kappa > 0.0:  # phi has plain derivatives of d
                by_binomials(z + d, ORDERS, -kappa)
                by_binomials(dz + d, ORDERS, -kappa)
            self.prediction.over(h, now.u)
            for i in range(n):
                slope[i][j] = dz[i]
        memcpy(now.x, z, (d if kappa > 0.0 else n) * sizeof(double))
        for i in range(d, n if kappa > 0.0 else d):
            memset(slope[i], 0, sizeof(Row))
            slope[i][i] = exp(-kappa * h)
            now.x[i] *= slope[i][i]
            for j in range(i + 1, n):
                slope[i][j] = slope[i][j - 1] * h / (j - i)
                now.x[i] += slope[i][j] * now.x[j]

    cdef void change_model(self, const Point* before, Point* now) noexcept nogil:
        """
        Go over to the model of d of a row, with its own derivatives of d (D 34).

        A derivative that the model before did not have begins as ever. If the model before was
        surer of an estimate than the observer is now, it was wrong.
        """
        cdef int i, j, d = self.order
        cdef double more = now.model.loss - before.model.loss
        by_binomials(now.x + d, ORDERS, more)
        for i in range(d + 1, self.n):  # row by row: (D + kappa)^j = (D + kappa)^(j-1) (D + kappa)
            for j in range(d, i + 1):
                now.f[i][j] = more * now.f[i - 1][j] + (now.f[i - 1][j - 1] if j > d else 0.0)
        for i in range(now.last + 1, self.n):
            now.x[i] = 0.0
            memset(now.f[i], 0, sizeof(Row))
        carry(self.n, now.f, now.p)
        for i in range(before.last + 1, now.last + 1):
            j = now.last - i
            now.p[i][i] = max(now.p[i][i], usual(j, j, now.model.loss, now.model.drive))
        for i in range(d + 1):
            if SURER * now.p[i][i] < now.own[1][i] < INFINITY:
                now.p[i][i] = now.own[1][i]

    cdef void take(self, Point* now) noexcept nogil:
        """Weigh the sample of a row (D 24); after a jump of d it says of what size (D 34)."""
        cdef int i, j, d = self.order
        cdef double s = now.p[0][0] + now.model.noise, e = now.y - now.x[0], share
        cdef double factor
        if now.kind == JUMPS:  # nothing before it matters to z_1, which is y (D 23)
            for i in range(self.n):
                now.f[0][i] = now.p[0][i] = now.p[i][0] = 0.0
            now.p[0][0], now.x[0] = now.model.noise, now.y
        if now.kind != MEASURED:
            return
        now.spread = spread_after(now.spread, e, sqrt(s))
        factor = max(fabs(e) / (HUBER * now.spread * sqrt(s)), 1.0)
        if now.model.derivatives < 0.0 and factor > 1.0:
            for i in range(self.n):
                share = (e * e - s) * now.f[i][d] / (now.f[0][d] * now.f[0][d])
                for j in range(self.n):
                    now.p[i][j] += share * now.f[j][d]
                if 0 < i <= d:  # when it has jumped is not known
                    now.p[i][i] += share * now.f[i][d]
            factor = 1.0
        now.noise = now.model.noise * factor
        now.certainty = 1.0 / (now.p[0][0] + now.noise)
        now.pull = e * now.certainty

    # Back

    cdef void go_back(
        self, const Point[::1] rows, Py_ssize_t last, Py_ssize_t begin, Py_ssize_t end,
        bint doubted, double[:, :, ::1] out
    ) noexcept nogil:
        """
        Write what rows up to `last` say of those from `begin` to `end` (D 25).

        If `doubted`, write x as it would become if all samples were as predicted, but the
        estimates behind row `last` were off by a standard deviation.
        """
        cdef double costate[MOST_LEVELS]
        cdef double behind[MOST_LEVELS]
        cdef Row known[MOST_LEVELS]  # X of D 34
        cdef Row a[MOST_LEVELS]  # of X <- A X A'
        cdef const Point* now = &rows[last]
        cdef const Point* after
        cdef double total
        cdef Py_ssize_t k
        cdef int i, j, n = self.n
        memset(known, 0, sizeof(known))
        for i in range(n):
            costate[i] = 1.0 / sqrt(now.p[i][i]) if doubted and now.p[i][i] > 0.0 else 0.0
        for k in range(last, begin - 1, -1):
            after, now = now, &rows[k]
            total = 0.0 if doubted else now.pull
            for i in range(n):
                total += now.certainty * now.p[0][i] * costate[i]
            costate[0] -= total
            if self.tunes and k < last:
                for j in range(n):
                    total = 0.0
                    for i in range(n):
                        a[i][j] = after.f[j][i]
                        total += now.p[0][i] * a[i][j]
                    a[0][j] -= now.certainty * total
                carry(n, a, known)
            known[0][0] += now.certainty
            if k < end:
                self.write(now, costate, known, &out[k, 0, 0])
            memcpy(behind, costate, n * sizeof(double))
            total = 0.0
            for j in range(n):
                costate[j] = 0.0
                for i in range(n):
                    costate[j] += now.f[i][j] * behind[i]
                total += costate[j] + known[j][j]
            if not isfinite(total):  # nothing is known of what comes later
                memset(costate, 0, sizeof(costate))
                memset(known, 0, sizeof(known))

    cdef void write(
        self, const Point* now, const double* costate, Row* known, double* out
    ) noexcept nogil:
        """Write the estimates of a row, and of a self-tuning observer the variances of errors."""
        cdef Row less[MOST_LEVELS]
        cdef int i, j, n = self.n
        for i in range(n):
            out[i] = now.x[i]
            for j in range(n):
                out[i] -= now.p[i][j] * costate[j]
        if self.tunes:
            memcpy(less, known, n * sizeof(Row))
            carry(n, now.p, less)
            for i in range(n):
                out[n + i] = max(now.p[i][i] - less[i][i], ROUNDING * fabs(now.p[i][i]))

    def back(self, rows, Py_ssize_t end, lag=None):
        """
        Return the estimates of rows, of the first `end` at most, that are due by what is known.

        With a lag (ns) these are the ones that are so old, by what was known when they became so
        old; a row that begins makes all before it due, which will not be known better. Where
        numbers overflow estimates are the observer's. They are a (K, 2, N) array, with variances
        of their errors if the observer tunes itself.
        """
        cdef Point[::1] point = rows
        cdef Py_ssize_t due = 0, done = 0, count = point.shape[0], k
        cdef long long age = 0 if lag is None else lag
        cdef double[:, :, ::1] out = np.zeros((end, 2, self.n))
        for k in range(count - 1 if lag is None else 0, count):
            while due < min(end, k + 1) and (
                lag is None or point[k].time - point[due].time >= age
                or (point[k].kind >= BEGINS and due < k)
            ):
                due += 1
            if due > done:
                self.go_back(point, k, done, due, False, out)
                done = due
        found = np.asarray(out)[:due]
        finite = np.isfinite(found).all(axis=(1, 2), keepdims=True)
        return np.where(finite, found, rows['own'][:due, :, :self.n])

    def settled(self, rows):
        """Return how many of the first rows samples to come change by `TOLERANCE` at most."""
        cdef Py_ssize_t count = len(rows)
        cdef double[:, :, ::1] out = np.empty((count, 2, self.n))
        self.go_back(rows, count - 1, 0, count, True, out)
        x, p = rows['x'][:, :self.n], rows['p'].diagonal(0, 1, 2)[:, :self.n]
        change, allowed = np.abs(np.asarray(out)[:, 0] - x), TOLERANCE * np.sqrt(np.abs(p))
        is_open = (change > allowed + ROUNDING * np.abs(x)).any(axis=1)
        return np.argmax(np.append(is_open, True))
