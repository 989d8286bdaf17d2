# SPDX-License-Identifier: Apache-2.0
"""
How far off the estimates may be, and the gains and the test of y that follow from it.

The covariance P of the errors follows the Kalman filter of the model, linearised at rest, with a
Matern model of d (D 17, D 20). It begins with the sizes of the states, of d and of the noise that
parameters tell. Equations are cited by their numbers in docs/mathematics.md (D).

The compiled functions work on P in the last rows of ``work.x``.
"""

from collections.abc import Mapping
import math
from typing import Any

from fhaosmo_ros.core.compiled.cache import compiled
from fhaosmo_ros.core.model.bytecode import evaluate, Floats
from fhaosmo_ros.core.model.integrate import NOW, POINT, SLOPE, TOTAL
from fhaosmo_ros.core.model.triangular import TriangularModel
from fhaosmo_ros.core.observer.arrays import (
    ALPHA,
    BEYOND,
    COVARIANCE,
    DRIFT,
    FASTEST,
    FIRST_MISS,
    GAMMA,
    HAT,
    HAT_SENSITIVITY,
    INTENSITY,
    INVERSE_WIDTH,
    JUMPS,
    LAMBDA,
    Law,
    LEVANT,
    MISS,
    NARROWED,
    NEXT_SIZE,
    OFFSET,
    ONE_SIDED,
    PREDICTING,
    PREDICTION_STEP,
    psi,
    SELF_TUNING,
    SETTLED,
    SIGN,
    SINGLE,
    SPREAD,
    State,
    STEADY,
    TILDE,
    TILDE_SENSITIVITY,
    VARIANCE,
    WATCHED,
    Work,
    Y,
)
from fhaosmo_ros.core.observer.prediction import predict
from fhaosmo_ros.core.parameters.errors import ConfigurationError
import numpy as np
from numpy.typing import NDArray

Matrix = NDArray[np.float64]
STEP = 0.5
"""Part of the time constant of the fastest motion that one step of the covariance may take."""
MOST_STEPS = 100
LONG = 8.0
"""Time constants of the steady Kalman filter after which its errors are steady."""
HUBER, LEAST_HUBER = 2.0, 1.0
"""Innovations of more standard deviations count as so many, at most and at least (D 32)."""
WITHIN = 0.9465
"""1 - beyond(HUBER): with that limit the gains are the tuned ones."""
NARROWING = 0.01
"""Standard deviations by which the limit follows one sample."""
ISOLATED = 20.0
"""More samples in a row beyond the limit on the same side are no outliers (D 32)."""
MEDIAN = 0.6745
"""Of |x| where x is normal with variance 1."""
SPREAD_RATE = 0.005
GATE = 6.0
"""Innovations of so many standard deviations are too unlikely to be used (D 21)."""
STATES_DOUBT, INPUT_DOUBT = 5.0, 0.4
"""
At the start states count as so many times larger than `state_sizes`, d as so much smaller than
`unknown_input_size`: the start hardly depends on sizes of states that are too large, or on a size
of d that is too small, but it does on the opposite.
"""
WATCH, REMEMBERED, MOST_DRIFT = 1000.0, 100.0, 35.0
"""
Samples after a jump of y in which prediction errors may not sum up, how many of them the sum
remembers, and the sum that is too much: five standard deviations of that of white noise (D 23).
"""
OF_SIZE, OF_DEVIATION = 0.25, 3.0
"""
A jump of y contradicts the model if it changes a Phi by more than this part of the size of z_{i+1}
or d; where they are known, by so many of their standard deviations.
"""
MUCH_SMALLER = 0.5
"""If a jump of y would make |z_{i+1}| or |d| so much smaller, y was wrong before it."""
NOISE_DOUBT, DOUBTED = 3.0, 2.0
"""
At the start the noise counts as so many times larger than `noise_size`; the logarithm of this
factor decays within so many time constants of the steady Kalman filter.
"""
LONG_AGO = 1e12
"""Seconds since the start where it does not matter when it was."""
DOUBLINGS = 60
BISECTIONS = 60
DECIDING = (
    'noise_size', 'unknown_input_size', 'unknown_input_rate', 'unknown_input_decay',
    'correction_period', 'structure', 'scheme', 'phi',
)  # fmt: skip
"""Parameters that decide whether there is a steady covariance."""


@compiled()
def predict_covariance(law: Law, work: Work, h: float) -> None:
    """P <- Phi P Phi' + Q over `h` (D 20), in place."""
    n = law.gains.shape[1]
    count = int(min(math.ceil(h * law.scalars[FASTEST] / STEP), MOST_STEPS))
    count = max(count, 1)
    h /= count
    p, power = work.x, work.stages[TOTAL]
    for _ in range(count):
        for j in range(n):  # columns, then rows
            _carry(law, work, h, j, True)
        for i in range(n):
            _carry(law, work, h, i, False)
        power[0, n - 1] = 1.0
        for i in range(n - 1, 0, -1):
            power[0, i - 1] = power[0, i] * h / (n - i)
        for i in range(n):  # white noise through a chain of integrators (Van Loan 1978)
            for j in range(n):
                q = power[0, i] * power[0, j] / (2 * n - 1 - i - j)
                p[COVARIANCE + i, j] += law.scalars[INTENSITY] * h * q


@compiled()
def _carry(law: Law, work: Work, h: float, k: int, column: bool) -> None:
    """Multiply a column (or row) of P by exp(A h), by the first N terms of its series."""
    n, p, x, term = law.gains.shape[1], work.x, work.stages[TOTAL], work.stages[SLOPE]
    for i in range(n):
        x[0, i] = p[COVARIANCE + i, k] if column else p[COVARIANCE + k, i]
        term[0, i] = x[0, i]
    for order in range(1, n + 1):
        for i in range(n):
            total = 0.0
            for j in range(min(i + 2, n)):  # A is a lower Hessenberg matrix
                total += law.chances[i, j] * term[0, j]
            term[1, i] = total * h / order
        for i in range(n):
            term[0, i] = term[1, i]
            x[0, i] += term[1, i]
    for i in range(n):
        if column:
            p[COVARIANCE + i, k] = x[0, i]
        else:
            p[COVARIANCE + k, i] = x[0, i]


@compiled()
def correct_covariance(law: Law, work: Work, doubt: float) -> None:
    """Take a sample into P (D 20), in place; its noise counts as `doubt` times as large."""
    n, p, variance = law.gains.shape[1], work.x, doubt * doubt * law.scalars[VARIANCE]
    s = p[COVARIANCE, 0] + variance
    for i in range(1, n):
        for j in range(i, n):
            p[COVARIANCE + i, j] -= p[COVARIANCE, i] * p[COVARIANCE, j] / s
            p[COVARIANCE + j, i] = p[COVARIANCE + i, j]
    for j in range(n):
        p[COVARIANCE, j] *= variance / s
        p[COVARIANCE + j, 0] = p[COVARIANCE, j]


@compiled(forceinline=True)
def doubt_of_noise(age: float, speed: float) -> float:
    """Return the factor of the noise at some time after the start (D 20)."""
    return float(NOISE_DOUBT ** math.exp(-age * speed / DOUBTED))


@compiled(forceinline=True)
def bandwidth(law: Law, h: float) -> float:
    """Return the rate (1/s) at which the Kalman filter for samples every `h` forgets."""
    ratio = law.scalars[INTENSITY] / (law.scalars[VARIANCE] * h)
    return float(ratio ** (0.5 / law.gains.shape[1]))


@compiled(forceinline=True)
def usual_innovation(memory: Floats, b: float, expected: float) -> float:
    """
    Return the size that innovations have: the expected one times the spread, which follows (D 21).

    The spread goes up by a small part of it where |b| is above its median if it were normal, and
    down by as much where |b| is below. So its size does not matter, and outliers hardly do.
    A sample that is too far off is counted in ``memory[BEYOND]``.
    """
    if abs(b) > MEDIAN * memory[SPREAD] * expected:
        memory[SPREAD] *= 1.0 + SPREAD_RATE
    else:
        memory[SPREAD] = max(memory[SPREAD] / (1.0 + SPREAD_RATE), 1.0)
    usual = float(memory[SPREAD] * expected)
    if abs(b) > GATE * usual:
        memory[BEYOND] += 1.0
        memory[MISS] = b
        if memory[BEYOND] == 1.0:
            memory[FIRST_MISS] = b
        return usual
    memory[BEYOND] = 0.0
    if memory[WATCHED] > 0.0:
        memory[WATCHED] -= 1.0
        memory[DRIFT] += b / usual - memory[DRIFT] / REMEMBERED
        if abs(memory[DRIFT]) > MOST_DRIFT:
            memory[BEYOND] = math.inf
    return usual


@compiled(forceinline=True)
def beyond(c: float) -> float:
    """Return the share of samples beyond c where c is Huber's minimax limit (D 32)."""
    q = math.sqrt(2.0 / math.pi) * math.exp(-0.5 * c * c) / c
    return q / (1.0 + q - math.erfc(c / math.sqrt(2.0)))


@compiled(forceinline=True)
def influence(memory: Floats, b: float, usual: float) -> float:
    """
    Return as how large an innovation counts (D 32), and let its limit follow the noise.

    Only the first of several in a row beyond the limit on one side tells of outliers.
    """
    c, far = HUBER - memory[NARROWED], 0.0
    if abs(b) <= c * usual:
        memory[ONE_SIDED] = memory[FIRST_MISS] = 0.0
    elif b * memory[ONE_SIDED] > 0.0:
        memory[ONE_SIDED] += math.copysign(1.0, b)
    else:
        memory[ONE_SIDED] = math.copysign(1.0, b)
        far = 1.0
    share = beyond(c)
    narrowed = memory[NARROWED] + NARROWING * (far - share * (1.0 - 0.5 * share))
    memory[NARROWED] = min(max(narrowed, 0.0), HUBER - LEAST_HUBER)
    if abs(memory[ONE_SIDED]) > ISOLATED:
        first = memory[FIRST_MISS]  # 0 if none was too far off
        if first * (2.0 * b - first) > 0.0:  # y is lost
            memory[BEYOND], memory[MISS] = max(memory[BEYOND], ISOLATED + 1.0), b
        return b
    return float(min(max(b, -c * usual), c * usual) * WITHIN / (1.0 - share))


@compiled()
def jump(law: Law, work: Work, state: State, u: Floats) -> bool:
    """
    Go on with a y that alone has jumped (D 23), in place.

    Returns
    -------
    bool
        False if that is not what happened: y differs from its prediction by no constant, or the
        model says that the plant is now elsewhere. Then nothing but `JUMPS` has changed.

    """
    levels, memory, x = state.levels, state.memory, work.x
    n, m = law.gains.shape[1], work.stages[POINT]
    b, s = memory[MISS], x[COVARIANCE, 0] + law.scalars[VARIANCE]
    small = GATE * memory[SPREAD] * math.sqrt(2.0 * s)
    if not (memory[BEYOND] < math.inf and abs(b - memory[FIRST_MISS]) <= small):
        memory[JUMPS] = 0.0
        return False
    offset, total = memory[OFFSET] + b, memory[JUMPS] + b
    is_back, contradicted, larger = abs(total) <= small, False, True
    for i in range(n):
        m[0, i], m[1, i] = x[HAT, i], 0.0
    for i in range(n):
        most = OF_SIZE * law.chances[SINGLE * n + NEXT_SIZE, i]
        if law.flags[SELF_TUNING]:
            most = OF_DEVIATION * math.sqrt(x[COVARIANCE, i + 1]) if i + 1 < n else math.inf
        m[0, 0] = x[HAT, 0]
        change = evaluate(law.model, i, m, u, work.stack)[0]
        m[0, 0] = x[HAT, 0] + offset
        change -= evaluate(law.model, i, m, u, work.stack)[0]
        if not abs(change) <= most:
            contradicted = True
            d = x[HAT, i + 1] if i + 1 < n else 0.0
            larger = larger and not abs(d + change) <= MUCH_SMALLER * abs(d)
    memory[JUMPS] = 0.0 if is_back else total
    if contradicted and not is_back:
        if not larger:
            return False
        memory[OFFSET] = offset
    elif contradicted and memory[OFFSET] == 0.0:
        return False
    else:
        memory[OFFSET] = 0.0
        levels[HAT, 0] += offset
        memory[Y] += offset
    if not law.flags[SELF_TUNING] and (law.flags[PREDICTING] or memory[SETTLED] <= 0.0):
        for i in range(n):
            for j in range(n):
                x[COVARIANCE + i, j] = levels[COVARIANCE + i, j]
                if memory[SETTLED] > 0.0:
                    x[COVARIANCE + i, j] = law.chances[STEADY * n + i, j]
        if memory[SETTLED] > 0.0:
            correct_covariance(law, work, 1.0)
        for i in range(n):
            x[COVARIANCE, i] = x[COVARIANCE + i, 0] = 0.0
        x[COVARIANCE, 0] = b * b
        for i in range(n):
            for j in range(n):
                levels[COVARIANCE + i, j] = x[COVARIANCE + i, j]
        if memory[SETTLED] > 0.0:
            memory[SETTLED] = -LONG_AGO
    memory[BEYOND] = memory[DRIFT] = memory[ONE_SIDED] = 0.0
    memory[WATCHED] = WATCH
    return True


@compiled()
def begin_estimates(
    law: Law, work: Work, memory: Floats, y: float, h: float, u: Floats
) -> tuple[float, float]:
    """
    Estimate by the Kalman filter itself until P is steady, for schemes with gains of other kinds.

    In place; see `levant.predict_correct`. Sensitivities rest.
    """
    x, n, stages = work.x, law.gains.shape[1], work.stages
    predict_covariance(law, work, h)
    speed = bandwidth(law, h)
    doubt = doubt_of_noise(-memory[SETTLED], speed)
    s = x[COVARIANCE, 0] + doubt * doubt * law.scalars[VARIANCE]
    for i in range(n):
        stages[NOW, 0, i], stages[NOW, 1, i] = x[HAT, i], 0.0
    predict(law, work, h, u, law.scalars[PREDICTION_STEP])
    b = y - stages[NOW, 0, 0]
    usual_innovation(memory, b, math.sqrt(s))
    if memory[BEYOND] > 0.0:
        return 0.0, 0.0
    for i in range(n):
        x[HAT, i] = stages[NOW, 0, i] + x[COVARIANCE, i] / s * b
        x[HAT_SENSITIVITY, i] = x[TILDE_SENSITIVITY, i] = 0.0
    for i in range(n - 1):
        x[TILDE, i] = x[HAT, i + 1]
    x[TILDE, n - 1] = 0.0
    correct_covariance(law, work, doubt)
    memory[SETTLED] -= h
    if -memory[SETTLED] * speed > LONG:
        hand_over(law, work, memory, u)
        memory[SETTLED] = 1.0
    return (1.0 - x[COVARIANCE, 0] / (doubt * doubt * law.scalars[VARIANCE])) * b * b, 0.0


@compiled()
def hand_over(law: Law, work: Work, memory: Floats, u: Floats) -> None:
    """
    Put the levels of a cascade where they would be if they had followed these estimates.

    Level i then has alpha_i psi_i(eps_i) = z_{i+1}', and its internal state lags by its injection.
    """
    x, m, n, gamma = work.x, work.stages[POINT], law.gains.shape[1], memory[GAMMA]
    if law.flags[LEVANT]:
        return
    for i in range(n):
        m[0, i], m[1, i] = x[HAT, i], 0.0
    for i in range(n):
        rate = 0.0
        if i + 1 < n:
            rate = evaluate(law.model, i + 1, m, u, work.stack)[0]
            if i + 2 < n:
                rate += m[0, i + 2]
        wanted = min(abs(rate) / law.gains[ALPHA, i], 1.0)
        low, high = 0.0, 1.0 / law.gains[INVERSE_WIDTH, i]
        if law.flags[SIGN]:
            high = 0.0
        for _ in range(BISECTIONS):
            middle = 0.5 * (low + high)
            if psi(law, i, middle)[0] < wanted:
                low = middle
            else:
                high = middle
        eps = math.copysign(high, rate)
        injection = law.gains[LAMBDA, i] * high**gamma * wanted if high > 0.0 else 0.0
        x[HAT, i] = (x[HAT, 0] if i == 0 else x[TILDE, i - 1]) - eps
        behind = m[0, i + 1] if i + 1 < n else 0.0
        x[TILDE, i] = behind - math.copysign(injection, rate)


@compiled()
def is_unlikely(law: Law, work: Work, memory: Floats, y: float, h: float, u: Floats) -> bool:
    """Return True if y is too far from one Euler step of the internal states (D 21)."""
    x, m = work.x, work.stages[POINT]
    m[0, 0], m[1, 0] = memory[Y], 0.0
    phi = evaluate(law.model, 0, m, u, work.stack)[0]
    eps, rate = memory[Y] - x[HAT, 0], x[TILDE, 0] + phi
    if law.flags[LEVANT]:
        b = y - x[HAT, 0] - h * rate
    else:  # the internal state lags by the injection of the first level
        if eps != 0.0:
            injection = law.gains[LAMBDA, 0] * abs(eps) ** memory[GAMMA] * psi(law, 0, abs(eps))[0]
            rate += math.copysign(injection, eps)
        b = y - memory[Y] - h * rate
    usual_innovation(memory, b, math.sqrt(x[COVARIANCE, 0] + law.scalars[VARIANCE]))
    return bool(memory[BEYOND] > 0.0)


class Uncertainty:
    """
    What the covariance recursion needs, from parameters.

    Parameters
    ----------
    model : TriangularModel
    p : mapping
        Parameters of the observer, with noise_size > 0.
    sizes : (n,) array
        Of the states.

    Attributes
    ----------
    rates : (N, N) array
        A of the model with D 17, linearised at rest.
    intensity : float
        Of the white noise that drives the last level.
    fresh : (N, N) array
        Covariance of the errors of a fresh observer.

    Raises
    ------
    ConfigurationError
        The model has no finite slope at rest.

    """

    def __init__(self, model: TriangularModel, p: Mapping[str, Any], sizes: Matrix) -> None:
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
        self.rates, self.order = rates, n
        rate = decay or p['unknown_input_rate']
        factor = (2.0 * rate) ** (2 * k + 1) * math.factorial(k) ** 2 / math.factorial(2 * k)
        self.variance, self.intensity = p['noise_size'] ** 2, size**2 * factor
        self.fresh = np.zeros((levels, levels))
        self.fresh[range(n), range(n)] = np.square(STATES_DOUBT * sizes)
        if p['start_from_measurement']:
            self.fresh[0, 0] = self.variance
        chain = np.eye(k + 1, k=1) - rate * np.eye(k + 1)
        self.fresh[n:, n:] = INPUT_DOUBT**2 * stationary(chain, self.intensity)

    @property
    def fastest(self) -> float:
        """The rate (1/s) of the model's fastest motion."""
        return float(np.abs(np.linalg.eigvals(self.rates)).max())

    def steady(self, period: float) -> Matrix:
        """
        Return the covariance of the errors of the predictions once P has become steady.

        By the structure-preserving doubling algorithm (Chu, Fan, Lin and Wang 2004,
        doi:10.1080/00207170410001714988), in units in which the filter has a bandwidth of 1.

        Raises
        ------
        ConfigurationError
            There is no such covariance in floating-point numbers.

        """
        try:
            with np.errstate(all='ignore'):
                h, unit = self._doubled(period)
        except (ArithmeticError, np.linalg.LinAlgError):
            h = unit = np.full((1, 1), math.nan)
        if not np.isfinite(h).all() or not h[0, 0] > 0.0:
            raise ConfigurationError(
                f'parameters {", ".join(map(repr, DECIDING))}: expected values for which there is '
                'a Kalman filter in floating-point numbers, or noise_size = 0, got a noise of '
                f'{math.sqrt(self.variance):g} and an intensity of {self.intensity:g}'
            )
        return np.asarray(h * np.outer(unit, unit))

    def _doubled(self, period: float) -> tuple[Matrix, Matrix]:
        """Return the covariance in the filter's own units, and the units."""
        n = len(self.rates)
        speed = (self.intensity / (self.variance * period)) ** (0.5 / n)
        unit = math.sqrt(self.variance) * speed ** np.arange(n)
        phi, q = transition(self.rates, self.intensity, period)
        a = (phi * unit[None, :] / unit[:, None]).T
        h = q / np.outer(unit, unit)
        g = np.zeros((n, n))
        g[0, 0] = 1.0
        for _ in range(DOUBLINGS):
            shared = np.linalg.solve(np.eye(n) + g @ h, np.column_stack([a, g]))
            before = h
            g = g + a @ shared[:, n:] @ a.T
            h = h + a.T @ h @ shared[:, :n]
            a = a @ shared[:, :n]
            h = 0.5 * (h + h.T)
            if np.allclose(h, before, rtol=1e-12, atol=0.0):
                break
        return h, unit


def stationary(chain: Matrix, intensity: float) -> Matrix:
    """Return the covariance of a chain whose last state is driven by white noise."""
    size = len(chain)
    drive = np.zeros((size, size))
    drive[-1, -1] = intensity
    eye = np.eye(size)
    whole = np.kron(chain, eye) + np.kron(eye, chain)
    return np.asarray(np.linalg.solve(whole, -drive.ravel()).reshape(size, size))


def transition(rates: Matrix, intensity: float, h: float) -> tuple[Matrix, Matrix]:
    """Return exp(A h) and Q, by the same series as the compiled recursion."""
    n = len(rates)
    fastest = float(np.abs(np.linalg.eigvals(rates)).max())
    count = max(math.ceil(min(h * fastest / STEP, MOST_STEPS)), 1)
    h /= count
    phi = term = np.eye(n)
    for order in range(1, n + 1):
        term = term @ rates * (h / order)
        phi = phi + term
    power = np.array([h ** (n - 1 - i) / math.factorial(n - 1 - i) for i in range(n)])
    places = np.arange(n)
    each = intensity * h * np.outer(power, power) / (2 * n - 1 - places[:, None] - places)
    whole, q = np.eye(n), np.zeros((n, n))
    for _ in range(count):
        q = phi @ q @ phi.T + each
        whole = phi @ whole
    return whole, q
