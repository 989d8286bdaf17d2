# SPDX-License-Identifier: Apache-2.0
"""Where the paper stops: the implicit scheme, measurement noise, 2,000 s of adaptation."""

from typing import Any

from fhaosmo_ros.core.simulation.metrics import rms
import numpy as np
from numpy.typing import NDArray
from studies.evidence import Row
from studies.paper.cases import (
    CONVERGED,
    FREQUENCIES,
    observe,
    SAFE,
    sampled,
    score,
    truth_of,
)

Floats = NDArray[np.float64]

VARIANTS = ('sign', 'fuzzy', 'fuzzy_adaptive', 'sign_adaptive')
NOISES = (1e-4, 1e-3, 1e-2)
"""Standard deviations of the noise on y; the amplitude of z1 is of order 0.1 to 1."""
SAMPLED = (
    *(
        (scheme, step, omega, 0.0)
        for scheme, step in (('explicit', 1e-3), ('implicit', 1e-3), ('implicit', 1e-2))
        for omega in FREQUENCIES
    ),
    *(
        (scheme, 1e-3, FREQUENCIES[0], noise)
        for noise in NOISES
        for scheme in ('explicit', 'implicit')
    ),
)
"""Scheme, step (s), angular frequency, noise on y."""
LONG_DURATION, WINDOW = 2000.0, 100.0
"""Seconds of a long run, and of the windows at its begin and its end that are judged."""
LAWS: dict[str, dict[str, Any]] = {"the paper's": {}, 'default': SAFE}
"""Laws of gamma by name: what differs from config/paper.yaml."""
LONG = tuple(
    (scheme, omega, noise)
    for noise in (0.0, 1e-4)
    for scheme in ('explicit', 'implicit')
    for omega in FREQUENCIES
)
"""Long runs: scheme, angular frequency, noise on y."""
THINNED = 10
"""Long runs record every 10th sample."""


def sampled_rows(scheme: str, step: float, omega: float, noise: float) -> list[Row]:
    """Measure observers as a node runs them, a step a sample."""
    return [
        {'observer': variant, 'scheme': scheme, 'step': step, 'omega': omega, 'noise': noise}
        | score(sampled(variant, omega, step, scheme, noise))
        for variant in VARIANTS
    ]


def long_rows(
    scheme: str, omega: float, noise: float, duration: float = LONG_DURATION
) -> list[Row]:
    """
    Adapt gamma by each of `LAWS` for a long time, from `CONVERGED` on.

    Returns
    -------
    list of dict
        gamma_first, gamma_last: at the end of the first and the last window; rms_d_first,
        rms_d_last: error of d within it; rms_d_fixed: that of the last with gamma = 1/2.

    """
    truth = truth_of(omega, 1e-3, noise, duration + CONVERGED)
    row = THINNED * 1e-3
    first, size = round(CONVERGED / row), round(WINDOW / row)

    def windows(variant: str, changes: dict[str, Any]) -> tuple[Floats, Floats]:
        run = observe(truth, variant, scheme, THINNED, **changes)
        error = run.z_hat[:, -1] - run.unknown_input
        starts = range(first, len(error) - size + 1, size)
        return (
            np.array([rms(error[k : k + size]) for k in starts]),
            np.array([run.gamma[k + size - 1] for k in starts]),
        )

    fixed = float(windows('fuzzy', {})[0][-1])
    rows = []
    for law, changes in LAWS.items():
        rms_d, gamma = windows('fuzzy_adaptive', changes)
        rows.append({
            'law': law, 'scheme': scheme, 'omega': omega, 'noise': noise,
            'gamma_first': float(gamma[0]), 'gamma_last': float(gamma[-1]),
            'rms_d_first': float(rms_d[0]), 'rms_d_last': float(rms_d[-1]), 'rms_d_fixed': fixed,
        })  # fmt: skip
    return rows
