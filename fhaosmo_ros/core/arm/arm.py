# SPDX-License-Identifier: Apache-2.0
"""External torques of an arm, live: one update for node, replay and library."""

from collections import Counter, deque
from collections.abc import Mapping
from pathlib import Path
from threading import RLock
from typing import Any, NamedTuple

from fhaosmo_ros.core.arm.bank import Bank
from fhaosmo_ros.core.arm.doubts import Doubts
from fhaosmo_ros.core.arm.model import ArmModel, Calibration, Floats
from fhaosmo_ros.core.arm.samples import Samples
from fhaosmo_ros.core.parameters.arm import ARM_PARAMETERS
from fhaosmo_ros.core.parameters.declaration import Parameters
from fhaosmo_ros.core.parameters.errors import ConfigurationError
import numpy as np
from numpy.typing import ArrayLike

RATES = 0.15, 7.0, 30.0  # 1/s, at which contact begins and ends, and its intensity changes
ONSET = 0.05  # s of a contact's intensity by which its force may be there at once
SINCE = 0.005  # s for which positions do not show a contact that has begun; velocities do at once
DECAY = 1.5  # 1/s, of d in free motion: friction changes with the direction of motion
INTENSITIES = 0.012, 0.044, 0.16, 0.6  # of contact forces: arm's weight / root of a second
# Shares of the torque of the arm's weight, which counts at least so much of the largest.
TORQUE_NOISE, MODEL_ERROR, LEAST = 0.015, 0.015, 0.05
LEAST_FOUND = 0.1  # share of that noise of torques below which none is found
ODDS = 3.0  # their logarithm, above which contact is reported, if calibration says nothing
FURTHER = 0.5  # rad (m) beyond the URDF's limits, where positions are not believed
FASTER = 3.0  # times the URDF's velocity limit: a position that moved so fast is not believed
STRONGER = 100.0  # times the URDF's effort limit, or torque of the weight: no torque of this arm
STOPPING = 2.0  # times the same, by which no arm is stopped between two samples
DAMPING = 0.02  # m, singular value of a frame's Jacobian below which a force along it is damped
# s between two looks at the posture, and in contact at it and the link; and how much of what was
# known of the link still counts at the next one, since a contact may slide.
LOOK, LOOK_CLOSELY, KEEP = 0.05, 0.01, 0.96
ELSEWHERE = 0.02  # by so much forces on each link still count, however sure another link is
SLIDING = 0.01  # s: memory of the differences of positions that friction is computed from
ANEW = 'clock set back', 'restarts', 'jumped', 'diverged'
"""What makes the estimates begin anew."""


class ArmEstimate(NamedTuple):
    """What is estimated at a sample; of a run, with a row for each, NaN where it was not used."""

    stamp: Any  # int, of the sample, ns
    position: Floats  # (n,) rad; m for a prismatic joint
    velocity: Floats  # (n,) rad/s; m/s
    external_torque: Floats  # (n,) N m; N
    covariance: Floats  # (n, n) of external_torque
    log_odds: Any  # float, natural logarithm of the odds of contact
    contact: Any  # bool
    # str, likeliest by the samples of the contact, mostly of the last quarter of a second; also at
    # the first sample after it, else empty.
    link: Any

    @property
    def standard_deviation(self) -> Floats:
        """Of external_torque, (n,)."""
        return np.asarray(np.sqrt(np.diagonal(self.covariance, axis1=-2, axis2=-1)))


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
    parameters : Parameters
        All, with their present values.
    model : ArmModel
    calibration : Calibration
        What is known of this arm.
    torque_constants : (n,) array
        Joint torque for one unit of effort: those of the parameters, else of the calibration.
    counters : Counter
        Samples by what became of them.
    problem : str
        Which of these happened to the latest sample, if that was not used.
    doubts : Doubts
        Says which setting seems to be wrong. Unless that is `mild`, there is no estimate then.

    Raises
    ------
    ConfigurationError
        Bad parameters, or a robot that can't be used.

    """

    def __init__(
        self, urdf: str, parameters: Mapping[str, Any] | None = None, /, *,
        calibration: Calibration | None = None, **named: Any,
    ) -> None:  # fmt: skip
        p = self.parameters = ARM_PARAMETERS.complete(parameters, named)
        if len(p['gravity']) != 3:
            raise ARM_PARAMETERS['gravity'].error(p['gravity'], 'three numbers')
        chosen = [name for name in p['joints'] if name]
        self.model = model = ArmModel(urdf, joints=chosen, gravity=p['gravity'])
        self.joints, n = model.joints, len(model.joints)
        if calibration is None and p['calibration_file']:
            expected = "parameter 'calibration_file': expected a YAML file"
            calibration = Calibration.loads(text_of(p['calibration_file'], expected))
        self._calibrated, self._alone = calibration is not None, RLock()  # a second thread waits
        known = self.calibration = calibration or Calibration.of_urdf(model)
        if known.joints != model.joints:
            own, got = ', '.join(model.joints), ', '.join(known.joints)
            text = f'calibration: expected the joints {own} in this order, got {got}'
            raise ConfigurationError(text)
        model.set_inertial(known.inertial, known.motor_inertia)
        model.set_payload(payload_of(p))
        self._of_position = p['measurement'] == 'position'
        self._with_gravity = p['effort'] != 'gravity_compensated'
        self._delay = p['torque_delay']
        given = self._values('torque_constants')
        constants = self.torque_constants = np.where(given == 1.0, known.torque_constants, given)
        scale = model.torque_of_weight()
        scale = self._weight = np.maximum(scale, LEAST * np.max(scale))
        usual = [TORQUE_NOISE * scale, self._values('position_noise'), MODEL_ERROR * scale]
        found = np.array([known.torque_noise, known.position_noise, known.model_error])
        of_torque, of_position, error = np.where(found > 0.0, found, usual)
        self.doubts = Doubts(model, self._with_gravity, error)
        # Of efforts, positions and velocities: at first, and at least.
        noise = np.array([of_torque, of_position, self._values('velocity_noise')])
        least = noise * [[LEAST_FOUND], [1.0], [1.0]]
        strong = np.fmax(np.where(model.effort_limits < np.inf, model.effort_limits, 0.0), scale)
        fastest = FASTER * model.velocity_limits
        limits = np.array([
            [-STRONGER * strong, model.lowest - FURTHER, -fastest],
            [STRONGER * strong, model.highest + FURTHER, fastest],
        ])  # fmt: skip
        self._samples = Samples(
            noise, least, limits, constants, STOPPING * strong, model.continuous, self._of_position
        )
        self._bank = Bank(
            2.0 * DECAY * error**2, DECAY, np.array(INTENSITIES) * model.weight, RATES,
            self._samples.variance, ONSET, SINCE if self._of_position else 0.0, self._of_position,
        )  # fmt: skip
        self._momentum, self._external = self._bank.mean[1:]  # written anew by each step
        self._rest, self._tare = np.zeros((2, n))
        self.counters: Counter[str] = Counter()
        self.problem = ''
        self.reset()
        self.adopt(p)

    def _values(self, name: str) -> Floats:
        """Return a parameter that has one value, or one for each joint."""
        given, n = self.parameters[name], len(self.joints)
        if len(given) not in (1, n):
            raise ARM_PARAMETERS[name].error(given, f'1 or {n} numbers')
        return np.broadcast_to(np.array(given), n)

    def reset(self) -> None:
        """Begin anew with the next sample."""
        with self._alone:
            self._samples.reset()
            self._forget()
            self.doubts.reset()

    def _forget(self) -> None:
        # Samples that wait for their torque: time (s), stamp, `h`, `vague` and `latest`. Then the
        # time of the latest sample and its torque.
        self._waiting: deque[tuple[float, int, float, float, Floats]] = deque()
        self._time, self._torque = 0.0, self._rest
        self._velocity: Floats | None = None  # estimated
        self._contact = False
        self._looked, self._evidence = 0, self._rest  # stamp, and log-likelihood of each link
        self._reach = np.zeros((len(self._rest), len(self._rest)))

    def adopt(self, parameters: Parameters) -> None:
        """Go on with other live parameters; raise ConfigurationError for a bad payload."""
        payload = payload_of(parameters)
        with self._alone:
            if payload != self.parameters['payload']:
                self.model.set_payload(payload)
                self.doubts.reset()
        self.parameters = ARM_PARAMETERS.complete(parameters)
        rare = np.log(parameters['false_alarms_per_minute'])
        self._threshold = (self.calibration.log_odds or ODDS) - rare

    def tare(self) -> None:
        """Take the present external torque for zero from now on."""
        with self._alone:
            now = self._external.copy()
            self._tare -= now
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
            None where there is none yet, or the sample was not used; `problem` says why.

        """
        with self._alone:
            samples, found = self._samples, None
            speed = self._rest if self._of_position else velocity
            problem = samples.take(stamp, effort, q, speed, self._velocity, self._momentum)
            self.problem = '' if problem == 'first' else problem
            if not problem:
                latest = samples.latest.copy()  # the next sample is written over it
                self._time += samples.h
                self._waiting.append((self._time, stamp, samples.h, samples.vague, latest))
                known = self._time - self._delay  # when the latest torque was measured
                while self._waiting and self._waiting[0][0] <= known and not self.problem:
                    time, at, h, vague, sample = self._waiting.popleft()
                    torque = latest[0]
                    if time < known:
                        torque = torque + (known - time) / samples.h * (self._torque - torque)
                    found = self._go_on(torque, at, h, vague, sample)
                self._torque = latest[0]
            if self.problem in ANEW:
                self._forget()
            if self.problem or found is not None:
                self.counters[self.problem or 'used'] += 1
            return found

    def _go_on(
        self, torque: Floats, stamp: int, h: float, vague: float, sample: Floats
    ) -> ArmEstimate | None:
        """Go on to a sample, `h` seconds after the one before; see `Samples`."""
        q, change = sample[1], sample[3] if self._of_position else sample[2]
        bank, samples, before = self._bank, self._samples, self._velocity
        if before is None or not self._of_position:
            known = self._sliding = change / h if self._of_position else change
            self._faster = self._rest
        else:
            known = before
            if self._calibrated:
                # A line: by their mean friction would turn round too late, which is a contact.
                keep, ahead = np.exp(-h / SLIDING), self._sliding + h * self._faster
                news = change / h - ahead
                self._sliding = ahead + (1.0 - keep**2) * news
                self._faster = self._faster + (1.0 - keep) ** 2 / h * news
        mass, turning, gravity = self.model.terms(q, known)
        drive = torque + turning
        drive -= self._tare
        if self._with_gravity:
            drive -= gravity
        if self._calibrated:
            # Of encoders alone, because the estimate M^-1 p would feed its own error of friction
            # back, worst at joints of little inertia. What they say is of half a sample ago.
            drive -= self.calibration.friction(self._sliding + 0.5 * h * self._faster)
        if before is None:
            bank.start(h, mass, change, drive, self._weight**2)
        else:
            bank.step(h, mass, change, vague, drive, self._reach)
        self._velocity = self.model.velocity_of(self._momentum)
        if not samples.is_possible(2, self._velocity):  # C^T qd grows with its square
            samples.reset()
            self.problem = 'diverged'
            return None
        self.doubts.take(h, q, torque, self._external)
        if self.doubts.text and not self.doubts.mild:
            self.problem = 'doubted'
            return None
        return self._estimate(stamp, q, self._velocity)

    def _estimate(self, stamp: int, q: Floats, velocity: Floats) -> ArmEstimate:
        """Return what the bank says, and the likeliest link by all that it said in a contact."""
        bank, touched = self._bank, self._contact
        odds, torques, covariance = bank.log_odds, self._external.copy(), bank.covariance.copy()
        self._contact = odds > (min(0.0, self._threshold) if touched else self._threshold)
        every = LOOK_CLOSELY if self._contact else LOOK
        if self._contact != touched or stamp - self._looked >= every * 1e9:
            self._looked = stamp
            reach, shares = self.model.reach_of_links(q), np.ones(len(q))
            if self._contact:
                # For each link how likely a force on it makes this torque, as a logarithm.
                size = torques @ torques / np.maximum(np.trace(reach, axis1=1, axis2=2), 1e-12)
                spread = covariance + size[:, np.newaxis, np.newaxis] * reach
                missed = np.linalg.solve(spread, torques[np.newaxis, :, np.newaxis])
                own = -0.5 * (np.linalg.slogdet(spread)[1] + missed[..., 0] @ torques)
                self._evidence = KEEP * self._evidence + own if touched else own
                likely = np.exp(self._evidence - np.max(self._evidence))
                shares = likely / np.sum(likely) + ELSEWHERE
            self._reach = np.asarray(shares @ reach.reshape(len(q), -1)).reshape(len(q), len(q))
        link = self.model.links[int(np.argmax(self._evidence))] if self._contact or touched else ''
        return ArmEstimate(stamp, q, velocity, torques, covariance, odds, self._contact, link)

    def run(
        self, t: ArrayLike, q: ArrayLike, effort: ArrayLike, velocity: ArrayLike | None = None
    ) -> ArmEstimate:
        """
        Estimate from arrays: t (K,) in s, q, effort and velocity (K, n).

        Raises
        ------
        ConfigurationError
            Arrays of other sizes.

        """
        stamps = np.round(np.asarray(t, dtype=np.float64) * 1e9).astype(np.int64)
        shape = len(stamps), len(self.joints)
        arrays = [np.asarray(a, dtype=np.float64) for a in (q, effort, velocity) if a is not None]
        for name, array in zip(('q', 'effort', 'velocity'), arrays, strict=False):
            if array.shape != shape:
                raise ConfigurationError(f'run: {name}: expected shape {shape}, got {array.shape}')
        none = np.full((shape[1], shape[1]), np.nan)
        unused = ArmEstimate(0, none[0], none[0], none[0], none, np.nan, False, '')
        found = [
            self.take(int(stamp), *row) or unused._replace(stamp=stamp)
            for stamp, *row in zip(stamps, *arrays, strict=True)
        ]
        *columns, links = ([getattr(e, name) for e in found] for name in ArmEstimate._fields)
        return ArmEstimate._make([*map(np.array, columns), links])

    def wrench(self, estimate: ArmEstimate, frame: str) -> tuple[Floats, bool]:
        """
        Return the wrench at the origin of a frame that would make the estimated torque.

        Damped least squares, weighted by the covariance of the torque.

        Returns
        -------
        (6,) array, bool
            Force in N and torque in N m along the frame's axes; True if part of them cannot be
            seen in this posture.

        Raises
        ------
        ConfigurationError
            An unknown frame.

        """
        jacobian = self.model.frame_jacobian(estimate.position, frame)
        weighted = np.linalg.solve(estimate.covariance, jacobian.T)  # (n, 6)
        values = np.linalg.svd(jacobian, compute_uv=False)
        prior = DAMPING**2 / np.mean(np.diag(estimate.covariance)) * np.eye(6)
        along = weighted.T @ estimate.external_torque
        found = np.linalg.solve(jacobian @ weighted + prior, along)
        return found, bool(len(values) < 6 or values[-1] < DAMPING)


def payload_of(p: Parameters) -> list[float]:
    """Return the payload that parameters say; raise for one that cannot be."""
    payload: list[float] = p['payload']
    if len(payload) != 4 or payload[0] < 0.0:
        raise ARM_PARAMETERS['payload'].error(payload, 'mass >= 0 and three coordinates')
    return payload


def text_of(path: str | Path, expected: str) -> str:
    """Return a file's text; raise ConfigurationError, with what is `expected`, without it."""
    try:
        return Path(path).expanduser().read_text(encoding='utf-8')
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigurationError(f'{expected}, got {path} ({error})') from None
