# SPDX-License-Identifier: Apache-2.0
"""Copying the messages of a bag into another one."""

from collections.abc import Iterator

from fhaosmo_ros.tools import chunks
from fhaosmo_ros.tools.bag_reader import BagReader
from fhaosmo_ros.tools.bag_writer import BagWriter
import numpy as np


def copy_topics(reader: BagReader, writer: BagWriter) -> Iterator[None]:
    """Copy every topic as it is; yields now and then, so that the caller can stop."""
    ids = {
        c.topic: writer.add(c.topic, c.msgtype, reader.types, c.ext.offered_qos_profiles, c.digest)
        for c in reader.connections
    }
    if reader.has_chunks and writer.takes_chunks:
        for storage, _, data, records in reader.chunk_records():
            numbers = np.zeros(65536, dtype=np.int64)
            for connection in storage.connections:
                numbers[connection.id] = ids[connection.topic]
            writer.write_chunk(*chunks.copy(data, records, numbers[records.channels]))
            yield
        return
    for count, (topic, stamp, message) in enumerate(reader.messages()):
        writer.write(topic, stamp, message)
        if count % 1000 == 0:
            yield
