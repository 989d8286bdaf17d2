# SPDX-License-Identifier: Apache-2.0
"""
y in another unit, time in another unit: the same estimate in those units.

z_i' = z_{i+1} + Phi_i keeps its form if y is scaled by a, time by b, and z_i by a b^-(i-1). A
self-tuning observer is told nothing but Phi, so it has to give the same estimate: to the bit, as a
and b are powers of two here. The same holds for what the policy does with gaps,
stamps that are late or far away, bad values and a sensor that is stuck.
"""

from fhaosmo_ros.core import Observer, OnlineEstimator, Plant
import numpy as np
import pytest

PERIOD = 2.0**-9
COUNT = 3000


def model(a, b, order):
    """Return parameters of z_n' = -2 z_n - z_1 / 2 + d in other units; as simple as can be."""
    phi = ['0'] * (order - 1) + [f'{-2.0 / b!r}*z{order} - {0.5 * b**-order!r}*z1']
    return {'order': order, 'phi': phi}


def samples(order):
    t = np.arange(COUNT) * PERIOD
    plant = Plant(model(1.0, 1.0, order) | {'disturbance': 'square', 'initial_state': 0.0})
    y, noise = plant.simulate(t).y, np.random.default_rng(order).standard_normal(COUNT)
    return t, y + 1e-4 * np.std(y) * noise


def estimates(found, a, b, order):
    """Return z, d and what is known of them in the units of a = b = 1."""
    sizes = a * b ** -np.arange(order + 1.0)
    z = np.column_stack([found.z, found.unknown_input])
    return np.hstack([z / sizes, found.standard_deviation / sizes])


def in_units(a, b, order):
    """Return estimates from y and time in units of a and b, in those of 1."""
    t, y = samples(order)
    observer = Observer(model(a, b, order), gains='self_tuning')
    return estimates(observer.run(b * t, a * y), a, b, order)


@pytest.mark.parametrize('order', [1, 2, 4])
@pytest.mark.parametrize(('a', 'b'), [
    (2.0**20, 1.0), (2.0**-20, 1.0), (1.0, 2.0**20), (1.0, 2.0**-20), (2.0**-15, 2.0**9),
])  # fmt: skip
def test_powers_of_two_change_no_bit(order, a, b):
    np.testing.assert_array_equal(in_units(a, b, order), in_units(1.0, 1.0, order))


@pytest.mark.parametrize('order', [2, 4])
@pytest.mark.parametrize(('a', 'b'), [(2.0**16, 1), (1.0, 2**10), (2.0**-16, 2**3)])
def test_policy_takes_the_same_samples_in_any_unit(order, a, b):
    """At the periods of 2 ms, 16 ms and 2 s; stamps are whole nanoseconds, so none is shorter."""
    t, y = samples(order)
    rng = np.random.default_rng(7)
    stamps = np.round(t * 1e9).astype(np.int64) + rng.integers(0, 200_000, COUNT)
    stamps[500:] += 40_000_000  # a gap
    stamps[900:] += 3_000_000_000  # a silence
    stamps[1200] += 300_000_000  # a stamp ahead
    stamps[1500:] -= 5_000_000_000  # a clock that is set back
    y[700], y[800:810], y[2000:2100] = np.nan, y[800] + 5.0, y[2000]
    one = OnlineEstimator(model(1.0, 1.0, order), gains='self_tuning')
    other = OnlineEstimator(model(a, float(b), order), gains='self_tuning')
    origin = 2**40
    wanted = estimates(one.run(stamps + origin, y), 1.0, 1.0, order)
    found = estimates(other.run((stamps + origin) * b, a * y), a, float(b), order)
    assert other.counters == one.counters
    assert one.counters.restarts == 2
    np.testing.assert_array_equal(found, wanted)
