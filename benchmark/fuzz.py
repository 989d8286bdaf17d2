# SPDX-License-Identifier: Apache-2.0
"""
Hostile snapshots and hostile calls: each is refused or survived, and no estimate is not finite.

Run it on a build with bounds checks (FHAOSMO_DEBUG=1) and once with AddressSanitizer:

    python benchmark/fuzz.py --snapshots 100000 --calls 100000
"""

import argparse
from collections.abc import Callable, Mapping
import contextlib
import math
from typing import Any

from fhaosmo_ros.core import ConfigurationError, Observer, OnlineEstimator
import numpy as np

WILD = (
    math.nan, math.inf, -math.inf, 0.0, -0.0, 1.0, -1.0, 1e-320, 1e300, -1e300, 1.797e308, 2**31,
    -(2**31), 2**53, 2**63, 240.0, 1e9, -7.5, 0.3,
)  # fmt: skip
"""Numbers at the ends of what types hold, and some that could pass for a count or an index."""
STAMPS = (0, 1, -1, 10**9, 2**31, 2**62, 2**63 - 1, -(2**63), 2**64, 10**30, 5 * 10**6)
NO_NUMBERS = (None, 'text', [], {}, b'1', (1.0, 2.0), 3 + 4j)
REFUSALS = (ConfigurationError, TypeError, ValueError, IndexError, OverflowError)
SECOND_ORDER = {'order': 2, 'phi': ['0', '-z2 - 3*sin(z1) + u']}
KINDS: Mapping[str, Mapping[str, Any]] = {
    'cascade': {},
    'cascade, scheduled': {'noise_size': 1e-3},
    'cascade, explicit sign': {'scheme': 'explicit', 'variant': 'sign_adaptive'},
    'levant': {
        'structure': 'levant', 'scheme': 'predict_correct', 'correction_period': 1e-3,
        'noise_size': 1e-3, 'unknown_input_decay': 1.0, 'lambda': [60.0, 1500.0, 2e4, 1e5],
    },
    'self-tuning': SECOND_ORDER | {'gains': 'self_tuning'},
    'delayed': SECOND_ORDER | {
        'gains': 'fixed', 'measurement_delay': 0.01, 'input_delay': 0.002, 'predict_to_now': True,
        'stuck_time': 0.1, 'spike_gate': 0.5,
    },
    'smoothed': SECOND_ORDER | {'gains': 'self_tuning', 'smoothing_lag': 0.05},
    'clock': {'sampling': 'clock', 'event_threshold': 0.05},
}  # fmt: skip
"""Parameters that reach all of the core."""


def running(parameters: Mapping[str, Any], samples: int, seed: int) -> OnlineEstimator:
    """Return an estimator that has taken some samples of a noisy sine."""
    rng, estimator = np.random.default_rng(seed), OnlineEstimator(parameters)
    stamps = 10**9 + np.arange(samples) * 10**6
    y = 0.2 * np.sin(stamps * 2e-9) + 1e-3 * rng.standard_normal(samples)
    estimator.run(stamps, y)
    return estimator


def damaged(values: Mapping[str, Any], rng: np.random.Generator) -> dict[str, Any]:
    """Return a snapshot with a few entries replaced, resized, renamed or left out."""
    found, names = dict(values), list(values)
    for _ in range(rng.integers(1, 4)):
        name, kind = rng.choice(names), rng.integers(6)
        value = np.array(found.get(name, 0.0), dtype=object if kind == 5 else None)
        if kind < 3 and value.dtype.kind in 'fiu':
            value = value.astype(float)
            if value.size:
                value.flat[rng.integers(value.size)] = rng.choice(WILD)
            found[name] = value if value.ndim else float(value)
        elif kind == 3:
            found[name] = np.resize(value, rng.integers(0, 5, rng.integers(0, 3)))
        elif kind == 4:
            found.pop(name, None)
        else:
            found[name] = NO_NUMBERS[rng.integers(len(NO_NUMBERS))]
    return found


def assert_finite(estimator: OnlineEstimator) -> None:
    """Raise AssertionError if an estimate is not finite."""
    estimate = estimator.estimate
    if estimate is not None:
        numbers = [*estimate.z, estimate.unknown_input, estimate.gamma]
        assert np.isfinite(numbers).all(), estimate


def fuzz_snapshots(kind: str, count: int, seed: int) -> int:
    """Load damaged snapshots and go on; return how many were accepted."""
    rng, accepted = np.random.default_rng(seed), 0
    estimator = running(KINDS[kind], 300, seed)
    good = estimator.state_dict()
    for _ in range(count):
        try:
            estimator.load_state_dict(damaged(good, rng))
        except ConfigurationError:
            continue
        accepted += 1
        for k in range(5):
            estimator.update(10**9 + (301 + k) * 10**6, 0.1)
            assert_finite(estimator)
    estimator.load_state_dict(good)
    return accepted


def fuzz_calls(kind: str, count: int, seed: int) -> None:
    """Call with numbers, and with what is no number, in any order."""
    rng = np.random.default_rng(seed)

    def wild() -> Any:
        choice = rng.random()
        if choice < 0.1:
            return NO_NUMBERS[rng.integers(len(NO_NUMBERS))]
        return WILD[rng.integers(len(WILD))] if choice < 0.6 else float(rng.normal())

    def stamp() -> int:
        odd = rng.random() < 0.3
        return STAMPS[rng.integers(len(STAMPS))] if odd else int(rng.integers(10**9, 2 * 10**9))

    estimator, known = running(KINDS[kind], 50, seed), Observer().parameters
    observer = Observer({k: v for k, v in KINDS[kind].items() if k in known})
    calls: tuple[Callable[[], object], ...] = (
        lambda: estimator.update(stamp(), wild()),
        lambda: estimator.set_input(wild(), wild()),
        lambda: estimator.run([stamp()] * 3, [wild(), wild(), 0.1]),
        lambda: estimator.seed([wild()] * int(rng.integers(0, 5)), wild()),
        lambda: observer.step(wild(), wild(), wild()),
        lambda: observer.run([0.0, 1e-3, 2e-3], [wild(), 0.1, wild()], wild()),
        lambda: observer.start(wild()),
        estimator.reset,
    )
    for _ in range(count):
        with contextlib.suppress(*REFUSALS):
            calls[rng.integers(len(calls))]()
        assert_finite(estimator)


def main() -> None:
    """Run both on all kinds."""
    parser = argparse.ArgumentParser(description='Hostile snapshots and calls for the core.')
    parser.add_argument('--snapshots', type=int, default=10_000)
    parser.add_argument('--calls', type=int, default=10_000)
    parser.add_argument('--seed', type=int, default=1)
    options = parser.parse_args()
    for kind in KINDS:
        part = options.snapshots // len(KINDS)
        accepted = fuzz_snapshots(kind, part, options.seed)
        fuzz_calls(kind, options.calls // len(KINDS), options.seed)
        print(f'{kind}: {part} snapshots, {accepted} of them could be, none did harm', flush=True)


if __name__ == '__main__':
    main()
