# SPDX-License-Identifier: Apache-2.0
"""Fields are found in messages of any type, in objects of rosbags and of rclpy."""

from fhaosmo_ros.messages.fields import find_field, MissingElementError
import numpy as np
import pytest
from rosbags.typesys import get_types_from_msg, get_typestore, Stores

STORE = get_typestore(Stores.ROS2_JAZZY)
JOINTS = 'sensor_msgs/msg/JointState'
INNER = 'float32 force\nbool[] on\n'
OUTER = (
    'std_msgs/Header header\nint64 count\nfloat32[3] three\nrig/Inner[<=2] parts\nstring[] words\n'
)
for name, text in (('Inner', INNER), ('Outer', OUTER)):
    STORE.register(get_types_from_msg(text, f'rig/msg/{name}'))


@pytest.mark.parametrize(
    ('path', 'number'),
    [
        ('count', -7.0), ('three[2]', 2.5), ('parts[1].force', 1.5), ('parts[0].on[1]', 1.0),
        ('parts[2].force', None), ('parts[1].on[0]', None), ('header.stamp.sec', 1.0),
    ],
)  # fmt: skip
def test_numbers_at_any_depth(path, number):
    """None: this message's lists are too short, others' may be longer."""
    inner, outer = (STORE.types[f'rig/msg/{name}'] for name in ('Inner', 'Outer'))
    parts = [inner(0.5, np.array([False, True])), inner(1.5, np.zeros(0, dtype=bool))]
    header = joints([], []).header
    message = outer(header, -7, np.array([0.5, 1.5, 2.5], np.float32), parts, ['count'])
    data = STORE.serialize_cdr(message, 'rig/msg/Outer')
    field = find_field(STORE.fielddefs, 'rig/msg/Outer', path)
    assert field.header == 'header'
    for same in (message, STORE.deserialize_cdr(data, 'rig/msg/Outer')):
        if number is None:
            with pytest.raises(MissingElementError, match='index below the number'):
                field.value(same)
        else:
            assert field.value(same) == number


def joints(names, positions):
    stamp = STORE.types['builtin_interfaces/msg/Time'](sec=1, nanosec=2)
    header = STORE.types['std_msgs/msg/Header'](stamp=stamp, frame_id='a')
    lists = {'position': np.array(positions), 'velocity': np.zeros(0), 'effort': np.zeros(0)}
    return STORE.types[JOINTS](header=header, name=names, **lists)


@pytest.mark.parametrize(
    ('text', 'names', 'positions', 'problem'),
    [
        ('position[elbow]', ['hip', 'elbow'], [1.0, 2.0], ''),
        ('position[1]', [], [1.0, 2.0], ''),
        ('position[1]', [], [1.0], '1 in one message, got 1'),
        ('position[elbow]', ['hip', 'elbw'], [1.0, 2.0], "did you mean 'elbw'"),
        ('position[elbow]', ['hip', 'elbow'], [1.0], "none for 'elbow'"),
    ],
)
def test_element_of_a_list_by_index_and_by_name(text, names, positions, problem):
    field = find_field(STORE.fielddefs, JOINTS, text)
    message = joints(names, positions)
    assert field.stamp(message) == 1_000_000_002
    if problem:
        with pytest.raises(MissingElementError, match=problem):
            field.value(message)
    else:
        assert field.value(message) == 2.0


def test_angle_of_a_quaternion():
    kind = 'geometry_msgs/msg/Quaternion'
    message = STORE.types[kind](x=0.0, y=0.0, z=2.0 * np.sin(0.4), w=2.0 * np.cos(0.4))
    field = find_field(STORE.fielddefs, kind, 'yaw')
    assert field.value(message) == pytest.approx(0.8)
