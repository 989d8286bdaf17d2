# SPDX-License-Identifier: Apache-2.0
"""A robot of three joints, as URDF, and its free motion."""

import numpy as np

JOINTS = ('turn', 'shoulder', 'elbow')


def segment(name, parent, child, axis, z, mass=0.0, length=0.0, kind='revolute'):
    """Return a joint at the end of its parent, and the rod along z that it moves."""
    inertia = mass * length**2 / 12.0
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin xyz="0 0 {z}"/><axis xyz="{axis}"/>'
        '<limit lower="-3" upper="3" velocity="5" effort="100"/></joint>'
        f'<link name="{child}"><inertial><origin xyz="0 0 {length / 2}"/><mass value="{mass}"/>'
        f'<inertia ixx="{inertia}" iyy="{inertia}" izz="{mass / 1000}" ixy="0" ixz="0" iyz="0"/>'
        '</inertial></link>'
    )


URDF = ''.join([
    '<robot name="three"><link name="base"/>',
    segment('turn', 'base', 'column', '0 0 1', 0.1, 4.0, 0.3),
    segment('shoulder', 'column', 'upper', '0 1 0', 0.3, 3.0, 0.4),
    segment('elbow', 'upper', 'lower', '0 1 0', 0.4, 2.0, 0.4),
    segment('flange', 'lower', 'tool', '0 0 1', 0.4, kind='fixed'), '</robot>',
])  # fmt: skip


def motion(model, t, seed=1, resting=()):
    """Return times t, positions, velocities and torques of free sines; some joints may rest."""
    random, n = np.random.default_rng(seed), len(model.joints)
    swing, speed = random.uniform(0.3, 0.8, (2, n)), random.uniform(0.7, 2.5, (2, n))
    swing[:, list(resting)] = 0.0
    angle = speed[:, np.newaxis] * t[:, np.newaxis]
    q = 0.2 + np.sum(swing[:, np.newaxis] * np.sin(angle), axis=0)
    v = np.sum((swing * speed)[:, np.newaxis] * np.cos(angle), axis=0)
    a = -np.sum((swing * speed**2)[:, np.newaxis] * np.sin(angle), axis=0)
    rows = zip(q, v, a, strict=True)
    return t, q, v, np.array([model.regressor(*row) @ model.inertial.ravel() for row in rows])
