# SPDX-License-Identifier: Apache-2.0
"""
A recording, row by row, and what is known of each time by all of it (D 24, D 25, D 34).

The observer runs forward as ever. About its estimates the model is linearised, with D 17 as the
model of d, and the smoothing problem of this linear model is solved: forward by the Kalman filter
of the deviation from the observer's estimates, backward by the recursion of Rauch, Tung and
Striebel in the form of Bierman, which inverts no matrix. For a nonlinear Phi this is one
Gauss-Newton step towards the most likely trajectory, begun at the observer's (Bell 1994). With a
self-tuning observer the noise and the model of d are those of its likeliest member at each sample.

Rauch, Tung and Striebel 1965, doi:10.2514/3.3166; Bierman 1973, Int. J. Control 18 (1);
Bell 1994, doi:10.1137/0804035.
"""

from libc.math cimport INFINITY, exp, fabs, fmax, isfinite, pow, sqrt
from libc.string cimport memcpy, memset

from fhaosmo_ros.core.model.prediction cimport MOST_LEVELS, Prediction
from fhaosmo_ros.core.observer.kalman cimport (
    LinearModel, Row, add_drive, carry, correct, multiply, sub_steps
)
from fhaosmo_ros.core.observer.self_tuning.members cimport by_binomials, ORDERS
from fhaosmo_ros.core.observer.sliding_mode cimport follow_spread

from fhaosmo_ros.core.observer.kalman import STATES_DOUBT, Uncertainty
from fhaosmo_ros.core.parameters.errors import ConfigurationError
import numpy as np

# Innovations of so many times their usual size count as no larger ones (D 24).
cdef double HUBER = 2.0
# What later samples may still change, in standard deviations of the filter's errors.
cdef double TOLERANCE = 1e-9
# A model of d that ends has been wrong if it has so much smaller a variance than the observer.
cdef double SURER = 4.0
# No variance is less than this part of that of the prediction, from which it is subtracted.
cdef double ROUNDING = 1e-12
# At the start states count as so many times larger than `state_sizes`, or than their estimates.
cdef double DOUBT = STATES_DOUBT
cdef Point example
POINT = np.asarray(<Point[:1]> &example).dtype


cdef class Rows:
    """
    The rows of a recording, in their order; they are dropped once they have been handed out.

    Parameters
    ----------
    configuration : ObserverConfiguration

    Raises
    ------
    ConfigurationError
        The parameters do not say how large noise and d are.

    """

    def __cinit__(self, configuration):
        cdef int n = configuration.levels
        self.n, self.order = n, configuration.model.order
        self.inputs, self.tunes = len(configuration.model.inputs), configuration.self_tuning
        self.look_at({
            'point': np.empty(0, dtype=POINT),
            'u': np.empty((0, self.inputs)),
            'own': np.empty((0, (self.order + 1) * self.tunes)),
            'base': np.empty((0, n)),
            'deviation': np.empty((0, n)),
            'covariance': np.empty((0, n, n)),
            'transition': np.empty((0, n, n)),
        })
        self.configure(configuration)

    def configure(self, configuration):
        """Go on with other parameters of the same model from the next row on."""
        cdef LinearModel linear
        p, n, model = configuration.parameters, configuration.levels, configuration.model
        if (n, model.order, len(model.inputs)) != (self.n, self.order, self.inputs):
            raise ValueError('smoothing: the parameters are those of another model')
        if self.tunes:
            slopes = model.jacobian(np.zeros(self.order))
            linear = LinearModel(np.nan_to_num(slopes, posinf=0.0, neginf=0.0), 0.0)
            self.fresh = np.zeros((n, n))
        elif p['noise_size'] > 0.0 and p['unknown_input']:
            its = Uncertainty(model, p, configuration.state_sizes)
            linear, self.fresh = its.linear, its.fresh
            self.model = its.variance, its.intensity, 0.0, n - 1 - self.order
        else:
            raise ConfigurationError(
                "smoothing: expected 'noise_size' > 0 (standard deviation of the noise on y; "
                f"`tune` writes it) and 'unknown_input' = true, got {p['noise_size']:g} and "
                f'{str(p["unknown_input"]).lower()}'
            )
        self.configuration, self.fastest = configuration, linear.fastest
        self.prediction = Prediction(configuration.expressions, p['prediction_step'])
        self.from_measurement = self.tunes or p['start_from_measurement']
        self.first, self.state_sizes = configuration.initial_estimate, configuration.state_sizes

    cdef look_at(self, dict columns):
        """Hold the rows in these arrays."""
        self.columns, self.point, self.u = columns, columns['point'], columns['u']
        self.base, self.own, self.deviation = columns['base'], columns['own'], columns['deviation']
        self.covariance, self.transition = columns['covariance'], columns['transition']

    cdef make_room(self, Py_ssize_t more):
        """Drop rows that are done, all but two to go on from, where memory is needed for more."""
        cdef Py_ssize_t drop = max(min(self.done, self.count - 2), 0)
        cdef Py_ssize_t kept = self.count - drop
        if self.count + more <= self.point.shape[0]:
            return
        larger = {}
        for name, rows in self.columns.items():
            larger[name] = np.empty((2 * (kept + more) + 64, *rows.shape[1:]), rows.dtype)
            larger[name][:kept] = rows[drop:self.count]
        self.look_at(larger)
        self.count, self.done, self.began = kept, self.done - drop, self.began - drop

    cdef enter(self):
        """Raise RuntimeError while another thread appends rows."""
        if self.busy:
            raise RuntimeError('this smoother is in use by another thread: give each its own')

    def append(self, estimates, samples, times, kinds, models, deviations):
        """Go forward (D 24) through more rows: `base` of each, and the rest as `Smoother.take`."""
        cdef Py_ssize_t more = len(estimates), k
        self.enter()
        self.busy = True
        try:
            self.make_room(more)
            rows = slice(self.count, self.count + more)
            point = self.columns['point'][rows]
            model = models.T if self.tunes else self.model
            for name, values in zip(('variance', 'intensity', 'decay', 'derivatives'), model):
                point[name] = values
            point['time'], point['kind'] = times, kinds
            point['y'], point['h'], self.columns['u'][rows] = samples
            self.columns['base'][rows], self.columns['own'][rows] = estimates, deviations
            self.new = self.count
            for k in range(self.count, self.count + more):
                if self.point[k].kind == BEGINS:
                    self.began = k
                self.point[k].last = self.order + (<int>self.point[k].derivatives & (ORDERS - 1))
                self.forward(k)
            self.count += more
        finally:
            self.busy = False

    # Forward

    cdef void forward(self, Py_ssize_t k) noexcept nogil:
        """Go forward to row k (D 24), which holds the sample and the observer's estimate."""
        cdef Point* now = &self.point[k]
        cdef Point* before
        if k == 0 or now.kind == BEGINS:
            self.begin(k, now.y)
            self.memory.spread = 1.0
            return
        before = &self.point[k - 1]
        if now.kind != UNMEASURED and now.h <= 0.0 and k > 1 and before.kind != BEGINS:
            # The policy has withdrawn the sample before: its stamp was ahead.
            if before.kind == JUMPS:
                now.kind = JUMPS
            before.kind, before.h, before.time = UNMEASURED, 0.0, self.point[k - 2].time
            self.predict(k - 1)
            now.h = (now.time - before.time) * 1e-9
        if not now.h > 0.0:  # no time has passed
            now.h, now.time = 0.0, before.time
            if now.kind == MEASURED:
                now.kind = UNMEASURED
        self.predict(k)
        if now.kind == JUMPS:
            self.jump(k)
        elif now.kind == MEASURED:
            self.measure(k)

    cdef void begin(self, Py_ssize_t k, double y) noexcept nogil:
        """Let nothing before row k matter: its estimate is that of a fresh observer."""
        cdef Point* now = &self.point[k]
        cdef int i, j
        if self.tunes:
            self.doubt(k)
        now.pull, now.certainty, now.noise, now.kind = 0.0, 0.0, 0.0, BEGINS
        for i in range(self.n):
            self.deviation[k, i] = self.first[i] - self.base[k, i]
            for j in range(self.n):
                self.transition[k, i, j] = 0.0
                self.covariance[k, i, j] = self.fresh[i, j]
        if self.from_measurement:
            self.deviation[k, 0] = y - self.base[k, 0]

    cdef void doubt(self, Py_ssize_t k) noexcept nogil:
        """Write to `fresh` how far off the estimates of row k may be with its model (D 34)."""
        cdef int i, j, d = self.order, count = self.point[k].last - d
        cdef double size
        self.fresh[:, :] = 0.0
        self.fresh[0, 0] = self.point[k].variance
        for i in range(1, d):
            size = DOUBT * fmax(self.state_sizes[i], fabs(self.base[k, i]))
            self.fresh[i, i] = size * size
        for i in range(count + 1):
            for j in range(count + 1):
                self.fresh[d + i, d + j] = usual(&self.point[k], count - i, count - j)

    cdef void predict(self, Py_ssize_t k) noexcept nogil:
        """Predict row k from row k - 1 (D 24); if that can't be, begin at the observer's."""
        cdef Row f[MOST_LEVELS]
        cdef Row p[MOST_LEVELS]
        cdef Row slope[MOST_LEVELS]
        cdef double x[MOST_LEVELS]
        cdef double before[MOST_LEVELS]
        cdef double carried[MOST_LEVELS]
        cdef Point* now = &self.point[k]
        cdef int i, j, n = self.n, count = sub_steps(now.h, fmax(self.fastest, now.decay))
        cdef double step = now.h / count, off
        cdef bint finite
        memset(f, 0, sizeof(f))
        for i in range(n):
            x[i], f[i][i] = self.base[k - 1, i], 1.0
            before[i] = (
                self.deviation[k - 1, i] + self.covariance[k - 1, i, 0] * self.point[k - 1].pull
            )
            memcpy(p[i], &self.covariance[k - 1, i, 0], n * sizeof(double))
        if self.point[k - 1].certainty > 0.0:
            correct(n, p, self.point[k - 1].noise)
        if now.decay != self.point[k - 1].decay or now.last != self.point[k - 1].last:
            self.change_model(k, x, f, p)
        for _ in range(count):
            self.step(k, step, x, slope)
            multiply(n, slope, f)
            carry(n, slope, p)
            add_drive(now.last, now.intensity, step, p)
        now.pull = now.certainty = now.noise = 0.0
        finite = p[0][0] + now.variance > 0.0
        for i in range(n):
            carried[i] = 0.0
            for j in range(n):
                carried[i] += f[i][j] * before[j]
                self.transition[k, i, j] = f[i][j]
                self.covariance[k, i, j] = 0.5 * (p[i][j] + p[j][i])
            off = self.deviation[k, i] = x[i] + carried[i] - self.base[k, i]
            finite = finite and isfinite(off * off) and isfinite(p[i][i])
        if not finite:
            self.begin(k, self.base[k, 0])
            memset(&self.deviation[k, 0], 0, n * sizeof(double))
        elif now.kind == UNMEASURED:
            memcpy(&self.base[k, 0], x, n * sizeof(double))
            memcpy(&self.deviation[k, 0], carried, n * sizeof(double))

    cdef void step(self, Py_ssize_t k, double h, double* x, Row* slope) noexcept nogil:
        """Go on from x by `h`, in place; write the exact derivative of the Runge-Kutta steps."""
        cdef double* z = self.prediction.z
        cdef double* dz = self.prediction.dz
        cdef double kappa = self.point[k].decay, decayed = exp(-kappa * h)
        cdef int i, j, n = self.n, d = self.order
        for j in range(n):
            for i in range(n):
                z[i], dz[i] = x[i], 1.0 if i == j else 0.0
            if kappa > 0.0:  # phi has plain derivatives of d
                by_binomials(z + d, ORDERS, -kappa)
                by_binomials(dz + d, ORDERS, -kappa)
            self.prediction.over(h, &self.u[k, 0])
            for i in range(n):
                slope[i][j] = dz[i]
        memcpy(x, z, (d if kappa > 0.0 else n) * sizeof(double))
        for i in range(d, n if kappa > 0.0 else d):
            memset(slope[i], 0, sizeof(Row))
            slope[i][i] = decayed
            x[i] *= decayed
            for j in range(i + 1, n):
                slope[i][j] = slope[i][j - 1] * h / (j - i)
                x[i] += slope[i][j] * x[j]

    cdef void change_model(self, Py_ssize_t k, double* x, Row* f, Row* p) noexcept nogil:
        """
        Express the levels of d of row k - 1 as the model of row k has them (D 34), in place.

        A level that the model before did not have is as large as ever; one that the model has not
        any more is 0. If it was far surer of z and d than the observer is now, it was wrong.
        """
        cdef Point* now = &self.point[k]
        cdef int i, j, d = self.order
        cdef double more = now.decay - self.point[k - 1].decay, variance
        by_binomials(x + d, ORDERS, more)
        for i in range(d + 1, self.n):  # row by row: (D + kappa)^j = (D + kappa)^(j-1) (D + kappa)
            for j in range(d, i + 1):
                f[i][j] = more * f[i - 1][j] + (f[i - 1][j - 1] if j > d else 0.0)
        for i in range(now.last + 1, self.n):
            x[i] = 0.0
            memset(f[i], 0, sizeof(Row))
        carry(self.n, f, p)
        for i in range(self.point[k - 1].last + 1, now.last + 1):
            p[i][i] = fmax(p[i][i], usual(now, now.last - i, now.last - i))
        for i in range(d + 1):
            variance = self.own[k, i] * self.own[k, i]
            if SURER * p[i][i] < variance < INFINITY:
                p[i][i] = variance

    cdef void jump(self, Py_ssize_t k) noexcept nogil:
        """Let nothing before row k matter to z_1, which is y: y alone has jumped (D 23)."""
        cdef int i
        for i in range(self.n):
            self.transition[k, 0, i] = 0.0
            self.covariance[k, 0, i] = self.covariance[k, i, 0] = 0.0
        self.covariance[k, 0, 0] = self.point[k].variance
        self.deviation[k, 0] = self.point[k].y - self.base[k, 0]

    cdef void measure(self, Py_ssize_t k) noexcept nogil:
        """Weigh the sample of row k (D 24)."""
        cdef Point* now = &self.point[k]
        cdef double s = self.covariance[k, 0, 0] + now.variance
        cdef double e = now.y - self.base[k, 0] - self.deviation[k, 0]
        cdef double usual = follow_spread(&self.memory, e, sqrt(s))
        cdef double factor = fmax(fabs(e) / (HUBER * usual), 1.0)
        if now.derivatives < 0.0 and factor > 1.0:
            self.allow_jump(k, e * e - s)
            factor = 1.0
        now.noise = now.variance * factor
        now.certainty = 1.0 / (self.covariance[k, 0, 0] + now.noise)
        now.pull = e * now.certainty

    cdef void allow_jump(self, Py_ssize_t k, double missing) noexcept nogil:
        """Raise the variance of the predicted y by `missing`: d has jumped meanwhile (D 34)."""
        cdef double share[MOST_LEVELS]  # of the jump of y
        cdef int i, j, d = self.order
        for i in range(self.n):
            share[i] = self.transition[k, i, d] / self.transition[k, 0, d]
        for i in range(self.n):
            for j in range(self.n):
                self.covariance[k, i, j] += missing * share[i] * share[j]
            if 0 < i <= d:  # when it has jumped is not known
                self.covariance[k, i, i] += missing * share[i] * share[i]

    # Back

    cdef void turn_back(self, Py_ssize_t k, bint is_last, Row* a) noexcept nogil:
        """
        Write A of chi_k = A chi_{k+1} - c e / S, of the costates before two samples (D 25).

        Of the last row it goes on from the costate behind its sample.
        """
        cdef int i, j
        cdef double total
        for i in range(self.n):
            for j in range(self.n):
                a[j][i] = 1.0 if i == j else 0.0
                if not is_last:
                    a[j][i] = self.transition[k + 1, i, j]
        for j in range(self.n):
            total = 0.0
            for i in range(self.n):
                total += self.covariance[k, i, 0] * a[i][j]
            a[0][j] -= self.point[k].certainty * total

    cdef void go_back(
        self, Py_ssize_t last, Py_ssize_t stop, Py_ssize_t top, double* out
    ) noexcept nogil:
        """Go back from row `last` to row `stop` (D 25); write what is known of `stop` .. `top`."""
        cdef double costates[2][MOST_LEVELS]
        cdef double* costate = costates[0]
        cdef double* behind = costates[1]
        cdef Row known[MOST_LEVELS]  # X of D 34
        cdef Row a[MOST_LEVELS]
        cdef double total, size
        cdef Py_ssize_t k
        cdef int i, j
        memset(costate, 0, sizeof(Row))
        memset(known, 0, sizeof(known))
        for k in range(last, stop - 1, -1):
            total = 0.0
            for i in range(self.n):
                total += self.covariance[k, 0, i] * costate[i]
            costate[0] -= self.point[k].pull + self.point[k].certainty * total
            if self.tunes:
                self.turn_back(k, k == last, a)
                carry(self.n, a, known)
                known[0][0] += self.point[k].certainty
            if k <= top:
                self.write(k, costate, known, out + (k - stop) * (1 + self.tunes) * self.n)
            costate, behind = behind, costate
            size = 0.0
            for j in range(self.n):
                total = 0.0
                for i in range(self.n):
                    total += self.transition[k, i, j] * behind[i]
                costate[j] = total
                size += total + known[j][j]
            if not isfinite(size):  # nothing is known of what comes later
                memset(costate, 0, sizeof(Row))
                memset(known, 0, sizeof(known))

    cdef void write(
        self, Py_ssize_t k, const double* costate, const Row* known, double* out
    ) noexcept nogil:
        """
        Write the estimates of row k, and of a self-tuning observer the variances of their errors.

        If one of them is not finite they are the observer's own.
        """
        cdef double total, variance
        cdef bint finite = True
        cdef int i, j, m
        for i in range(self.n):
            total, variance = self.base[k, i] + self.deviation[k, i], self.covariance[k, i, i]
            for j in range(self.n):
                total -= self.covariance[k, i, j] * costate[j]
                for m in range(self.n if self.tunes else 0):
                    variance -= self.covariance[k, i, j] * known[j][m] * self.covariance[k, m, i]
            out[i] = total
            if self.tunes:
                out[self.n + i] = fmax(variance, ROUNDING * fabs(self.covariance[k, i, i]))
            finite = finite and isfinite(total) and isfinite(variance)
        for i in range(0 if finite else self.n):
            out[i] = self.base[k, i]
            if self.tunes:
                out[self.n + i] = self.own[k, i] * self.own[k, i] if i <= self.order else INFINITY

    cdef room(self, Py_ssize_t rows):
        """Return an array for the estimates of so many rows."""
        self.enter()
        return np.empty((rows, 1 + self.tunes, self.n))

    def smooth(self, Py_ssize_t end):
        """
        Return the estimates of the rows before `end` that wait, by all that is known.

        Returns
        -------
        (K, 1 or 2, N) array
            With the variances of their errors, for a self-tuning observer.

        """
        cdef double[:, :, ::1] out = self.room(max(end - self.done, 0))
        if end != self.done + out.shape[0] or end > self.count:
            raise ValueError(f'smooth: expected {self.done} to {self.count}, got {end}')
        if end > self.done:
            self.go_back(self.count - 1, self.done, end - 1, &out[0, 0, 0])
        self.done = end
        return np.asarray(out)

    def smooth_lagging(self, long long lag):
        """
        Return likewise those of the rows that became `lag` (ns) old with the last `append`.

        A row that begins makes all before it due: they will not be known better.
        """
        cdef double[:, :, ::1] out = self.room(self.count - self.done)
        cdef Py_ssize_t first = self.done, k, due, last
        for k in range(self.new, min(self.count, first + out.shape[0])):
            due, last = self.done, k
            if self.point[k].kind == BEGINS:
                due, last = k, k - 1
            while due <= last and self.point[k].time - self.point[due].time >= lag:
                due += 1
            if due > self.done:
                self.go_back(last, self.done, due - 1, &out[self.done - first, 0, 0])
                self.done = due
        self.new = self.count
        return np.asarray(out)[:self.done - first]

    def settled(self):
        """Return how many rows samples to come can change by `TOLERANCE` at most."""
        cdef Row influence[MOST_LEVELS]  # of what the filter has yet to learn, on the costate
        cdef Row a[MOST_LEVELS]
        cdef double total, largest
        cdef Py_ssize_t k
        cdef int i, j, m
        self.enter()
        memset(influence, 0, sizeof(influence))
        for i in range(self.n):
            if self.count > 0 and self.covariance[self.count - 1, i, i] > 0.0:
                influence[i][i] = 1.0 / sqrt(self.covariance[self.count - 1, i, i])
        for k in range(self.count - 1, self.done - 1, -1):
            self.turn_back(k, k == self.count - 1, a)
            multiply(self.n, a, influence)
            largest = 0.0
            for i in range(self.n):
                for m in range(self.n):
                    total = 0.0
                    for j in range(self.n):
                        total += self.covariance[k, i, j] * influence[j][m]
                    if total != 0.0:
                        total = fabs(total) / sqrt(fabs(self.covariance[k, i, i]))
                        largest = fmax(largest, total)
            if largest < TOLERANCE:
                return k + 1
        return self.done

    def innovations(self):
        """Return e and S of the samples that are remembered, for their likelihood."""
        points = self.columns['point'][:self.count]
        points = points[points['certainty'] > 0.0]
        return points['pull'] / points['certainty'], 1.0 / points['certainty']

    def __reduce__(self):
        self.enter()
        columns = {name: rows[:self.count].copy() for name, rows in self.columns.items()}
        numbers = self.done, self.began, self.new, self.memory.spread
        return Rows, (self.configuration,), (columns, *numbers)

    def __setstate__(self, state):
        columns, done, began, new, spread = state
        count = len(columns['point'])
        for name, rows in self.columns.items():
            if columns[name].shape != (count, *rows.shape[1:]):
                raise ValueError(f'smoothing: {name} of another size')
        last = columns['point']['last']
        if not (0 <= done <= count and new >= 0 and self.order <= last.min(initial=self.order)
                and last.max(initial=0) < self.n):
            raise ValueError('smoothing: numbers of rows or levels that can not be')
        self.look_at({name: np.array(rows) for name, rows in columns.items()})
        self.done, self.began, self.new, self.memory.spread = done, began, new, spread
        self.count = count


cdef double usual(const Point* now, int i, int j) noexcept nogil:
    """Return the covariance of the levels i and j before the last one, as ever in D 26."""
    cdef double share = now.intensity
    cdef int m
    for m in range(1, i + 1):  # (i + j)! / (i! j!)
        share *= (j + m) / <double>m
    return share / pow(2.0 * now.decay, i + j + 1)
