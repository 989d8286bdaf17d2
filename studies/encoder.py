# SPDX-License-Identifier: Apache-2.0
"""
`python -m studies.encoder` writes docs/encoder.png and prints its numbers: velocity of an encoder.

Velocity and acceleration of a joint from an encoder of 4096 counts a turn at 1 kHz, beside the
low-passed difference and a causal Savitzky-Golay filter. Each has one or two numbers to choose;
they are scanned on four recordings, for velocity and acceleration separately, and judged on four
others.
"""

from collections.abc import Callable
from itertools import product
from pathlib import Path
import sys
from typing import Any

from fhaosmo_ros.core import Family, Observer, Recording
from fhaosmo_ros.core.parameters.files import load
from fhaosmo_ros.tools.plot.figures import COLOURS
from matplotlib.figure import Figure
import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter, savgol_coeffs

ROOT = Path(__file__).resolve().parents[1]
H = 1e-3
JOINT = {
    'order': 2, 'phi': ['0', '0'], 'duration': 8.0, 'sample_rate': 1 / H, 'initial_state': 0.0,
    'quantisation': 2 * np.pi / 4096, 'noise_std': 0.0, 'rms_of_d': 20.0, 'band_of_d': [2.0, 15.0],
    'disturbances': ['sines', 'steps'], 'step_interval': 0.5,
}  # fmt: skip
SETTLED, RECORDINGS = 1.0, 4
NAMES = ('velocity [rad/s]', 'acceleration [rad/s²]')
Estimates = tuple[NDArray[np.float64], NDArray[np.float64]]


def difference(r: Recording, cutoff: float) -> Estimates:
    """Return velocity and acceleration by differences and a first-order low pass (rad/s)."""
    share = 1.0 - np.exp(-cutoff * H)
    filtered = [r.y]
    for _ in range(2):
        step = np.diff(filtered[-1], prepend=filtered[-1][0]) / H
        filtered.append(lfilter([share], [1.0, share - 1.0], step))
    return filtered[1], filtered[2]


def savitzky_golay(r: Recording, window: int, degree: int) -> Estimates:
    """Return both by a polynomial through the last samples, at the newest one."""
    velocity, acceleration = (
        lfilter(savgol_coeffs(window, degree, deriv, H, pos=window - 1), [1.0], r.y)
        for deriv in (1, 2)
    )
    return velocity, acceleration


def observer(r: Recording, bandwidth: float) -> Estimates:
    """Return both by the observer of config/joint_states.yaml at another bandwidth (rad/s)."""
    width = load(ROOT / 'config' / 'joint_states.yaml', 'estimator')['fuzzy_widths'][0]
    found = Observer(
        base()
        | {'lambda': [2 * bandwidth * width, 2 * bandwidth**2 * width, bandwidth**3 * width]}
    ).run(r.t, r.y)
    return found.z[:, 1], found.unknown_input


def base() -> dict[str, Any]:
    """Return the observer's parameters of the file."""
    p = load(ROOT / 'config' / 'joint_states.yaml', 'estimator')
    known = Observer({}).parameters
    return {name: value for name, value in p.items() if name in known}


WAYS: dict[str, tuple[Callable[..., Estimates], list[tuple[Any, ...]]]] = {
    'low-passed difference': (difference, [(w,) for w in np.geomspace(10, 500, 25)]),
    'Savitzky-Golay': (savitzky_golay, list(product(range(11, 202, 10), (1, 2, 3)))),
    'this observer': (observer, [(w,) for w in np.geomspace(10, 500, 25)]),
}


def errors(recordings: list[Recording], way: Callable[..., Estimates], choice: Any) -> list[float]:
    """Return the RMS errors of velocity and acceleration."""
    wrong = []
    for r in recordings:
        part = r.t > SETTLED
        pairs = zip(way(r, *choice), (r.z[:, 1], r.d), strict=True)
        wrong.append([np.mean((found - truth)[part] ** 2) for found, truth in pairs])
    return np.sqrt(np.mean(wrong, axis=0)).tolist()


def main() -> int:
    """Write the figure of this checkout, print the errors."""
    family = Family(JOINT)
    recordings = family.recordings(2 * RECORDINGS)
    training, unseen = recordings[:RECORDINGS], recordings[RECORDINGS:]
    shown = unseen[0]
    part = (shown.t > 3.0) & (shown.t < 4.5)
    figure = Figure(figsize=(9.5, 4.6), layout='constrained')
    axes = figure.subplots(2, 1, sharex=True)
    for k, (name, (way, choices)) in enumerate(WAYS.items()):
        for column, axis in enumerate(axes):
            best = min(choices, key=lambda choice: errors(training, way, choice)[column])
            error = errors(unseen, way, best)[column]
            print(f'{NAMES[column]:24} {name:22} {error:.3g}  chosen: {best}')
            wrong = way(shown, *best)[column] - (shown.z[:, 1], shown.d)[column]
            axis.plot(shown.t[part], wrong[part], color=COLOURS[k], lw=1.1, label=name)
            axis.set_ylabel(f'error of {NAMES[column]}')
            axis.grid(alpha=0.3)
    axes[0].legend(fontsize='small', ncols=3)
    axes[1].set_xlabel('time [s]')
    path = ROOT / 'docs' / 'encoder.png'
    figure.savefig(path, dpi=110)
    print(path)
    return 0


if __name__ == '__main__':
    sys.exit(main())
