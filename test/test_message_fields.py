# SPDX-License-Identifier: Apache-2.0
"""Fields are found in messages of any type, in objects of rosbags and of rclpy."""

from fhaosmo_ros.messages.fields import find_field, MissingElementError
from hypothesis import given
from hypothesis import strategies as st
import numpy as np
import pytest
from rosbags.typesys import get_types_from_msg, get_typestore, Stores

NUMBERS = ['bool', 'int8', 'uint8', 'int16', 'uint32', 'int64', 'float32', 'float64']
SHAPES = ['{}', '{}[3]', '{}[]', '{}[<=5]']


def definitions(draw, names):
    """Draw the text of a type that may use those before it."""
    kinds = st.sampled_from([*NUMBERS, 'string', *names])
    fields = [
        draw(st.sampled_from(SHAPES)).format(draw(kinds)) + f' f{k}'
        for k in range(draw(st.integers(1, 5)))
    ]
    if draw(st.booleans()):
        fields.insert(0, 'std_msgs/Header header')
    return '\n'.join(fields)


@st.composite
def typestores(draw):
    store, names = get_typestore(Stores.ROS2_JAZZY), []
    for k in range(draw(st.integers(1, 3))):
        name = f'rig/T{k}'
        store.register(get_types_from_msg(definitions(draw, names), f'rig/msg/T{k}'))
        names.append(name)
    return store, f'rig/msg/T{len(names) - 1}'


def fill(store, message_type, rng, longest, paths, prefix=''):
    """Make a random message; collect the path and the value of each number in it."""
    values = {}
    for name, node in store.fielddefs[message_type][1]:
        values[name] = value(store, node, rng, longest, paths, prefix + name)
    return store.types[message_type](**values)


def value(store, node, rng, longest, paths, path):
    kind, detail = node
    if kind == 2:
        return fill(store, detail, rng, longest, paths, path + '.')
    if kind in (3, 4):
        count = detail[1] if kind == 3 else int(rng.integers(0, longest + 1))
        items = [
            value(store, detail[0], rng, longest, paths, f'{path}[{k}]') for k in range(count)
        ]
        inner = detail[0]
        if inner[0] == 1 and inner[1][0] != 'string':
            return np.array(items, dtype=inner[1][0])
        return items
    if detail[0] == 'string':
        return 'x' * int(rng.integers(0, longest + 1))
    number = np.dtype(detail[0]).type(rng.integers(0, 2) if detail[0] == 'bool' else
                                      rng.integers(0, 100))  # fmt: skip
    paths[path] = float(number)
    return number.item()


@given(typestores(), st.integers(0, 2**32), st.integers(0, 4))
def test_any_number_in_messages_of_any_lengths(store_and_type, seed, longest):
    store, message_type = store_and_type
    rng = np.random.default_rng(seed)
    known = []
    for k in range(10):
        paths = {}
        message = fill(store, message_type, rng, longest if k % 3 else 2, paths)
        text = store.serialize_cdr(message, message_type)
        known.append((store.deserialize_cdr(text, message_type), paths))
    union = sorted(set().union(*(paths for _, paths in known)))[:8]
    for field in [find_field(store.fielddefs, message_type, path) for path in union]:
        for message, paths in known:  # some messages lack some
            assert field.header == ('header' if hasattr(message, 'header') else '')
            if field.text in paths:
                assert field.value(message) == paths[field.text]
            else:
                with pytest.raises(MissingElementError, match='index below the number'):
                    field.value(message)


STORE = get_typestore(Stores.ROS2_JAZZY)
JOINTS = 'sensor_msgs/msg/JointState'


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
