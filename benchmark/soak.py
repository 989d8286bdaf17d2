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

from children import Child, Children, ROOT
from fhaosmo_ros.core.online.counters import Counters
from heartbeat import Heartbeat, LATE
import numpy as np
from rates import isolate
from soak_schedule import CALLS, CYCLE, JUDGED, RESTORE, schedule
from table import CannotMeasureError, render
from tqdm import tqdm

RATE = 500.0
PARAMETERS = ('--ros-args', '--params-file', str(ROOT / 'config' / 'demo.yaml'))
ESTIMATOR = ('-r', 'y:=faulty_y', '-p', 'spike_gate:=1.0', '-p', 'gamma_leakage:=1.0',
             '-p', 'gamma_dead_zone:=0.0')  # fmt: skip
"""What docs/operation.md advises for a node that nobody looks after."""
MATCHED = 30.0
STALLED = 3
"""Exit code."""


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
    """Run once, write figure and table, print the verdict; return the exit code."""
    from soak_verdict import draw, explained, verdict

    course = run(seed, minutes * 60.0)
    output.mkdir(parents=True, exist_ok=True)
    draw(course, output / 'soak.png')
    rows = verdict(course)
    faults = ', '.join(f'{n:,} {k}' for k, n in sorted(course.faults.items()))
    text = (
        f'{minutes:g} minutes, seed {seed}, {os.cpu_count()} cores, load '
        f'{os.getloadavg()[1]:.1f}: {faults}\n\n{render(rows)}\n'
    )
    (output / 'soak.txt').write_text(text)
    print(f'{text}\nFigure: {output / "soak.png"}')
    missed = [row.name for row in rows if row.missed]
    if not missed:
        print('passed')
        return 0
    stalled = explained(course).issuperset(missed)
    print(f'{"STALLED" if stalled else "FAILED"}: {"; ".join(missed)}')
    return STALLED if stalled else 1


def run(seed: int, seconds: float):
    """Run a soak and return its course."""
    from soak_client import SoakClient
    from soak_verdict import BUSY, Course
    from soak_watch import SoakWatch

    with (
        Heartbeat() as heartbeat, Children() as children, SoakWatch() as watch,
        SoakClient() as client,
    ):  # fmt: skip
        estimator = children.start(
            'estimator', '-m', 'fhaosmo_ros', 'estimator', *PARAMETERS, *ESTIMATOR
        )
        plant = children.start(
            'plant', 'benchmark/soak_faults.py', '--seed', str(seed), '--seconds', str(seconds),
            *PARAMETERS, '-p', f'sample_rate:={RATE}',
        )  # fmt: skip
        estimator.wait_for('estimating')
        plant.wait_for('injecting')
        client.learn()
        start = monotonic()
        memory, windows, losses = _follow(
            seed, seconds, {'estimator': estimator, 'plant': plant}, watch, client
        )
        late, busy = (
            [heartbeat.late(start + k, start + k + 1.0, least) for k in range(round(seconds))]
            for least in (LATE, BUSY)
        )
        plant.interrupt()
        plant.wait_for('}')
        counts = Counter(json.loads(plant.output().splitlines()[-1]))
        ended, deadline = time_ns(), monotonic() + MATCHED
        while int(watch.report.get('received', 0)) < ended + 500_000_000:
            if monotonic() > deadline:
                raise CannotMeasureError('the estimator no longer reports on /diagnostics')
            sleep(0.05)
        return Course(
            memory, windows, watch.outputs, watch.not_finite,
            counts['published'], _taken(watch.report), int(watch.report['samples lost']),
            losses, np.array(late), np.array(busy), counts, client.counts,
        )  # fmt: skip


def _follow(seed, seconds, nodes: dict[str, Child], watch, client):
    """Make the scheduled calls; return memory by process, judged windows, times of losses."""
    calls = [event for event in schedule(seed, seconds) if event.kind in CALLS][::-1]
    memory: dict[str, list[tuple[float, float]]] = defaultdict(list)
    windows, lost, restored, judging, second = [], [], 0, False, 0
    start = monotonic()
    with tqdm(
        total=round(seconds), desc='soak', unit='s', mininterval=1.0, disable=None
    ) as progress:
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
                    watch.keep()
                else:
                    windows.append((now, *watch.judge()))
            if now >= second + 1:
                second = int(now)
                progress.update(second - progress.n)
                lost.append((now, int(watch.report.get('samples lost', 0))))
                if now > CYCLE:
                    for name, node in nodes.items():
                        memory[name].append((now, node.resident_megabytes()))
                progress.set_postfix_str(
                    f'{memory["estimator"][-1][1]:.1f} MB' if memory['estimator'] else 'warm-up'
                )
    ends, counts = np.array(lost).T
    losses = ends[np.diff(counts, prepend=0) > 0]
    return {name: np.array(course) for name, course in memory.items()}, np.array(windows), losses


def _taken(report: dict[str, str]) -> int:
    """Return the samples of y that the estimator has used or rejected."""
    names = {name: name.replace('_', ' ') for name in Counters._fields}
    names['accepted'] = 'samples accepted'
    counters = Counters(**{name: int(report[key]) for name, key in names.items()})
    return counters.accepted + counters.rejected


if __name__ == '__main__':
    sys.exit(main())
