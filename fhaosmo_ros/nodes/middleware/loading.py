# SPDX-License-Identifier: Apache-2.0
"""Loading the compiled core, or compiling it while the node already answers."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
import gc
import logging
import sys
import threading
from time import perf_counter

from fhaosmo_ros.core.compiled import cache
from fhaosmo_ros.core.parameters.errors import ConfigurationError
from rclpy.clock import Clock, ClockType
from rclpy.node import Node

LOOK = 0.05
"""Seconds between two looks at whether the core has been compiled."""
THREAD = 'loading'


class NodeLog(logging.Handler):
    """Passes what the core logs, such as faults of the compile cache, to the log of a node."""

    def __init__(self, node: Node) -> None:
        super().__init__()
        self._logger = node.get_logger()

    def emit(self, record: logging.LogRecord) -> None:
        """Log a warning of the core."""
        self._logger.warning(record.getMessage())


class Loading:
    """
    Loads compiled functions in a thread of its own, and then begins the node's work.

    Where machine code is in the cache, all of this is over when the constructor returns.
    Otherwise it returns as soon as the compiler begins: the node can answer calls meanwhile, and
    its executor calls `begin` when the compiler has ended.

    Parameters
    ----------
    node : Node
    load : callable
        Calls the compiled functions that the node is going to need.
    begin : callable
        Begins the node's work.

    Raises
    ------
    Exception
        What `load` or `begin` raised, here or in the executor.

    """

    def __init__(self, node: Node, load: Callable[[], None], begin: Callable[[], None]) -> None:
        self._node, self._load, self._begin = node, load, begin
        self._error: BaseException | None = None
        logging.getLogger(cache.NAME).handlers = [NodeLog(node)]
        cache.compiling.clear()
        if cache.cache_folder() is None:
            cache.compiling.set()
        self._begun = perf_counter()
        self._thread = threading.Thread(target=self._run, name=THREAD, daemon=True)
        self._thread.start()
        while self.running and not cache.compiling.is_set():
            self._thread.join(0.01)
        if not self.running:
            self._end()
            return
        clock = Clock(clock_type=ClockType.STEADY_TIME)  # /clock may stand still
        self._timer = node.create_timer(LOOK, self._look, clock=clock)

    @property
    def running(self) -> bool:
        """True until the compiler has ended."""
        return self._thread.is_alive()

    def _run(self) -> None:
        try:
            self._load()
        except BaseException as error:
            self._error = error

    def _look(self) -> None:
        if not self.running:
            self._node.destroy_timer(self._timer)
            time = perf_counter() - self._begun
            self._node.get_logger().info(f'compiled in {time:.1f} s')
            try:
                self._end()
            except ConfigurationError as error:  # what somebody has set meanwhile does not fit
                self._node.get_logger().error(f'not started: {error}')
            settle_memory()

    def _end(self) -> None:
        if self._error is not None:
            raise self._error
        self._begin()


def is_loading() -> bool:
    """Return True while this process loads or compiles: it must not end as Python usually does."""
    return any(thread.name == THREAD for thread in threading.enumerate())


def settle_memory() -> None:
    """Keep the present objects, which live to the end, out of later garbage collections."""
    gc.collect()
    gc.freeze()


@contextmanager
def without_blas() -> Iterator[None]:
    """
    Let numba load without scipy.linalg, a fifth of a warm start.

    numba asks for it only to know whether it can compile BLAS functions; the core uses none.
    """
    hidden = 'scipy.linalg' not in sys.modules
    if hidden:
        sys.modules['scipy.linalg'] = None  # type: ignore[assignment]
    try:
        yield
    finally:
        if hidden:
            del sys.modules['scipy.linalg']
