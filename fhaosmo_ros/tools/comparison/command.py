# SPDX-License-Identifier: Apache-2.0
"""Compare the observer with what people would use instead, all tuned by the same rules."""

import argparse
from collections.abc import Callable, Iterator
from concurrent.futures import as_completed, ProcessPoolExecutor
import contextlib
import multiprocessing
import multiprocessing.connection
import os
from pathlib import Path
import signal
import sys
import threading
import time
from typing import Any

from fhaosmo_ros.core.errors import ConfigurationError
from fhaosmo_ros.tools import paper_document as document
from fhaosmo_ros.tools.comparison import figures, results, steps_bound, tables
from fhaosmo_ros.tools.comparison.cells import Sensor, sensors
from fhaosmo_ros.tools.comparison.evaluation import evaluate, METHODS, seconds_a_sample
from fhaosmo_ros.tools.comparison.results import Entry, Results
from fhaosmo_ros.tools.comparison.verdicts import verdicts
from tqdm import tqdm

DOCS = Path(__file__).resolve().parents[3] / 'docs'
FOLDER, RESULTS = 'comparison', 'results.json'
TRIALS, QUICK_TRIALS = 160, 15
TRAINING, QUICK_TRAINING = 4, 1
Work = tuple[Callable[..., Any], tuple[Any, ...], tuple[Any, ...]]
"""Function, the arguments that name the result, further arguments."""


def main(argv: list[str] | None = None) -> int:
    """
    Run the command.

    Returns
    -------
    int
        0, 2 for a bad argument or output, 130 if it was interrupted.

    """
    arguments = _parser().parse_args(argv)
    quick = arguments.quick
    output = arguments.output or _default_output(quick)
    trials = arguments.trials or (QUICK_TRIALS if quick else TRIALS)
    training = QUICK_TRAINING if quick else TRAINING
    begin = time.monotonic()
    try:
        folder = output / FOLDER
        folder.mkdir(parents=True, exist_ok=True)
        found = run(sensors(quick), trials, training, arguments.jobs)
        write(found, output)
    except (ConfigurationError, OSError) as error:
        print(f'compare: error: {error}', file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print('compare: interrupted, nothing was written', file=sys.stderr)
        return 130
    print(f'\n{tables.verdict_table(verdicts(found.table(list(METHODS))))}\n')
    print(
        f'document: {output / "comparison.md"}, figures: {folder} '
        f'({time.monotonic() - begin:.0f} s)'
    )
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog='compare', description=__doc__)
    parser.add_argument(
        '--quick',
        action='store_true',
        help='a few cells and trials, for a first look and for tests',
    )
    parser.add_argument(
        '--trials', type=_positive, metavar='N',
        help=f'trials of each tuning (default: {TRIALS}, {QUICK_TRIALS} with --quick)',
    )  # fmt: skip
    parser.add_argument(
        '--jobs', type=_positive, metavar='N', default=os.cpu_count() or 1,
        help='processes (default: one a core)',
    )  # fmt: skip
    parser.add_argument(
        '--output', type=Path, metavar='FOLDER',
        help='folder for comparison.md and comparison/ (default: docs of this checkout; '
        'comparison_output with --quick or without a checkout)',
    )  # fmt: skip
    return parser


def _positive(text: str) -> int:
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f'expected an integer >= 1, got {text}')
    return value


def _default_output(quick: bool) -> Path:
    return DOCS if not quick and (DOCS / 'comparison.md').is_file() else Path('comparison_output')


def run(chosen: list[Sensor], trials: int, training: int, jobs: int) -> Results:
    """Tune and judge all methods for these sensors, in `jobs` processes."""
    tasks = [(sensor, name) for sensor in chosen for name in METHODS]
    known = [sensor for sensor in chosen if steps_bound.applies(sensor)]
    entries, bounds = {}, {}
    work: list[Work] = [(_task, task, (trials, training)) for task in tasks]
    work += [(steps_bound.bound, (sensor,), ()) for sensor in known]
    with tqdm(total=len(work), unit='tuning', desc='compare') as bar:
        for what, key, found in _done(work, jobs):
            if what is _task:
                entries[key] = found
            else:
                bounds[key[0]] = found
            bar.update()
    seconds = {
        name: seconds_a_sample(name, entries[chosen[0], name].tuned, chosen[0]) for name in METHODS
    }
    return Results(
        [entries[task] for task in tasks], seconds, trials, training,
        {sensor: bounds[sensor] for sensor in known},
    )  # fmt: skip


def _done(work: list[Work], jobs: int) -> Iterator[tuple[Any, Any, Any]]:
    """Call functions in processes; yield function, key and result as they come."""
    # One thread each for linear algebra: for matrices as small as these more only wait for each
    # other, and the processes already use all cores.
    for variable in ('OMP_NUM_THREADS', 'OPENBLAS_NUM_THREADS', 'MKL_NUM_THREADS'):
        os.environ.setdefault(variable, '1')
    context = multiprocessing.get_context('spawn')
    pool = ProcessPoolExecutor(jobs, mp_context=context, initializer=_end_with_parent)
    try:
        with _without_ctrl_c():  # a child cut off in its birth would say so
            futures = {pool.submit(call, *key, *rest): (call, key) for call, key, rest in work}
        for future in as_completed(futures):
            yield *futures[future], future.result()
    finally:
        # After Ctrl-C the tunings that run are not worth waiting for.
        for process in (pool._processes or {}).values():
            process.terminate()
        pool.shutdown(cancel_futures=True)


@contextlib.contextmanager
def _without_ctrl_c() -> Iterator[None]:
    """
    Hold Ctrl-C back until the end of the block; children that are started in it never see it.

    They inherit the mask. It is not enough here, because another thread may take the signal.
    """
    held: list[int] = []
    before = signal.signal(signal.SIGINT, lambda number, _: held.append(number))
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        signal.signal(signal.SIGINT, before)
    if held:
        raise KeyboardInterrupt


def _end_with_parent() -> None:
    """End this child when its parent has been killed, instead of waiting for work for ever."""
    parent = multiprocessing.parent_process()

    def watch() -> None:
        multiprocessing.connection.wait([parent.sentinel])
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def _task(sensor: Sensor, name: str, trials: int, training: int) -> Entry:
    tuned, scores = evaluate(sensor, name, training, trials)
    return Entry(sensor, name, tuned, scores)


def write(found: Results, output: Path) -> None:
    """Write document, figures and results."""
    folder = output / FOLDER
    results.save(found, folder / RESULTS)
    rounded = results.load(folder / RESULTS)  # so that the document is a function of the file
    figures.save_all(rounded, folder)
    document.write(output / 'comparison.md', tables.texts(rounded), 'Comparison')


if __name__ == '__main__':
    sys.exit(main())
