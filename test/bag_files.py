# SPDX-License-Identifier: Apache-2.0
"""Bags for tests, written by rosbags, and those of mcap's presets by the mcap package."""

import struct

from fhaosmo_ros.tools.bags.types import header, serialise, TYPES
from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter
import numpy as np
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
import yaml

FLOAT, JOINTS = 'std_msgs/msg/Float64', 'sensor_msgs/msg/JointState'
ORIGIN = 1_700_000_000_123_456_789
PRESETS = {
    'plain': {'compression': CompressionType.NONE},
    'zstd': {'compression': CompressionType.ZSTD},
    'lz4': {'compression': CompressionType.LZ4},
    'fastwrite': {'use_chunking': False},
    'fastwrite_crc': {'use_chunking': False, 'enable_data_crcs': True},
    'zstd_fast': {'compression': CompressionType.ZSTD, 'enable_crcs': False},
}
"""Of Jazzy's mcap storage, and one with a CRC of all that is not in chunks."""


def signal(count):
    """Stamps (ns) at 1 kHz with jitter, and a smooth y."""
    rng = np.random.default_rng(7)
    stamps = ORIGIN + np.arange(count) * 1_000_000 + rng.integers(-200_000, 200_000, count)
    return stamps, 0.2 + 0.1 * np.sin(stamps % 10**12 * 1e-9)


def float64(value):
    return b'\0\1\0\0' + struct.pack('<d', value)


def floats(stamps, values, topic='/y'):
    rows = zip(stamps.tolist(), values.tolist(), strict=True)
    return [(topic, FLOAT, stamp, float64(value)) for stamp, value in rows]


def joint_state(stamp, position, names=('a', 'b', 'c'), effort=()):
    """Return the CDR of joints."""
    return serialise(
        JOINTS, header=header(stamp), name=list(names), position=np.array(position),
        velocity=np.zeros(0), effort=np.array(effort),
    )  # fmt: skip


def write(path, messages, storage='mcap', compression='none', version=9):
    """Write (topic, type, stamp, CDR) tuples; compression: none, file or message."""
    bag = Writer(path, version=version, storage_plugin=StoragePlugin[storage.upper()])
    bag.set_compression(CompressionMode[compression.upper()], CompressionFormat.ZSTD)
    with bag:
        connections = {}
        for topic, message_type, stamp, data in messages:
            if topic not in connections:
                connections[topic] = bag.add_connection(topic, message_type, typestore=TYPES)
            bag.write(connections[topic], int(stamp), data)
    return path


def write_preset(path, messages, preset, published=None, parts=1):
    """
    Write (topic, type, stamp, CDR) tuples as one of `PRESETS`, to so many files.

    `published` are the publish times, by default the stamps.
    """
    write(path, messages)  # for its metadata
    (path / f'{path.name}.mcap').unlink()
    published = [m[2] for m in messages] if published is None else published
    rows = list(zip(messages, published, strict=True))
    share = -(-len(rows) // parts)
    names = [f'{path.name}_{k}.mcap' for k in range(parts)]
    for k, name in enumerate(names):
        with (path / name).open('wb') as stream:
            writer = McapWriter(stream, chunk_size=20_000, **PRESETS[preset])
            writer.start(profile='ros2', library='libmcap 1.3.1')
            channels = {}
            for (topic, kind, stamp, data), sent in rows[k * share : (k + 1) * share]:
                if topic not in channels:
                    text, _ = TYPES.generate_msgdef(kind, ros_version=2)
                    schema = writer.register_schema(kind, 'ros2msg', text.encode())
                    extra = {'offered_qos_profiles': '[]'}
                    channels[topic] = writer.register_channel(topic, 'cdr', schema, extra)
                writer.add_message(channels[topic], int(stamp), data, int(sent))
            writer.finish()
    information = yaml.safe_load((path / 'metadata.yaml').read_text())
    information['rosbag2_bagfile_information'] |= {'relative_file_paths': names, 'files': []}
    (path / 'metadata.yaml').write_text(yaml.safe_dump(information))
    return path
