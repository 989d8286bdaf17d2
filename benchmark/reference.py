# SPDX-License-Identifier: Apache-2.0
"""The recursion in C (reference.c) and in the core, on the same case, as callables to time."""

from collections.abc import Callable
import ctypes
import os
from pathlib import Path
import shlex
import shutil
import subprocess
from typing import Any

from fhaosmo_ros.core.observer.configuration import ObserverConfiguration
from fhaosmo_ros.core.observer.fuzzy import KNOTS
from fhaosmo_ros.core.observer.observer import Observer
from fhaosmo_ros.core.observer.record import run as run_structure
from fhaosmo_ros.core.observer.status import LEVEL_SHIFT
from fhaosmo_ros.core.simulation.plant import Plant
import numpy as np
from numpy.typing import NDArray
from results import CannotMeasureError

SOURCE = Path(__file__).with_name('reference.c')
OPTIONS = ('-O3', '-shared', '-fPIC', f'-DLEVEL_SHIFT={LEVEL_SHIFT}')
PERIOD = 1e-3
CASE = {'variant': 'fuzzy_adaptive', 'scheme': 'explicit', 'fuzzy_widths': [0.1]}
"""Wide fuzzy sets: no chatter, so that rounding does not grow and both end at the same state."""

PARTS = ('z_hat', 'z_tilde', 'p', 'q', 'gamma', 'y', 'pending')
"""What a cascade remembers, in the order of the state of reference.c."""
LAW = ('min', 'max', 'dead_zone', 'leakage')
"""Parameters of gamma at the end of its law."""

State = NDArray[np.float64]
"""The numbers of `PARTS`, the first four of them for each level."""


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


def started(parameters: dict[str, Any], y: float) -> Observer:
    """Return an observer after its first sample."""
    observer = Observer(parameters)
    observer.start(y)
    return observer


def state_of(observer: Observer) -> State:
    """Return the numbers of `PARTS`."""
    found = observer.structure.state_dict()
    return np.concatenate([np.atleast_1d(found[name]) for name in PARTS])


def in_c(library: ctypes.CDLL, y: NDArray[np.float64]) -> Callable[[], tuple[State, int]]:
    """
    Return a callable that steps through y[1:] in C.

    Returns
    -------
    callable
        Returns the final state and the last status word.

    """
    c = ObserverConfiguration(CASE)
    if c.curves.shape != (4, KNOTS) or KNOTS != 193:
        raise CannotMeasureError(
            f'reference.c expects 4 levels and 193 knots, the core has {c.curves.shape}'
        )
    gains = np.concatenate([c.lambdas, c.alphas, 1.0 / c.widths, c.curves[:2].ravel()])
    gamma = [c.gamma_initial, *(c.parameters[f'gamma_{name}'] for name in ('rate', *LAW))]
    packed = np.array([*gains, c.epsilon, *gamma])
    start = state_of(started(CASE, y[0]))
    rest, eps = np.ascontiguousarray(y[1:]), np.empty(4)

    def run() -> tuple[State, int]:
        state = start.copy()
        word = library.run(
            packed.ctypes.data, state.ctypes.data, rest.ctypes.data, PERIOD, len(rest),
            eps.ctypes.data,
        )  # fmt: skip
        return state, word

    return run


def in_core(parameters: dict[str, Any], y: NDArray[np.float64]) -> Callable[[], tuple[State, int]]:
    """Return the same of the compiled loop behind `Observer.run`, for any parameters."""
    observer, rest = started(parameters, y[0]), np.ascontiguousarray(y[1:])
    start, count = observer.state, len(rest)
    h, u = np.full(count, PERIOD), np.zeros((count, 1))

    def run() -> tuple[State, int]:
        observer.restore(start)
        record = run_structure(observer.structure, rest, h, u, 0, count)
        return state_of(observer), int(record.columns['words'][0])

    return run


def assert_agreement(library: ctypes.CDLL, y: NDArray[np.float64]) -> None:
    """Raise AssertionError unless C and the core end at the same state, gamma and status word."""
    (expected, word_c), (actual, word) = in_c(library, y)(), in_core(CASE, y)()
    np.testing.assert_allclose(actual, expected, rtol=1e-9, atol=1e-15)
    np.testing.assert_equal(word, word_c)
