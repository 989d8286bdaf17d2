# SPDX-License-Identifier: Apache-2.0
"""Force on a nonlinear oscillator: Silverbox, with its input hidden."""

from collections.abc import Mapping
from math import comb
from pathlib import Path
from typing import Any

import numpy as np
from studies.harness import Floats, observed, SELF_TUNING
from studies.recipes import judging
from studies.recipes.judging import FIXED, Fold, Method, OURS, Recipe, Recorded

PERIOD = 2**14 / 1e7
MULTISINES, HALF = 45_000, 65_000
"""Row from which on the input is a multisine; model and peers come from the rows up to `HALF`."""
END = 85_000
LAG = 1  # samples: each method is judged by what it says of d that much later
LAGGING, SMOOTHING = f'{OURS}, smoothing_lag of one sample', 0.0016
"""The same with the estimates smoothed by that sample: the lag is a little less than a period."""
SETTLED, WINDOW = 1.0, 300
FREQUENCIES = 2 * np.pi * np.arange(10.0, 200.0, 10.0)
BANDWIDTHS = np.geomspace(500.0, 10000.0, 10).tolist()


def identify(y: Floats, force: Floats) -> list[float]:
    """
    Return b, k1, k2, k3, c, g of y'' = c + g force - b y' - k1 y - k2 y² - k3 y³.

    Least squares with modulating functions (Shinbrot 1957): integrals over windows, by parts, so
    that nothing is differentiated.
    """
    t = (np.arange(WINDOW) + 0.5) * PERIOD
    rate = np.pi / (WINDOW * PERIOD)
    sin, cos = np.sin(rate * t), np.cos(rate * t)
    bell = sin**6, 6 * rate * sin**5 * cos, rate**2 * (30 * sin**4 * cos**2 - 6 * sin**6)
    table, wanted = [], []
    for w in FREQUENCIES:
        wave = np.exp(1j * w * t)
        p0 = bell[0] * wave
        p1 = (bell[1] + 1j * w * bell[0]) * wave
        p2 = (bell[2] + 2j * w * bell[1]) * wave - w**2 * p0
        for begin in range(0, len(y) - WINDOW, WINDOW // 2):
            part = slice(begin, begin + WINDOW)
            x, f = y[part], force[part]
            table.append([p1 @ x, -p0 @ x, -p0 @ x**2, -p0 @ x**3, p0.sum(), p0 @ f])
            wanted.append(p2 @ x)
    both = np.concatenate([np.real(table), np.imag(table)])
    target = np.concatenate([np.real(wanted), np.imag(wanted)])
    found: list[float] = np.linalg.lstsq(both, target, rcond=None)[0].tolist()
    return found


def fixed(p: Mapping[str, Any], r: Recorded, bandwidth: float) -> Floats:
    """Return d of the observer with one derivative of d and all four poles at a bandwidth."""
    gains = judging.fixed_gains(2, bandwidth, r.period) | {
        'unknown_input_derivatives': 1,
        'lambda': [comb(4, k) * bandwidth**k for k in range(1, 5)],
    }
    return observed(dict(p) | gains, r).unknown_input


def lagging(p: Mapping[str, Any], r: Recorded, _: float) -> Floats:
    """Return what the observer that is told only the model says of d one sample later."""
    found = observed(dict(p) | SELF_TUNING | {'smoothing_lag': SMOOTHING}, r)
    told = 1e-9 * (found.t - 10**9) + LAG * PERIOD
    return np.interp(r.t - r.t[0], told, found.unknown_input)


def described(found: list[float]) -> dict[str, Any]:
    """Return the oscillator as parameters of the estimator."""
    damping, k1, k2, k3, c, _ = found
    phi = f'{c!r} - {damping!r}*z2 - {k1!r}*z1 - {k2!r}*z1**2 - {k3!r}*z1**3'
    return {'order': 2, 'phi': ['0', phi]}


def conditions(data: Path) -> dict[str, list[Fold]]:
    """Return model and peers from one half of the multisines, judged on the other."""
    force, y = np.genfromtxt(data, delimiter=',', skip_header=1, max_rows=END)[:, :2].T
    found = identify(y[MULTISINES:HALF], force[MULTISINES:HALF])
    # A third of the first half is enough for one number.
    training, judged = (
        recorded(f'rows {a} to {b}', y[a:b], found[-1] * force[a:b])
        for a, b in ((MULTISINES, MULTISINES + (HALF - MULTISINES) // 3), (HALF, END))
    )
    return {'second half': [Fold(described(found), [training], [judged])]}


def recorded(name: str, y: Floats, d: Floats) -> Recorded:
    """Return a recording whose truth is that of `LAG` samples before."""
    t = np.arange(len(y)) * PERIOD
    late = np.concatenate([np.repeat(d[0], LAG), d[:-LAG]])
    return Recorded(name, t, y, np.zeros((len(y), 1)), late, SETTLED)


RECIPE = Recipe(
    {
        'disturbance observer': Method(judging.disturbance_observer, BANDWIDTHS),
        'Kalman filter, d a random walk': Method(judging.kalman_filter, BANDWIDTHS),
        FIXED: Method(fixed, BANDWIDTHS),
        OURS: Method(judging.this_observer),
        LAGGING: Method(lagging),
    },
    conditions, 'V1 [V]', ('disturbance observer', LAGGING), (5.0, 5.12),
    scale=1.0 / 186_024.0, band=False, data='SNLS80mV.csv of Silverbox',
)  # fmt: skip
