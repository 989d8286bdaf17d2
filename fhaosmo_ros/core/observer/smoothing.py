# SPDX-License-Identifier: Apache-2.0
"""
Estimates of the past from the samples before and after: a whole recording, or a fixed lag.

The observer runs forward as ever. About its estimates the model is linearised, with D 17 as the
model of d, and the smoothing problem of this linear model is solved (D 24, D 25): forward by the
Kalman filter of the deviation from the observer's estimates, backward by the recursion of Rauch,
Tung and Striebel in the form of Bierman, which inverts no matrix. For a nonlinear Phi this is one
Gauss-Newton step towards the most likely trajectory, begun at the observer's (Bell 1994). With a
self-tuning observer the noise and the model of d are those of its likeliest member at each sample
(D 34).

Rauch, Tung and Striebel 1965, doi:10.2514/3.3166; Bierman 1973, Int. J. Control 18 (1);
Bell 1994, doi:10.1137/0804035.
"""

from typing import NamedTuple

from fhaosmo_ros.core.compiled.cache import compiled
from fhaosmo_ros.core.compiled.unowned_arrays import unowned
from fhaosmo_ros.core.model.bytecode import Floats, Ints
from fhaosmo_ros.core.model.integrate import NOW
from fhaosmo_ros.core.observer.arrays import (
    DERIVATIVES,
    DRIVE,
    FRESH,
    FROM_MEASUREMENT,
    Law,
    LOSS,
    NOISE,
    PREDICTION_STEP,
    SPREAD,
    Work,
)
from fhaosmo_ros.core.observer.configuration import ObserverConfiguration
from fhaosmo_ros.core.observer.covariance import (
    HUBER,
    MOST_STEPS,
    STATES_DOUBT,
    STEP,
    Uncertainty,
    usual_innovation,
)
from fhaosmo_ros.core.observer.prediction import predict
from fhaosmo_ros.core.observer.self_tuning.members import by_binomials, ORDERS
from fhaosmo_ros.core.parameters.errors import ConfigurationError
import numpy as np

MEASURED, UNMEASURED, JUMPS, BEGINS = range(4)
"""
What a row is: a sample that was used, a time at which none was, the first used after a jump of y
alone (D 23), the first of a fresh start.
"""
TOLERANCE = 1e-9
"""What later samples may still change, in standard deviations of the filter's errors."""
SURER = 4.0
"""A model of d that ends has been wrong if it has so much smaller a variance than the observer."""
ROUNDING = 1e-12
"""No variance is less than this part of that of the prediction, from which it is subtracted."""


class Problem(NamedTuple):
    """
    What the smoother knows beside the law, from parameters.

    Attributes
    ----------
    variance, intensity, fastest : float
        Of the noise on y; of the white noise that drives the last level; of the model (1/s).
    decay : float
        kappa of D 26 (1/s), with d and its derivatives as in D 26 too; 0: the law has them all.
    last : int
        The level that white noise drives.
    fresh : (N, N) array
        Covariance of the errors of a fresh observer.
    first : (N,) array
        Its estimates.

    """

    variance: float
    intensity: float
    fastest: float
    decay: float
    last: int
    fresh: Floats
    first: Floats


class Rows(NamedTuple):
    """
    What the way back needs of each time: room for R of them.

    Attributes
    ----------
    base : (R, N) array
        The observer's estimates, about which the model is linearised.
    transition : (R, N, N) array
        F from the time before; 0 where a row begins, and of z_1 where y jumps.
    deviation, covariance : (R, N), (R, N, N) arrays
        Predicted from the rows before: of the state from the base, and P of its error.
    pull, certainty, noise : (R,) arrays
        e / S, 1 / S, and the variance that the sample is taken to have; 0 without a sample.
    decay, last : (R,) arrays
        Of the row's `Problem`, in whose terms its levels of d are.
    times, kinds : (R,) arrays
        In ns; `MEASURED`, `UNMEASURED`, `JUMPS` or `BEGINS`.

    """

    base: Floats
    transition: Floats
    deviation: Floats
    covariance: Floats
    pull: Floats
    certainty: Floats
    noise: Floats
    decay: Floats
    times: Ints
    kinds: Ints
    last: Ints

    @classmethod
    def empty(cls, room: int, levels: int) -> 'Rows':
        """Return room for so many rows."""
        matrix, integers = (room, levels, levels), np.zeros((3, room), dtype=np.int64)
        return cls(
            np.zeros((room, levels)), np.zeros(matrix), np.zeros((room, levels)),
            np.zeros(matrix), *np.zeros((4, room)), *integers,
        )  # fmt: skip


def make_problem(configuration: ObserverConfiguration) -> Problem:
    """
    Return what the smoother needs of a configuration.

    Raises
    ------
    ConfigurationError
        The parameters do not say how large noise and d are.

    """
    p, levels = configuration.parameters, configuration.levels
    first = configuration.initial_estimate.copy()
    if configuration.self_tuning:
        slopes = configuration.model.jacobian(np.zeros(configuration.model.order))
        fastest = np.abs(np.linalg.eigvals(np.nan_to_num(slopes, posinf=0.0, neginf=0.0))).max()
        return Problem(0.0, 0.0, float(fastest), 0.0, 0, np.zeros((levels, levels)), first)
    if not (p['noise_size'] > 0.0 and p['unknown_input']):
        raise ConfigurationError(
            "smoothing: expected 'noise_size' > 0 (standard deviation of the noise on y; `tune` "
            f"writes it) and 'unknown_input' = true, got {p['noise_size']:g} and "
            f'{str(p["unknown_input"]).lower()}'
        )
    its = Uncertainty(configuration.model, p, configuration.state_sizes)
    return Problem(its.variance, its.intensity, its.fastest, 0.0, levels - 1, its.fresh, first)


@compiled(forceinline=True)
def of_model(problem: Problem, model: Floats) -> Problem:
    """Return the problem with the noise and the model of d of a self-tuning observer (D 34)."""
    return Problem(
        model[NOISE], model[DRIVE], problem.fastest, model[LOSS],
        problem.fresh.shape[0] - ORDERS + int(model[DERIVATIVES]) % ORDERS, problem.fresh,
        problem.first,
    )  # fmt: skip


@compiled()
def doubt(law: Law, problem: Problem, estimates: Floats) -> None:
    """Write to `fresh` how far off a self-tuning observer with these estimates may be (D 34)."""
    fresh, n = problem.fresh, problem.fresh.shape[0]
    z, k = n - ORDERS, problem.last - n + ORDERS
    fresh[:] = 0.0
    fresh[0, 0] = problem.variance
    for i in range(1, z):
        size = max(law.chances[FRESH * n + i, i], estimates[i] * estimates[i])
        fresh[i, i] = STATES_DOUBT * STATES_DOUBT * size
    for i in range(k + 1):
        for j in range(k + 1):
            fresh[z + i, z + j] = usual(problem, k - i, k - j)


@compiled(forceinline=True)
def usual(problem: Problem, i: int, j: int) -> float:
    """Return the covariance of the levels i and j before the last one, as ever in D 26."""
    share = problem.intensity
    for m in range(1, i + 1):  # (i + j)! / (i! j!)
        share *= (j + m) / m
    return float(share / (2.0 * problem.decay) ** (i + j + 1))


@compiled()
def change_model(
    problem: Problem, rows: Rows, k: int, x: Floats, p: Floats, f: Floats, deviations: Floats
) -> None:
    """
    Express the levels of d of row k - 1 as the model of row k has them (D 34), in place.

    A level that the model before did not have is as large as ever; one that the model has not any
    more is 0. If it was far surer of z and d than the observer is now, it was wrong.
    """
    n, z = x.shape[0], x.shape[0] - ORDERS
    more = problem.decay - rows.decay[k - 1]
    for row in range(ORDERS - 1, 0, -1):  # (D + kappa + more)^j, by the binomial theorem
        share = 1.0
        for column in range(row - 1, -1, -1):
            share *= more * (column + 1) / (row - column)
            f[z + row, z + column] = share
            x[z + row] += share * x[z + column]
    for i in range(problem.last + 1, n):
        x[i] = 0.0
        f[i, :] = 0.0
    line = np.empty(n)
    multiply(f, p, line, False)
    multiply(f, p, line, True)
    for i in range(rows.last[k - 1] + 1, problem.last + 1):
        p[i, i] = max(p[i, i], usual(problem, problem.last - i, problem.last - i))
    for i in range(z + 1):
        variance = deviations[i] * deviations[i]
        if SURER * p[i, i] < variance < np.inf:
            p[i, i] = variance


@compiled()
def begin(law: Law, problem: Problem, rows: Rows, k: int, y: float) -> None:
    """Let nothing before row k matter: its estimate is that of a fresh observer."""
    n, tunes = rows.base.shape[1], problem.decay > 0.0
    if tunes:
        doubt(law, problem, rows.base[k])
    rows.pull[k] = rows.certainty[k] = rows.noise[k] = 0.0
    rows.kinds[k] = BEGINS
    for i in range(n):
        rows.deviation[k, i] = problem.first[i] - rows.base[k, i]
        for j in range(n):
            rows.transition[k, i, j] = 0.0
            rows.covariance[k, i, j] = problem.fresh[i, j]
    if law.flags[FROM_MEASUREMENT] or tunes:
        rows.deviation[k, 0] = y - rows.base[k, 0]


@compiled()
def jump_row(problem: Problem, rows: Rows, k: int, y: float) -> None:
    """Let nothing before row k matter to z_1, which is y: y alone has jumped (D 23)."""
    for i in range(rows.base.shape[1]):
        rows.transition[k, 0, i] = rows.covariance[k, 0, i] = rows.covariance[k, i, 0] = 0.0
    rows.covariance[k, 0, 0] = problem.variance
    rows.deviation[k, 0] = y - rows.base[k, 0]


@compiled()
def repeat(rows: Rows, k: int) -> None:
    """Make row k say what row k - 1 says after its sample: no time has passed."""
    n = rows.base.shape[1]
    filtered(rows, k - 1, rows.deviation[k], rows.covariance[k])
    rows.pull[k] = rows.certainty[k] = rows.noise[k] = 0.0
    rows.kinds[k], rows.times[k] = UNMEASURED, rows.times[k - 1]
    rows.decay[k], rows.last[k] = rows.decay[k - 1], rows.last[k - 1]
    for i in range(n):
        rows.base[k, i] = rows.base[k - 1, i]
        for j in range(n):
            rows.transition[k, i, j] = 1.0 if i == j else 0.0


@compiled()
def filtered(rows: Rows, k: int, deviation: Floats, p: Floats) -> None:
    """Write the deviation and its covariance after the sample of row k."""
    n, before, c = rows.base.shape[1], rows.covariance[k], rows.certainty[k]
    for i in range(n):
        deviation[i] = rows.deviation[k, i] + before[i, 0] * rows.pull[k]
        for j in range(n):
            if c > 0.0 and (i == 0 or j == 0):  # without a difference of large numbers
                p[i, j] = before[i, j] * c * rows.noise[k]
            else:
                p[i, j] = before[i, j] - before[i, 0] * before[0, j] * c


@compiled()
def predict_row(
    law: Law,
    work: Work,
    problem: Problem,
    rows: Rows,
    k: int,
    h: float,
    u: Floats,
    deviations: Floats,
    point: Floats,
) -> None:
    """
    Predict row k from row k - 1 (D 24): F, the deviation and P; leave the model's z in `point`.

    Parameters
    ----------
    deviations : (n + 1,) or (0,) array
        Of the observer's estimates of z and d.
    point : (4 + N, N) array
        Scratch memory: z in row 0, the deviation in row 1, a row of F or P, Q's powers, and F.

    """
    n, stages = rows.base.shape[1], work.stages
    p, f, x, power = rows.covariance[k], rows.transition[k], point[0], point[3]
    last = problem.last
    filtered(rows, k - 1, point[1], p)
    for i in range(n):
        x[i] = rows.base[k - 1, i]
        for j in range(n):
            f[i, j] = 1.0 if i == j else 0.0
    if problem.decay != rows.decay[k - 1] or last != rows.last[k - 1]:
        change_model(problem, rows, k, x, p, f, deviations)
    fastest = max(problem.fastest, problem.decay)
    count = max(int(min(np.ceil(h * fastest / STEP), MOST_STEPS)), 1)
    h /= count
    power[:] = 0.0
    power[last] = 1.0
    for i in range(last, 0, -1):
        power[i - 1] = power[i] * h / (last + 1 - i)
    slope, kappa = point[4:], problem.decay
    for _ in range(count):
        if kappa > 0.0:
            chain = x[n - ORDERS :].copy()
            by_binomials(x[n - ORDERS :], -kappa)
        for j in range(n):  # exact derivative of the Runge-Kutta steps along each state
            for i in range(n):
                stages[NOW, 0, i], stages[NOW, 1, i] = x[i], 1.0 if i == j else 0.0
            predict(law, work, h, u, law.scalars[PREDICTION_STEP])
            for i in range(n):
                slope[i, j] = stages[NOW, 1, i]
        for i in range(n):
            x[i] = stages[NOW, 0, i]
        if kappa > 0.0:
            x[n - ORDERS :] = chain
            follow_chain(slope, x, kappa, h)
        multiply(slope, f, point[2], False)
        multiply(slope, p, point[2], False)
        multiply(slope, p, point[2], True)
        for i in range(last + 1):
            for j in range(last + 1):
                q = power[i] * power[j] / (2 * last + 1 - i - j)
                p[i, j] += problem.intensity * h * q
    for i in range(n):
        total = x[i]
        for j in range(n):
            total += f[i, j] * point[1, j]
        rows.deviation[k, i] = total
        for j in range(i):
            p[i, j] = p[j, i] = 0.5 * (p[i, j] + p[j, i])


@compiled()
def follow_chain(slope: Floats, x: Floats, kappa: float, h: float) -> None:
    """Let d and its derivatives be those of D 26 in a step of a law that knows plain ones."""
    n, z, decayed = x.shape[0], x.shape[0] - ORDERS, np.exp(-kappa * h)
    for i in range(z):
        for last in range(n - 1, z, -1):  # D^j d by those of (D + kappa)^j d: binomials
            for j in range(last, n):
                slope[i, j - 1] -= kappa * slope[i, j]
    for i in range(z, n):
        slope[i, :] = 0.0
        slope[i, i] = decayed
        for j in range(i + 1, n):
            slope[i, j] = slope[i, j - 1] * h / (j - i)
        x[i] *= decayed
        for j in range(i + 1, n):
            x[i] += slope[i, j] * x[j]


@compiled(forceinline=True)
def multiply(a: Floats, b: Floats, line: Floats, right: bool) -> None:
    """Replace b by a b, or by b a'."""
    n = b.shape[0]
    for j in range(n):
        for i in range(n):
            line[i] = b[j, i] if right else b[i, j]
        for i in range(n):
            total = 0.0
            for k in range(n):
                total += a[i, k] * line[k]
            if right:
                b[j, i] = total
            else:
                b[i, j] = total


@compiled()
def take_rows(
    law: Law,
    work: Work,
    problem: Problem,
    rows: Rows,
    first: int,
    estimates: Floats,
    h: Floats,
    y: Floats,
    u: Floats,
    models: Floats,
    deviations: Floats,
    memory: Floats,
    point: Floats,
) -> None:
    """
    Go forward (D 24) through rows from `first` on, whose times and kinds are written already.

    Parameters
    ----------
    estimates : (K, N) array
        The observer's.
    h, y, u : (K,), (K,), (K, m) arrays
        Time (s) since the row before, sample, and known inputs meanwhile.
    models, deviations : (K, 4), (K, n + 1) or (K, 0) arrays
        `MODEL` of a self-tuning observer, and the standard deviations of its z and d.
    memory : (MEMORY,) array
        Remembers the size of the innovations (D 21).
    point : (4 + N, N) array
        Scratch memory.

    """
    law, work, rows, u = unowned(law), unowned(work), unowned(rows), unowned(u)
    n, tunes = rows.base.shape[1], models.shape[1] > 0
    for place in range(y.shape[0]):
        k, step = first + place, h[place]
        if tunes:
            problem = of_model(problem, models[place])
        for i in range(n):
            rows.base[k, i] = estimates[place, i]
        rows.decay[k], rows.last[k] = problem.decay, problem.last
        used = rows.kinds[k] == MEASURED or rows.kinds[k] == JUMPS
        if used and step <= 0.0 and rows.kinds[k - 1] != BEGINS:
            # The policy has withdrawn the sample before: its stamp was ahead.
            if rows.kinds[k - 1] == JUMPS:
                rows.kinds[k] = JUMPS
            repeat(rows, k - 1)
            step = (rows.times[k] - rows.times[k - 1]) * 1e-9
        if rows.kinds[k] == BEGINS:
            begin(law, problem, rows, k, y[place])
            memory[SPREAD] = 1.0
            continue
        if not step > 0.0:
            jumps = rows.kinds[k] == JUMPS
            repeat(rows, k)
            if jumps:
                jump_row(problem, rows, k, y[place])
            continue
        predict_row(law, work, problem, rows, k, step, u[place], deviations[place], point)
        if rows.kinds[k] == UNMEASURED:
            for i in range(n):
                rows.base[k, i] = point[0, i]
        for i in range(n):
            rows.deviation[k, i] -= rows.base[k, i]
        rows.pull[k] = rows.certainty[k] = rows.noise[k] = 0.0
        zero, e = 0.0, 0.0
        for i in range(n):
            zero += rows.deviation[k, i] - rows.deviation[k, i]
            zero += rows.covariance[k, i, i] - rows.covariance[k, i, i]
        s = rows.covariance[k, 0, 0] + problem.variance
        if zero != 0.0 or not s > 0.0:  # not finite: begin at the observer's estimate
            begin(law, problem, rows, k, estimates[place, 0])
            for i in range(n):
                rows.base[k, i] = estimates[place, i]
                rows.deviation[k, i] = 0.0
        elif rows.kinds[k] == JUMPS:
            jump_row(problem, rows, k, y[place])
        elif rows.kinds[k] == MEASURED:
            e = y[place] - rows.base[k, 0] - rows.deviation[k, 0]
            usual = usual_innovation(memory, e, np.sqrt(s))
            factor = max(abs(e) / (HUBER * usual), 1.0)
            if tunes and models[place, DERIVATIVES] < 0.0 and factor > 1.0:
                allow_jump(rows.covariance[k], rows.transition[k], e * e - s)
                factor = 1.0
            noise = problem.variance * factor
            rows.noise[k] = noise
            rows.certainty[k] = 1.0 / (rows.covariance[k, 0, 0] + noise)
            rows.pull[k] = e * rows.certainty[k]


@compiled()
def allow_jump(p: Floats, f: Floats, missing: float) -> None:
    """Raise the variance of the predicted y by `missing`: d has jumped meanwhile (D 34)."""
    n, z = p.shape[0], p.shape[0] - ORDERS
    for i in range(n):
        for j in range(n):
            p[i, j] += missing * f[i, z] / f[0, z] * (f[j, z] / f[0, z])
        if 0 < i <= z:  # when it has jumped is not known
            p[i, i] += missing * (f[i, z] / f[0, z]) ** 2


@compiled(forceinline=True)
def back(rows: Rows, k: int, costate: Floats) -> None:
    """Go from the costate behind the sample of row k to the one before it (D 25), in place."""
    total = rows.pull[k]
    for i in range(costate.shape[0]):
        total += rows.certainty[k] * rows.covariance[k, i, 0] * costate[i]
    costate[0] -= total


@compiled(forceinline=True)
def back_over(rows: Rows, k: int, costate: Floats, line: Floats) -> None:
    """Go from row k to row k - 1: multiply the costate by F' (D 25), in place."""
    n = costate.shape[0]
    for i in range(n):
        line[i] = costate[i]
    for j in range(n):
        total = 0.0
        for i in range(n):
            total += rows.transition[k, i, j] * line[i]
        costate[j] = total


@compiled()
def smooth_rows(rows: Rows, last: int, stop: int, top: int, out: Floats) -> None:
    """
    Go back from row `last` to row `stop` (D 25); write the estimates of rows `stop` .. `top`.

    Parameters
    ----------
    out : (top - stop + 1, 1 or 2, N) array
        Gets the estimates, and the variances of their errors where there is room for them.

    """
    rows, out = unowned(rows), unowned(out)
    n, sure = rows.base.shape[1], out.shape[1] > 1
    costate, line, known = np.zeros(n), np.zeros(n), np.zeros((n, n))
    for k in range(last, stop - 1, -1):
        p = rows.covariance[k]
        back(rows, k, costate)
        if sure:
            know_sample(rows, k, known, line)
        if k <= top:
            for i in range(n):
                total = rows.base[k, i] + rows.deviation[k, i]
                for j in range(n):
                    total -= p[i, j] * costate[j]
                out[k - stop, 0, i] = total
            for i in range(n if sure else 0):
                total = p[i, i]
                for j in range(n):
                    for m in range(n):
                        total -= p[i, j] * known[j, m] * p[m, i]
                out[k - stop, 1, i] = max(total, ROUNDING * abs(p[i, i]))
        back_over(rows, k, costate, line)
        if sure:
            for j in range(n):
                back_over(rows, k, known[:, j], line)
            for i in range(n):
                back_over(rows, k, known[i], line)


@compiled()
def know_sample(rows: Rows, k: int, known: Floats, line: Floats) -> None:
    """Add to the inverse covariance of the costate what the sample of row k tells (D 25)."""
    n, c, total = known.shape[0], rows.certainty[k], rows.certainty[k]
    for i in range(n):
        line[i] = 0.0
        for j in range(n):
            line[i] += c * known[i, j] * rows.covariance[k, j, 0]
    for i in range(n):
        total += c * rows.covariance[k, i, 0] * line[i]
    for i in range(n):
        known[0, i] -= line[i]
        known[i, 0] -= line[i]
    known[0, 0] += total


@compiled()
def settled_row(rows: Rows, last: int, first: int) -> int:
    """Return the last row that samples after row `last` can change by `TOLERANCE` at most."""
    rows = unowned(rows)
    n = rows.base.shape[1]
    influence, line = np.zeros((n, n)), np.zeros(n)
    for i in range(n):
        if rows.covariance[last, i, i] > 0.0:
            influence[i, i] = 1.0 / np.sqrt(rows.covariance[last, i, i])
    for k in range(last, first - 1, -1):
        largest = 0.0
        for m in range(n):
            back(rows, k, influence[m])
            influence[m, 0] += rows.pull[k]  # of the costate alone, not of this sample
            for i in range(n):
                total = 0.0
                for j in range(n):
                    total += rows.covariance[k, i, j] * influence[m, j]
                if total != 0.0:
                    largest = max(largest, abs(total) / np.sqrt(abs(rows.covariance[k, i, i])))
            back_over(rows, k, influence[m], line)
        if largest < TOLERANCE:
            return k
    return first - 1


@compiled()
def smooth_lagging(rows: Rows, new: int, count: int, done: int, lag: int, out: Floats) -> int:
    """
    Write the estimates of the rows that become `lag` (ns) old with rows new .. count - 1.

    A row that begins makes all before it due: they will not be known better.

    Parameters
    ----------
    done : int
        Rows that were due before.
    out : (count - done, 1 or 2, N) array
        As in `smooth_rows`.

    Returns
    -------
    int
        Rows that are due now.

    """
    before = done
    for k in range(new, count):
        due, last = done, k
        if rows.kinds[k] == BEGINS:
            due, last = k, k - 1
        while due <= last and rows.times[k] - rows.times[due] >= lag:
            due += 1
        if due > done:
            smooth_rows(rows, last, done, due - 1, out[done - before : due - before])
            done = due
    return done
