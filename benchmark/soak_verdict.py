# SPDX-License-Identifier: Apache-2.0
"""What a soak must fulfil, what of it a stall of the machine explains, and the figure."""

from collections import Counter
from math import ceil
from pathlib import Path
from typing import NamedTuple

from matplotlib.figure import Figure
import numpy as np
from numpy.typing import NDArray
from scipy.stats import theilslopes
from soak_schedule import JUDGED
from table import Row

MEMORY = 2.0
"""MB that memory may grow by over the run."""
ERROR_GROWTH = 0.01
"""What the error of d may grow by between the first and the last third: a tenth of d's amplitude.
Not a ratio: that of two errors near the noise tells how busy the machine was."""
MANY = 15
"""Windows from which on medians of thirds tell more than how busy the machine was."""
ERROR = 0.05
"""Largest median error of d in any judged window: half of d's amplitude."""
GAMMA = 0.02
"""What gamma may move between the first and the last third."""
LOSS = 0.02
"""Seconds of stalls that explain lost samples: at 500 Hz it fills a writer's queue of 10."""
REPORTED = 3
"""Seconds after a stall within which the estimator reports what it lost."""
BUSY = 0.0002
"""Seconds of lateness that count for the error of a window: stamps are late by as much."""
SLOW = 0.05
"""
Part of a window that beats were late by if its error says nothing. Measured with other work on two
cores: beats were late by 2 to 7 % of a window, and the error of d was 0.012 to 0.025 instead of
0.01.
"""
LOST = 'samples lost, by sequence number'
GROWTH = 'error of d, growth'
WORST = 'error of d, worst window'


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
    published, taken, lost : int
        Samples that left the fault injector, that the estimator used or rejected, and that it
        missed in the sequence numbers.
    losses : (K,) array
        Times at which it was seen that it had missed some, in seconds since the start.
    late, busy : (S,) arrays
        Of each second: by how many seconds the heartbeat was late, in beats that were late by at
        least `heartbeat.LATE` and `BUSY`.
    faults, calls : Counter
        What was injected, what was called.

    """

    memory: dict[str, NDArray[np.float64]]
    windows: NDArray[np.float64]
    outputs: int
    not_finite: int
    published: int
    taken: int
    lost: int
    losses: NDArray[np.float64]
    late: NDArray[np.float64]
    busy: NDArray[np.float64]
    faults: Counter[str]
    calls: Counter[str]


def growth(memory: NDArray[np.float64]) -> float:
    """Return by how many MB memory has grown, by the median of all slopes (Theil and Sen)."""
    t, used = memory[:: max(1, len(memory) // 300)].T
    return float(theilslopes(used, t).slope * (t[-1] - t[0])) if len(t) > 1 else float('nan')


def verdict(course: Course) -> list[Row]:
    """Return one row for each thing that a soak may fail on."""
    rows = []
    for name, memory in course.memory.items():
        note = f'{memory[0, 1]:.1f} to {memory[-1, 1]:.1f} MB after warm-up'
        rows.append(Row(f'memory of {name}, growth', growth(memory), 'MB', MEMORY, note))
    unaccounted = course.published - course.taken - course.lost
    note = f'{course.published:,} published, {course.taken:,} used or rejected'
    rows.append(Row('samples unaccounted for', abs(unaccounted), bar=0.0, note=note))
    note = f'in {len(course.losses)} of the seconds'
    rows.append(Row(LOST, course.lost, bar=0.0, note=note))
    note = f'of {course.outputs:,} messages'
    rows.append(Row('outputs that are not finite', course.not_finite, bar=0.0, note=note))
    _, error, gamma = course.windows.T
    first, last = (np.median(part) for part in (_third(error, 0), _third(error, 2)))
    note = f'{first:.2g} to {last:.2g}, medians of the first and the last third of the windows'
    bar = ERROR_GROWTH if len(error) >= MANY else ERROR
    rows.append(Row(GROWTH, last - first, bar=bar, note=note))
    note = f'{len(error)} windows, median {np.median(error):.2g}'
    rows.append(Row(WORST, error.max(), bar=ERROR, note=note))
    first, last = (np.median(part) for part in (_third(gamma, 0), _third(gamma, 2)))
    note = f'{first:.4f} to {last:.4f}, within {gamma.min():.4f} .. {gamma.max():.4f}'
    rows.append(Row('gamma, drift', abs(last - first), bar=GAMMA, note=note))
    calls = sum(course.calls.values()) - course.calls['wrong answers']
    note = f'of {calls} calls: ' + ', '.join(
        f'{count} {kind}' for kind, count in course.calls.items() if kind != 'wrong answers'
    )
    rows.append(Row('wrong answers to calls', course.calls['wrong answers'], bar=0.0, note=note))
    return rows


def explained(course: Course) -> set[str]:
    """
    Return the names of the rows that a stall of the machine explains if they are missed.

    Samples are lost in transport when a process cannot read for some hundredths of a second; the
    error of a window grows when stamps are late. Nothing else depends on how busy the machine is,
    and an error that is not finite depends on it neither.
    """
    rows = set()
    if course.lost and all(
        course.late[max(0, int(end) - REPORTED) : ceil(end)].sum() >= LOSS for end in course.losses
    ):
        rows.add(LOST)
    end, error, _ = course.windows.T
    first = np.median(_third(error, 0))
    large = error > min(ERROR, first + ERROR_GROWTH)
    length = JUDGED[1] - JUDGED[0]
    if np.isfinite(error).all() and all(
        course.busy[int(t - length) : int(t) + 1].sum() >= SLOW * length for t in end[large]
    ):
        rows.update((GROWTH, WORST))
    return rows


def _third(values: NDArray[np.float64], index: int) -> NDArray[np.float64]:
    return np.array_split(values, 3)[index] if len(values) >= 3 else values


def draw(course: Course, path: Path) -> None:
    """Draw memory, gamma and the error over time."""
    figure = Figure(figsize=(9.0, 7.0), layout='constrained')
    axes = figure.subplots(3, 1, sharex=True)
    t, error, gamma = course.windows.T
    for name, memory in course.memory.items():
        axes[0].plot(memory[:, 0] / 60.0, memory[:, 1], label=name)
    axes[0].set_ylabel('resident memory, MB')
    axes[0].legend(loc='center right')
    axes[1].plot(t / 60.0, gamma, 'o-', markersize=3)
    axes[1].set_ylabel('γ, median of a window')
    axes[2].semilogy(t / 60.0, error, 'o-', markersize=3)
    axes[2].axhline(ERROR, color='tab:red', linewidth=0.8, label='limit')
    axes[2].set_ylabel('error of d, median of a window')
    axes[2].legend(loc='center right')
    axes[2].set_xlabel('minutes')
    figure.savefig(path, dpi=110)
