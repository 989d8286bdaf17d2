# SPDX-License-Identifier: Apache-2.0
"""Intervals between samples: of the stamps, or even ones, whichever fits the motion."""

from pathlib import Path
import sys

import numpy as np
import pytest

pytest.importorskip('pinocchio')
sys.path.insert(0, str(Path(__file__).parent))

from fhaosmo_ros.core.arm.arm import Arm
from fhaosmo_ros.core.arm.model import ArmModel
from fhaosmo_ros.core.arm.samples import Clock
from robots import motion, URDF

PERIOD = 1e-3


def intervals(sampled, stamps):
    """Return the clock, and the intervals that it gives to sines sampled at these times."""
    clock, q = Clock(), np.sin(np.outer(sampled, [1.0, 2.3]))
    moved = np.diff(q, axis=0)
    return clock, np.array([
        clock.interval(h, m) for h, m in zip(np.diff(stamps), moved, strict=True)
    ])  # fmt: skip


@pytest.mark.parametrize('late', [0.05, 0.1, 0.2])
def test_stamps_that_jitter_around_even_samples_are_evened_out(late):
    t = 2.0 + PERIOD * np.arange(4000.0)
    stamps = t + late * PERIOD * np.random.default_rng(1).standard_normal(4000)
    clock, found = intervals(t, np.maximum.accumulate(stamps) + 1e-9 * np.arange(4000))
    assert clock.even
    assert np.quantile(np.abs(found[500:] - PERIOD), 0.99) < 0.08 * late * PERIOD


def test_samples_that_jitter_with_their_stamps_are_left_as_they_are():
    t = PERIOD * (np.arange(4000.0) + 0.1 * np.random.default_rng(1).standard_normal(4000))
    clock, found = intervals(t, t)
    assert not clock.even
    np.testing.assert_array_equal(found[100:], np.diff(t)[100:])


def test_missing_samples_and_another_rate_are_followed():
    random = np.random.default_rng(2)
    t = PERIOD * np.flatnonzero(random.random(4000) > 0.05)
    t = np.concatenate([t, t[-1] + 0.4 * PERIOD * np.arange(1, 4000)])
    stamps = t + 2e-5 * random.standard_normal(len(t))
    clock, found = intervals(t, stamps)
    assert clock.even
    late = np.r_[500:3000, len(t) - 2000 : len(t) - 1]
    np.testing.assert_allclose(found[late], np.diff(t)[late], atol=5e-6)


def test_an_arm_feels_as_well_with_stamps_that_jitter():
    t, q, _, torque = motion(ArmModel(URDF), 4.0)
    error = {}
    for late in (0.0, 1e-4):
        stamps = 10.0 + t + late * np.random.default_rng(3).standard_normal(len(t))
        estimates = Arm(URDF).run(stamps, q, torque)
        error[late] = np.sqrt(np.nanmean(estimates.external_torque[1000:] ** 2))
        assert not estimates.contact[1000:].any()
    assert error[1e-4] < error[0.0] + 0.02
