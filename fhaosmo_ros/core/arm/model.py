# SPDX-License-Identifier: Apache-2.0
"""Rigid-body terms of an arm with a fixed base, by Pinocchio; the only file that knows it."""

from collections.abc import Sequence
from typing import Any, NamedTuple
from xml.etree import ElementTree

from fhaosmo_ros.core.parameters.errors import ConfigurationError
import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]
MOVING = ('revolute', 'continuous', 'prismatic')
"""Types of URDF joints that can be estimated."""
GRIPPER = ('finger', 'gripper', 'knuckle')
"""Joints with such a word in their name are left out if none are named."""
GRAVITY = (0.0, 0.0, -9.81)
POSTURES = 200
"""Random postures over which the torque of the arm's weight is averaged."""


class Payload(NamedTuple):
    """What the last link carries, as a point mass."""

    mass: float = 0.0  # kg
    center: tuple[float, float, float] = (0.0, 0.0, 0.0)  # m, in the frame of the last joint


class Terms(NamedTuple):
    """The equation M(q) qdd + C(q, qd) qd + g(q) = torque at one posture and velocity."""

    mass: Floats  # (n, n) M, kg m^2 (kg for a prismatic joint)
    coriolis: Floats  # (n,) C(q, qd)^T qd, N m: what drives p = M qd beside torque and gravity
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
    gravity : (3,) array

    Raises
    ------
    ConfigurationError
        No Pinocchio, no URDF, a floating or planar joint, an unknown joint, a link without mass.

    """

    def __init__(
        self, urdf: str, *, joints: Sequence[str] = (), gravity: ArrayLike = GRAVITY
    ) -> None:
        self._pin = pin = _pinocchio()
        moving = _moving_joints(urdf)
        chosen = list(joints) or [
            name for name, mimics in moving.items()
            if not mimics and not any(word in name.lower() for word in GRIPPER)
        ]  # fmt: skip
        if unknown := [name for name in chosen if name not in moving]:
            raise ConfigurationError(
                f'joints: expected some of {", ".join(moving) or "none"}, got {", ".join(unknown)}'
            )
        if not chosen:
            raise ConfigurationError('robot description: expected a joint that moves, got none')
        whole = pin.buildModelFromXML(urdf)
        others = [whole.getJointId(name) for name in whole.names[1:] if name not in chosen]
        self._model = model = pin.buildReducedModel(whole, others, pin.neutral(whole))
        self._data = model.createData()
        self.gravity = model.gravity.linear = np.array(gravity, dtype=np.float64)
        self.joints, n = tuple(model.names[1:]), model.nv
        bodies = [f for f in model.frames if f.type == pin.FrameType.BODY]
        first = {f.parentJoint: str(f.name) for f in reversed(bodies)}
        self.links = tuple(first.get(k, name) for k, name in enumerate(self.joints, 1))
        self.continuous = np.array([size == 2 for size in list(model.nqs)[1:]])
        self._zero = pin.neutral(model)
        # A URDF that says nothing of a limit, or zero, means none.
        at = np.array(model.idx_qs[1:])
        lowest, highest = model.lowerPositionLimit[at], model.upperPositionLimit[at]
        ends = ~self.continuous & (lowest < highest)
        self.lowest, self.highest = np.where(ends, [lowest, highest], [[-np.inf], [np.inf]])
        limits = np.array([model.velocityLimit, model.effortLimit])
        self.velocity_limits, self.effort_limits = np.where(limits > 0.0, limits, np.inf)
        # For each link an arm whose only mass is 1 kg of that link: see `set_payload`.
        self._even = [pin.Model(model) for _ in range(n)]
        for even in self._even:
            for k in range(1, n + 1):
                even.inertias[k] = pin.Inertia.Zero()
        self._even_data = [even.createData() for even in self._even]
        self.set_inertial([
            own.toDynamicParameters() if own.mass > 0.0 else np.zeros(10)
            for own in model.inertias[1:]
        ])  # fmt: skip

    def set_inertial(self, inertial: ArrayLike, motor_inertia: ArrayLike = 0.0) -> None:
        """
        Take other inertial parameters (n, 10), without payload; raise as `set_payload`.

        `motor_inertia` (n,) is that of rotors as joints see it, kg m^2, and part of `Terms.mass`.
        """
        self._model.armature = np.broadcast_to(motor_inertia, len(self.joints))
        self.unloaded = np.array(inertial, dtype=np.float64)
        self.set_payload(Payload())

    def set_payload(self, payload: Payload) -> None:
        """
        Carry another payload from now on.

        Raises
        ------
        ConfigurationError
            A link, with what it carries, has no mass.

        """
        inertial = self.inertial = self.unloaded.copy()
        inertial[-1] += self.inertial_of(payload)
        for k, values in enumerate(inertial, 1):
            if not (np.isfinite(values).all() and values[0] > 0.0):
                raise ConfigurationError(
                    f'link {self.links[k - 1]}: expected a mass > 0, got {values[0]:g}'
                )
            own = self._model.inertias[k] = self._pin.Inertia.FromDynamicParameters(values)
            # A force of any direction at the place r from the centre has the moment r x force.
            # Over places spread as the mass is, each component has 2/3 of their mean square
            # distance, which is half the trace of the inertia over the mass. So J^T J of a link is
            # the mass matrix of an arm that has 1 kg there, of an inertia of that mean square.
            square = max(np.trace(own.inertia), 0.0) / (3.0 * own.mass)
            self._even[k - 1].inertias[k] = self._pin.Inertia(1.0, own.lever, square * np.eye(3))
        mass = self.terms(np.zeros(len(self.joints)), np.zeros(len(self.joints))).mass
        if not np.all(np.linalg.eigvalsh(mass) > 0.0):
            raise ConfigurationError(
                'robot description: expected links with mass and inertia, got a mass matrix that '
                f'is not positive (diagonal {np.array2string(np.diag(mass), precision=3)})'
            )

    def inertial_of(self, payload: Payload) -> Floats:
        """Return the ten inertial parameters of a payload, about the last joint."""
        point = self._pin.Inertia(payload.mass, np.array(payload.center), np.zeros((3, 3)))
        return np.asarray(point.toDynamicParameters())

    def _configuration(self, q: ArrayLike) -> Floats:
        """Return q as Pinocchio has it: cosine and sine of a continuous joint's angle."""
        moved = np.asarray(q, dtype=np.float64)
        if len(self._zero) == len(moved):
            return moved
        return np.asarray(self._pin.integrate(self._model, self._zero, moved))

    def terms(self, q: ArrayLike, velocity: ArrayLike) -> Terms:
        """Return the terms at q (n,) and its velocity (n,)."""
        pin, model, data = self._pin, self._model, self._data
        configuration, velocity = self._configuration(q), np.asarray(velocity, dtype=np.float64)
        coriolis = velocity @ pin.computeCoriolisMatrix(model, data, configuration, velocity)
        gravity = pin.computeGeneralizedGravity(model, data, configuration).copy()
        mass = pin.crba(model, data, configuration).copy()
        return Terms(mass, coriolis, gravity)

    def velocity_of(self, momentum: Floats) -> Floats:
        """Return M^-1 p of p (n,), at the posture of the latest `terms`."""
        self._pin.cholesky.decompose(self._model, self._data)
        return np.asarray(self._pin.cholesky.solve(self._model, self._data, momentum))

    def reach_of_links(self, q: ArrayLike) -> Floats:
        """Return J^T J of each link, the mean over the places of its mass, (n, n, n), m^2."""
        configuration, links = (
            self._configuration(q),
            zip(self._even, self._even_data, strict=True),
        )
        return np.array([self._pin.crba(*link, configuration) for link in links])

    def gravity_columns(self, q: ArrayLike) -> Floats:
        """Return the matrix (n, 3) whose product with a vector of gravity is g(q)."""
        mass = np.sum(self.inertial[:, 0])
        center = self._pin.jacobianCenterOfMass(self._model, self._data, self._configuration(q))
        return np.asarray(-mass * center.T)

    def frame_jacobian(self, q: ArrayLike, frame: str) -> Floats:
        """
        Return the Jacobian (6, n) at a frame's origin, along its axes.

        Raises
        ------
        ConfigurationError
            An unknown frame.

        """
        if not self._model.existFrame(frame):
            link = self._pin.FrameType.BODY
            known = ', '.join(f.name for f in self._model.frames if f.type == link)
            raise ConfigurationError(f'frame: expected one of {known}, got {frame!r}')
        configuration, index = self._configuration(q), self._model.getFrameId(frame)
        return np.asarray(self._pin.computeFrameJacobian(
            self._model, self._data, configuration, index, self._pin.ReferenceFrame.LOCAL
        ))  # fmt: skip

    def regressor(self, q: ArrayLike, velocity: ArrayLike, acceleration: ArrayLike) -> Floats:
        """Return the matrix (n, 10 n) whose product with `inertial`, as one row, is the torque."""
        arrays = (np.asarray(a, dtype=np.float64) for a in (velocity, acceleration))
        return np.array(self._pin.computeJointTorqueRegressor(
            self._model, self._data, self._configuration(q), *arrays
        ))  # fmt: skip

    def pseudo_inertias(self) -> Floats:
        """Return the pseudo-inertia for a unit of each of the ten parameters, (4, 4, 10)."""
        of = self._pin.PseudoInertia.FromDynamicParameters
        return np.stack([of(unit).toMatrix() for unit in np.eye(10)], axis=-1)

    def torque_of_weight(self) -> Floats:
        """
        Return the torque by which the arm's own weight would act in any direction, (n,), N m.

        The root mean square over random postures of sum_l (m_l g)^2 J_l^T J_l / 3. It says how
        large torques of this arm are, whatever its joints' axes.
        """
        random = np.random.default_rng(0)
        weight = self.inertial[:, 0] * np.linalg.norm(self.gravity)
        postures = random.uniform(-np.pi, np.pi, (POSTURES, len(weight)))
        reaches = np.array([self.reach_of_links(q) for q in postures])
        squares = np.einsum('l,pljj->pj', weight**2, reaches) / 3.0
        return np.asarray(np.sqrt(np.mean(squares, axis=0)))

    @property
    def weight(self) -> float:
        """Of all that moves, N."""
        return float(np.sum(self.inertial[:, 0]) * np.linalg.norm(self.gravity))


def _pinocchio() -> Any:
    try:
        import pinocchio
    except ImportError:
        raise ConfigurationError(
            'arms need Pinocchio, which is not installed: pip install pin (rosdep: pinocchio)'
        ) from None
    return pinocchio


def _moving_joints(urdf: str) -> dict[str, bool]:
    """Return whether it mimics another one, for each joint that moves."""
    try:
        robot = ElementTree.fromstring(urdf)
    except ElementTree.ParseError as error:
        problem = f'the XML of a URDF, got {urdf[:40]!r} ({error})'
        raise ConfigurationError(f'robot description: expected {problem}') from None
    if robot.tag != 'robot':
        problem = f'a URDF (<robot ...>), got <{robot.tag} ...>'
        raise ConfigurationError(f'robot description: expected {problem}')
    found = {}
    for joint in robot.findall('joint'):
        name, kind = joint.get('name', ''), joint.get('type', '')
        if kind in ('floating', 'planar'):
            raise ConfigurationError(
                f'joint {name}: expected a fixed base and joints that are '
                f'{", ".join(MOVING)} or fixed, got a {kind} one'
            )
        if kind in MOVING:
            found[name] = joint.find('mimic') is not None
    return found
