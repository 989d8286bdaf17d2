# SPDX-License-Identifier: Apache-2.0
"""The recursion in C (reference.c) and in numba, on the same case, as callables to time."""

from collections.abc import Callable
import ctypes
import os
from pathlib import Path
import shlex
import shutil
import subprocess
from typing import Any

from fhaosmo_ros.core.observer import arrays
from fhaosmo_ros.core.observer import step as recursion
from fhaosmo_ros.core.observer.configuration import ObserverConfiguration
from fhaosmo_ros.core.observer.estimates import ObserverState
from fhaosmo_ros.core.observer.fuzzy import KNOTS
from fhaosmo_ros.core.observer.observer import make_record, Observer
from fhaosmo_ros.core.observer.status import LEVEL_SHIFT
from fhaosmo_ros.core.simulation.plant import Plant
import numpy as np
from numpy.typing import NDArray
from table import CannotMeasureError

SOURCE = Path(__file__).with_name('reference.c')
OPTIONS = ('-O3', '-shared', '-fPIC', f'-DLEVEL_SHIFT={LEVEL_SHIFT}')
PERIOD = 1e-3
REMEMBERED = 4
"""Entries of the memory that matter to a cascade."""
CASE = {'variant': 'fuzzy_adaptive', 'scheme': 'explicit', 'fuzzy_widths': [0.1]}
"""Wide fuzzy sets: no chatter, so that rounding does not grow and both end at the same state."""

State = NDArray[np.float64]
"""HAT, TILDE and their sensitivities (4 N), then gamma, y, pending, wait; see arrays.py."""


def find_compiler() -> list[str]:
    """Return the command of the C compiler ($CC, else cc)."""
    command = shlex.split(os.environ.get('CC', 'cc'))
    if not command or shutil.which(command[0]) is None:
        raise CannotMeasureError(
            f'no C compiler {command[0] if command else ""!r} to compare with: install one '
            '(Debian: apt install gcc libc6-dev) or set CC'
        )
    return command


def compile_reference(folder: Path) -> ctypes.CDLL:
    """Compile reference.c into `folder` and load it."""
    library = folder / 'reference.so'
    command = [*find_compiler(), *OPTIONS, '-o', str(library), str(SOURCE), '-lm']
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        lines = done.stderr.strip().splitlines() or ['without a word']
        raise CannotMeasureError(f'{shlex.join(command[:1])} failed on reference.c: {lines[0]}')
    loaded = ctypes.CDLL(str(library))
    pointer = ctypes.c_void_p
    loaded.run.argtypes = [
        pointer, pointer, pointer, ctypes.c_double, ctypes.c_long, pointer,
    ]  # fmt: skip
    loaded.run.restype = ctypes.c_int
    return loaded


def output(count: int) -> NDArray[np.float64]:
    """Return `count` samples of the paper's plant, without noise."""
    plant = Plant({'integration_step': PERIOD})
    return np.asarray(plant.simulate(np.arange(count) * PERIOD).y)


def first_state(parameters: dict[str, Any], y: float) -> ObserverState:
    """Return the state of a fresh observer after its first sample."""
    observer = Observer(parameters)
    observer.start(y)
    return observer.state


def in_c(library: ctypes.CDLL, y: NDArray[np.float64]) -> Callable[[], tuple[State, int]]:
    """
    Return a callable that steps through y[1:] in C.

    Returns
    -------
    callable
        Returns the final state and the last status word.

    """
    law = ObserverConfiguration(CASE).law
    if law.curves.shape != (4, KNOTS) or KNOTS != 193:
        raise CannotMeasureError(
            f'reference.c expects 4 levels and 193 knots, the core has {law.curves.shape}'
        )
    packed = np.concatenate([law.gains[:3].ravel(), law.curves[:2].ravel(), law.scalars])
    start = first_state(CASE, y[0])
    rest, eps = np.ascontiguousarray(y[1:]), np.empty(4)

    def run() -> tuple[State, int]:
        state = np.concatenate([start.levels[: arrays.ROWS].ravel(), start.memory[:REMEMBERED]])
        word = library.run(
            packed.ctypes.data, state.ctypes.data, rest.ctypes.data, PERIOD, len(rest),
            eps.ctypes.data,
        )  # fmt: skip
        return state, word

    return run


def in_numba(
    parameters: dict[str, Any], y: NDArray[np.float64]
) -> Callable[[], tuple[State, int]]:
    """Return the same of the compiled function behind `Observer.run`, for any parameters."""
    configuration = ObserverConfiguration(parameters)
    count, levels = len(y), configuration.levels
    work = arrays.make_work(configuration.law, configuration.model.depth)
    start = first_state(parameters, y[0])
    h, u = np.full(count, PERIOD), np.zeros((count, 1))
    record = make_record(1, levels, 2)

    def run() -> tuple[State, int]:
        state = arrays.State(start.levels.copy(), start.memory.copy())
        samples = recursion.Samples(y, h, u)
        recursion.run(configuration.law, work, state, samples, record, 1, count)
        levels, memory = state.levels[: arrays.ROWS], state.memory[:REMEMBERED]
        return np.concatenate([levels.ravel(), memory]), int(record.words[0])

    return run


def assert_agreement(library: ctypes.CDLL, y: NDArray[np.float64]) -> None:
    """Raise AssertionError unless C and numba end at the same state, gamma and status word."""
    (expected, word_c), (actual, word) = in_c(library, y)(), in_numba(CASE, y)()
    np.testing.assert_allclose(actual, expected, rtol=1e-9, atol=1e-15)
    np.testing.assert_equal(word, word_c)
