# SPDX-License-Identifier: Apache-2.0
"""Listens to numbers and does nothing with them."""

import signal
import sys
import threading

from fhaosmo_ros.nodes.recording.topic_recorder import ExpectedTopic, TopicRecorder
from fhaosmo_ros.topics import FLOAT


def main() -> None:
    """Listen to the topics in the arguments until SIGINT."""
    ended = threading.Event()
    signal.signal(signal.SIGINT, lambda *_: ended.set())
    expected = [ExpectedTopic(f'/{topic}', FLOAT) for topic in sys.argv[1:]]
    with TopicRecorder(lambda _: None, expected):
        print('listening', flush=True)
        ended.wait()


if __name__ == '__main__':
    main()
