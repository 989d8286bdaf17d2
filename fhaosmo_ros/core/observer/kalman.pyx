# SPDX-License-Identifier: Apache-2.0
"""
The Kalman filter of a triangular model with a chain of integrators that makes d (D 17, D 20).

For the scheduled gains, the smoother and the identification of a recording. The self-tuning
observer has the same formulas with one more index (self_tuning/members.pyx).
"""

from libc.math cimport NAN, ceil, pow, sqrt
from libc.string cimport memcpy, memset

from fhaosmo_ros.core.model.prediction cimport MOST_LEVELS, Prediction

from contextlib import suppress
import math

from fhaosmo_ros.core.parameters.errors import ConfigurationError
import numpy as np

# Part of the time constant of the fastest motion that one step of a covariance may take, and the
# most steps of one prediction.
cdef double STEP = 0.5
cdef double MOST_STEPS = 100.0
# At the start states count as so many times larger than `state_sizes`, d as so much smaller than
# `unknown_input_size`: the start hardly depends on sizes of states that are too large, or on a
# size of d that is too small, but it does on the opposite.
STATES_DOUBT, INPUT_DOUBT = 5.0, 0.4
RATE = 1.0  # how fast d changes where `unknown_input_decay` is 0 (1/s)
DOUBLINGS = 60


cdef fill(Row* to, matrix):
    """Copy an (N, N) array; raise ValueError if N is more than `MOST_LEVELS`."""
    cdef const double[:, :] numbers = np.asarray(matrix, dtype=np.float64)
    cdef Py_ssize_t i, j, n = numbers.shape[0]
    if n > MOST_LEVELS or numbers.shape[1] != n:
        raise ValueError(f'expected at most {MOST_LEVELS} states, got {np.shape(matrix)}')
    for i in range(n):
        for j in range(n):
            to[i][j] = numbers[i, j]


cdef int sub_steps(double h, double fastest) noexcept nogil:
    """Return in how many steps a covariance goes over `h`."""
    cdef double count = ceil(h * fastest / STEP)
    return <int>min(count, MOST_STEPS) if count > 1.0 else 1  # also for NaN


cdef void multiply(int n, const Row* f, Row* p) noexcept nogil:
    """P <- F P, in place."""
    cdef int i, j, k
    cdef double column[MOST_LEVELS]
    cdef double total
    for j in range(n):
        for i in range(n):
            column[i] = p[i][j]
        for i in range(n):
            total = 0.0
            for k in range(n):
                total += f[i][k] * column[k]
            p[i][j] = total


cdef void carry(int n, const Row* f, Row* p) noexcept nogil:
    """P <- F P F', in place."""
    cdef int i, j, k
    cdef double line[MOST_LEVELS]
    cdef double total
    multiply(n, f, p)
    for i in range(n):
        memcpy(line, p[i], n * sizeof(double))
        for j in range(n):
            total = 0.0
            for k in range(n):
                total += line[k] * f[j][k]
            p[i][j] = total


cdef void add_drive(int last, double intensity, double h, Row* p) noexcept nogil:
    """P <- P + Q over `h`: white noise drives state `last` of a chain (Van Loan 1978)."""
    cdef double power[MOST_LEVELS]  # h^j / j!, j integrations before the last state
    cdef int i, j
    power[last] = 1.0
    for i in range(last, 0, -1):
        power[i - 1] = power[i] * h / (last + 1 - i)
    for i in range(last + 1):
        for j in range(last + 1):
            p[i][j] += intensity * h * power[i] * power[j] / (2 * last + 1 - i - j)


cdef void correct(int n, Row* p, double variance) noexcept nogil:
    """Take a sample y = x_1 + noise into P, in place, without a difference of large numbers."""
    cdef double s = p[0][0] + variance
    cdef int i, j
    for i in range(1, n):
        for j in range(i, n):
            p[i][j] -= p[0][i] * p[0][j] / s
            p[j][i] = p[i][j]
    for j in range(n):
        p[0][j] *= variance / s
        p[j][0] = p[0][j]


cdef class LinearModel:
    """
    A linear model x' = A x whose last state is driven by white noise of some intensity.

    `rates` is A, (N, N), in 1/s.
    """

    def __cinit__(self, rates, double intensity):
        fill(self.rates, rates)
        self.n, self.intensity = len(rates), intensity
        self.fastest = np.abs(np.linalg.eigvals(rates)).max()

    def __reduce__(self):
        rates = np.array(self.rates)[:self.n, :self.n].copy()
        return LinearModel, (rates, self.intensity)

    cdef void flow(self, double h, Row* f) noexcept nogil:
        """Write exp(A h), by the first N terms of its series."""
        cdef int i, j, order, n = self.n
        cdef double term[MOST_LEVELS]
        cdef double after[MOST_LEVELS]
        cdef int k
        for j in range(n):
            for i in range(n):
                f[i][j] = term[i] = 1.0 if i == j else 0.0
            for order in range(1, n + 1):
                for i in range(n):
                    after[i] = 0.0
                    for k in range(min(i + 2, n)):  # A is a lower Hessenberg matrix
                        after[i] += self.rates[i][k] * term[k]
                for i in range(n):
                    term[i] = after[i] * h / order
                    f[i][j] += term[i]

    cdef void predict(self, Row* p, double h) noexcept nogil:
        """P <- exp(A h) P exp(A h)' + Q, in place (D 20)."""
        cdef Row f[MOST_LEVELS]
        cdef int _, count = sub_steps(h, self.fastest)
        self.flow(h / count, f)
        for _ in range(count):
            carry(self.n, f, p)
            add_drive(self.n - 1, self.intensity, h / count, p)

    def transition(self, double h):
        """Return exp(A h) and Q over `h`, (N, N) each."""
        cdef Row f[MOST_LEVELS]
        cdef Row q[MOST_LEVELS]
        cdef int count = sub_steps(h, self.fastest), n = self.n
        memset(q, 0, sizeof(q))
        self.predict(q, h)
        self.flow(h / count, f)
        part = np.array(f)[:n, :n].copy()
        return np.linalg.matrix_power(part, count), np.array(q)[:n, :n].copy()


cdef double usual(int i, int j, double rate, double intensity) noexcept nogil:
    """Return the covariance of the levels i and j before the last one, as ever in D 17."""
    cdef int m
    for m in range(1, i + 1):  # (i + j)! / (i! j!)
        intensity *= (j + m) / <double>m
    return intensity / pow(2.0 * rate, i + j + 1)


def stationary(rate, derivatives, intensity):
    """Return the covariance of d and its derivatives, (k + 1, k + 1), as ever in D 17."""
    before = range(derivatives, -1, -1)
    return np.array([[usual(i, j, rate, intensity) for j in before] for i in before])


def matern(rate, derivatives):
    """Return the intensity of the white noise behind a Matern d of the RMS 1 (D 17)."""
    return 1.0 / usual(derivatives, derivatives, rate, 1.0)


class Uncertainty:
    """
    What the covariance of an observer follows from (D 20).

    `p` are parameters of the observer with noise_size > 0, `sizes` those of the n states.
    ConfigurationError: the model has no finite slope at rest.

    Attributes
    ----------
    linear : LinearModel
        The model with D 17, linearised at rest.
    variance : float
        Of the noise on y.
    fresh : (N, N) array
        Covariance of the errors of a fresh observer.

    """

    def __init__(self, model, p, sizes):
        n, k = model.order, p['unknown_input_derivatives']
        size, decay = p['unknown_input_size'], p['unknown_input_decay']
        levels = n + 1 + k
        jacobian = model.jacobian(np.zeros(n))
        if not np.isfinite(jacobian).all():
            raise ConfigurationError(
                "parameters 'noise_size', 'phi': expected a model whose slopes at z = 0 are "
                f'finite, or noise_size = 0, got {jacobian.tolist()}'
            )
        rates = np.eye(levels, k=1)
        rates[:n, :n] += jacobian
        rates[range(n, levels), range(n, levels)] = -decay
        rate = decay or RATE
        self.variance = p['noise_size'] ** 2
        self.linear = LinearModel(rates, size**2 * matern(rate, k))
        self.fresh = np.zeros((levels, levels))
        self.fresh[range(n), range(n)] = np.square(STATES_DOUBT * sizes)
        if p['start_from_measurement']:
            self.fresh[0, 0] = self.variance
        self.fresh[n:, n:] = INPUT_DOUBT**2 * stationary(rate, k, self.linear.intensity)

    def steady(self, period):
        """
        Return the covariance of the errors of the predictions once P has become steady.

        By the structure-preserving doubling algorithm (Chu, Fan, Lin and Wang 2004,
        doi:10.1080/00207170410001714988), in units in which the filter has a bandwidth of 1.
        Where there is none in floating-point numbers it raises ConfigurationError.
        """
        n, noise = len(self.fresh), math.sqrt(self.variance)
        steady = np.full((n, n), math.nan)
        with np.errstate(all='ignore'), suppress(ArithmeticError, np.linalg.LinAlgError):
            speed = (self.linear.intensity / (self.variance * period)) ** (0.5 / n)
            unit = noise * speed ** np.arange(n)
            phi, q = self.linear.transition(period)
            a = (phi * unit[None, :] / unit[:, None]).T
            g, h = np.diag(np.eye(n)[0]), q / np.outer(unit, unit)
            for _ in range(DOUBLINGS):
                shared = np.linalg.solve(np.eye(n) + g @ h, np.column_stack([a, g]))
                before = h
                g = g + a @ shared[:, n:] @ a.T
                h = h + a.T @ h @ shared[:, :n]
                a = a @ shared[:, :n]
                h = 0.5 * (h + h.T)
                if np.allclose(h, before, rtol=1e-12, atol=0.0):
                    break
            steady = h * np.outer(unit, unit)
        if not np.isfinite(steady).all() or not steady[0, 0] > 0.0:
            raise ConfigurationError(
                "parameters 'noise_size', 'unknown_input_size', 'unknown_input_decay', "
                "'correction_period', 'structure', 'phi': expected values for which there is a "
                'Kalman filter in floating-point numbers, or noise_size = 0, '
                f'got a noise of {noise:g} and an intensity of {self.linear.intensity:g}'
            )
        return steady


def innovations(Prediction prediction not None, samples, linear):
    """
    Run the filter of one model of d along a recorded y (D 30).

    States follow the model by Runge-Kutta steps, their covariance follows a linear model of one
    sampling period.

    Parameters
    ----------
    prediction : Prediction
        Of N states.
    samples
        With `h`, `y`, `periods`, `u`, `used`: see `Samples` of tools/tuning/identify.py.
    linear
        With `a`, `q`, `fresh` of shape (N, N): transition, added covariance of a period, and
        covariance where the filter begins; `variance` of the noise on y; `clip`:
        innovations of more standard deviations correct as so many (Huber 1964); `settled`:
        samples without a gap after which the covariance counts as steady.

    Returns
    -------
    (K,), (K,), (K, N) arrays
        Innovations and their variances, NaN where the filter begins; estimates.

    """
    cdef const double[::1] h = samples.h
    cdef const double[::1] y = samples.y
    cdef const double[:, ::1] u = samples.u
    cdef const long long[::1] periods = samples.periods
    cdef const unsigned char[::1] used = np.asarray(samples.used, dtype=np.uint8)
    cdef int n = prediction.n
    cdef Py_ssize_t k, count = y.shape[0]
    cdef double[::1] b = np.empty(count), s = np.empty(count)
    cdef double[:, ::1] x = np.empty((count, n))
    cdef double clip = linear.clip, noise = linear.variance
    cdef Row a[MOST_LEVELS]
    cdef Row q[MOST_LEVELS]
    cdef Row fresh[MOST_LEVELS]
    cdef Row p[MOST_LEVELS]
    cdef double gain[MOST_LEVELS]
    cdef double variance = 0.0, limit
    cdef long long since = 0, settled = linear.settled, _
    cdef int i, j
    if n > MOST_LEVELS or u.shape[1] < max(prediction.phi.inputs, 1) or not (
        h.shape[0] == u.shape[0] == periods.shape[0] == used.shape[0] == count
        and np.shape(linear.a) == np.shape(linear.q) == np.shape(linear.fresh) == (n, n)
    ):
        raise ValueError('innovations: arrays of sizes that do not fit')
    fill(a, linear.a)
    fill(q, linear.q)
    fill(fresh, linear.fresh)
    with nogil:
        for k in range(count):
            if periods[k] == 0:
                memcpy(p, fresh, sizeof(p))
                memset(prediction.x, 0, sizeof(prediction.x))
                prediction.z[0] = y[k]
                since, b[k], s[k] = 0, NAN, NAN
            else:
                prediction.over(h[k], &u[k, 0])
                if periods[k] > 1:
                    since = 0
                if since <= settled:
                    for _ in range(periods[k]):
                        carry(n, a, p)
                        for i in range(n):
                            for j in range(n):
                                p[i][j] += q[i][j]
                    variance = p[0][0] + noise
                    for i in range(n):
                        gain[i] = p[i][0] / variance
                    for i in range(n if used[k] else 0):
                        for j in range(n):
                            p[i][j] -= gain[i] * gain[j] * variance
                since = since + 1 if used[k] else 0
                b[k], s[k] = y[k] - prediction.z[0], variance
                limit = clip * sqrt(variance)
                for i in range(n if used[k] else 0):
                    prediction.z[i] += gain[i] * min(max(b[k], -limit), limit)
            for i in range(n):
                x[k, i] = prediction.z[i]
    return np.asarray(b), np.asarray(s), np.asarray(x)
