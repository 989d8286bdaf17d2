# SPDX-License-Identifier: Apache-2.0
"""Listens to numbers and does nothing with them."""

import signal
import sys
import threading

from fhaosmo_ros.nodes.recorder import Recorder
from std_msgs.msg import Float64


def main() -> None:
    """Listen to the topics in the arguments until SIGINT."""
    ended = threading.Event()
    signal.signal(signal.SIGINT, lambda *_: ended.set())
    with Recorder(
        dict.fromkeys((f'/{topic}' for topic in sys.argv[1:]), Float64), lambda *_: None
    ):
        print('listening', flush=True)
        ended.wait()


if __name__ == '__main__':
    main()
