# SPDX-License-Identifier: Apache-2.0
"""A robot of three joints, as URDF, and its free motion."""

import numpy as np

JOINTS = ('turn', 'shoulder', 'elbow')


def link(name: str, mass: float, length: float) -> str:
    """Return a rod along z."""
    inertia = mass * length**2 / 12.0
    return (
        f'<link name="{name}"><inertial><origin xyz="0 0 {length / 2}"/><mass value="{mass}"/>'
        f'<inertia ixx="{inertia}" iyy="{inertia}" izz="0.002" ixy="0" ixz="0" iyz="0"/>'
        '</inertial></link>'
    )


def joint(name: str, parent: str, child: str, axis: str, z: float, kind: str = 'revolute') -> str:
    """Return a joint at the end of its parent."""
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin xyz="0 0 {z}"/><axis xyz="{axis}"/>'
        '<limit lower="-3" upper="3" velocity="5" effort="100"/></joint>'
    )


URDF = ''.join([
    '<robot name="three"><link name="base"/>', link('column', 4.0, 0.3),
    link('upper', 3.0, 0.4), link('lower', 2.0, 0.4), '<link name="tool"/>',
    joint('turn', 'base', 'column', '0 0 1', 0.1),
    joint('shoulder', 'column', 'upper', '0 1 0', 0.3),
    joint('elbow', 'upper', 'lower', '0 1 0', 0.4),
    joint('flange', 'lower', 'tool', '0 0 1', 0.4, 'fixed'), '</robot>',
])  # fmt: skip


def motion(model, duration=10.0, seed=1, period=1e-3, resting=()):
    """Return times, positions, velocities and torques of free sines; some joints may rest."""
    random = np.random.default_rng(seed)
    t = np.arange(0.0, duration, period)
    n = len(model.joints)
    swing, speed = random.uniform(0.3, 0.8, (2, n)), random.uniform(0.7, 2.5, (2, n))
    swing[:, list(resting)] = 0.0
    angle = speed[:, np.newaxis] * t[:, np.newaxis]
    q = 0.2 + np.sum(swing[:, np.newaxis] * np.sin(angle), axis=0)
    v = np.sum((swing * speed)[:, np.newaxis] * np.cos(angle), axis=0)
    a = -np.sum((swing * speed**2)[:, np.newaxis] * np.sin(angle), axis=0)
    torque = np.array([
        model.regressor(*row) @ model.inertial.ravel() for row in zip(q, v, a, strict=True)
    ])  # fmt: skip
    return t, q, v, torque
