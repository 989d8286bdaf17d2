# SPDX-License-Identifier: Apache-2.0
"""Copies, threads, hostile snapshots and calls: an error or a good estimate, never a crash."""

import contextlib
import copy
from pathlib import Path
import pickle
import re
import threading

from fhaosmo_ros.core import Status
from fhaosmo_ros.core.observer.status import FLAGS_MASK, LEVEL_SHIFT, REJECTED, UNUSED
from fuzz import fuzz_calls, fuzz_snapshots, KINDS, running
import numpy as np
import pytest
from waiting import wait_until

ROOT = Path(__file__).resolve().parents[1]
kinds = pytest.mark.parametrize('kind', KINDS)
STAMPS = 10**9 + 300 * 10**6 + np.arange(200) * 10**6
Y = 0.1 * np.sin(STAMPS * 3e-9)


def same(one, other):
    for name, value in one._asdict().items():
        np.testing.assert_array_equal(value, getattr(other, name))


@pytest.mark.parametrize('duplicate', [
    copy.copy, copy.deepcopy, lambda x: pickle.loads(pickle.dumps(x)),  # noqa: S301
])  # fmt: skip
@kinds
def test_a_copy_goes_on_by_itself(kind, duplicate):
    estimator = running(KINDS[kind], 300, 1)
    other = duplicate(running(KINDS[kind], 300, 1))  # what it was made from is gone
    found = other.run(STAMPS, Y)
    same(found, estimator.run(STAMPS, Y))
    third = duplicate(estimator)
    estimator.run(STAMPS + 10**9, -Y)
    same(third.run(STAMPS + 2 * 10**8, Y), other.run(STAMPS + 2 * 10**8, Y))


@kinds
def test_hostile_snapshots(kind):
    fuzz_snapshots(kind, 150, 3)


@kinds
def test_hostile_calls(kind):
    fuzz_calls(kind, 200, 4)


@pytest.mark.parametrize('kind', ['cascade', 'self-tuning'])
def test_two_threads_on_one_estimator_get_an_error(kind):
    estimator = running(KINDS[kind], 100, 1)
    stamps = 2 * 10**9 + np.arange(20_000) * 10**6
    seen = threading.Event()

    def run():
        k = 0
        while not seen.is_set():
            with contextlib.suppress(RuntimeError):  # or this thread is the one that is refused
                estimator.run(stamps + k * 20 * 10**9, np.zeros(len(stamps)))
            k += 1

    thread = threading.Thread(target=run)
    thread.start()
    try:
        wait_until(lambda: refused(estimator), 'error', 60.0)
    finally:
        seen.set()
        thread.join()
    assert np.isfinite(estimator.observer.estimate.z).all()


def refused(estimator):
    try:
        estimator.update(1, 0.0)
    except RuntimeError as error:
        return 'another thread' in str(error)
    return False


def test_flags_of_compiled_code_are_those_of_status():
    text = (ROOT / 'fhaosmo_ros' / 'core' / 'observer' / 'status.pxd').read_text()
    found = {name: eval(value) for name, value in re.findall(r'(\w+) = ([\d +]+)', text)}  # noqa: S307
    named = {'REJECTED': REJECTED, 'UNUSED': UNUSED}
    named |= {'LEVEL_SHIFT': LEVEL_SHIFT, 'FLAGS_MASK': FLAGS_MASK}
    assert found == named | {flag.name: int(flag) for flag in Status if flag}
