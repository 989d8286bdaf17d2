# SPDX-License-Identifier: Apache-2.0
"""What a channel costs in one process of many, over what a process for it alone costs."""

from time import monotonic, sleep, time_ns

from children import Child, Children
import numpy as np
from rates import end_source, isolate, wait_until
from table import CannotMeasureError, Row
from tqdm import tqdm

BAR = 0.2
RATE = 100.0
"""Of each y, and of the estimates, in Hz."""
CHANNELS = 32
SINGLES = 4
"""Processes with a channel each, on the samples of the first channels."""
WARM_UP = 2.0
ATTEMPTS = 3
HELD = 0.97
"""A run counts if the estimates came at this part of their rate at least."""


def measure(quick: bool) -> list[Row]:
    """Return the ratios, without and with a listener to the estimates."""
    isolate()
    channels, seconds, repetitions = (4, 2.0, 1) if quick else (CHANNELS, 10.0, 3)
    runs: dict[bool, list[np.ndarray]] = {False: [], True: []}
    with tqdm(total=2 * repetitions, desc='channels', unit='run', leave=False) as progress:
        for listen in [False, True] * repetitions * ATTEMPTS:
            if len(runs[listen]) == repetitions:
                continue
            costs = observe(channels, seconds, listen)
            rates = costs[2]
            if min(rates) < HELD * RATE:  # estimates that were left out cost nothing
                tqdm.write(
                    f'channels: a run with {rates[0]:.0f} and {rates[1]:.0f} Hz is left out'
                )
                continue
            runs[listen].append(costs)
            progress.update()
    if not all(runs.values()):
        raise CannotMeasureError(
            f'the machine is too busy for {channels} estimates at {RATE:g} Hz'
        )
    rows = []
    for listen, costs in runs.items():
        ratios = [many / channels / single for (many, single), *_ in costs]
        (many, single), memory, rates = np.median(costs, axis=0)
        name = 'estimates of d heard by one listener' if listen else 'nobody listens'
        rows.append(Row(
            f'CPU, a channel of {channels} / a process each, {RATE:g} Hz, {name}',
            float(np.median(ratios)), bar=None if quick else BAR,
            note=f'{many:.1%} / {channels} and {single:.2%}; ratios '
            f'{", ".join(f"{r:.3f}" for r in ratios)}; estimates at {rates[0]:.0f} and '
            f'{rates[1]:.0f} Hz',
        ))  # fmt: skip
    note = f'{memory[0]:.0f} MB / {channels} and {memory[1]:.0f} MB'
    rows.append(Row(f'memory, a channel of {channels} / a process each',
                    memory[0] / channels / memory[1], note=note))  # fmt: skip
    return [*rows, *_self_tuning(channels, seconds)]


def _self_tuning(channels: int, seconds: float) -> list[Row]:
    """Return the CPU of a process with so many self-tuning channels, and the samples it lost."""
    from watch import Watch  # needs ROS

    names = [f'c{k}' for k in range(channels)]
    topics = [f'many/{name}' for name in names]
    with Children() as children, Watch(topics) as watch:
        many = _many(children, names, '-p', 'gains:=self_tuning')
        many.wait_for('estimating')
        source = _source(children, names)
        sleep(WARM_UP)
        watch.forget()
        before, start = many.cpu_seconds(), monotonic()
        sleep(seconds)
        used, elapsed = many.cpu_seconds() - before, monotonic() - start
        rate = watch.count(topics[0]) / elapsed
        memory = many.resident_megabytes()
        sent, ended = end_source(source), time_ns()
        wait_until(
            lambda: all(watch.report(name)[0] > ended for name in topics), 'no report of all'
        )
        lost = len(names) * sent - sum(watch.report(name)[1] for name in topics)
    title = f'{channels} self-tuning channels, {RATE:g} Hz, one process'
    return [
        Row(f'CPU of {title}', 100.0 * used / elapsed, '%',
            note=f'of a core; estimates at {rate:.0f} Hz; {memory:.0f} MB'),
        Row(f'samples lost by {title}', lost, bar=0.0, note=f'of {len(names) * sent:,}'),
    ]  # fmt: skip


def _many(children: Children, names: list[str], *arguments: str) -> Child:
    return children.start(
        'many', '-m', 'fhaosmo_ros', 'estimator', '--ros-args', '-r', '__node:=many',
        '-p', f'publish_rate:={RATE}', '-p', f'channels:=[{", ".join(names)}]', *arguments,
    )  # fmt: skip


def _source(children: Children, names: list[str]) -> Child:
    source = children.start(
        'source', 'benchmark/source.py', '--rate', str(RATE),
        '--topics', *(f'{name}/y' for name in names),
    )  # fmt: skip
    source.wait_for('publishing')
    return source


def observe(channels: int, seconds: float, listen: bool) -> np.ndarray:
    """Return CPU over time, MB and estimates a second of a channel: of many, and of one alone."""
    from watch import Watch  # needs ROS

    names = [f'c{k}' for k in range(channels)]
    singles = names[: min(SINGLES, channels)]
    watched = [f'many/{names[0]}', f'single_{names[0]}']
    with Children() as children, Watch(watched) as watch:
        many = _many(children, names)
        alone = [
            children.start(
                f'single_{name}', '-m', 'fhaosmo_ros', 'estimator', '--ros-args',
                '-r', f'__node:=single_{name}', '-r', f'y:={name}/y',
                '-p', f'publish_rate:={RATE}',
            )
            for name in singles
        ]  # fmt: skip
        for node in (many, *alone):
            node.wait_for('estimating')
        if listen:
            topics = [f'many/{name}/unknown_input' for name in names]
            topics += [f'single_{name}/unknown_input' for name in singles]
            children.start('listener', 'benchmark/listener.py', *topics).wait_for('listening')
        _source(children, names)
        sleep(WARM_UP)
        watch.forget()
        before, start = _used(many, alone), monotonic()
        sleep(seconds)
        used, elapsed = _used(many, alone) - before, monotonic() - start
        rates = [watch.count(name) / elapsed for name in watched]
        memory = [many.resident_megabytes(), alone[0].resident_megabytes()]
        return np.array([used / elapsed, memory, rates])


def _used(many: Child, alone: list[Child]) -> np.ndarray:
    return np.array([many.cpu_seconds(), np.mean([node.cpu_seconds() for node in alone])])
