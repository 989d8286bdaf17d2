# SPDX-License-Identifier: Apache-2.0
"""Rigid-body terms of an arm with a fixed base, by Pinocchio; the only file that knows it."""

from collections.abc import Sequence
from typing import Any, NamedTuple
from xml.etree import ElementTree

from fhaosmo_ros.core.parameters.errors import ConfigurationError
import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]
CROSS = np.array([
    [0, 0, 0, 0, 0, 1, 0, -1, 0], [0, 0, -1, 0, 0, 0, 1, 0, 0], [0, 1, 0, -1, 0, 0, 0, 0, 0]
], dtype=np.float64)  # fmt: skip
"""(r @ CROSS) as rows of a matrix (3, 3) times w is the cross product w x r."""
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
    reach: Floats  # (n, n) sum over the links of J^T J, the mean over places on a link, m^2


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
    payload : Payload
    inertial : (n, 10) array, optional
        Of each link with all that is fixed to it, instead of the URDF's: mass, mass times centre,
        inertia about the joint (xx, xy, yy, xz, yz, zz).

    Attributes
    ----------
    joints, links : tuple of str
        In the model's order; a link for each joint.
    frames : tuple of str
        All links, also those that are fixed to others.
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
        self,
        urdf: str,
        *,
        joints: Sequence[str] = (),
        gravity: ArrayLike = GRAVITY,
        payload: Payload = Payload(),  # noqa: B008 - immutable
        inertial: ArrayLike | None = None,
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
        self._model = pin.buildReducedModel(whole, others, pin.neutral(whole))
        self.gravity = np.array(gravity, dtype=np.float64)
        self._model.gravity.linear = self.gravity
        self._data = self._model.createData()
        self._even = pin.Model(self._model)  # links of 1 kg, see `set_payload`
        self._even_data = self._even.createData()
        self.joints = tuple(self._model.names[1:])
        self.links = tuple(self._link_of(i) for i in range(1, self._model.njoints))
        self.frames = tuple(f.name for f in self._model.frames if f.type == pin.FrameType.BODY)
        n = len(self.joints)
        self.continuous = np.array([self._model.nqs[i] == 2 for i in range(1, n + 1)])
        self._at = np.array(self._model.idx_qs[1:])
        # A URDF that says nothing of a limit, or zero, means none.
        turns = self.continuous | ~(
            self._model.lowerPositionLimit[self._at] < self._model.upperPositionLimit[self._at]
        )
        self.lowest = np.where(turns, -np.inf, self._model.lowerPositionLimit[self._at])
        self.highest = np.where(turns, np.inf, self._model.upperPositionLimit[self._at])
        self.velocity_limits, self.effort_limits = (
            np.where(limit > 0.0, limit, np.inf)
            for limit in (self._model.velocityLimit, self._model.effortLimit)
        )
        moves = [[j in self._model.supports[i] for j in range(1, n + 1)] for i in range(1, n + 1)]
        self._moves = np.array(moves, dtype=np.float64)[:, np.newaxis, :]
        if inertial is None:
            inertial = np.array(
                [
                    i.toDynamicParameters() if i.mass > 0.0 else np.zeros(10)
                    for i in self._model.inertias[1:]
                ]
            )
        self.set_inertial(inertial)
        self.set_payload(payload)

    def _link_of(self, joint: int) -> str:
        names = [
            f.name for f in self._model.frames
            if f.type == self._pin.FrameType.BODY and f.parentJoint == joint
        ]  # fmt: skip
        return str(names[0] if names else self._model.names[joint])

    def set_inertial(self, inertial: ArrayLike, motor_inertia: ArrayLike = 0.0) -> None:
        """
        Take other inertial parameters (n, 10), without payload; raise as `set_payload`.

        `motor_inertia` (n,) is that of rotors as joints see it, kg m^2, and part of `Terms.mass`.
        """
        self._model.armature = np.broadcast_to(motor_inertia, len(self.joints))
        self.unloaded = np.array(inertial, dtype=np.float64)
        n = len(self.joints)
        if self.unloaded.shape != (n, 10):
            raise ConfigurationError(
                f'inertial: expected an array of shape {(n, 10)}, got {self.unloaded.shape}'
            )
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
        for name, link, values in zip(self.joints, self.links, inertial, strict=True):
            if not (np.isfinite(values).all() and values[0] > 0.0):
                raise ConfigurationError(f'link {link}: expected a mass > 0, got {values[0]:g}')
            index = self._model.getJointId(name)
            self._model.inertias[index] = self._pin.Inertia.FromDynamicParameters(values)
        # A force of any direction at the place r from the centre has the moment r x force. Over
        # places spread as the mass is, each component has 2/3 of their mean square distance, which
        # is half the trace of the inertia over the mass. So the sum of J^T J is the mass matrix of
        # an arm with links of 1 kg and of an inertia of that mean square.
        own = list(self._model.inertias[1:])
        self._levers = [np.array(i.lever) for i in own]
        squares = np.array([max(np.trace(i.inertia), 0.0) / (3.0 * i.mass) for i in own])
        self._radii = np.sqrt(squares)[:, np.newaxis, np.newaxis]
        for k, (lever, square) in enumerate(zip(self._levers, squares, strict=True), 1):
            self._even.inertias[k] = self._pin.Inertia(1.0, lever, square * np.eye(3))
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
        q = np.asarray(q, dtype=np.float64)
        if not self.continuous.any():
            return q
        out = np.empty(self._model.nq)
        out[self._at] = np.where(self.continuous, np.cos(q), q)
        out[self._at[self.continuous] + 1] = np.sin(q[self.continuous])
        return out

    def terms(self, q: ArrayLike, velocity: ArrayLike) -> Terms:
        """Return the terms at q (n,) and its velocity (n,)."""
        pin, model, data = self._pin, self._model, self._data
        configuration, velocity = self._configuration(q), np.asarray(velocity, dtype=np.float64)
        coriolis = pin.computeCoriolisMatrix(model, data, configuration, velocity).T @ velocity
        gravity = pin.computeGeneralizedGravity(model, data, configuration).copy()
        mass = pin.crba(model, data, configuration).copy()
        reach = pin.crba(self._even, self._even_data, configuration).copy()
        return Terms(mass, coriolis, gravity, reach)

    def velocity_of(self, momentum: Floats) -> Floats:
        """Return M^-1 p of p (n,), at the posture of the latest `terms`."""
        self._pin.cholesky.decompose(self._model, self._data)
        return np.asarray(self._pin.cholesky.solve(self._model, self._data, momentum))

    def reach_of_links(self, q: ArrayLike) -> Floats:
        """Return J^T J of each link, the mean over the places of its mass, (n, n, n), m^2."""
        pin, data = self._pin, self._data
        columns = pin.computeJointJacobians(self._model, data, self._configuration(q))
        centers = np.array([
            place.act(lever) for place, lever in zip(data.oMi[1:], self._levers, strict=True)
        ])  # fmt: skip
        turning = columns[3:]  # of spatial velocities at the base's origin, by joint
        links = np.empty((len(centers), 6, len(centers)))
        links[:, :3] = columns[:3] + (centers @ CROSS).reshape(-1, 3, 3) @ turning
        links[:, 3:] = turning * self._radii
        links *= self._moves
        return np.asarray(links.transpose(0, 2, 1) @ links)

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
            raise ConfigurationError(
                f'frame: expected one of {", ".join(self.frames)}, got {frame!r}'
            )
        configuration, index = self._configuration(q), self._model.getFrameId(frame)
        return np.asarray(self._pin.computeFrameJacobian(
            self._model, self._data, configuration, index, self._pin.ReferenceFrame.LOCAL
        ))  # fmt: skip

    def regressor(self, q: ArrayLike, velocity: ArrayLike, acceleration: ArrayLike) -> Floats:
        """Return the matrix (n, 10 n) whose product with `inertial`, as one row, is the torque."""
        return np.array(
            self._pin.computeJointTorqueRegressor(
                self._model, self._data, self._configuration(q),
                np.asarray(velocity, dtype=np.float64), np.asarray(acceleration, dtype=np.float64),
            )
        )  # fmt: skip

    def torque_of_weight(self) -> Floats:
        """
        Return the torque by which the arm's own weight would act in any direction, (n,), N m.

        The root mean square over random postures of sum_l (m_l g)^2 J_l^T J_l / 3. It says how
        large torques of this arm are, whatever its joints' axes.
        """
        random = np.random.default_rng(0)
        weight = self.inertial[:, 0] * np.linalg.norm(self.gravity)
        squares = []
        for _ in range(POSTURES):
            reach = self.reach_of_links(random.uniform(-np.pi, np.pi, len(weight)))
            squares.append(weight**2 @ np.diagonal(reach, axis1=1, axis2=2) / 3.0)
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
        raise ConfigurationError(
            f'robot description: expected the XML of a URDF, got {urdf[:40]!r} ({error})'
        ) from None
    if robot.tag != 'robot':
        raise ConfigurationError(
            f'robot description: expected a URDF (<robot ...>), got <{robot.tag} ...>'
        )
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
