# SPDX-License-Identifier: Apache-2.0
"""What all studies share: their command line, many calls at once, and our observer as a node."""

import argparse
from collections.abc import Hashable, Mapping
import multiprocessing
from multiprocessing import resource_tracker
import os
from pathlib import Path
import signal
import threading
from typing import Any

from fhaosmo_ros.core import OnlineEstimator, Trajectory
from fhaosmo_ros.core.parameters.tables import CONSTANTS
from fhaosmo_ros.stop_signals import Stop, Stopped
from fhaosmo_ros.tools.cli.progress import progress
import numpy as np
from numpy.typing import NDArray
from studies.evidence import DOCS

SELF_TUNING = {'gains': 'self_tuning'}
MODEL = ('order', 'phi', 'inputs')
POLL = 0.1
"""Seconds between two looks at what has come."""
Floats = NDArray[np.float64]


def model_alone(parameters: Mapping[str, Any]) -> dict[str, Any]:
    """Return the parameters that are the model: what a self-tuning observer is told."""
    return {k: v for k, v in parameters.items() if k in MODEL or k.startswith(CONSTANTS)}


def observed(
    parameters: Mapping[str, Any], t: Floats, y: Floats, u: Floats | None = None
) -> Trajectory:
    """Return what the node would have estimated from samples, the first one at t[0]."""
    stamps = 10**9 + np.round((t - t[0]) * 1e9).astype(np.int64)
    return OnlineEstimator(parameters).run(stamps, y, u)


def study(name: str, description: str | None) -> argparse.ArgumentParser:
    """Return a parser with the options that all studies have."""
    parser = argparse.ArgumentParser(prog=name, description=description)
    parser.add_argument(
        '--quick', action='store_true', help='little of everything: for a first look and for tests'
    )
    parser.add_argument(
        '--output', type=Path, metavar='FOLDER',
        help=f'folder for results and figures (default: docs; {name}_output with --quick)',
    )  # fmt: skip
    return parser


def with_jobs(parser: argparse.ArgumentParser) -> argparse.ArgumentParser:
    """Return the parser with an option for the number of processes."""
    parser.add_argument(
        '--jobs', type=positive, metavar='N', default=os.cpu_count() or 1,
        help='processes (default: one a core)',
    )  # fmt: skip
    return parser


def positive(text: str) -> int:
    """Return the number in an argument, which has to be 1 or more."""
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f'expected an integer >= 1, got {text}')
    return value


def output(arguments: argparse.Namespace, name: str) -> Path:
    """Return the folder that the results go to."""
    chosen: Path | None = arguments.output
    return chosen or (Path(f'{name}_output') if arguments.quick else DOCS)


def called(
    calls: Mapping[Hashable, tuple[Any, ...]], name: str, jobs: int, stop: Stop
) -> dict[Hashable, Any]:
    """
    Return the results of calls (function, arguments) in several processes, by key, in order.

    The main process only waits, and a signal sets `stop`: nothing is raised in the middle of
    anything, where a lock would stay locked or a library would make another error of it.

    Raises
    ------
    Stopped
        `stop` is set; the processes have ended.

    """
    for variable in ('OMP_NUM_THREADS', 'OPENBLAS_NUM_THREADS', 'MKL_NUM_THREADS'):
        os.environ.setdefault(variable, '1')  # the processes already use all cores
    found = {}
    # Inherited: only this process takes signals, and ends the others.
    signals = {signal.SIGINT, signal.SIGHUP}
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, signals)
    resource_tracker.ensure_running()  # which unblocks SIGINT (Python 3.11), so once more
    signal.pthread_sigmask(signal.SIG_BLOCK, signals)
    with multiprocessing.get_context('spawn').Pool(jobs, _end_with_parent) as pool:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        waiting = {key: pool.apply_async(call[0], call[1:]) for key, call in calls.items()}
        with progress(total=len(calls), unit='part', desc=name) as bar:
            while waiting:
                if stop.wait(POLL):
                    raise Stopped
                for key in [key for key, result in waiting.items() if result.ready()]:
                    found[key] = waiting.pop(key).get()
                    bar.update()
    return {key: found[key] for key in calls}


def _end_with_parent() -> None:
    """End this process once its parent has: a killed one does not end it."""

    def watch() -> None:
        multiprocessing.parent_process().join()
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
