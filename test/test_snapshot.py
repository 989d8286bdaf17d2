# SPDX-License-Identifier: Apache-2.0
"""A snapshot holds all that an estimator needs to go on bit for bit."""

from fhaosmo_ros.core.online.estimator import OnlineEstimator
from fhaosmo_ros.core.online.snapshots import Flag, pack, Snapshot, unpack
from fhaosmo_ros.core.parameters.errors import ConfigurationError
import numpy as np
import pytest

ORIGIN = 1_700_000_000_123_456_789


def fed(count, **parameters):
    """Return an estimator that has taken samples with jitter."""
    estimator, rng = OnlineEstimator(parameters), np.random.default_rng(3)
    k = np.arange(count)
    stamps = ORIGIN + k * 1_000_000 + rng.integers(-200_000, 200_000, count)
    estimator.run(stamps, 0.2 + 0.1 * np.sin(3e-3 * k))
    return estimator


def test_labels_name_what_stands_there():
    estimator = fed(700)
    labels, vector = pack(Snapshot(estimator.latest, Flag(0), estimator.state_dict()))
    entries = dict(zip(labels, vector.tolist(), strict=True))
    assert len(entries) == len(vector)  # no name twice
    assert labels[0] == 'version'
    state = estimator.observer.structure.state_dict()
    assert entries['z_hat2'] == state['z_hat'][1]
    assert entries['z_tilde1'] == state['z_tilde'][0]
    assert entries['gamma'] == estimator.estimate.gamma
    assert entries['y'] == state['y']
    assert int(entries['stamp_upper']) * 2**32 + int(entries['stamp_lower']) == estimator.stamp
    assert int(entries['sec']) * 10**9 + int(entries['nanosec']) == estimator.stamp


@pytest.mark.parametrize('integer', [0, 1, -1, 2**63 - 1, -(2**63), 1_700_000_000_123_456_789])
def test_integers_come_back_exactly(integer):
    times = ('stamp', 'latest', 'now', 'held_stamp', 'seen', 'tick', 'placed', 'event_since')
    values = OnlineEstimator().state_dict() | dict.fromkeys(times, integer)
    labels, vector = pack(Snapshot(5, Flag(0), values))
    back = unpack(vector, labels).values
    assert [back[name] for name in times] == [integer] * len(times)
    estimator = OnlineEstimator()
    estimator.load_state_dict(back)
    assert estimator.state_dict()['latest'] == integer


LATE = {'gains': 'fixed', 'measurement_delay': 0.1, 'phi': ['u', '0', '0']}


@pytest.mark.parametrize(('name', 'number'), [
    ('past_place', -1), ('past_place', 512), ('past_count', 513), ('event', 6), ('intervals', 33),
    ('regular', -1), ('frozen', 2), ('latest', 2**63), ('latest', 0.5), ('latest', 'x'),
    ('mean_interval', -1.0), ('mean_interval', np.nan), ('held_y', np.inf), ('z_hat', np.zeros(3)),
    ('z_hat', np.full(4, np.nan)), ('past_pieces', np.full((512, 2), np.inf)), ('u', np.zeros(2)),
    ('past_latest', None), ('version', 2), ('spread', 0.0),
])  # fmt: skip
def test_a_number_that_can_not_be_is_refused_and_changes_nothing(name, number):
    estimator, good = fed(50, **LATE), fed(100, **LATE).state_dict()
    before = estimator.state_dict()
    for values in (good | {name: number}, {k: v for k, v in good.items() if k != name}):
        with pytest.raises(ConfigurationError, match='snapshot'):
            estimator.load_state_dict(values)
        np.testing.assert_equal(estimator.state_dict(), before)


def test_vector_of_other_entries_is_refused():
    labels, vector = pack(Snapshot(5, Flag(0), OnlineEstimator().state_dict()))
    with pytest.raises(ConfigurationError, match='entries'):
        unpack(np.zeros(8), labels)
    with pytest.raises(ConfigurationError, match='entries'):
        unpack(vector, [*labels[:-1], labels[0]])
    for names in ([], ['flags'], labels[4:]):
        with pytest.raises(ConfigurationError, match='version'):
            unpack(np.zeros(len(names)), names)
    for name in ('z_hat9999999', 'z_hat6', 'z_hat0', 'covariance1', 'z_hat1_1'):
        with pytest.raises(ConfigurationError, match='snapshot'):
            unpack([*vector, 0.0], [*labels, name])


def test_state_of_another_size_is_refused():
    two = OnlineEstimator({'order': 2, 'phi': ['0', 'a - b'], 'inputs': ['a', 'b']}).state_dict()
    for other, said in (
        ({'order': 2, 'phi': ['0', 'u']}, 'expected finite numbers of shape'),
        ({'order': 1, 'phi': ['0*a*b'], 'inputs': ['a', 'b']}, r'\(2,\)'),
        (LATE, 'measurement_delay'),
    ):
        with pytest.raises(ConfigurationError, match=said):
            OnlineEstimator(other).load_state_dict(two)
