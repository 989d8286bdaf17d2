# SPDX-License-Identifier: Apache-2.0
"""Child processes that never outlive their parent's block: programs, and workers of a pool."""

from collections.abc import Iterator, Mapping
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
import contextlib
import multiprocessing
import multiprocessing.connection
import os
from pathlib import Path
import signal
import subprocess
import sys
import threading
from typing import Any, ClassVar, TypeVar

from fhaosmo_ros.core.parameters.errors import ConfigurationError
from fhaosmo_ros.stop_signals import ending_signals, SIGNALS, Stop, Stopped

GRACE = 5.0
"""Seconds that a child has to end by itself."""
POLL = 0.1
"""Seconds between two looks at the event that a signal sets."""

Key = TypeVar('Key')


class Child:
    """
    A Python process whose output goes to a file.

    Parameters
    ----------
    log : path
        Its output.
    arguments : str
        What follows ``python``.
    environment : dict, optional
        Variables to add.
    options
        For `subprocess.Popen`: ``start_new_session=True`` lets Ctrl-C in a terminal reach only
        the parent.

    """

    failure: ClassVar[type[Exception]] = ConfigurationError
    """What `check` raises."""

    def __init__(
        self,
        log: Path,
        *arguments: str,
        environment: Mapping[str, str] | None = None,
        **options: Any,
    ) -> None:
        self._log = log
        with log.open('wb') as output:
            self._process = subprocess.Popen(
                [sys.executable, *arguments],
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT,
                env={**os.environ, **(environment or {})},
                **options,
            )
        self.pid = self._process.pid

    def output(self) -> str:
        """Return what the child has printed so far."""
        return self._log.read_text(errors='replace')

    def check(self) -> None:
        """Raise, with the end of its output, if the child has ended."""
        if self._process.poll() is not None:
            lines = self.output().splitlines()
            raise self.failure(
                f'{self._log.stem} ended with exit code {self._process.returncode}: '
                f'{" / ".join(lines[-2:]) or "without a word"}'
            )

    def interrupt(self) -> None:
        """Ask the child to end."""
        if self._process.poll() is None:
            self._process.send_signal(signal.SIGINT)

    def end(self) -> None:
        """Wait for the child's end, and kill it if it takes more than `GRACE` seconds."""
        try:
            self._process.wait(GRACE)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()


class Children:
    """
    Children that all end with its block.

    Parameters
    ----------
    folder : path
        Each child's output goes to ``<name>.log`` there.

    """

    kind: ClassVar[type[Child]] = Child

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._children: list[Child] = []

    def start(self, name: str, *arguments: str, **options: Any) -> Any:
        """Start a child; see `Child`."""
        child = self.kind(self._folder / f'{name}.log', *arguments, **options)
        self._children.append(child)
        return child

    def start_node(self, name: str, *arguments: str) -> Child:
        """Start one of this package's nodes."""
        return self.start(name, '-m', 'fhaosmo_ros', name, *arguments)

    def check(self) -> None:
        """Raise if one of them has ended."""
        for child in self._children:
            child.check()

    def __enter__(self) -> 'Children':
        return self

    def __exit__(self, *_: object) -> None:
        # A second Ctrl-C must not cut the clean-up.
        handlers = {n: signal.signal(n, lambda *_: None) for n in ending_signals()}
        try:
            for child in self._children:
                child.interrupt()
            for child in self._children:
                child.end()
        finally:
            for number, handler in handlers.items():
                signal.signal(number, handler)


class Workers:
    """
    Processes that compute; they end with its block, and also if their parent is killed.

    They never see SIGINT, SIGTERM and SIGHUP, which may reach a whole group of processes: only the
    parent takes these, and it ends the workers. Linear algebra has one thread in each worker: for
    small matrices more threads only wait for each other, and the workers already use all cores.

    Parameters
    ----------
    jobs : int
        Number of processes.
    stop : Stop
        What signals set; `results` then raises Stopped.

    """

    def __init__(self, jobs: int, stop: Stop) -> None:
        self._stop = stop
        for variable in ('OMP_NUM_THREADS', 'OPENBLAS_NUM_THREADS', 'MKL_NUM_THREADS'):
            os.environ.setdefault(variable, '1')
        # spawn: a fork after rclpy has started threads can hang.
        context = multiprocessing.get_context('spawn')
        # This starts multiprocessing's resource tracker, which inherits the mask: it handles
        # SIGINT and SIGTERM only, so that a SIGHUP to the group would kill it.
        with _signals_blocked():
            self._pool = ProcessPoolExecutor(
                jobs, mp_context=context, initializer=_end_with_parent
            )

    def results(self, calls: Mapping[Key, tuple[Any, ...]]) -> Iterator[tuple[Key, Any]]:
        """
        Call functions, and yield each call's key and result as they come.

        Parameters
        ----------
        calls : mapping
            By key: a function of a module, and its arguments.

        Raises
        ------
        Stopped
            A signal came.

        """
        # A worker inherits the mask, so it takes no signal from its very beginning.
        with _signals_blocked():
            keys = {self._pool.submit(*call): key for key, call in calls.items()}
        left = set(keys)
        while left:
            done, left = wait(left, POLL, return_when=FIRST_COMPLETED)
            if self._stop.is_set():
                raise Stopped
            for future in done:
                yield keys[future], future.result()

    def __enter__(self) -> 'Workers':
        return self

    def __exit__(self, *_: object) -> None:
        for process in (self._pool._processes or {}).values():
            process.kill()  # what it computes is not worth waiting for
        self._pool.shutdown(cancel_futures=True)


@contextlib.contextmanager
def _signals_blocked() -> Iterator[None]:
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)


def _end_with_parent() -> None:
    """End this worker when its parent has been killed, instead of waiting for work for ever."""
    parent = multiprocessing.parent_process()

    def watch() -> None:
        multiprocessing.connection.wait([parent.sentinel])
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
