# SPDX-License-Identifier: Apache-2.0
"""
Identification of an arm from a recording of free motion.

Linear regression of the filtered torque on Pinocchio's regressor (C. Atkeson, C. An, J.
Hollerbach, International Journal of Robotics Research 5(3), 1986, doi:10.1177/027836498600500306),
with friction, motor inertia and offset beside it; robust by Huber's weights, and drawn towards the
URDF, so that what the motion does not show stays as it is.
"""

from typing import NamedTuple

from fhaosmo_ros.core.arm.model import ArmModel, Calibration, Floats, WIDTHS
from fhaosmo_ros.core.parameters.errors import ConfigurationError
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import block_diag
from scipy.optimize import least_squares
from scipy.signal import butter, sosfiltfilt

CUTOFF = 8.0  # Hz: both sides are low-passed alike; arms move slower
QUICK = 40.0  # Hz: for the velocity by which friction changes its sign
ROWS = 100.0  # Hz, at most: rows of the regression
BLOCK, HELD_OUT = 2.0, 4  # s of a block of the recording; one in so many is held out
# How strongly parameters are drawn to the URDF: what is held out says which of these is best.
DRAWS = tuple(10.0**k for k in range(-4, 3))
HUBER, ROUNDS = 2.0, 6
SHARE = 0.3  # standard deviation of URDFs' masses and inertias, as a share of them
LEAST_ROWS, SHORTEST = 200, 10.0  # samples, and seconds, of the shortest recording
GAP = 0.2  # s without a sample, after which filters begin anew
LEVER = 0.1  # m: how far a link's centre may lie from where the URDF has it
FARTHEST = 2.0  # m: how far the centre of a payload may lie from the last joint, each way
# Of the search for links that can exist; their least pseudo-inertia, as a share.
SWEEPS, LEAST_SHARE = 500, 1e-3
STILL = 0.05  # rad/s: a joint that never moved faster has hardly moved
ONE_WAY = 0.05  # share of its moving time a joint has to move the other way, to tell its friction
# A torque constant is told where the URDF's torque explains so much of the effort that friction
# and rotor leave, and is no less than this share of the largest joint's.
TOLD, WEAK = 0.7, 0.01


class Identified(NamedTuple):
    """What was found; torques are low-passed, K rows."""

    calibration: Calibration
    before: Floats  # (n,) RMS of the held-out torque that the URDF alone leaves, N m
    after: Floats  # (n,) and that the calibrated model leaves
    notes: list[str]  # what the motion did not show
    t: Floats  # (K,) s
    torque: Floats  # (K, n) measured
    by_urdf: Floats  # (K, n)
    by_calibration: Floats  # (K, n)
    held_out: NDArray[np.bool_]  # (K,)


def noise_of(samples: Floats) -> Floats:
    """
    Return the standard deviation of white noise on each column, by third differences.

    Those above six times the 90 % quantile, of gaps and shocks, do not count, but the rare steps
    of a resting encoder do.
    """
    third = np.diff(samples, n=3, axis=0)
    bound = 6.0 * np.quantile(np.abs(third), 0.9, axis=0)
    kept = np.where(np.abs(third) <= np.maximum(bound, 1e-300), third, 0.0)
    return np.asarray(np.sqrt(np.mean(kept**2, axis=0) / 20.0))  # 20 = 1 + 9 + 9 + 1


def identify(
    model: ArmModel, t: Floats, q: Floats, effort: Floats, *, torque_constants: ArrayLike = 1.0
) -> Identified:
    """
    Find what the torque of an arm in free motion says about it, beyond the URDF of `model`.

    Takes increasing times t (K,) in s, positions q (K, n), efforts (K, n), and the torque for a
    unit of effort, a number or (n,); 0 where that is not known and has to be found. Raises
    ConfigurationError for a recording that is too short, or does not tell any such torque.
    """
    n = len(model.joints)
    problem = _Regression(model, t, q, effort, Calibration.of_urdf(model), torque_constants)
    before = problem.unexplained
    held = ((problem.t - problem.t[0]) // BLOCK).astype(int) % HELD_OUT == HELD_OUT - 1
    errors = [
        np.sum(((before - problem.columns @ problem.solve(~held, draw))[held] / problem.size) ** 2)
        for draw in DRAWS
    ]
    x = problem.solve(~held, DRAWS[int(np.argmin(errors))], possible=True)
    left = before - problem.columns @ x
    for name, v in zip(model.joints, problem.velocity.T, strict=True):
        ahead = v[np.abs(v) > STILL] > 0.0
        if not len(ahead):
            most = f'at most {np.abs(v).max():.2g} rad/s'
            note = f'{name} hardly moved ({most}): what is found of it is mostly the URDF'
            problem.notes.append(note)
        elif not ONE_WAY <= np.mean(ahead) <= 1.0 - ONE_WAY:
            note = f'{name} moved one way only: its friction cannot be told from its offset'
            problem.notes.append(note)
    motor_inertia, offset, viscous, *coulomb = x[10 * n :].reshape(-1, n)
    calibration = Calibration(
        model.joints, model.unloaded + x[: 10 * n].reshape(n, 10), motor_inertia, offset, viscous,
        np.column_stack(coulomb), problem.constants, np.maximum(noise_of(q), 1e-9),
        noise_of(effort) * np.abs(problem.constants), np.maximum(_rms(left[held]), 1e-9),
    )  # fmt: skip
    return Identified(
        calibration, _rms(before[held]), _rms(left[held]), problem.notes, problem.t,
        problem.torque, problem.torque - before, problem.torque - left, held,
    )  # fmt: skip


def payload_of_motion(
    model: ArmModel, t: Floats, q: Floats, effort: Floats, calibration: Calibration
) -> tuple[Floats, Floats, Floats]:
    """
    Return what the last link carries, and the RMS of the torque left without and with it, (n,).

    Everything else is taken from `calibration`, of the arm without payload.
    """
    problem = _Regression(model, t, q, effort, calibration, calibration.torque_constants)
    last = 10 * (len(model.joints) - 1)
    columns = problem.columns[..., last : last + 10]

    def missed(payload: Floats) -> Floats:
        return np.asarray(problem.unexplained - columns @ model.inertial_of(payload))

    place = np.full(3, FARTHEST)
    payload = least_squares(
        lambda payload: (missed(payload) / problem.size).ravel(), [0.1, 0.0, 0.0, 0.0],
        bounds=([0.0, *-place], [np.inf, *place]),
    ).x  # fmt: skip
    return payload, _rms(problem.unexplained), _rms(missed(payload))


class _Regression:
    """
    What is left unexplained of a torque, as a sum of columns; K rows, low-passed.

    Columns, by joint: changes of the ten inertial parameters, motor inertia, offset, viscous
    friction, and dry friction of each width. Positions, torques and friction are filtered alike,
    forwards and backwards. Friction changes within milliseconds where a joint turns round. So it
    is computed from a velocity that is hardly filtered, and then filtered as the torque is.
    """

    def __init__(
        self, model: ArmModel, t: Floats, q: Floats, effort: Floats, known: Calibration,
        torque_constants: ArrayLike,
    ) -> None:  # fmt: skip
        n, steps = len(model.joints), np.diff(t)
        parts = [
            part for part in np.split(np.arange(len(t)), np.flatnonzero(steps > GAP) + 1)
            if len(part) and np.ptp(t[part]) > BLOCK
        ]  # fmt: skip
        seconds = sum(np.ptp(t[part]) for part in parts)
        if len(t) < LEAST_ROWS or not np.all(steps > 0.0) or seconds < SHORTEST:
            raise ConfigurationError(
                f'recording: expected at least {SHORTEST:g} s of samples with increasing times, '
                f'in parts of {BLOCK:g} s without gaps, got {seconds:.3g} s in {len(t)} samples'
            )
        self._model = model
        period = float(np.median(steps))
        edge, every = int(0.5 / period), max(1, round(1.0 / (ROWS * period)))

        def low(array: Floats, cutoff: float) -> Floats:
            sos = butter(2, min(cutoff * period * 2.0, 0.5), output='sos')
            return np.asarray(sosfiltfilt(sos, array, axis=0))

        def filtered(part: NDArray[np.intp]) -> tuple[Floats, Floats]:
            even = np.arange(t[part[0]], t[part[-1]], period)
            turned = np.where(model.continuous, np.unwrap(q[part], axis=0), q[part])
            raw, torque = (
                np.column_stack([np.interp(even, t[part], column) for column in array.T])
                for array in (turned, effort[part])
            )
            quick = np.gradient(low(raw, QUICK), period, axis=0)
            rubbing = [low(np.tanh(quick / width), CUTOFF) for width in WIDTHS]
            smooth = low(raw, CUTOFF)
            velocity = np.gradient(smooth, period, axis=0)
            acceleration = np.gradient(velocity, period, axis=0)
            kept, one = slice(edge, len(even) - edge, every), np.ones_like(velocity)
            rows = smooth, low(torque, CUTOFF), acceleration, one, velocity, *rubbing
            return even[kept], np.array(rows)[:, kept]

        times, signals = zip(*map(filtered, parts), strict=True)
        self.t = np.concatenate(times)
        both = np.concatenate(signals, axis=1)
        smooth, effort, own = both[0], both[1], both[2:]
        acceleration, _, self.velocity = own[:3]
        if not np.any(np.abs(self.velocity) > STILL):
            raise ConfigurationError(
                f'recording: expected joints that move, got none faster than {STILL:g} rad/s'
            )
        regressors = np.array([
            model.regressor(*row) for row in zip(smooth, self.velocity, acceleration, strict=True)
        ])  # fmt: skip
        factors = np.array([known.motor_inertia, known.offset, known.viscous, *known.coulomb.T])
        by_model = regressors @ (known.inertial + model.inertial - model.unloaded).ravel()
        by_model += np.einsum('cj,ckj->kj', factors, own)
        self.notes: list[str] = []
        self.constants = np.array(np.broadcast_to(torque_constants, n), dtype=np.float64)
        if not self.constants.all():
            self._find_constants(by_model, effort, own)
        self.torque = effort * self.constants
        self.unexplained = self.torque - by_model
        of_joints = [np.eye(n) * column[:, np.newaxis] for column in own]
        self.columns = np.concatenate([regressors, *of_joints], axis=2)
        mass, spread = model.inertial[:, 0], np.abs(model.inertial[:, [4, 6, 9]]).max(axis=1)
        second = spread + mass * LEVER**2
        inertial = np.column_stack([mass, *[mass * LEVER] * 3, *[second] * 6])
        level = np.maximum(_rms(self.torque), 1e-9)
        fastest = np.maximum(np.abs(acceleration).max(axis=0), 1e-3)
        self._scale = np.concatenate([
            np.maximum(SHARE * inertial, 1e-9).ravel(), level / fastest, *[level] * (len(own) - 1)
        ])  # fmt: skip
        self.size = np.maximum(_rms(self.unexplained), 1e-9)

    def _find_constants(self, by_model: Floats, effort: Floats, own: Floats) -> None:
        """Find unknown torque constants by the URDF; what it does not tell is as of the others."""
        found, unknown = {}, np.flatnonzero(self.constants == 0.0)
        for j in unknown:
            # The effort is fitted by the torque, not the torque by the effort: what else is in the
            # effort would make the constant too small. Friction and rotor are taken from both.
            both, others = np.column_stack([by_model[:, j], effort[:, j]]), own[..., j].T
            x, y = (both - others @ np.linalg.lstsq(others, both, rcond=None)[0]).T
            explains = (x @ y) ** 2 > TOLD * (x @ x) * (y @ y)
            size = np.sqrt(x @ x / len(x))
            if x @ y > 0.0 and explains and size > WEAK * by_model.std(axis=0).max():
                found[j] = x @ x / (x @ y)
        if not found:
            raise ConfigurationError(
                'torque_constants: expected them as a parameter, because this motion does not '
                'tell the torque of a unit of effort, got none'
            )
        usual = float(np.median(list(found.values())))
        self.constants[unknown] = [found.get(j, usual) for j in unknown]
        self.notes += [
            f'{self._model.joints[j]}: the torque of a unit of effort cannot be told from this '
            f'motion; taken for {usual:.3g}, as of the other joints (parameter torque_constants)'
            for j in unknown if j not in found
        ]  # fmt: skip

    def solve(self, rows: NDArray[np.bool_], draw: float, possible: bool = False) -> Floats:
        """Return the columns' factors, drawn towards the URDF; of links that are `possible`."""
        a = (self.columns[rows] * self._scale).reshape(-1, len(self._scale))
        b, count = self.unexplained[rows], len(self.size)
        x, size = np.zeros(len(self._scale)), self.size
        for _ in range(ROUNDS):
            left = b - (a @ x).reshape(-1, count)
            size = np.maximum(1.4826 * np.median(np.abs(left), axis=0), 1e-3 * self.size)
            far = np.abs(left) / size
            weights = (np.minimum(1.0, HUBER / np.maximum(far, 1e-12)) ** 0.5 / size).ravel()
            weighted = a * weights[:, np.newaxis]
            normal = weighted.T @ weighted
            rounding = len(x) * np.finfo(np.float64).eps * np.trace(normal)
            normal.flat[:: len(x) + 1] += draw * len(b) * 1e-3 + rounding
            right = weighted.T @ (b.ravel() * weights)
            x = np.linalg.solve(normal, right)
        return np.asarray((self._possible(normal, right) if possible else x) * self._scale)

    def _possible(self, normal: Floats, right: Floats) -> Floats:
        """
        Return the best factors of links and rotors that can exist.

        A link can exist if its pseudo-inertia is positive (P. Wensing, S. Kim, J.-J. Slotine,
        IEEE Robotics and Automation Letters 3(1), 2018, doi:10.1109/LRA.2017.2729659), so that
        every mass matrix is. The alternating direction method of multipliers finds the least of
        x^T normal x / 2 - right^T x there.
        """
        n = len(self.size)
        links = self._model.unloaded
        unit = np.sqrt(np.maximum(links[:, :1], 1e-3)) * np.array([LEVER, LEVER, LEVER, 1.0])
        units = unit[:, :, np.newaxis] * unit[:, np.newaxis, :]
        shape = self._model.pseudo_inertias() / units[..., np.newaxis]
        of_links = block_diag(*shape.reshape(n, 16, 10)) * self._scale[: 10 * n]
        map_ = np.zeros((17 * n, len(right)))
        map_[:, : 11 * n] = block_diag(of_links, np.eye(n))
        start = np.concatenate([np.einsum('iabk,ik->iab', shape, links).ravel(), np.zeros(n)])
        # As stiff as the data in the middle between the directions it knows well and hardly.
        rate = float(np.sqrt(np.prod(np.linalg.eigvalsh(normal)[[0, -1]])))
        inverse = np.linalg.inv(normal + rate * map_.T @ map_)
        near, dual = start, np.zeros(len(start))
        for _ in range(SWEEPS):
            x = inverse @ (right + rate * map_.T @ (near - start - dual))
            there = start + map_ @ x + dual
            values, vectors = np.linalg.eigh(there[: 16 * n].reshape(n, 4, 4))
            clipped = vectors * np.maximum(values, LEAST_SHARE)[:, np.newaxis]
            clipped = clipped @ vectors.transpose(0, 2, 1)
            near = np.concatenate([clipped.ravel(), np.maximum(there[16 * n :], 0.0)])
            dual = there - near
        body, other = slice(0, 11 * n), slice(11 * n, None)
        x[body] = np.linalg.lstsq(map_[:, body], near - start, rcond=None)[0]
        coupled = normal[other, body] @ x[body]
        x[other] = np.linalg.solve(normal[other, other], right[other] - coupled)
        return np.asarray(x)


def _rms(values: Floats) -> Floats:
    return np.asarray(np.sqrt(np.mean(values**2, axis=0)))
