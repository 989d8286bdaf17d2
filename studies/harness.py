# SPDX-License-Identifier: Apache-2.0
"""What all studies share: their command, many calls at once, and our observer as a node."""

import argparse
from collections.abc import Callable, Hashable, Iterable, Mapping
from concurrent.futures import ProcessPoolExecutor, wait
import multiprocessing
import os
from pathlib import Path
import signal
import threading
from typing import Any, NamedTuple

from fhaosmo_ros.core import OnlineEstimator, Trajectory
from fhaosmo_ros.core.parameters.declaration import ParameterTable
from fhaosmo_ros.core.parameters.errors import ConfigurationError
from fhaosmo_ros.core.parameters.tables import MODEL
from fhaosmo_ros.stop_signals import Stop, Stopped
from fhaosmo_ros.tools.cli.command import progress, run_command
from fhaosmo_ros.tools.tuning.tuner import stamps_of
from matplotlib.figure import Figure
import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm
from studies import evidence
from studies.evidence import DOCS, Row

SELF_TUNING = {'gains': 'self_tuning'}
model_alone = ParameterTable(MODEL).part_of  # the parameters that self-tuning is told
POLL = 0.1  # seconds between two looks at what has come
Floats = NDArray[np.float64]
Call = tuple[Any, ...]  # a function of a module, and its arguments
Results = Callable[[Mapping[Hashable, Call]], dict[Any, Any]]
"""Returns what calls return, by key: `called` for one study."""


class Found(NamedTuple):
    """What a study publishes: lines by table, parts of the page, figures by name."""

    tables: Mapping[str, list[Row]]
    texts: Mapping[str, str]
    figures: Mapping[str, Figure]


def discretised(rates: Floats, driven: int, period: float) -> tuple[Floats, Floats]:
    """
    Return transition and noise over a period for x' = rates x and white noise on one state.

    C. F. Van Loan, IEEE Trans. Automatic Control 23(3), 1978, doi:10.1109/TAC.1978.1101743.
    """
    n, drive = len(rates), np.diag(np.eye(len(rates))[driven])
    block = expm(np.block([[-rates, drive], [np.zeros((n, n)), rates.T]]) * period)
    transition = block[n:, n:].T
    return transition, transition @ block[:n, n:]


def run_study(
    name: str,
    description: str | None,
    measure: Callable[[argparse.Namespace, Results], Found],
    options: Iterable[tuple[str, dict[str, Any]]] = (),
) -> int:
    """
    Run the command of a study: measure, and write what was found into a folder.

    `measure` gets the arguments, with the folder as `output`, and a function that computes calls
    in several processes; `options` are arguments beside those that all studies have.
    """
    parser = argparse.ArgumentParser(prog=name, description=description)
    add = parser.add_argument
    for argument, settings in options:
        add(argument, **settings)
    add('--quick', action='store_true', help='little of everything: for a first look, for tests')
    add(
        '--output', type=Path, metavar='FOLDER',
        help=f'folder for results and figures (default: docs; {name}_output with --quick)',
    )  # fmt: skip
    add(
        '--jobs', type=int, metavar='N', default=os.cpu_count() or 1,
        help='processes (default: one a core)',
    )  # fmt: skip

    def body(arguments: argparse.Namespace, stop: Stop) -> None:
        if arguments.jobs < 1:
            raise ConfigurationError(f'--jobs: expected an integer >= 1, got {arguments.jobs}')
        usual = Path(f'{name}_output') if arguments.quick else DOCS
        arguments.output = arguments.output or usual
        found = measure(arguments, lambda calls: called(calls, name, arguments.jobs, stop))
        evidence.publish(arguments.output, *found)

    return run_command(parser, None, body)


def called(calls: Mapping[Hashable, Call], name: str, jobs: int, stop: Stop) -> dict[Any, Any]:
    """
    Return the results of calls in several processes, by key, in order.

    The main process only waits, and a signal sets `stop`: nothing is raised in the middle of
    anything, where a lock would stay locked or a library would make another error of it. Raises
    `Stopped` then, and BrokenProcessPool if a process ended, or could not load its call.
    """
    for variable in ('OMP_NUM_THREADS', 'OPENBLAS_NUM_THREADS', 'MKL_NUM_THREADS'):
        os.environ.setdefault(variable, '1')  # the processes already use all cores
    spawn = multiprocessing.get_context('spawn')
    with ProcessPoolExecutor(jobs, spawn, _end_with_parent) as pool:
        try:
            futures = {key: pool.submit(*call) for key, call in calls.items()}
            waiting = set(futures.values())
            with progress(total=len(calls), unit='part', desc=name) as bar:
                while waiting:
                    if stop.wait(POLL):
                        raise Stopped
                    done, waiting = wait(waiting, timeout=0.0)
                    for future in done:
                        future.result()  # raises what the call has raised
                        bar.update()
        except BaseException:
            for process in multiprocessing.active_children():
                process.terminate()
            raise
    return {key: future.result() for key, future in futures.items()}


def _end_with_parent() -> None:
    """End this process once its parent has, also a killed one; signals are for the parent."""
    for number in (signal.SIGINT, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)

    def watch() -> None:
        multiprocessing.parent_process().join()
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def observed(parameters: Mapping[str, Any], r: Any) -> Trajectory:
    """Return what the node would have estimated from t, y and u of a recording."""
    estimator = OnlineEstimator(parameters)
    u = r.u if estimator.observer.used_inputs else None
    return estimator.run(stamps_of(r.t - r.t[0]), r.y, u)
