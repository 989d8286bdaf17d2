# SPDX-License-Identifier: Apache-2.0
"""
Copies, threads, hostile snapshots: an error or a good estimate, never a crash.

HOSTILE=100000 in the environment makes so many snapshots of each kind: for a build with bounds
checks (FHAOSMO_DEBUG=1), or with AddressSanitizer.
"""

from concurrent.futures import ThreadPoolExecutor
import contextlib
import copy
import math
import os
import pickle
import time

from fhaosmo_ros.core import ConfigurationError, OnlineEstimator, Plant
from fhaosmo_ros.core.arm.samples import Samples
from fhaosmo_ros.core.model import phi
from fhaosmo_ros.core.observer.kalman import LinearModel
import numpy as np
import pytest

HOSTILE = int(os.environ.get('HOSTILE', '0'))
WILD = (
    math.nan, math.inf, -math.inf, 0.0, -0.0, 1.0, -1.0, 1e-320, 1e300, -1e300, 1.797e308, 2**31,
    -(2**31), 2**53, 2**63, 240.0, 1e9, -7.5, 0.3,
)  # fmt: skip
"""Numbers at the ends of what types hold, and some that could pass for a count or an index."""
NO_NUMBERS = (None, 'text', [], {}, b'1', (1.0, 2.0), 3 + 4j)
SECOND_ORDER = {'order': 2, 'phi': ['0', '-z2 - 3*sin(z1) + u']}
KINDS = {
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
    'infinite': {'phi': ['0', '0', 'sqrt(z1-.12)'], 'gains': 'self_tuning', 'smoothing_lag': 0.05},
    'clock': {'sampling': 'clock', 'event_threshold': 0.05},
}  # fmt: skip
"""Parameters that reach all of the core."""
kinds = pytest.mark.parametrize('kind', KINDS)
STAMPS = 10**9 + (300 + np.arange(200)) * 10**6
Y = 0.1 * np.sin(STAMPS * 3e-9)


def running(parameters, samples, seed):
    """Return an estimator that has taken some samples of a noisy sine."""
    noise, estimator = np.random.default_rng(seed), OnlineEstimator(parameters)
    stamps = 10**9 + np.arange(samples) * 10**6
    estimator.run(stamps, 0.2 * np.sin(stamps * 2e-9) + noise.normal(0.0, 1e-3, samples))
    return estimator


def damaged(values, rng):
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


@pytest.mark.parametrize('duplicate', [
    copy.copy, copy.deepcopy, lambda x: pickle.loads(pickle.dumps(x)),  # noqa: S301
])  # fmt: skip
@kinds
def test_a_copy_goes_on_by_itself(kind, duplicate):
    estimator = running(KINDS[kind], 300, 1)
    other = duplicate(running(KINDS[kind], 300, 1))  # what it was made from is gone
    found = other.run(STAMPS, Y)
    assert not np.isnan(found.standard_deviation).any()
    np.testing.assert_equal(found._asdict(), estimator.run(STAMPS, Y)._asdict())
    third = duplicate(estimator)
    estimator.run(STAMPS + 10**9, -Y)
    np.testing.assert_equal(*(one.run(STAMPS + 2 * 10**8, Y)._asdict() for one in (third, other)))


@kinds
def test_hostile_snapshots(kind):
    rng, estimator = np.random.default_rng(3), running(KINDS[kind], 300, 3)
    good = estimator.state_dict()
    for _ in range(HOSTILE or 150):
        with contextlib.suppress(ConfigurationError):
            estimator.load_state_dict(damaged(good, rng))
            for k in range(5):
                e = estimator.update(10**9 + (301 + k) * 10**6, 0.1)
                assert e is None or np.isfinite([*e.z, e.unknown_input, e.gamma]).all(), e
    estimator.load_state_dict(good)


@pytest.mark.parametrize('kind', ['cascade', 'self-tuning'])
def test_two_threads_on_one_estimator_get_an_error(kind):
    estimator, stamps = running(KINDS[kind], 100, 1), 2 * 10**9 + np.arange(200_000) * 10**6
    y, refused = 0.1 * np.sin(stamps * 3e-9), pytest.raises(RuntimeError, match='another thread')
    deadline = time.monotonic() + 60.0
    with refused, ThreadPoolExecutor(1) as other:
        while time.monotonic() < deadline:
            run = other.submit(estimator.run, stamps, y)
            while not run.done():
                estimator.update(0, 0.1)
            run.result()
    assert np.isfinite(estimator.observer.estimate.z).all()


def test_a_thread_has_an_estimator_for_itself_until_it_has_smoothed():
    estimator = running(KINDS['smoothed'], 100, 1)
    calls = estimator.reset, estimator.finish, lambda: estimator.run(STAMPS, Y)
    with estimator.policy, ThreadPoolExecutor(1) as other:
        for call in calls:
            with pytest.raises(RuntimeError, match='another thread'):
                other.submit(call).result()
    estimator.run(STAMPS, Y)


def test_gains_that_are_not_scheduled_reject_no_sample():
    estimator = running(KINDS['levant'], 300, 1)
    assert estimator.update(STAMPS[0], 1.0).status.rejected
    estimator.configure({'noise_size': 0.0})
    assert not estimator.run(STAMPS[1:], Y[1:]).status.any()


def test_compiled_code_takes_no_arrays_of_other_sizes():
    """It reads arrays without looking at their ends: who calls it from Python is refused."""
    policy, none, three = running({}, 50, 5).policy, np.zeros((len(Y), 0)), np.ones(3)
    smoother = running(KINDS['smoothed'], 300, 5).smoothing
    for call, *arguments in (
        (policy.run, STAMPS[:2], Y, none), (policy.run, STAMPS, Y, np.zeros((200, 2))),
        (Plant()._system.advance, Y, Y), (Samples, *[three] * 6, True),
        (smoother._passes.forward, three), (LinearModel, np.eye(18), 1.0),
        *((phi.Expressions, [[(int(code), 1)]], 1, 1) for code in (phi.ADD, phi.STATE)),
    ):  # fmt: skip
        with pytest.raises(ValueError, match=r'expected|arrays'):
            call(*arguments)
