# SPDX-License-Identifier: Apache-2.0
"""Starting, spinning and stopping a node: what both nodes' `main` share."""

from collections.abc import Callable
import faulthandler
import gc
import os
import re
import sys
import threading
import traceback
from typing import Any

from fhaosmo_ros.core.parameters.errors import ConfigurationError
from fhaosmo_ros.core.parameters.files import with_origin
from fhaosmo_ros.nodes.middleware.arguments import help_of, Origins, read_arguments
from fhaosmo_ros.stop_signals import stop_on_signals, Stopped
import rclpy
from rclpy.exceptions import InvalidHandle
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from rclpy.task import Future

try:
    from rclpy.experimental import EventsExecutor
except ImportError:  # an older rclpy
    EventsExecutor = None

PATIENCE = 20.0
"""Seconds after a signal in which the middleware has to end, or the process ends without it."""
FOREVER = 3600.0
"""
Seconds. Without a finite timeout, the events executor of the PyPI wheels (rclpy 7.1) never runs a
callback and keeps a core busy.
"""


class Spinner:
    """
    Runs a node in a thread of its own while it is open, then destroys it and ends its context.

    The usual main (`rclpy.init`, ``executor.spin()``, except KeyboardInterrupt) hangs on SIGINT
    with the events executor of rclpy 7.1. So that spins here until a future is done, at which
    `wake` makes it look, and the main thread waits for signals: Python runs handlers there only.

    `on_end` is called in that thread when it ends, also by the `error` that a callback raised. At
    the end a callback has `grace` seconds to end, or the node stays; None: as long as it takes.
    """

    grace: float | None = 0.5

    def __init__(self, node: Node, on_end: Callable[[], None] = lambda: None) -> None:
        self.error: BaseException | None = None
        self.node, self._on_end = node, on_end
        # At 1 kHz the events executor takes a fifth of the CPU of the single-threaded one.
        kind = EventsExecutor or SingleThreadedExecutor
        self._executor = kind(context=node.context)
        self._executor.add_node(node)
        self._stop = Future()
        self._thread = threading.Thread(target=self._spin, name='executor', daemon=True)

    def __enter__(self) -> Any:
        # What there is now lives to the end, so garbage collections need not look at it. One that
        # does takes 70 ms, in which the middleware waits for Python and drops messages.
        gc.collect()
        gc.freeze()
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set_result(None)
        self._executor.wake()
        self._thread.join(timeout=self.grace)
        self.stuck = self._thread.is_alive()  # a callback is still running
        if not self.stuck:
            self._executor.shutdown()
            self.node.destroy_node()
            rclpy.try_shutdown(context=self.node.context)

    def _spin(self) -> None:
        try:
            while not self._stop.done():
                try:
                    self._executor.spin_until_future_complete(self._stop, timeout_sec=FOREVER)
                except InvalidHandle:
                    # The events executor of rclpy 7.1 still calls a service that was destroyed
                    # while its request waited, and then cannot send the answer. The
                    # single-threaded executor passes over such requests by itself.
                    self.node.get_logger().warning(
                        'dropped a request to a service that was destroyed meanwhile',
                        throttle_duration_sec=5.0,
                    )
        except BaseException as error:
            if not self._stop.done():
                self.error = error
        finally:
            self._on_end()


def run_node(name: str, factory: Callable[..., Node], argv: list[str] | None) -> int:
    """
    Run the node that `factory` makes of given parameters, until SIGINT, SIGTERM or SIGHUP.

    Returns the exit code: 0 after a signal, 1 if a callback failed, 2 for a bad configuration,
    which is said in one line on stderr. `argv` is None for the arguments of the process. rclpy's
    own signal handlers are off: SIGINT would come out of the events executor as a RuntimeError,
    and a second Ctrl-C would cut the clean-up short.
    """
    argv = sys.argv[1:] if argv is None else argv
    if '-h' in argv or '--help' in argv:
        print(help_of(name))
        return 0
    ended = stop_on_signals()
    origins: Origins = {}
    try:
        with ended.raising():
            given, origins, rest = read_arguments(name, argv)
            rclpy.init(args=[name, *rest], signal_handler_options=SignalHandlerOptions.NO)
            node = factory(given)
        with Spinner(node, on_end=ended.set) as spinner:
            ended.wait()
            # Says where each thread was: an end that takes so long is an error to look into.
            faulthandler.dump_traceback_later(PATIENCE, exit=True)
        if spinner.stuck:  # a node has nothing to save
            print(f'{name}: ended while a callback was running', file=sys.stderr, flush=True)
            os._exit(0)
        if spinner.error is not None:
            print(f'{name}: error: a callback failed', file=sys.stderr)
            traceback.print_exception(spinner.error)
            return 1
    except Stopped:
        pass
    except (ConfigurationError, RuntimeError) as error:  # the latter is rcl's
        text = of_rcl(with_origin(error, origins))
        unknown = 'unknown ROS arguments ' * (type(error).__name__ == 'UnknownROSArgsError')
        print(f'{name}: error: {unknown}{" ".join(text.split())}', file=sys.stderr)
        return 2
    finally:
        rclpy.try_shutdown()
        faulthandler.cancel_dump_traceback_later()
    return 0


def of_rcl(error: Exception) -> str:
    """Return what rcl says, without its places in C, and what to do where it has no folder."""
    text = re.sub(r', at \S+:\d+', '', str(error))
    return text + '; set HOME or ROS_LOG_DIR' * ('logging directory' in text)
