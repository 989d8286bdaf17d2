# SPDX-License-Identifier: Apache-2.0
"""
What is known of an arm: by its URDF, and what `calibrate` finds beyond that.

No other file knows Pinocchio.
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any, NamedTuple
from xml.etree import ElementTree

from fhaosmo_ros.core.parameters.declaration import shown
from fhaosmo_ros.core.parameters.errors import ConfigurationError
import numpy as np
from numpy.typing import ArrayLike, NDArray
import yaml

try:
    import pinocchio as pin
except ImportError:
    pin = None

Floats = NDArray[np.float64]
GRIPPER = 'finger', 'gripper', 'knuckle'
"""Joints with such a word in their name are left out if none are named."""
WIDTHS = 0.01, 0.03, 0.1, 0.3  # rad/s: how fast friction changes its sign, tanh(velocity / width)
USUAL = 9.81  # m/s^2, of gravity: how heavy an arm is, also where there is none
POSTURES = 200  # random ones over which the torque of the arm's weight is averaged


class Terms(NamedTuple):
    """The equation M(q) qdd + C(q, qd) qd + g(q) = torque at one posture and velocity."""

    mass: Floats  # (n, n) M, kg m^2 (kg for a prismatic joint)
    turning: Floats  # (n,) C^T qd, N m: drives p = M qd beside torque and gravity
    gravity: Floats  # (n,) g, N m


class ArmModel:
    """
    Rigid-body terms of an arm with a fixed base, from its URDF.

    Parameters
    ----------
    urdf : str
        XML text.
    joints : sequence of str, optional
        Names of the joints that are estimated; others rest at zero. By default all that move but
        mimic joints and those of a gripper (a name with finger, gripper or knuckle in it).
    gravity : (3,) array
        In the base's frame, m/s^2.

    Attributes
    ----------
    joints, links : tuple of str
        In the model's order; a link for each joint.
    continuous : (n,) array of bool
        Joints whose angle has no end.
    lowest, highest, velocity_limits, effort_limits : (n,) array
        Limits of the URDF, rad and rad/s; m and m/s for a prismatic joint.
    inertial : (n, 10) array
        Of each link with its payload; `unloaded` without it.

    Raises
    ------
    ConfigurationError
        No Pinocchio, no URDF, a floating or planar joint, an unknown joint, a link without mass.

    """

    def __init__(
        self, urdf: str, *, joints: Sequence[str] = (), gravity: ArrayLike = (0.0, 0.0, -9.81)
    ) -> None:
        if pin is None:
            raise ConfigurationError(
                'arms need Pinocchio, which is not installed: pip install pin (rosdep: pinocchio)'
            )
        try:
            robot, whole = ElementTree.fromstring(urdf), pin.buildModelFromXML(urdf)
        except (ElementTree.ParseError, ValueError) as error:
            text = f'robot description: expected a URDF, got {urdf[:40]!r} ({error})'
            raise ConfigurationError(text) from None
        moving = dict(zip(list(whole.names)[1:], list(whole.joints)[1:], strict=True))
        mimics = [joint.get('name') for joint in robot.iterfind('joint[mimic]')]
        chosen = list(joints) or [
            name for name in moving
            if name not in mimics and not any(word in name.lower() for word in GRIPPER)
        ]  # fmt: skip
        if unknown := [name for name in chosen if name not in moving]:
            raise ConfigurationError(
                f'joints: expected some of {", ".join(moving) or "none"}, got {", ".join(unknown)}'
            )
        if not chosen:
            raise ConfigurationError(
                'robot description: expected a joint that moves and is no gripper, got '
                f'{", ".join(moving) or "none"} (parameter joints)'
            )
        for name, joint in moving.items():
            if joint.nv > 1:
                raise ConfigurationError(
                    f'joint {name}: expected a fixed base and joints that turn or slide along '
                    f'one axis, got one that moves in {joint.nv} directions'
                )
        # Pinocchio's reduced model would refuse a link that has the name of a joint.
        for joint in robot.iterfind('joint'):
            if joint.get('name') not in chosen:
                joint.set('type', 'fixed')
        reduced = ElementTree.tostring(robot, encoding='unicode')
        self._model = model = pin.buildModelFromXML(reduced)
        self._data, self._zero = model.createData(), pin.neutral(model)
        self.gravity = model.gravity.linear = np.array(gravity, dtype=np.float64)
        self.joints = tuple(model.names[1:])
        bodies = [f for f in model.frames if f.type == pin.FrameType.BODY]
        first = {f.parentJoint: str(f.name) for f in reversed(bodies)}
        self.links = tuple(first[k] for k in range(1, model.njoints))
        self.continuous = np.array([size == 2 for size in list(model.nqs)[1:]])
        self._turns = bool(self.continuous.any())
        # A URDF that says nothing of a limit, or zero, means none.
        at = np.array(model.idx_qs[1:])
        lowest, highest = model.lowerPositionLimit[at], model.upperPositionLimit[at]
        ends = ~self.continuous & (lowest < highest)
        self.lowest, self.highest = np.where(ends, [lowest, highest], [[-np.inf], [np.inf]])
        limits = np.array([model.velocityLimit, model.effortLimit])
        self.velocity_limits, self.effort_limits = np.where(limits > 0.0, limits, np.inf)
        self.set_inertial([own.toDynamicParameters() for own in model.inertias[1:]])

    def set_inertial(self, inertial: ArrayLike, motor_inertia: ArrayLike = 0.0) -> None:
        """
        Take other inertial parameters (n, 10), without payload; raise as `set_payload`.

        `motor_inertia` (n,) is that of rotors as joints see it, kg m^2, and part of `Terms.mass`.
        """
        self._model.armature = np.broadcast_to(motor_inertia, len(self.joints))
        self.unloaded = np.array(inertial, dtype=np.float64)
        self.set_payload(np.zeros(4))

    def set_payload(self, payload: ArrayLike) -> None:
        """
        Carry another payload (4,) from now on: a point's mass (kg) and place (m, as to its joint).

        Raise ConfigurationError for a link that, with what it carries, has no mass.
        """
        self.inertial = self.unloaded.copy()
        self.inertial[-1] += self.inertial_of(payload)
        self._even = np.zeros((len(self.inertial), 6, 6))
        for k, (values, link) in enumerate(zip(self.inertial, self.links, strict=True)):
            if not values[0] > 0.0:
                raise ConfigurationError(f'link {link}: expected a mass > 0, got {values[0]:g}')
            own = self._model.inertias[k + 1] = pin.Inertia.FromDynamicParameters(values)
            # A force of any direction at the place r from the centre has the moment r x force.
            # Over places spread as the mass is, each component has 2/3 of their mean square
            # distance, which is half the trace of the inertia over the mass. So J^T J of a link is
            # that of its centre, weighted by 1 kg with an inertia of that mean square.
            square = max(np.trace(own.inertia), 0.0) / (3.0 * own.mass)
            self._even[k] = pin.Inertia(1.0, own.lever, square * np.eye(3)).matrix()
        rest = np.zeros(len(self.joints))
        mass = self.terms(rest, rest).mass
        if not np.all(np.linalg.eigvalsh(mass) > 0.0):
            raise ConfigurationError(
                'robot description: expected links with mass and inertia, got a mass matrix that '
                f'is not positive (diagonal {np.array2string(np.diag(mass), precision=3)})'
            )

    def inertial_of(self, payload: ArrayLike) -> Floats:
        """Return the ten inertial parameters of a payload, about the last joint."""
        mass, *center = np.asarray(payload, dtype=np.float64)
        point = pin.Inertia(mass, np.array(center), np.zeros((3, 3)))
        return np.asarray(point.toDynamicParameters())

    def _at(self, q: Floats) -> tuple[Any, Any, Floats]:
        """Return what Pinocchio takes first; q has cosine and sine of a continuous joint."""
        configuration = pin.integrate(self._model, self._zero, q) if self._turns else q
        return self._model, self._data, configuration

    def terms(self, q: Floats, velocity: Floats) -> Terms:
        """Return the terms at q (n,) and its velocity (n,)."""
        at = self._at(q)
        turning = velocity.dot(pin.computeCoriolisMatrix(*at, velocity))
        gravity = pin.computeGeneralizedGravity(*at).copy()
        return Terms(pin.crba(*at).copy(), turning, gravity)

    def velocity_of(self, momentum: Floats) -> Floats:
        """Return M^-1 p of p (n,), at the posture of the latest `terms`."""
        pin.cholesky.decompose(self._model, self._data)
        return np.asarray(pin.cholesky.solve(self._model, self._data, momentum))

    def reach_of_links(self, q: Floats) -> Floats:
        """Return J^T J of each link, the mean over the places of its mass, (n, n, n), m^2."""
        pin.computeJointJacobians(*self._at(q))
        local, n = pin.ReferenceFrame.LOCAL, len(q)
        jacobians = np.array(
            [pin.getJointJacobian(self._model, self._data, k + 1, local) for k in range(n)]
        ).reshape(n, 6, n)  # of one joint Pinocchio has (6,)
        return np.asarray(jacobians.transpose(0, 2, 1) @ self._even @ jacobians)

    def gravity_columns(self, q: Floats) -> Floats:
        """Return the matrix (n, 3) whose product with a vector of gravity is g(q)."""
        center = pin.jacobianCenterOfMass(*self._at(q))
        return np.asarray(-np.sum(self.inertial[:, 0]) * center.reshape(3, -1).T)

    def frame_jacobian(self, q: Floats, frame: str) -> Floats:
        """Return the Jacobian (6, n) at a frame's origin; raise ConfigurationError without it."""
        model, link = self._model, pin.FrameType.BODY
        if not model.existFrame(frame, link):
            known = [f.name for f in model.frames if f.type == link]
            raise ConfigurationError(f'frame: expected one of {", ".join(known)}, got {frame!r}')
        at = *self._at(q), model.getFrameId(frame, link), pin.ReferenceFrame.LOCAL
        return np.asarray(pin.computeFrameJacobian(*at).reshape(6, -1))

    def regressor(self, q: Floats, velocity: Floats, acceleration: Floats) -> Floats:
        """Return the matrix (n, 10 n) whose product with `inertial`, as one row, is the torque."""
        regressor = pin.computeJointTorqueRegressor(*self._at(q), velocity, acceleration)
        return np.array(regressor.reshape(len(q), -1))

    def pseudo_inertias(self) -> Floats:
        """Return the pseudo-inertia for a unit of each of the ten parameters, (4, 4, 10)."""
        of = pin.PseudoInertia.FromDynamicParameters
        return np.stack([of(unit).toMatrix() for unit in np.eye(10)], axis=-1)

    def torque_of_weight(self) -> Floats:
        """
        Return the torque by which the arm's own weight would act in any direction, (n,), N m.

        The root mean square over random postures of sum_l (m_l g)^2 J_l^T J_l / 3. It says how
        large torques of this arm are, whatever its joints' axes.
        """
        random = np.random.default_rng(0)
        weight = self.inertial[:, 0] * USUAL
        postures = random.uniform(-np.pi, np.pi, (POSTURES, len(weight)))
        reaches = np.array([self.reach_of_links(q) for q in postures])
        squares = np.einsum('l,pljj->pj', weight**2, reaches) / 3.0
        return np.asarray(np.sqrt(np.mean(squares, axis=0)))

    @property
    def weight(self) -> float:
        """Of all that moves, N."""
        return float(np.sum(self.inertial[:, 0]) * USUAL)


@dataclass(frozen=True)
class Calibration:
    """What is known of an arm beyond its URDF; zeros where nothing is."""

    joints: tuple[str, ...]
    inertial: Floats  # (n, 10) of each link in Pinocchio's order, without payload
    motor_inertia: Floats  # (n,) of rotors, as joints see it, kg m^2
    offset: Floats  # (n,) of the measured torque, N m
    viscous: Floats  # (n,) friction for a velocity, N m s/rad
    coulomb: Floats  # (n, k) friction for tanh(velocity / width) with each of `WIDTHS`, N m
    torque_constants: Floats  # (n,) N m for one unit of effort
    position_noise: Floats  # (n,) as the parameter, which counts where this is 0
    torque_noise: Floats  # (n,) from sample to sample, N m; 0: not known
    model_error: Floats  # (n,) of the torque that is left unexplained, N m; 0: not known
    log_odds: float | Floats = 0.0  # of contact, once a minute in the free motion; 0: not known

    @classmethod
    def of_urdf(cls, model: ArmModel) -> 'Calibration':
        """Return that of an arm of which only the URDF is known."""
        none = np.zeros(len(model.joints))
        dry = np.zeros((len(none), len(WIDTHS)))
        return cls(
            model.joints, model.unloaded, none, none, none, dry, none + 1.0, none, none, none
        )

    def friction(self, velocity: Floats) -> Floats:
        """Return friction and offset at velocities (..., n), in N m."""
        dry = (self.coulomb * np.tanh(velocity[..., np.newaxis] / WIDTHS)).sum(axis=-1)
        return np.asarray(self.offset + self.viscous * velocity + dry)

    def dumps(self) -> str:
        """Return the text of the file."""
        values = {name: np.asarray(value).tolist() for name, value in asdict(self).items()}
        return yaml.safe_dump({'arm_calibration': values}, sort_keys=False, width=100)

    @classmethod
    def loads(cls, text: str) -> 'Calibration':
        """Return what a file says; raise ConfigurationError for one that is none, or not whole."""
        try:
            given = dict(yaml.safe_load(text)['arm_calibration'])
            joints = tuple(map(str, given.pop('joints')))
            arrays = {name: np.array(v, dtype=np.float64) for name, v in given.items()}
            found = cls(joints, **arrays)
        except (yaml.YAMLError, TypeError, KeyError, ValueError) as error:
            got = f'{text[:40]!r} ({" ".join(str(error).split())})'
            problem = f'calibration: expected a file of `calibrate`, got {got}'
            raise ConfigurationError(problem) from None
        n = len(joints)
        shapes = {'inertial': (n, 10), 'coulomb': (n, len(WIDTHS)), 'log_odds': ()}
        for name, array in arrays.items():
            shape = shapes.get(name, (n,))
            if array.shape != shape or not np.isfinite(array).all():
                text = f'expected finite numbers of shape {shape}, got {shown(array)}'
                raise ConfigurationError(f'calibration: {name}: {text}')
        return found
