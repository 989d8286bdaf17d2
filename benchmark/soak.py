# SPDX-License-Identifier: Apache-2.0
"""
Run plant, fault injector and estimator for a long time, and say what grew, drifted or got lost.

`make soak MINUTES=30`. Exit code 0 if everything held, 1 if not, 130 after Ctrl-C. With
``--retries`` a run is repeated that missed nothing but what a busy machine makes: samples lost in
transport because a process could not read, and errors of d because stamps were late.

`soak.py plant` is the plant, with faults on its topic ``faulty_y``, and counts what it does. They
are not made by a node between plant and estimator: that would stamp y anew, and on a busy machine
the jitter of one more hop makes an error in d that hides the drift which a soak is to find.
"""

import argparse
from collections import Counter
from collections.abc import Iterator, Mapping
import json
import math
import os
from pathlib import Path
import signal
import sys
import threading
from time import monotonic, sleep
from typing import Any

from fhaosmo_ros.core.parameters.files import load
from fhaosmo_ros.core.parameters.tables import ESTIMATOR_PARAMETERS
from fhaosmo_ros.nodes.middleware.arguments import read_arguments
from fhaosmo_ros.nodes.middleware.spin import Spinner
from fhaosmo_ros.nodes.plant import PlantNode
from fhaosmo_ros.nodes.recording import PrivateNode
from fhaosmo_ros.stop_signals import Stop
from fhaosmo_ros.tools.cli.command import run_command
from fhaosmo_ros.topics import ARRAY, FLOAT, TIME
from live import Child, ROOT, start_node, wait_until, Watch
import numpy as np
from numpy.typing import NDArray
import rclpy
from rclpy.parameter import Parameter
from rclpy.parameter_client import AsyncParameterClient
from rclpy.signals import SignalHandlerOptions
from results import render, Row
from scipy.stats import theilslopes
from std_msgs.msg import Float64
from std_srvs.srv import Trigger
from tqdm import tqdm

FILE = 'benchmark/soak.yaml'
PARAMETERS = ('--ros-args', '--params-file', FILE)
TRUTH, ESTIMATE = '/plant/unknown_input', '/estimator/unknown_input'
GAMMA, STAMP = '/estimator/gamma', '/estimator/stamp'
TOPICS = {
    TRUTH: FLOAT, ESTIMATE: FLOAT, GAMMA: FLOAT, STAMP: TIME, '/estimator/state': ARRAY,
    '/estimator/innovation': ARRAY,
}  # fmt: skip
CYCLE, FAULTS, RESTORE, JUDGED = 20.0, (0.5, 11.0), 12.0, (15.0, 19.5)
"""
Seconds of a cycle, and when in it faults begin, parameters are put back, and the estimate must be
right. The first cycle has no faults: caches fill.
"""
PAUSE = (0.2, 1.2)  # shortest and longest time between two faults, in seconds
STREAM = {
    'nan': (1, 20), 'infinity': (1, 20), 'spike': (1, 3), 'duplicate': (1, 50), 'stuck': (5, 100),
    'burst': (2, 40), 'short gap': (2, 100), 'long gap': (300, 600), 'publisher restart': (1, 1),
}  # fmt: skip
"""Faults of y, with the smallest and largest number of samples that each concerns."""
CALLS = ('good parameters', 'bad parameters', 'reset')  # what a client does meanwhile
SETTLE = 0.5  # seconds from the match of a new publisher, as seen from here, to its first sample
PAIRED = 5_000_000  # nanoseconds within which the topics of one estimate are published
LAST = 10.0  # seconds that the last samples, and the report of them, may take on a busy machine
MEMORY, DRIFT = 2.0, 0.02
"""What the estimator's memory (MB) may grow by; gamma, from the first to the last third."""
ERROR, ERROR_GROWTH, MANY = 0.05, 0.01, 15
"""
Largest median error of d in any judged window (half of d's amplitude), what it may grow by between
the first and the last third, and from how many windows on that is judged.
"""
LOST, GROWTH, WORST = (
    'samples lost, by sequence number', 'error of d, growth', 'error of d, worst window',
)  # fmt: skip
SETS = {
    'good parameters': (
        {'variant': 'sign'}, {'variant': 'fuzzy'}, {'variant': 'fuzzy_adaptive'},
        {'scheme': 'explicit', 'variant': 'fuzzy'}, {'scheme': 'implicit'},
        {'lambda': [15.0], 'alpha': [30.0]}, {'epsilon': 0.5}, {'publish_rate': 250.0},
        {'estimate_from': 'filtered'}, {'gamma_rate': 4.0, 'gamma_min': 0.4, 'gamma_max': 0.6},
    ),
    'bad parameters': (
        {'variant': 'fuzy'}, {'lambda': [-1.0]}, {'alpha': [1.0, 2.0]}, {'epsilon': math.nan},
        {'gamma_min': 0.9, 'gamma_max': 0.2}, {'order': 7}, {'publish_rate': 0.0},
        {'no_such_parameter': 1.0},
    ),
}  # fmt: skip
COMPLETE = ESTIMATOR_PARAMETERS.complete(load(ROOT / FILE, 'estimator'))
BASE = {name: COMPLETE[name] for changes in SETS['good parameters'] for name in changes}
"""What is put back."""


def schedule(seed: int) -> Iterator[tuple[float, str, int]]:
    """
    Yield the seconds since the start, the kind of each fault or call, and its samples.

    Every kind comes up before one comes up again.
    """
    random, kinds, start = np.random.default_rng(seed), list[str](), 0.0
    while start := start + CYCLE:
        time = start + FAULTS[0]
        while time < start + FAULTS[1]:
            kinds = kinds or random.permutation([*STREAM, *CALLS]).tolist()
            kind = kinds.pop()
            low, high = STREAM.get(kind, (1, 1))
            yield time, kind, int(random.integers(low, high + 1))
            time += float(random.uniform(*PAUSE))


class FaultyPlant(PlantNode):
    """A plant whose y goes through faults; their time begins with the first sample."""

    def __init__(self, given: dict[str, Any], seed: int) -> None:
        super().__init__(given)
        self.counts: Counter[str] = Counter()
        self._left: Counter[str] = Counter()  # samples by fault
        self._events = (event for event in schedule(seed) if event[1] in STREAM)
        self._next = next(self._events)
        self._held: list[float] = []  # of a burst
        self._last = self._first_sample = self._matched = 0.0
        self._faulty_y = self.create_publisher(Float64, 'faulty_y', 10)
        self._publish_y = self._pass_on

    def _pass_on(self, message: Float64) -> None:
        """Publish what faults leave, or make, of a sample."""
        now = monotonic()
        if not self._matched and self._faulty_y.get_subscription_count():
            self._matched = now
        if not self._matched or now - self._matched < SETTLE:
            return
        if not self._first_sample:
            self._first_sample = now
            print('injecting', flush=True)
        while self._next[0] <= now - self._first_sample:
            _, kind, self._left[kind] = self._next
            self._next = next(self._events)
        for y in self._faulty(message.data):
            self._faulty_y.publish(Float64(data=y))
            self.counts['published'] += 1

    def _faulty(self, y: float) -> list[float]:
        """Return what is published in place of `y`."""
        if self._take('publisher restart'):
            self.destroy_publisher(self._faulty_y)
            self._faulty_y = self.create_publisher(Float64, 'faulty_y', 10)
            self._matched = 0.0
            return []
        if self._take('short gap') or self._take('long gap'):
            return []
        self._last = y = self._last if self._take('stuck') else y
        for kind, value in (('nan', math.nan), ('infinity', math.inf), ('spike', y + 1e3)):
            y = value if self._take(kind) else y
        if self._take('burst'):
            self._held.append(y)
            return []
        found = [*self._held, y]
        self._held.clear()
        return [*found, y] if self._take('duplicate') else found

    def _take(self, kind: str) -> bool:
        """Return True, and count one, while a fault lasts."""
        lasts = self._left[kind] > 0
        self._left[kind] -= lasts
        self.counts[kind] += lasts
        return lasts


class Client(PrivateNode):
    """
    Changes the estimator's parameters, well and badly, and resets it.

    `counts` has the calls by kind, and 'wrong answers': a bad set that was accepted, a good one
    refused.
    """

    def __init__(self) -> None:
        super().__init__('soak_client')
        self.counts: Counter[str] = Counter()
        self._parameters = AsyncParameterClient(self.node, '/estimator')
        self._reset = self.node.create_client(Trigger, '/estimator/reset')

    def call(self, kind: str) -> None:
        """Make the next call of a kind of `CALLS`."""
        if kind == 'reset':
            right = self._answer(self._reset.call_async(Trigger.Request())).success
        else:
            accepted = self.set(SETS[kind][self.counts[kind] % len(SETS[kind])])
            right = accepted == (kind == 'good parameters')
        self.counts[kind] += 1
        self.counts['wrong answers'] += not right

    def set(self, values: Mapping[str, Any]) -> bool:
        """Set parameters of the estimator; return whether it accepted them."""
        wait_until(self._parameters.services_are_ready, 'the estimator offers no parameters')
        parameters = [Parameter(name, value=value) for name, value in values.items()]
        answer = self._answer(self._parameters.set_parameters_atomically(parameters))
        return bool(answer.result.successful)

    def _answer(self, future: Any) -> Any:
        wait_until(future.done, 'the estimator did not answer', 0.002)
        return future.result()


def main() -> int:
    """Run, print the verdict; see the top of this file for the exit code."""
    parser = argparse.ArgumentParser(prog='make soak', description='Run for long, with faults.')
    parser.add_argument('--minutes', type=float, default=2.0, help='at least 2')
    parser.add_argument('--seed', type=int, default=1, help='of the schedule of faults')
    parser.add_argument('--output', type=Path, default=Path('soak_output'), help='folder')
    parser.add_argument(
        '--retries', type=int, default=0, help='if nothing failed but what a busy machine makes'
    )

    def body(arguments: argparse.Namespace, stop: Stop) -> int:
        if arguments.minutes < 2.0:
            parser.error(f'argument --minutes: expected at least 2, got {arguments.minutes:g}')
        with stop.raising():
            for _ in range(arguments.retries + 1):
                missed = soak(arguments.seed, arguments.minutes, arguments.output)
                if not missed or not missed <= {LOST, GROWTH, WORST}:
                    break
        return 1 if missed else 0

    return run_command(parser, None, body)


def run_plant(seed: str, *arguments: str) -> None:
    """Run until SIGINT, then print the counts as one line of JSON; end with the second SIGINT."""
    given, _, rest = read_arguments('plant', list(arguments))
    ended = threading.Event()
    signal.signal(signal.SIGINT, lambda *_: ended.set())
    rclpy.init(args=[sys.argv[0], *rest], signal_handler_options=SignalHandlerOptions.NO)
    node = FaultyPlant(given, int(seed))
    with Spinner(node, on_end=ended.set) as spinner:
        ended.wait()
    if spinner.error:
        raise spinner.error
    ended.clear()
    print(json.dumps(node.counts), flush=True)
    ended.wait()  # the last samples are taken before their writer leaves
    node.destroy_node()
    rclpy.try_shutdown()


def soak(seed: int, minutes: float, output: Path) -> set[str]:
    """Run once, write and print the verdict; return the names of what was missed."""
    seconds, memory, windows = 60.0 * minutes, [], []
    with (
        Watch(TOPICS) as watch,
        Client() as client,
        start_node('estimator', *PARAMETERS, '-r', 'y:=faulty_y') as estimator,
        Child('plant', 'benchmark/soak.py', 'plant', str(seed), *PARAMETERS) as plant,
    ):
        estimator.wait_for('estimating')
        plant.wait_for('injecting')
        calls = (event for event in schedule(seed) if event[1] in CALLS)
        (time, kind, _), start = next(calls), monotonic()
        restored, judging = 0, False
        for second in tqdm(range(round(seconds)), desc='soak', unit='s', mininterval=1.0):
            while (now := monotonic() - start) < second + 1:
                sleep(0.02)
                estimator.check()
                plant.check()
                cycle, phase = divmod(now, CYCLE)
                if time <= now:
                    client.call(kind)
                    time, kind, _ = next(calls)
                if phase >= RESTORE and restored <= cycle:
                    client.counts['wrong answers'] += not client.set(BASE)
                    restored += 1
                if judging != (JUDGED[0] <= phase < JUDGED[1]):
                    judging = not judging
                    if judging:
                        watch.forget()
                    else:
                        windows.append(judged(watch))
            if now > CYCLE:
                memory.append((now, estimator.resident_megabytes()))
        plant.interrupt()
        plant.wait_for('}')
        faults = Counter(json.loads(plant.output().splitlines()[-1]))
        deadline = monotonic() + LAST
        while unaccounted(faults, watch) and monotonic() < deadline:
            sleep(0.1)
    rows = verdict(np.array(memory), np.array(windows), faults, client.counts, watch)
    said = ', '.join(f'{n:,} {k}' for k, n in sorted(faults.items()))
    load = f'{os.cpu_count()} cores, load {os.getloadavg()[1]:.1f}'
    text = f'{minutes:g} minutes, seed {seed}, {load}: {said}\n\n{render(rows)}\n'
    output.mkdir(parents=True, exist_ok=True)
    (output / 'soak.txt').write_text(text)
    missed = [row.name for row in rows if row.missed]
    print(text, f'FAILED: {"; ".join(missed)}' if missed else 'passed', sep='\n')
    return set(missed)


def unaccounted(faults: Counter[str], watch: Watch) -> int:
    """Return how many samples were published that the estimator has neither taken nor missed."""
    known = watch.taken('estimator') + watch.reported('estimator', 'samples lost')
    return abs(faults['published'] - known)


def judged(watch: Watch) -> tuple[float, float]:
    """
    Return medians of the absolute error of d and of gamma since `Watch.forget`; NaN without any.

    Medians, because a busy machine delays single samples.
    """
    if not all(watch.count(topic) for topic in (TRUTH, ESTIMATE, GAMMA, STAMP)):
        return math.nan, math.nan
    (published, d), (times, stamps), (at, truth) = map(watch.series, (ESTIMATE, STAMP, TRUTH))
    after = np.minimum(np.searchsorted(times, published), len(times) - 1)
    paired = np.abs(times[after] - published) < PAIRED
    true = np.interp((stamps[after] - at[0])[paired], at - at[0], truth)
    return float(np.median(np.abs(d[paired] - true))), float(np.median(watch.series(GAMMA)[1]))


def verdict(
    memory: NDArray[np.float64], windows: NDArray[np.float64], faults: Counter[str],
    calls: Counter[str], watch: Watch,
) -> list[Row]:  # fmt: skip
    """
    Return one row for each thing that a soak may fail on.

    `memory` has seconds and MB of the estimator; `windows` what `judged` found in each.
    """
    t, used = memory[:: max(1, len(memory) // 300)].T
    growth = float(theilslopes(used, t).slope * (t[-1] - t[0]))  # the median of all slopes
    error, gamma = windows.T
    errors, gammas = _ends(error), _ends(gamma)
    taken, lost = watch.taken('estimator'), watch.reported('estimator', 'samples lost')
    made = ', '.join(f'{n} {kind}' for kind, n in calls.items() if kind != 'wrong answers')
    allowed = ERROR_GROWTH if len(error) >= MANY else ERROR
    return [
        Row('memory of estimator, growth', growth, 'MB', MEMORY,
            f'{used[0]:.1f} to {used[-1]:.1f} MB after warm-up'),
        Row('samples unaccounted for', unaccounted(faults, watch), '', 0.0,
            f'{faults["published"]:,} published, {taken:,} used or rejected'),
        Row(LOST, lost, '', 0.0),
        Row('outputs that are not finite', watch.not_finite, '', 0.0, f'of {watch.outputs:,}'),
        Row(GROWTH, errors[1] - errors[0], '', allowed,
            f'{errors[0]:.2g} to {errors[1]:.2g}, medians of the first and the last third'),
        Row(WORST, error.max(), '', ERROR, f'{len(error)} windows, median {np.median(error):.2g}'),
        Row('gamma, drift', abs(gammas[1] - gammas[0]), '', DRIFT,
            f'{gammas[0]:.4f} to {gammas[1]:.4f}'),
        Row('wrong answers to calls', calls['wrong answers'], '', 0.0, made),
    ]  # fmt: skip


def _ends(values: NDArray[np.float64]) -> tuple[float, float]:
    """Return the medians of the first and of the last third."""
    parts = np.array_split(values, 3) if len(values) >= 3 else [values]
    return float(np.median(parts[0])), float(np.median(parts[-1]))


if __name__ == '__main__':
    if sys.argv[1:2] == ['plant']:
        run_plant(*sys.argv[2:])
    else:
        sys.exit(main())
