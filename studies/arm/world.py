# SPDX-License-Identifier: Apache-2.0
"""An arm in MuJoCo: it moves, is touched, and its encoders and torque sensors are read."""

from collections.abc import Callable
from pathlib import Path
import re
from typing import Any, NamedTuple

from fhaosmo_ros.core.arm.model import ArmModel
import mujoco
import numpy as np
import pinocchio
import pybullet_data
from studies.harness import Floats

PERIOD, SUBSTEPS = 1e-3, 2  # seconds between two samples, and steps of the simulation in it
ENCODER = 2.0 * np.pi / 2**17
TORQUE_NOISE = 0.005
"""Of torque sensors, as a share of the mean torque of gravity at each joint, and N m at least."""
LEAST_NOISE = 0.01
STIFFNESS = 20.0  # of the drives, N m/rad, at least
SETTLED = 0.5  # seconds from when errors count
ROBOTS = {
    'iiwa': 'kuka_iiwa/model.urdf',
    'panda': 'franka_panda/panda.urdf',
    'ur5': 'ur_description/urdf/ur5_robot.urdf',
}
PUSHES = ('pulse', 'step', 'slow')
UNSEEN = ('knock', 'ramp', 'rub')  # kinds of contact on which nothing is tuned
SHAPES: dict[str, tuple[tuple[float, float], Callable[[float], float]]] = {
    'pulse': ((20, 60), lambda share: np.sin(np.pi * share)),
    'step': ((400, 400), lambda share: 1.0),
    'slow': ((1000, 1000), lambda share: np.sin(np.pi * share) ** 2),
    'knock': ((8, 15), lambda share: np.sin(np.pi * share)),
    'ramp': ((300, 600), lambda share: share),
    'rub': ((600, 900), lambda share: 0.6 + 0.4 * np.sin(6.0 * np.pi * share)),
}
"""Least and greatest length in samples, and force as a share of the largest, by kind."""
Forces = dict[int, tuple[int, Floats, Floats]]  # body, place on it and force (N) by sample
Begins = list[tuple[int, str, int]]  # sample, kind and length (samples) of contacts


class Touched(NamedTuple):
    """What was recorded, K rows."""

    t: Floats  # (K,) s
    q: Floats  # (K, n) of the encoders
    velocity: Floats  # (K, n) of a good sensor
    torque: Floats  # (K, n) of torque sensors
    truth: Floats  # (K, n) external torque
    begins: Begins  # of contacts


def rmse(w: Touched, estimate: Floats) -> float:
    """Return the root mean square error, summed over joints."""
    late = w.t > SETTLED
    return float(np.sum(np.sqrt(np.mean((estimate[late] - w.truth[late]) ** 2, axis=0))))


def urdf_of(robot: str) -> str:
    """Return the URDF of a robot of pybullet or example-robot-data, without its looks."""
    places = (
        Path(pybullet_data.getDataPath()),
        Path(pinocchio.__file__).parents[4] / 'share' / 'example-robot-data' / 'robots',
    )
    text = next(p for p in (place / ROBOTS[robot] for place in places) if p.exists()).read_text()
    return re.sub(r'<(visual|collision)\b.*?</\1>', '', text, flags=re.S)


def simulate(
    urdf: str, arm: ArmModel, duration: float, seed: int, kinds: tuple[str, ...] = PUSHES,
    payload: float = 0.0, wall: bool = False, balls: tuple[float, ...] = (),
    push: float | None = None,
) -> Touched:  # fmt: skip
    """
    Let an arm follow sines and be touched every second and a half.

    Forces of 5 to 40 % of its weight act in random directions at random places of random links.
    The last link carries a `payload`, a share of the arm's mass. With `wall` there is MuJoCo's own
    contact of the last link with a plane instead; with `balls` that of the middle link with a
    ball, thrown at these times (s); and one slow push at `push`.
    """
    random = np.random.default_rng(seed)
    model = _compiled(urdf, arm, payload, wall, bool(balls))
    data = mujoco.MjData(model)
    joints = [model.joint(name) for name in arm.joints]
    at, dof = (np.concatenate([getattr(j, a) for j in joints]) for a in ('qposadr', 'dofadr'))
    bodies = [model.body(name).id for name in arm.links]
    forces: Forces = {}
    begins: Begins = []
    n, count = len(at), round(duration / PERIOD)
    if push is not None:
        for i in range(1500):
            force = 0.15 * arm.weight * np.sin(np.pi * i / 1500) ** 2 * np.array([0.0, 1.0, 0.0])
            forces[round(push / PERIOD) + i] = bodies[-2], np.zeros(3), force
    elif kinds and not wall:
        forces, begins = _contacts(random, count, kinds, bodies, arm.weight)
    throws = {round(moment / PERIOD) for moment in balls}
    swing = random.uniform(0.15, 0.5, (2, n)) * np.sign(random.uniform(-1.0, 1.0, (2, n)))
    speed = random.uniform(0.5, 2.5, (2, n))
    middle = np.array([0.0, 0.6, 0.0, -1.2, 0.0, 1.2, 0.0])[:n] + random.uniform(-0.3, 0.3, n)

    def reference(t: float) -> tuple[Floats, Floats, Floats]:
        angle = speed * t
        return (
            middle + np.sum(swing * np.sin(angle), axis=0),
            np.sum(swing * speed * np.cos(angle), axis=0),
            -np.sum(swing * speed**2 * np.sin(angle), axis=0),
        )

    if wall:
        reached = []
        for t in np.arange(0.0, count * PERIOD, 0.05):
            data.qpos[at] = reference(t)[0]
            mujoco.mj_kinematics(model, data)
            reached.append(data.xpos[bodies[-1], 0])
        # The sphere at the last link is pressed against the wall in a tenth of the time.
        face = np.quantile(reached, 0.9) + 0.06
        model.geom_pos[model.geom('wall').id] = (face + 0.02, 0.0, 0.0)
    data.qpos[at], data.qvel[dof], _ = reference(0.0)
    mujoco.mj_forward(model, data)
    noise = np.maximum(TORQUE_NOISE * _gravity(model, at, dof), LEAST_NOISE)
    q, velocity, torque, truth = np.zeros((4, count, n))
    full, jacobian = np.zeros((model.nv, model.nv)), np.zeros((3, model.nv))
    for k in range(count):
        target = reference(k * PERIOD)
        mujoco.mj_fullM(model, data, full)
        mass = full[np.ix_(dof, dof)]
        angle, v = data.qpos[at].copy(), data.qvel[dof].copy()
        stiff = STIFFNESS + 100.0 * np.diag(mass)
        drive = mass @ target[2] + data.qfrc_bias[dof] + stiff * (target[0] - angle)
        drive += 2.0 * np.sqrt(stiff * np.diag(mass)) * (target[1] - v)
        data.qfrc_applied[:] = 0.0
        if k in throws:
            _throw(model, data, bodies[len(bodies) // 2])
        if k in forces:
            body, place, force = forces[k]
            point = data.xpos[body] + data.xmat[body].reshape(3, 3) @ place
            mujoco.mj_jac(model, data, jacobian, None, point, body)
            truth[k] = jacobian[:, dof].T @ force
        q[k] = np.round(angle / ENCODER) * ENCODER
        velocity[k] = v + 1e-3 * random.standard_normal(n)
        torque[k] = drive + noise * random.standard_normal(n)
        data.qfrc_applied[dof] = drive + truth[k]
        felt = np.zeros(n)
        for _ in range(SUBSTEPS):
            mujoco.mj_step(model, data)
            felt += data.qfrc_constraint[dof] / SUBSTEPS
        truth[k] += felt
        mujoco.mj_forward(model, data)
    if wall or throws:
        pressed = np.linalg.norm(truth, axis=1) > 0.0
        begins = [(k + 1, 'wall', 0) for k in np.flatnonzero(np.diff(pressed) & pressed[1:])]
    return Touched(np.arange(count) * PERIOD, q, velocity, torque, truth, begins)


def _compiled(urdf: str, arm: ArmModel, payload: float, wall: bool, ball: bool) -> Any:
    """Return MuJoCo's model."""
    spec, sphere = mujoco.MjSpec.from_string(urdf), mujoco.mjtGeom.mjGEOM_SPHERE
    spec.option.timestep = PERIOD / SUBSTEPS
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.compiler.fusestatic = False
    for extra in (*spec.equalities, *(j for j in spec.joints if j.name not in arm.joints)):
        spec.delete(extra)
    last = spec.body(arm.links[-1])
    if payload:
        mass = payload * sum(b.mass for b in spec.bodies[1:])
        carried = last.add_body(pos=[0.0, 0.0, 0.08], explicitinertial=True)
        carried.mass, carried.inertia = mass, [mass * 4e-4] * 3
    if wall:
        last.add_geom(type=sphere, size=[0.06, 0, 0], mass=0.0)
        plane = spec.worldbody.add_geom(
            name='wall', type=mujoco.mjtGeom.mjGEOM_BOX, size=[0.02, 3.0, 3.0], pos=[9.0, 0, 0.0]
        )
        plane.solref, plane.priority = [0.04, 1.0], 1
        plane.solimp = [0.1, 0.4, 0.02, 0.5, 2.0]  # stiffer ones flutter
    if ball:
        padded = spec.body(arm.links[len(arm.links) // 2])
        padded.add_geom(type=sphere, size=[0.08, 0, 0], mass=0.0)
        body = spec.worldbody.add_body(name='ball', pos=[0.0, 0.0, -5.0])
        body.add_freejoint()
        body.add_geom(type=sphere, size=[0.05, 0, 0], mass=0.4)
    model = spec.compile()
    model.opt.gravity[:] = (0.0, 0.0, -9.81)
    model.dof_frictionloss[:] = 0.0
    model.dof_damping[:] = 0.0
    model.jnt_limited[:] = 0
    return model


def _gravity(model, at, dof) -> Floats:
    """Return the mean torques of gravity over random postures."""
    data, found, random = mujoco.MjData(model), [], np.random.default_rng(0)
    for _ in range(50):
        data.qpos[at] = random.uniform(-2.0, 2.0, len(at))
        mujoco.mj_forward(model, data)
        found.append(data.qfrc_bias[dof].copy())
    return np.abs(found).mean(axis=0)


def _contacts(random, count, kinds, bodies, weight) -> tuple[Forces, Begins]:
    forces, begins, k = {}, [], 1000
    while k < count - 1500:
        body = bodies[int(random.integers(2, len(bodies) - 1))]
        direction, place = random.standard_normal(3), random.uniform(-0.08, 0.08, 3)
        size = weight * 10.0 ** random.uniform(np.log10(0.05), np.log10(0.4))
        force = size * direction / np.linalg.norm(direction)
        kind = kinds[int(random.integers(len(kinds)))]
        bounds, shape = SHAPES[kind]
        length = int(random.uniform(*bounds))
        for i in range(length):
            forces[k + i] = body, place, force * shape(i / length)
        begins.append((k, kind, length))
        k += length + int(random.uniform(500, 1500))
    return forces, begins


def _throw(model, data, body) -> None:
    """Let the ball fly towards the middle of a link, from half a metre beside it, at 5 m/s."""
    joint = model.jnt(model.body('ball').jntadr[0])
    place, speed = joint.qposadr[0], joint.dofadr[0]
    beside = np.array([0.3, -0.4, 0.0])
    data.qpos[place : place + 3] = data.xpos[body] + beside
    data.qpos[place + 3 : place + 7] = (1.0, 0.0, 0.0, 0.0)
    data.qvel[speed : speed + 6] = 0.0
    # Half of g t^2 upwards, so that it does not pass below.
    data.qvel[speed : speed + 3] = -10.0 * beside + np.array([0.0, 0.0, 0.5])
    mujoco.mj_forward(model, data)
