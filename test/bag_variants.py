# SPDX-License-Identifier: Apache-2.0
"""Bags as rosbag2 of Humble and of Jazzy lays them out, written without rosbags."""

import sqlite3

from backports import zstd
import bag_files as files
from mcap.writer import CompressionType, Writer
import yaml

KIND = 'std_msgs/msg/Float64'
QOS_NUMBERS = [{
    'history': 1, 'depth': 10, 'reliability': 1, 'durability': 2,
    'deadline': {'sec': 9223372036, 'nsec': 854775807},
    'lifespan': {'sec': 9223372036, 'nsec': 854775807}, 'liveliness': 1,
    'liveliness_lease_duration': {'sec': 9223372036, 'nsec': 854775807},
    'avoid_ros_namespace_conventions': False,
}]  # fmt: skip
QOS_NAMES = [
    QOS_NUMBERS[0] | {
        'history': 'keep_last', 'reliability': 'reliable', 'durability': 'volatile',
        'liveliness': 'automatic',
    }
]  # fmt: skip
HASH = files.TYPES.hash_rihs01(KIND)
MCAP = {
    'plain': {'compression': CompressionType.NONE},
    'zstd': {'compression': CompressionType.ZSTD},
    'lz4': {'compression': CompressionType.LZ4},
    'fastwrite': {'use_chunking': False},  # presets of Jazzy; this one has no chunks
    'zstd_fast': {'compression': CompressionType.ZSTD, 'enable_crcs': False},
}
VARIANTS = [
    *((distribution, 'mcap', preset) for distribution in ('humble', 'jazzy') for preset in MCAP),
    *((distribution, 'sqlite3', how) for distribution in ('humble', 'jazzy')
      for how in ('plain', 'FILE', 'MESSAGE')),
    ('humble', 'mcap', 'FILE'), ('jazzy', 'mcap', 'FILE'),
]  # fmt: skip


def write(path, messages, distribution, storage, how, parts=1, published=None):
    """
    Write (topic, type, stamp, CDR) of Float64, to so many files one after the other.

    In mcap, `published` are the publish times, by default the stamps.
    """
    published = [m[2] for m in messages] if published is None else published
    path.mkdir()
    share = -(-len(messages) // parts)
    pieces = [messages[k : k + share] for k in range(0, len(messages), share)]
    names = []
    for k, piece in enumerate(pieces):
        suffix = 'mcap' if storage == 'mcap' else 'db3'
        file = path / f'{path.name}_{k}.{suffix}'
        if storage == 'mcap':
            times = published[k * share :]
            _mcap(file, piece, times, distribution, MCAP.get(how, MCAP['plain']))
        else:
            _sqlite(file, piece, distribution, how == 'MESSAGE')
        if how == 'FILE':
            packed = file.with_name(f'{file.name}.zstd')
            packed.write_bytes(zstd.compress(file.read_bytes()))
            file.unlink()
            file = packed
        names.append(file.name)
    _metadata(path, messages, pieces, names, distribution, storage, how)
    return path


def _mcap(file, messages, published, distribution, options):
    with file.open('wb') as stream:
        writer = Writer(stream, chunk_size=20_000, **options)
        writer.start(profile='ros2', library='libmcap 1.3.1')
        text, _ = files.TYPES.generate_msgdef(KIND, ros_version=2)
        schema = writer.register_schema(KIND, 'ros2msg', text.encode())
        channels = {}
        for (topic, _, stamp, data), sent in zip(messages, published, strict=False):
            if topic not in channels:
                qos = QOS_NUMBERS if distribution == 'humble' else QOS_NAMES
                extra = {'offered_qos_profiles': yaml.safe_dump(qos)}
                if distribution == 'jazzy':
                    extra['topic_type_hash'] = HASH
                channels[topic] = writer.register_channel(topic, 'cdr', schema, extra)
            writer.add_message(channels[topic], int(stamp), data, int(sent))
        writer.finish()


def _sqlite(file, messages, distribution, compressed):
    hashed = ', type_description_hash TEXT NOT NULL' if distribution == 'jazzy' else ''
    with sqlite3.connect(file) as database:
        database.executescript(f"""
            CREATE TABLE schema(schema_version INTEGER PRIMARY KEY, ros_distro TEXT NOT NULL);
            CREATE TABLE metadata(id INTEGER PRIMARY KEY, metadata_version INTEGER NOT NULL,
                metadata TEXT NOT NULL);
            CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT NOT NULL, type TEXT NOT NULL,
                serialization_format TEXT NOT NULL, offered_qos_profiles TEXT NOT NULL{hashed});
            CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER NOT NULL,
                timestamp INTEGER NOT NULL, data BLOB NOT NULL);
            CREATE INDEX timestamp_idx ON messages (timestamp ASC);
            INSERT INTO schema VALUES ({4 if distribution == 'jazzy' else 3}, '{distribution}');
        """)
        if distribution == 'jazzy':
            text, _ = files.TYPES.generate_msgdef(KIND, ros_version=2)
            database.execute(
                'CREATE TABLE message_definitions(id INTEGER PRIMARY KEY, topic_type TEXT NOT '
                'NULL, encoding TEXT NOT NULL, encoded_message_definition TEXT NOT NULL, '
                'type_description_hash TEXT NOT NULL)'
            )
            database.execute(
                'INSERT INTO message_definitions VALUES (1, ?, ?, ?, ?)',
                (KIND, 'ros2msg', text, HASH),
            )
        topics = sorted({m[0] for m in messages})
        qos = yaml.safe_dump(QOS_NUMBERS if distribution == 'humble' else QOS_NAMES)
        for k, topic in enumerate(topics):
            row = (k + 1, topic, KIND, 'cdr', qos) + ((HASH,) if hashed else ())
            database.execute(f'INSERT INTO topics VALUES ({",".join("?" * len(row))})', row)
        database.executemany(
            'INSERT INTO messages(topic_id, timestamp, data) VALUES (?, ?, ?)',
            [
                (topics.index(topic) + 1, int(stamp), zstd.compress(data) if compressed else data)
                for topic, _, stamp, data in messages
            ],
        )
    database.close()


def _metadata(path, messages, pieces, names, distribution, storage, how):
    jazzy = distribution == 'jazzy'
    topics = []
    for topic in sorted({m[0] for m in messages}):
        metadata = {'name': topic, 'type': KIND, 'serialization_format': 'cdr'}
        metadata['offered_qos_profiles'] = QOS_NAMES if jazzy else yaml.safe_dump(QOS_NUMBERS)
        if jazzy:
            metadata['type_description_hash'] = HASH
        count = sum(m[0] == topic for m in messages)
        topics.append({'topic_metadata': metadata, 'message_count': count})

    def span(part):
        first, last = int(part[0][2]), int(part[-1][2])
        return {
            'starting_time': {'nanoseconds_since_epoch': first},
            'duration': {'nanoseconds': last - first}, 'message_count': len(part),
        }  # fmt: skip

    mode = how if how in ('FILE', 'MESSAGE') else ''
    information = {
        'version': 9 if jazzy else 5, 'storage_identifier': storage, **span(messages),
        'topics_with_message_count': topics, 'compression_format': 'zstd' if mode else '',
        'compression_mode': mode, 'relative_file_paths': names,
        'files': [
            {'path': name, **span(part)} for name, part in zip(names, pieces, strict=True)
        ],
    }  # fmt: skip
    if jazzy:
        information |= {'custom_data': None, 'ros_distro': 'jazzy'}
    content = {'rosbag2_bagfile_information': information}
    (path / 'metadata.yaml').write_text(yaml.safe_dump(content, sort_keys=False))
