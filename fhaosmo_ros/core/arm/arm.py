# SPDX-License-Identifier: Apache-2.0
"""External torques of an arm, live: one update for node, replay and library."""

from collections import Counter, deque
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from fhaosmo_ros.core.arm.bank import Bank
from fhaosmo_ros.core.arm.calibration import Calibration
from fhaosmo_ros.core.arm.doubts import Doubts
from fhaosmo_ros.core.arm.model import ArmModel, Payload, Terms
from fhaosmo_ros.core.arm.samples import Clock, Limits, momentum_of, Noise
from fhaosmo_ros.core.parameters.arm import ARM_PARAMETERS
from fhaosmo_ros.core.parameters.declaration import Parameters
from fhaosmo_ros.core.parameters.errors import ConfigurationError
import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]
MAX_GAP = 0.1
"""Seconds without a sample, or back in time, after which the estimates begin anew."""
BEGIN, END, CHANGE = 0.15, 7.0, 30.0
"""Rates (1/s) at which contact begins and ends, and its intensity changes."""
ONSET = 0.05
"""Seconds of a contact's intensity by which its force may be there at once."""
SINCE = 0.005
"""Seconds for which positions do not show a contact that has begun; velocities do at once."""
DECAY = 1.5
"""Of d in free motion, 1/s: friction changes with the direction of motion."""
INTENSITIES = (0.012, 0.044, 0.16, 0.6)
"""Of contact forces, in the arm's weight over the root of a second."""
TORQUE_NOISE, MODEL_ERROR, LEAST = 0.015, 0.015, 0.05
"""Shares of the torque of the arm's weight, which counts at least so much of the largest."""
LEAST_FOUND = 0.1
"""Share of that noise of torques below which none is found."""
ODDS = 3.0
"""Logarithm of the odds above which contact is reported, if calibration says nothing."""
FURTHER = 0.5
"""rad (m) beyond the URDF's limits, where positions are not believed."""
FASTER = 3.0
"""Times the URDF's velocity limit: a position that has moved so fast is not believed."""
ENCODER = 10.0
"""Standard deviations by which the noise of positions may add to that, however near they are."""
STRONGER = 100.0
"""Times the URDF's effort limit, or the torque of the arm's weight: no torque of this arm."""
STOPPING = 2.0
"""Times the same, by which no arm is stopped between two samples."""
DAMPING = 0.02
"""Singular value of a frame's Jacobian, m, below which a force along it is damped."""
LOOK = 0.005
"""s between two estimates that count for the link: neighbours say nearly the same."""
SLIDING = 0.005
"""s: memory of the differences of positions that friction is computed from."""


@dataclass(frozen=True)
class ArmEstimate:
    """
    What is estimated at one sample.

    Attributes
    ----------
    stamp : int
        Of the sample, ns.
    position, velocity, external_torque : (n,) array
        rad, rad/s, N m; m, m/s, N for a prismatic joint.
    covariance : (n, n) array
        Of external_torque.
    log_odds : float
        Natural logarithm of the odds of contact.
    contact : bool
    link : str
        The likeliest one by all samples since the contact began, also at the first one after it;
        else empty.

    """

    stamp: int
    position: Floats
    velocity: Floats
    external_torque: Floats
    covariance: Floats
    log_odds: float
    contact: bool
    link: str

    @property
    def standard_deviation(self) -> Floats:
        """Of external_torque, (n,)."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))


class ArmEstimates(NamedTuple):
    """Estimates of a run: arrays with a row for each sample; NaN where a sample was not used."""

    velocity: Floats
    external_torque: Floats
    standard_deviation: Floats
    log_odds: Floats
    contact: NDArray[np.bool_]
    link: list[str]


class Wrench(NamedTuple):
    """Force (3,) in N and torque (3,) in N m along the axes of a frame, and how sure they are."""

    force: Floats
    torque: Floats
    covariance: Floats  # (6, 6)
    near_singular: bool  # part of it cannot be seen in this posture


class Arm:
    """
    Estimates the external torque at every joint of an arm, and whether something touches it.

    Parameters
    ----------
    urdf : str
        XML text.
    parameters : mapping, optional
        Values for the parameters of an arm; defaults for the rest.
    calibration : Calibration, optional
        Instead of the parameter calibration_file.
    **named
        Parameters as keyword arguments, which win.

    Attributes
    ----------
    model : ArmModel
    counters : Counter
        Samples by what became of them.
    doubts : Doubts
        Says which setting seems to be wrong. Unless it is a payload, there is no estimate then.

    Raises
    ------
    ConfigurationError
        Bad parameters, or a robot that can't be used.

    """

    def __init__(
        self,
        urdf: str,
        parameters: Mapping[str, Any] | None = None,
        /,
        *,
        calibration: Calibration | None = None,
        **named: Any,
    ) -> None:
        p = self._parameters = ARM_PARAMETERS.complete(parameters, named)
        if calibration is None and p['calibration_file']:
            calibration = _read(p['calibration_file'])
        chosen = [name for name in p['joints'] if name]
        if len(p['gravity']) != 3:
            raise ARM_PARAMETERS['gravity'].error(p['gravity'], 'three numbers')
        model = ArmModel(urdf, joints=chosen, gravity=p['gravity'])
        known = (calibration or Calibration.none(model.joints)).of(model.joints)
        own = known.inertial if len(known.inertial) else model.unloaded
        model.set_inertial(own, known.motor_inertia)
        self.model, self.joints, self._known = model, model.joints, known
        self._turns = bool(model.continuous.any())
        self._calibrated = calibration is not None
        self.set_payload(payload_of(p))
        self._of_position = p['measurement'] == 'position'
        spread = self._size('position_noise')
        size = spread if self._of_position else self._values('velocity_noise')
        self._noise = Noise(size, size, np.ones(len(size), dtype=bool))
        scale = model.torque_of_weight()
        scale = np.maximum(scale, LEAST * np.max(scale))
        told = self._size('torque_noise')
        size = np.where(told > 0.0, told, TORQUE_NOISE * scale)
        self._torques = Noise(size, LEAST_FOUND * size, told == 0.0)
        self._model_variance = self._size('model_error', MODEL_ERROR * scale) ** 2
        constants = self._values('torque_constants')
        self._constants = np.where(constants == 1.0, known.torque_constants, constants)
        scales = np.array(INTENSITIES) * model.weight
        free = 2.0 * DECAY * self._model_variance
        since = SINCE if self._of_position else 0.0
        self._bank = Bank(free, DECAY, scales, BEGIN, END, CHANGE, ONSET, since, self._of_position)
        finite = np.where(np.isfinite(model.effort_limits), model.effort_limits, 0.0)
        strong = np.maximum(finite, scale)
        self._limits = Limits(
            model.lowest - FURTHER, model.highest + FURTHER, FASTER * model.velocity_limits,
            STRONGER * strong, ENCODER * spread,
        )  # fmt: skip
        self._stopping = STOPPING * strong
        self._waiting: deque[tuple[int, Floats, Floats | None]] = deque()
        self.doubts = Doubts(
            model, p['effort'] != 'gravity_compensated', np.sqrt(self._model_variance)
        )
        self._tare = np.zeros(len(self.joints))
        self.counters: Counter[str] = Counter()
        self._clock = Clock()
        self.reset()

    def _values(self, name: str) -> Floats:
        """Return a parameter that has one value, or one for each joint."""
        given, n = self._parameters[name], len(self.joints)
        if len(given) not in (1, n):
            raise ARM_PARAMETERS[name].error(given, f'1 or {n} numbers')
        return np.broadcast_to(np.array(given), n).copy()

    def _size(self, name: str, otherwise: Floats | float = 0.0) -> Floats:
        """Return the size of a noise: by calibration, else by the parameter, else `otherwise`."""
        given, found = self._values(name), getattr(self._known, name)
        return np.where(found > 0.0, found, np.where(given > 0.0, given, otherwise))

    def reset(self) -> None:
        """Begin anew with the next sample."""
        self._last: tuple[int, Floats, Terms, Floats] | None = None
        self._started, self._velocity = False, np.zeros(len(self.joints))
        self._still, self._momentum = False, np.zeros(len(self.joints))
        self._contact, self._evidence = False, np.zeros(len(self.joints))
        self._looked = 0  # when evidence was taken
        self.doubts.reset()
        self._clock.reset()
        self._torques.reset()
        self._noise.reset()
        self._waiting.clear()

    @property
    def parameters(self) -> Parameters:
        """All parameters with their present values."""
        return self._parameters

    @property
    def threshold(self) -> float:
        """Logarithm of the odds above which contact is reported."""
        rare = np.log(self._parameters['false_alarms_per_minute'])
        return float((self._known.log_odds or ODDS) - rare)

    def adopt(self, parameters: Parameters) -> None:
        """Go on with other live parameters; raise ConfigurationError for a bad payload."""
        payload = payload_of(parameters)
        self._parameters = ARM_PARAMETERS.complete(parameters)
        self.set_payload(payload)

    def set_payload(self, payload: Payload) -> None:
        """Carry another payload from now on."""
        self.model.set_payload(payload)

    def tare(self) -> None:
        """Take the present external torque for zero from now on."""
        now = self._bank.mean[2].copy()
        self._tare += now
        self._bank.shift(now)

    def take(
        self, stamp: int, q: ArrayLike, effort: ArrayLike, velocity: ArrayLike | None = None
    ) -> ArmEstimate | None:
        """
        Go on by one sample.

        Parameters
        ----------
        stamp : int
            ns.
        q, effort : (n,) array
            In the order of `joints`.
        velocity : (n,) array, optional
            Needed if measurement is velocity.

        Returns
        -------
        ArmEstimate or None
            None where there is none yet, or the sample was not used; `counters` say why.

        """
        given = (q, effort) if self._of_position else (q, effort, velocity)
        try:
            arrays = [np.asarray(part, dtype=np.float64) for part in given]
        except (TypeError, ValueError):
            arrays = [np.empty(0)]  # no numbers
        if any(a.shape != self._constants.shape for a in arrays):
            self.counters['wrong size'] += 1
            return None
        torque = arrays[1] * self._constants
        wrong = self._limits.fault(arrays[0], torque, None if self._of_position else arrays[2])
        wrong = wrong or self._too_old(stamp)
        if wrong:
            self.counters[wrong] += 1
            return None
        delay = int(self._parameters['torque_delay'] * 1e9)
        if delay:
            found = self._at(stamp - delay, stamp, arrays)
            if found is None:
                return None
            stamp, arrays = stamp - delay, found
        return self._go_on(stamp, arrays[0], torque, None if self._of_position else arrays[-1])

    def _too_old(self, stamp: int) -> str:
        """Return why a stamp can't be used; nothing if it can. A clock set back begins anew."""
        newest = self._waiting[-1][0] if self._waiting else self._last[0] if self._last else None
        if newest is None or stamp > newest:
            return ''
        if stamp > newest - MAX_GAP * 1e9:
            return 'not newer'
        self.counters['clock set back'] += 1
        self.reset()
        return ''

    def _at(self, stamp: int, now: int, arrays: list[Floats]) -> list[Floats] | None:
        """Return the sample at an earlier time, between those that were kept."""
        kept = self._waiting
        kept.append((now, arrays[0], None if self._of_position else arrays[-1]))
        while len(kept) > 2 and kept[1][0] <= stamp:
            kept.popleft()
        if len(kept) < 2 or not kept[0][0] <= stamp <= kept[1][0]:
            return None
        (t0, q0, v0), (t1, q1, v1) = kept[0], kept[1]
        share = (stamp - t0) / (t1 - t0)
        found = [q0 + share * self._moved(q0, q1), arrays[1]]
        if v0 is not None and v1 is not None:
            found.append(v0 + share * (v1 - v0))
        return found

    def _moved(self, before: Floats, q: Floats) -> Floats:
        """Return q - before; of continuous joints the shorter way."""
        moved = q - before
        if not self._turns:
            return moved
        around = np.remainder(moved + np.pi, 2.0 * np.pi) - np.pi
        return np.where(self.model.continuous, around, moved)

    def _go_on(
        self, stamp: int, q: Floats, torque: Floats, velocity: Floats | None
    ) -> ArmEstimate | None:
        """Bring the bank to a sample that can be used."""
        if self._stands_still(stamp, q, velocity):
            self.counters['standing still'] += 1
            return None
        if self._last is not None and (stamp - self._last[0]) * 1e-9 > MAX_GAP:
            self.counters['restarts'] += 1
            self.reset()
        if self._last is None:
            rest = np.zeros(len(q)) if velocity is None else velocity
            self._last = stamp, q, *self._drive(q, rest, torque, rest)
            return None
        before, old, terms, drive = self._last
        moved = self._moved(old, q)
        h = self._clock.interval((stamp - before) * 1e-9, moved)
        if self._limits.jumped(moved, h):
            self.counters['jumped'] += 1
            self.reset()
            return None
        self._torques.take(torque)
        self._noise.take(q if velocity is None else velocity)
        if not self._started:
            speed = moved / h if velocity is None else velocity
            variance = 2.0 * self._noise.variance / (h * h if velocity is None else 1.0)
            spread = terms.mass * variance
            self._bank.start(terms.mass @ speed, spread @ terms.mass.T, self._model_variance)
            self._started = True
            self._velocity = self._sliding = speed
        if velocity is None:
            if self._calibrated:
                share = -np.expm1(-h / SLIDING)
                self._sliding = self._sliding + share * (moved / h - self._sliding)
            new, drives = self._drive(q, self._velocity, torque, self._sliding)
            # p times what is not known of the interval is noise, too.
            vague = self._clock.apart / h
            measured, noise = momentum_of(terms.mass, new.mass, moved, self._noise.variance, vague)
        else:
            new, drives = self._drive(q, velocity, torque, velocity)
            measured, noise = momentum_of(new.mass, new.mass, velocity, self._noise.variance, 0.0)
        drive += drives
        drive *= 0.5
        self._bank.step(h, measured, drive, noise, self._torques.variance, new.reach)
        self._last = stamp, q, new, drives
        self._momentum = measured / h if velocity is None else measured
        bank = self._bank
        self.doubts.take(h, q, torque, bank.mean[2])
        if self.doubts.text and not self.doubts.payload:
            self.counters['doubted'] += 1
            return None
        self.counters['used'] += 1
        odds, torques, covariance = bank.log_odds, bank.mean[2].copy(), bank.covariance.copy()
        touched = self._contact
        self._contact = odds > (0.0 if touched else self.threshold)
        if self._contact and not (touched and stamp - self._looked < LOOK * 1e9):
            own = self._likelihoods(torques, covariance, q)
            self._evidence = self._evidence + own if touched else own
            self._looked = stamp
        link = self.model.links[int(np.argmax(self._evidence))] if self._contact or touched else ''
        self._velocity = self.model.velocity_of(bank.mean[1])
        return ArmEstimate(
            stamp, q, self._velocity, torques, covariance, odds,
            self._contact, link,
        )  # fmt: skip

    def _stands_still(self, stamp: int, q: Floats, velocity: Floats | None) -> bool:
        """Return True if all joints stand at once, to the bit, though the arm was in motion."""
        if self._last is None:
            return False
        before, old, terms, _ = self._last
        momentum = self._momentum if velocity is None else terms.mass @ velocity
        most = self._stopping * (stamp - before) * 1e-9
        self._still = np.array_equal(q, old) and (
            self._still or bool(np.any(np.abs(momentum) > most))
        )
        return self._still

    def _drive(
        self, q: Floats, velocity: Floats, torque: Floats, sliding: Floats
    ) -> tuple[Terms, Floats]:
        """
        Return the terms, and u = torque - friction + C^T qd - g.

        Friction is that of the velocity `sliding`: of encoders alone, because the estimate M^-1 p
        would feed its own error of friction back, worst at joints of little inertia.
        """
        terms = self.model.terms(q, velocity)
        drive = terms.coriolis + torque
        drive += self._tare
        if self._calibrated:
            drive -= self._known.friction(sliding)
        if self._parameters['effort'] != 'gravity_compensated':
            drive -= terms.gravity
        return terms, drive

    def _likelihoods(self, torque: Floats, covariance: Floats, q: Floats) -> Floats:
        """Return for each link how likely a force on it makes this torque, as a logarithm."""
        reach = self.model.reach_of_links(q)
        size = torque @ torque / np.maximum(np.trace(reach, axis1=1, axis2=2), 1e-12)
        spread = covariance + size[:, np.newaxis, np.newaxis] * reach
        missed = np.linalg.solve(spread, np.tile(torque[:, np.newaxis], (len(size), 1, 1)))
        return np.asarray(-0.5 * (np.linalg.slogdet(spread)[1] + missed[..., 0] @ torque))

    def run(
        self, t: ArrayLike, q: ArrayLike, effort: ArrayLike, velocity: ArrayLike | None = None
    ) -> ArmEstimates:
        """
        Estimate from arrays: t (K,) in s, q, effort and velocity (K, n).

        Raises
        ------
        ConfigurationError
            Arrays of other sizes.

        """
        stamps = np.round(np.asarray(t, dtype=np.float64) * 1e9).astype(np.int64)
        q, effort = np.asarray(q, dtype=np.float64), np.asarray(effort, dtype=np.float64)
        k, n = len(stamps), len(self.joints)
        v = None if velocity is None else np.asarray(velocity, dtype=np.float64)
        for name, array in (('q', q), ('effort', effort), ('velocity', v)):
            if array is not None and array.shape != (k, n):
                raise ConfigurationError(
                    f'run: {name}: expected shape {(k, n)}, got {array.shape}'
                )
        velocities, torques, deviations = (np.full((k, n), np.nan) for _ in range(3))
        odds, contact, links = np.full(k, np.nan), np.zeros(k, dtype=bool), [''] * k
        for i in range(k):
            found = self.take(int(stamps[i]), q[i], effort[i], None if v is None else v[i])
            if found is not None:
                velocities[i], torques[i] = found.velocity, found.external_torque
                deviations[i], odds[i] = found.standard_deviation, found.log_odds
                contact[i], links[i] = found.contact, found.link
        return ArmEstimates(velocities, torques, deviations, odds, contact, links)

    def wrench(self, estimate: ArmEstimate, frame: str) -> Wrench:
        """
        Return the wrench at the origin of a frame that would make the estimated torque.

        Damped least squares, weighted by the covariance of the torque. Raises ConfigurationError
        for an unknown frame.
        """
        jacobian = self.model.frame_jacobian(estimate.position, frame)
        root = np.linalg.cholesky(estimate.covariance)
        weighted = np.linalg.solve(root, jacobian.T)  # (n, 6)
        values = np.linalg.svd(jacobian, compute_uv=False)
        prior = DAMPING**2 / np.mean(np.diag(estimate.covariance)) * np.eye(6)
        covariance = np.linalg.inv(weighted.T @ weighted + prior)
        found = covariance @ weighted.T @ np.linalg.solve(root, estimate.external_torque)
        near = len(values) < 6 or values[-1] < DAMPING
        return Wrench(found[:3], found[3:], covariance, bool(near))


def payload_of(p: Parameters) -> Payload:
    """Return the payload that parameters say; raise for one that cannot be."""
    if len(p['payload']) != 4 or p['payload'][0] < 0.0:
        raise ARM_PARAMETERS['payload'].error(p['payload'], 'mass >= 0 and three coordinates')
    mass, *center = p['payload']
    return Payload(mass, tuple(center))


def _read(path: str) -> Calibration:
    try:
        return Calibration.loads(Path(path).read_text(encoding='utf-8'))
    except OSError as error:
        raise ConfigurationError(
            f"parameter 'calibration_file': expected a file of `calibrate`, got {path} "
            f'({error.strerror})'
        ) from None
