# SPDX-License-Identifier: Apache-2.0
"""Fields in messages of any type, of rosbags and rclpy."""

import bag_files as files
from fhaosmo_ros.messages.fields import find_field, MissingElementError
import numpy as np
import pytest

NONE = np.zeros(0)


def made(kind, **fields):
    return files.TYPES.types[kind](**fields)


def joints(names):
    data = files.joint_state(1_000_000_002, [1.0, 2.0], names)
    return files.TYPES.deserialize_cdr(data, files.JOINTS)


POINT = made(
    'trajectory_msgs/msg/JointTrajectoryPoint', positions=np.array([0.5, 1.5]),
    time_from_start=made('builtin_interfaces/msg/Duration', sec=-7, nanosec=0),
    **dict.fromkeys(('velocities', 'accelerations', 'effort'), NONE),
)  # fmt: skip
TRAJECTORY = made(
    'trajectory_msgs/msg/JointTrajectory', header=files.header(1_000_000_002), joint_names=['a'],
    points=[POINT],
)  # fmt: skip
QUATERNION = made(
    'geometry_msgs/msg/Quaternion', x=0.0, y=0.0, z=2.0 * np.sin(0.4), w=2.0 * np.cos(0.4)
)


@pytest.mark.parametrize(('message', 'path', 'expected'), [
    (TRAJECTORY, 'header.stamp.sec', 1.0), (TRAJECTORY, 'points[0].positions[1]', 1.5),
    (TRAJECTORY, 'points[0].time_from_start.sec', -7.0),
    (joints([]), 'position[1]', 2.0), (joints(['hip', 'elbow']), 'position[elbow]', 2.0),
    (QUATERNION, 'yaw', pytest.approx(0.8)),
    # This message's lists are too short, others' may be longer.
    (TRAJECTORY, 'points[1].positions[0]', 'a longer list, got one of 1'),
    (TRAJECTORY, 'points[0].effort[0]', 'a longer list, got one of 0'),
    (joints([]), 'position[2]', 'a longer list, got one of 2'),
    (joints(['hip', 'elbw']), 'position[elbow]', r"\(hip, elbw\), got 'elbow'"),
    (joints(['a', 'b', 'elbow']), 'position[elbow]', 'a longer list, got one of 2'),
])  # fmt: skip
def test_number_at_any_depth_by_index_and_by_name(message, path, expected):
    types, kind = files.TYPES, message.__msgtype__
    field = find_field(types.fielddefs, kind, path)
    if field.header:
        assert field.stamp(message) == 1_000_000_002
    for same in (message, types.deserialize_cdr(types.serialize_cdr(message, kind), kind)):
        if isinstance(expected, str):
            with pytest.raises(MissingElementError, match=expected):
                field.value(same)
        else:
            assert field.value(same) == expected
