# SPDX-License-Identifier: Apache-2.0
"""Bags for tests, written by rosbags."""

import struct

import numpy as np
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import get_typestore, Stores

TYPES = get_typestore(Stores.ROS2_JAZZY)
FLOAT = 'std_msgs/msg/Float64'
ORIGIN = 1_700_000_000_123_456_789


def signal(count, rng=None):
    """Stamps (ns) at 1 kHz with jitter, and a smooth y."""
    rng = rng or np.random.default_rng(7)
    stamps = ORIGIN + np.arange(count) * 1_000_000 + rng.integers(-200_000, 200_000, count)
    return stamps, 0.2 + 0.1 * np.sin(stamps % 10**12 * 1e-9)


def cdr(message_type, **fields):
    return bytes(TYPES.serialize_cdr(TYPES.types[message_type](**fields), message_type))


def float64(value):
    return b'\0\1\0\0' + struct.pack('<d', value)


def header(stamp, frame='base'):
    types = TYPES.types
    time = types['builtin_interfaces/msg/Time'](
        sec=int(stamp // 10**9), nanosec=int(stamp % 10**9)
    )
    return types['std_msgs/msg/Header'](stamp=time, frame_id=frame)


def write(path, messages, storage='mcap', compression=None, version=9):
    """Write (topic, type, stamp, CDR) tuples."""
    with Writer(path, version=version, storage_plugin=StoragePlugin[storage.upper()]) as bag:
        _fill(bag, messages)
    return path


def write_ros1(path, messages):
    """Write (topic, type, stamp, CDR) tuples as a bag of ROS 1, with its own message types."""
    types = get_typestore(Stores.ROS1_NOETIC)
    connections = {}
    with Ros1Writer(path) as bag:
        for topic, message_type, stamp, data in messages:
            if topic not in connections:
                connections[topic] = bag.add_connection(topic, message_type, typestore=types)
            message = TYPES.deserialize_cdr(data, message_type)
            if hasattr(message, 'header'):  # theirs has a sequence number in front
                header = types.types['std_msgs/msg/Header'](
                    seq=7, stamp=message.header.stamp, frame_id=message.header.frame_id
                )
                fields = {f: getattr(message, f) for f, _ in TYPES.fielddefs[message_type][1]}
                message = types.types[message_type](**(fields | {'header': header}))
            raw = types.serialize_ros1(message, message_type)
            bag.write(connections[topic], int(stamp), raw)
    return path


def write_compressed(path, messages, storage, mode):
    bag = Writer(path, version=9, storage_plugin=StoragePlugin[storage.upper()])
    bag.set_compression(CompressionMode[mode.upper()], CompressionFormat.ZSTD)
    with bag:
        _fill(bag, messages)
    return path


def _fill(bag, messages):
    connections = {}
    for topic, message_type, stamp, data in messages:
        if topic not in connections:
            connections[topic] = bag.add_connection(topic, message_type, typestore=TYPES)
        bag.write(connections[topic], int(stamp), data)


def floats(stamps, values, topic='/y'):
    rows = zip(stamps.tolist(), values.tolist(), strict=True)
    return [(topic, FLOAT, stamp, float64(value)) for stamp, value in rows]
