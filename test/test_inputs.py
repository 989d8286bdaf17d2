# SPDX-License-Identifier: Apache-2.0
"""Fields in messages of any type, of rosbags and rclpy; known inputs paired with y by stamps."""

import bag_files as files
from fhaosmo_ros.core.parameters.errors import ConfigurationError
from fhaosmo_ros.inputs import Input, known_inputs, MOST, Pairing
from fhaosmo_ros.messages.fields import find_field, MissingElementError
from hypothesis import given, settings
from hypothesis import strategies as st
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


MS = 1_000_000


def pairing_of(stamps, wait, held):
    """Return a pairing of known inputs with these kinds of stamps; `wait` in nanoseconds."""
    known = {f'u{j}': Input('u', '', '', stamp, '') for j, stamp in enumerate(stamps)}
    values = {'known_input_wait': wait * 1e-9, 'max_gap': 0.5}
    return Pairing(values, list(known), known, held)


def fed(pairing, events):
    """Feed (arrival, kind, stamp, value) in order; kind: 'y' or the number of an input."""
    found = []
    for _, kind, stamp, value in sorted(events, key=lambda e: e[0]):
        if kind == 'y':
            pairing.take_sample(stamp, value)
        else:
            pairing.take_input(kind, stamp, value)
        found += list(pairing.released())
    return found + list(pairing.released(at_once=True))


def newest(stamps, values, at):
    """The zero-order hold that is meant: the newest value not stamped after each time, or 0."""
    return np.concatenate([[0.0], values])[np.searchsorted(stamps, at, side='right')]


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(1, 7), st.integers(0, 30))
def test_order_of_arrival_within_the_wait_changes_nothing(seed, spacing, latest):
    rng = np.random.default_rng(seed)
    y = np.cumsum(rng.integers(1, 10, 40)) * MS
    u = [np.cumsum(rng.integers(1, 2 * spacing, 60)) * MS for _ in range(2)]
    values = [rng.normal(size=60) for _ in u]

    def arriving(stamps):  # a topic keeps its own order
        return np.maximum.accumulate(stamps + rng.integers(0, latest * MS + 1, len(stamps)))

    events = list(zip(arriving(y), ['y'] * 40, y, range(40), strict=True))
    for j in range(2):
        events += zip(arriving(u[j]), [j] * 60, u[j], values[j], strict=True)
    pairing = pairing_of(['header', 'header'], (2 * latest + 20) * MS, [0.0, 0.0])
    found = fed(pairing, events)
    expected = np.column_stack([newest(u[j], values[j], y) for j in range(2)])
    assert found == [(k, row) for k, row in enumerate(expected.tolist())]


def test_without_a_wait_the_newest_that_is_there_acts_and_late_ones_are_counted():
    pairing = pairing_of(['header'], 0, [7.0])
    events = [
        (1, 0, 20 * MS, 2.0), (2, 'y', 10 * MS, 'a'), (3, 'y', 20 * MS, 'b'),
        (4, 'y', 30 * MS, 'c'), (5, 0, 30 * MS, 3.0), (6, 'y', 40 * MS, 'd'),
        (7, 0, 541 * MS, 4.0), (8, 'y', 40 * MS, 'e'), (9, 'y', 41 * MS, 'f'),  # its clock jumps
    ]  # fmt: skip
    inputs = [7.0, 2.0, 2.0, 3.0, 3.0, 3.0]
    assert fed(pairing, events) == [(y, [u]) for y, u in zip('abcdef', inputs, strict=True)]
    assert (pairing.late, pairing.lacking, pairing.ahead) == (1, 0, 2)


def test_input_without_stamp_or_by_reception_holds_from_its_arrival_on():
    pairing = pairing_of(['header', 'reception'], 100 * MS, [0.0, 0.0])
    events = [
        (1, 1, 99 * MS, 5.0), (2, 'y', 10 * MS, 'a'), (3, 1, 1 * MS, 6.0), (4, 0, 10 * MS, 1.0),
        (5, 0, 0, 9.0), (6, 'y', 11 * MS, 'b'),
    ]  # fmt: skip
    assert fed(pairing, events) == [('a', [1.0, 5.0]), ('b', [9.0, 6.0])]
    assert pairing.lacking == 1  # b, as nobody fills the header


def test_clock_that_jumps_back_and_silence_leave_nothing_behind():
    pairing = pairing_of(['header'], 20 * MS, [0.0])
    events, at = [], 0
    for begin in (5000, 0, 9000):  # a bag that is played in a loop, then a jump ahead
        for k in range(0, 100, 10):
            for kind in ('y', 0):
                at += 1
                events.append((at, kind, (begin + k + 1) * MS, float(begin + k)))
    found = [sample == u[0] for sample, u in fed(pairing, events)]
    assert len(found) == 30
    assert sum(found) >= 27  # at a jump, the sample before it may not have waited
    for k in range(3 * MOST):  # y alone: memory stays bounded, samples go on
        pairing.take_sample((20_000 + k) * MS // 1000, k)
    assert len(list(pairing.released())) > 2 * MOST - 10


def test_pairing_needs_headers_on_both_sides():
    values = {'known_input_stamps': ['header'], 'input_stamp': 'source'}
    with pytest.raises(ConfigurationError, match='input_stamp is source'):
        known_inputs(values, ['u'])
