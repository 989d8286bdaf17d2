# SPDX-License-Identifier: Apache-2.0
"""
Run plant, fault injector and estimator for a long time, and say what grew, drifted or got lost.

`make soak MINUTES=30`. Exit code 0 if everything held, 1 if not, 3 if all that did not is
explained by a machine that stalled, 130 after Ctrl-C. With ``--retries`` a run that ends with 3 is
repeated, and no other.
"""

import argparse
from collections import Counter, defaultdict
import json
import os
from pathlib import Path
import signal
import sys
from time import monotonic, sleep, time_ns
from typing import NamedTuple

from children import Child, Children, ROOT
from heartbeat import Heartbeat
from node import isolate, wait_until
import numpy as np
from numpy.typing import NDArray
from results import CannotMeasureError, render, Row
from scipy.stats import theilslopes
from tqdm import tqdm

PARAMETERS = ('--ros-args', '--params-file', str(ROOT / 'config' / 'demo.yaml'))
ESTIMATOR = ('-r', 'y:=faulty_y', '-p', 'spike_gate:=1.0', '-p', 'gamma_leakage:=1.0',
             '-p', 'gamma_dead_zone:=0.0')  # fmt: skip
"""What docs/node.md advises for a node that nobody looks after."""
RATE = 500.0
TRUTH, ESTIMATE = '/plant/unknown_input', '/estimator/unknown_input'
GAMMA, STAMP = '/estimator/gamma', '/estimator/stamp'
ARRAYS = ('/estimator/state', '/estimator/innovation')
PAIRED = 5_000_000
"""Nanoseconds within which the topics of one estimate are published."""
STALLED = 3
"""Exit code."""
MEMORY = 2.0
"""MB that memory may grow by over the run."""
ERROR, ERROR_GROWTH, MANY = 0.05, 0.01, 15
"""
Largest median error of d in any judged window (half of d's amplitude), what it may grow by between
the first and the last third, and from how many windows on that is judged.
"""
DRIFT = 0.02
"""What gamma may move between the first and the last third."""
LATE, LOSS, REPORTED = 0.005, 0.02, 3
"""
Beats late by `LATE` seconds count for lost samples; `LOSS` seconds of them explain some, for at
500 Hz that fills a writer's queue of 10, and the estimator reports them within `REPORTED` seconds.
"""
SLOW = 0.05
"""
Part of a window that beats were late by if its error says nothing. Measured with other work on two
cores: late by 2 to 7 % of a window, and the error of d was 0.012 to 0.025 instead of 0.01.
"""
LOST, GROWTH, WORST = (
    'samples lost, by sequence number', 'error of d, growth', 'error of d, worst window',
)  # fmt: skip


class Course(NamedTuple):
    """
    What was measured over time.

    Attributes
    ----------
    memory : dict of str to (K, 2) array
        Seconds and MB (resident) of each process.
    windows : (W, 3) array
        Of each judged window: seconds, median error of d, median of gamma.
    outputs, not_finite : int
        Values published, and those that were NaN or infinite.
    taken, lost : int
        Samples that the estimator used or rejected, and that it missed in the sequence numbers.
    losses : list of float
        Times at which it was seen that it had missed some, in seconds since the start.
    beats : (K, 2) array
        When a beat of the heartbeat was late, and by how much (s).
    faults, calls : Counter
        What was injected, what was called.

    """

    memory: dict[str, NDArray[np.float64]]
    windows: NDArray[np.float64]
    outputs: int
    not_finite: int
    taken: int
    lost: int
    losses: list[float]
    beats: NDArray[np.float64]
    faults: Counter[str]
    calls: Counter[str]

    def late(self, start: float, end: float, least: float = 0.0) -> float:
        """Return by how many seconds beats came late in this time."""
        at, late = self.beats.T
        return float(late[(at >= start) & (at <= end) & (late >= least)].sum())


def main(argv: list[str] | None = None) -> int:
    """Run, print the verdict; see the top of this file for the exit code."""
    parser = argparse.ArgumentParser(prog='make soak', description='Run for long, with faults.')
    parser.add_argument('--minutes', type=float, default=2.0, help='at least 2')
    parser.add_argument('--seed', type=int, default=1, help='of the schedule of faults')
    parser.add_argument('--output', type=Path, default=Path('soak_output'), help='folder')
    parser.add_argument(
        '--retries', type=int, default=0, help='if nothing failed but what a stall explains'
    )
    arguments = parser.parse_args(argv)
    if arguments.minutes < 2.0:
        parser.error(f'argument --minutes: expected at least 2, got {arguments.minutes:g}')
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.default_int_handler)
    try:
        isolate()
        for _ in range(arguments.retries + 1):
            code = _soak(arguments.seed, arguments.minutes, arguments.output)
            if code != STALLED:
                break
        return code
    except KeyboardInterrupt:
        print('interrupted', file=sys.stderr)
        return 130
    except CannotMeasureError as error:
        print(f'soak: {error}', file=sys.stderr)
        return 1


def _soak(seed: int, minutes: float, output: Path) -> int:
    """Run once, write and print the verdict; return the exit code."""
    course = run(seed, minutes * 60.0)
    rows = verdict(course)
    faults = ', '.join(f'{n:,} {k}' for k, n in sorted(course.faults.items()))
    text = (
        f'{minutes:g} minutes, seed {seed}, {os.cpu_count()} cores, load '
        f'{os.getloadavg()[1]:.1f}: {faults}\n\n{render(rows)}\n'
    )
    output.mkdir(parents=True, exist_ok=True)
    (output / 'soak.txt').write_text(text)
    np.savetxt(output / 'windows.csv', course.windows, delimiter=',', header='t,error,gamma')
    print(text)
    missed = [row.name for row in rows if row.missed]
    if not missed:
        print('passed')
        return 0
    stalled = explained(course).issuperset(missed)
    print(f'{"STALLED" if stalled else "FAILED"}: {"; ".join(missed)}')
    return STALLED if stalled else 1


def run(seed: int, seconds: float) -> Course:
    """Run a soak and return its course."""
    from fhaosmo_ros.topics import ARRAY, FLOAT, TIME  # needs ROS
    from soak_client import SoakClient
    from watch import Watch

    topics = dict.fromkeys((TRUTH, ESTIMATE, GAMMA), FLOAT) | {STAMP: TIME}
    topics |= dict.fromkeys(ARRAYS, ARRAY)

    with (
        Heartbeat() as heartbeat, Children() as children, Watch(topics) as watch,
        SoakClient() as client,
    ):  # fmt: skip
        estimator = children.start(
            'estimator', '-m', 'fhaosmo_ros', 'estimator', *PARAMETERS, *ESTIMATOR
        )
        plant = children.start(
            'plant', 'benchmark/soak_plant.py', '--seed', str(seed), '--seconds', str(seconds),
            *PARAMETERS, '-p', f'sample_rate:={RATE}',
        )  # fmt: skip
        estimator.wait_for('estimating')
        plant.wait_for('injecting')
        client.learn()
        start = monotonic()
        nodes = {'estimator': estimator, 'plant': plant}
        memory, windows, losses = _follow(seed, seconds, nodes, watch, client)
        beats = np.array([(0.0, 0.0), *((at - start, late) for at, late in heartbeat.beats())])
        plant.interrupt()
        plant.wait_for('}')
        faults = Counter(json.loads(plant.output().splitlines()[-1]))
        ended = time_ns() + 500_000_000
        wait_until(lambda: watch.reported_after('estimator', ended), 'no report at the end')
        return Course(
            memory, windows, watch.outputs, watch.not_finite, watch.taken('estimator'),
            int(watch.reports['estimator']['samples lost']), losses, beats, faults, client.counts,
        )  # fmt: skip


def _follow(seed, seconds, nodes: dict[str, Child], watch, client):
    """Make the scheduled calls; return memory by process, judged windows, times of losses."""
    from soak_plant import CALLS, CYCLE, JUDGED, RESTORE, schedule

    calls = [event for event in schedule(seed, seconds) if event.kind in CALLS][::-1]
    memory: dict[str, list[tuple[float, float]]] = defaultdict(list)
    windows, losses, lost, restored, judging = [], [], 0, 0, False
    start = monotonic()
    with tqdm(total=round(seconds), desc='soak', unit='s', mininterval=1.0) as progress:
        while (now := monotonic() - start) < seconds:
            sleep(0.02)
            for child in nodes.values():
                child.check()
            cycle, phase = divmod(now, CYCLE)
            if calls and calls[-1].time <= now:
                client.call(calls.pop().kind)
            if phase >= RESTORE and restored <= cycle:
                client.restore()
                restored += 1
            if judging != (JUDGED[0] <= phase < JUDGED[1]):
                judging = not judging
                if judging:
                    watch.forget()
                else:
                    windows.append((now, *_judged(watch)))
            if now >= progress.n + 1:
                progress.update(int(now) - progress.n)
                before, lost = lost, int(watch.reports.get('estimator', {}).get('samples lost', 0))
                if lost > before:
                    losses.append(now)
                if now > CYCLE:
                    for name, node in nodes.items():
                        memory[name].append((now, node.resident_megabytes()))
    return {name: np.array(used) for name, used in memory.items()}, np.array(windows), losses


def _judged(watch) -> tuple[float, float]:
    """
    Return what came since `Watch.forget`.

    Returns
    -------
    (float, float)
        Medians of the absolute error of d (a busy machine delays single samples) and of gamma;
        NaN without estimates.

    """
    if not all(watch.count(topic) for topic in (TRUTH, ESTIMATE, GAMMA, STAMP)):
        return float('nan'), float('nan')
    (published, d), (times, stamps), (at, truth) = map(watch.series, (ESTIMATE, STAMP, TRUTH))
    after = np.minimum(np.searchsorted(times, published), len(times) - 1)
    paired = np.abs(times[after] - published) < PAIRED
    true = np.interp((stamps[after] - at[0])[paired], at - at[0], truth)
    return float(np.median(np.abs(d[paired] - true))), float(np.median(watch.series(GAMMA)[1]))


def verdict(course: Course) -> list[Row]:
    """Return one row for each thing that a soak may fail on."""
    rows = []
    for name, memory in course.memory.items():
        t, used = memory[:: max(1, len(memory) // 300)].T
        growth = float(theilslopes(used, t).slope * (t[-1] - t[0]))  # the median of all slopes
        note = f'{used[0]:.1f} to {used[-1]:.1f} MB after warm-up'
        rows.append(Row(f'memory of {name}, growth', growth, 'MB', MEMORY, note))
    _, error, gamma = course.windows.T
    errors, gammas = _ends(error), _ends(gamma)
    published, wrong = course.faults['published'], course.calls['wrong answers']
    calls = ', '.join(f'{n} {kind}' for kind, n in course.calls.items() if kind != 'wrong answers')
    return [
        *rows,
        Row('samples unaccounted for', abs(published - course.taken - course.lost), '', 0.0,
            f'{published:,} published, {course.taken:,} used or rejected'),
        Row(LOST, course.lost, '', 0.0, f'in {len(course.losses)} of the seconds'),
        Row('outputs that are not finite', course.not_finite, '', 0.0, f'of {course.outputs:,}'),
        Row(GROWTH, errors[1] - errors[0], '', ERROR_GROWTH if len(error) >= MANY else ERROR,
            f'{errors[0]:.2g} to {errors[1]:.2g}, medians of the first and the last third'),
        Row(WORST, error.max(), '', ERROR, f'{len(error)} windows, median {np.median(error):.2g}'),
        Row('gamma, drift', abs(gammas[1] - gammas[0]), '', DRIFT,
            f'{gammas[0]:.4f} to {gammas[1]:.4f}'),
        Row('wrong answers to calls', wrong, '', 0.0, calls),
    ]  # fmt: skip


def explained(course: Course) -> set[str]:
    """
    Return the names of the rows that a stall of the machine explains if they are missed.

    Samples are lost in transport when a process cannot read for some hundredths of a second; the
    error of a window grows when stamps are late. Nothing else depends on how busy the machine is,
    and an error that is not finite depends on it neither.
    """
    from soak_plant import JUDGED

    rows = set()
    if course.losses and all(
        course.late(end - REPORTED - 1.0, end, LATE) >= LOSS for end in course.losses
    ):
        rows.add(LOST)
    end, error, _ = course.windows.T
    large = error > min(ERROR, _ends(error)[0] + ERROR_GROWTH)
    length = JUDGED[1] - JUDGED[0]
    if np.isfinite(error).all() and all(
        course.late(t - length, t) >= SLOW * length for t in end[large]
    ):
        rows.update((GROWTH, WORST))
    return rows


def _ends(values: NDArray[np.float64]) -> tuple[float, float]:
    """Return the medians of the first and of the last third."""
    parts = np.array_split(values, 3) if len(values) >= 3 else [values]
    return float(np.median(parts[0])), float(np.median(parts[-1]))


if __name__ == '__main__':
    sys.exit(main())
