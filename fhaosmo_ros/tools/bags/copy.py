# SPDX-License-Identifier: Apache-2.0
"""Copying the messages of a bag into another one."""

from collections.abc import Iterator
from itertools import islice

from fhaosmo_ros.tools.bags.mcap import chunks
from fhaosmo_ros.tools.bags.reader import BagReader
from fhaosmo_ros.tools.bags.writer import BagWriter
import numpy as np

BATCH = 8192
"""Messages copied at a time where the bag has no chunks."""


def copy_topics(reader: BagReader, writer: BagWriter) -> Iterator[None]:
    """Copy every topic as it is; yield after each chunk or batch, so that the caller can stop."""
    ids = {
        c.topic: writer.add(c.topic, c.msgtype, reader.types, *reader.offered(c))
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
    found = reader.messages()
    while rows := list(islice(found, BATCH)):
        topics, stamps, texts = zip(*rows, strict=True)
        writer.write_many([ids[topic] for topic in topics], stamps, texts)
        yield
