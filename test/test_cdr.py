# SPDX-License-Identifier: Apache-2.0
"""Numbers taken out of messages at once are those that rosbags deserialises one by one."""

from fhaosmo_ros.messages.fields import find_field, MissingElementError
from fhaosmo_ros.messages.reader import MessageReader
from fhaosmo_ros.tools.bags.cdr import expect_all, GROUPS, numbers
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
    texts, known, stamps = [], [], []
    for k in range(2 * GROUPS):
        paths = {}
        message = fill(store, message_type, rng, longest if k % 3 else 2, paths)
        texts.append(
            bytes(
                store.serialize_cdr(message, message_type, little_endian=bool(rng.random() > 0.2))
            )
        )
        known.append(paths)
        header = getattr(message, 'header', None)
        stamps.append(header.stamp.sec * 10**9 + header.stamp.nanosec if header else 0)
    everywhere = sorted(set.intersection(*(set(paths) for paths in known)))
    data = np.frombuffer(b''.join(texts), dtype=np.uint8)
    ends = np.cumsum([len(text) for text in texts])
    starts = ends - [len(text) for text in texts]
    for path in everywhere[:6]:
        field = find_field(store.fielddefs, message_type, path)
        column = numbers(field, data, starts, ends)
        np.testing.assert_array_equal(column.values, [paths[path] for paths in known])
        np.testing.assert_array_equal(column.stamps, stamps)
    # One after the other as the node reads them, all fields at once; some messages lack some.
    union = sorted(set().union(*known))[:8]
    if union:
        reader = MessageReader([find_field(store.fielddefs, message_type, path) for path in union])
        for text, paths, stamp in zip(texts, known, stamps, strict=True):
            assert reader.read(text) == (stamp, pytest.approx([paths.get(p) for p in union]))


def test_one_list_that_is_too_short_is_told():
    store = get_typestore(Stores.ROS2_JAZZY)
    array = store.types['sensor_msgs/msg/JointState']
    empty = np.zeros(0)
    header = store.types['std_msgs/msg/Header'](
        stamp=store.types['builtin_interfaces/msg/Time'](sec=1, nanosec=2), frame_id='a'
    )
    texts = [
        bytes(store.serialize_cdr(
            array(header=header, name=[], position=np.ones(n), velocity=empty, effort=empty),
            'sensor_msgs/msg/JointState',
        )) for n in (3, 3, 2)
    ]  # fmt: skip
    ends = np.cumsum([len(text) for text in texts])
    starts = ends - [len(text) for text in texts]
    field = find_field(store.fielddefs, 'sensor_msgs/msg/JointState', 'position[2]')
    column = numbers(field, np.frombuffer(b''.join(texts), np.uint8), starts, ends)
    np.testing.assert_array_equal(column.values, [1.0, 1.0, np.nan])
    with pytest.raises(MissingElementError, match='2 in one message, got 2'):
        expect_all(column)


@pytest.mark.parametrize('length', [0, 3, 4, 11, 15])
def test_message_that_is_cut_is_told(length):
    store = get_typestore(Stores.ROS2_JAZZY)
    field = find_field(store.fielddefs, 'std_msgs/msg/Float64', 'data')
    data = (b'\0\1\0\0' + bytes(12))[: max(length, 1)]
    data = np.frombuffer(data, np.uint8)
    if length == 15:
        field = find_field(store.fielddefs, 'geometry_msgs/msg/Vector3', 'z')
    with pytest.raises(ValueError, match='shorter than its type'):
        numbers(field, data, np.array([0]), np.array([length]))
