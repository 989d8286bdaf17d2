# SPDX-License-Identifier: Apache-2.0
"""The numbers of the demonstration's table, from a bag whose errors are known."""

import bag_files as files
from fhaosmo_ros.core import ConfigurationError, OnlineEstimator
from fhaosmo_ros.tools.bags.types import labelled_array
from fhaosmo_ros.tools.demo import OTHERS, others, read_run, START, table
from fhaosmo_ros.topics import ARRAY, estimates_of, FLOAT, TIME
import numpy as np
import pytest

DIAGNOSTICS = 'diagnostic_msgs/msg/DiagnosticArray'
COUNT, PERIOD = 401, 0.01
T = PERIOD * np.arange(COUNT)
NAMES = ['z1', 'z2', 'z3', 'd']
SIZES = np.array([1.0, 3.0, 0.2, 0.05])
"""Amplitude of each state and of d."""
TRUTH = SIZES * np.sin(0.5 * np.pi * T)[:, None]
ERROR = np.select([T < 0.995, T < 1.495, T < 2.0, T < 2.995], [1.0, 0.3, 0.1, 0.01], 0.03)
"""Relative to the amplitude; the sign alternates."""
ESTIMATE = TRUTH + SIZES * (ERROR * (-1.0) ** np.arange(COUNT))[:, None]
KINDS = estimates_of({'gains': 'fixed'})


def tick(k, stamp):
    """Return the CDR of an estimate's messages by their topics."""
    z, d = ESTIMATE[k, :3], ESTIMATE[k, 3]
    return {
        'gamma': files.float64(0.5 + 1e-3 * k),
        'state': labelled_array(NAMES[:3], z),
        'unknown_input': files.float64(d),
        'innovation': labelled_array(['eps1', 'eps2', 'eps3', 'eps4'], np.zeros(4)),
        'stamp': files.cdr(TIME, sec=stamp // 10**9, nanosec=stamp % 10**9),
    }


def report(stamp, **values):
    """Return the CDR of the estimator's diagnostics."""
    types = files.TYPES.types
    pair, status = types['diagnostic_msgs/msg/KeyValue'], 'diagnostic_msgs/msg/DiagnosticStatus'
    pairs = [pair(key=key.replace('_', ' '), value=str(n)) for key, n in values.items()]
    status = types[status](
        level=0, name='estimator: input', message='OK', hardware_id='none', values=pairs
    )
    return files.cdr(DIAGNOSTICS, header=files.header(stamp), status=[status])


def record(path, missing=()):
    """Write a run; topics in `missing` are not in the bag."""
    messages = []
    for k in range(COUNT):
        stamp = files.ORIGIN + round(k * PERIOD * 1e9)
        truth = labelled_array(NAMES[:3], TRUTH[k, :3])
        rows = [
            ('/y', FLOAT, 0, files.float64(TRUTH[k, 0])),
            ('/plant/state', ARRAY, 20_000, truth),
            ('/plant/unknown_input', FLOAT, 40_000, files.float64(TRUTH[k, 3])),
        ]
        for number, (name, data) in enumerate(tick(k, stamp).items()):
            rows.append((f'/estimator/{name}', KINDS[name], 10**6 + 10**4 * number, data))
        if k in (100, 200, 300):
            counters = {'samples_lost': 3, 'samples_accepted': k, 'samples_rejected': 2}
            rows.append(('/diagnostics', DIAGNOSTICS, 2 * 10**6, report(stamp, **counters)))
        messages += [
            (topic, kind, stamp + delay, data)
            for topic, kind, delay, data in rows
            if topic not in missing
        ]
    return files.write(path, messages)


def test_table_says_the_errors_that_are_in_the_bag(tmp_path):
    run = read_run(record(tmp_path / 'bag'))
    assert run.curves.names == NAMES
    np.testing.assert_allclose(run.truth, TRUTH, rtol=0.0, atol=1e-15)
    np.testing.assert_allclose(run.curves.estimate, ESTIMATE, rtol=0.0, atol=1e-15)
    np.testing.assert_allclose(run.t, T, rtol=0.0, atol=1e-12)
    text = table(run, {}, [])
    assert 'samples: 300 used, 3 dropped, 2 rejected; 100.0 a second' in text
    (line,) = [line for line in text.splitlines() if line.startswith('this estimator, live')]
    (states,) = [line for line in text.splitlines() if line.startswith('RMS errors of the states')]
    of_states = [float(part.split()[1]) for part in states.split(': ')[1].split(', ')]
    late = T >= START
    rms = np.sqrt(np.mean((ESTIMATE - TRUTH)[late] ** 2, axis=0))
    moved = [np.abs(np.diff(d[late, 3])).sum() for d in (ESTIMATE, TRUTH)]
    expected = [rms[3], moved[0] / moved[1], *rms[:3]]
    assert [*map(float, line.split()[-2:]), *of_states] == pytest.approx(expected, rel=0.05)


def test_other_observers_go_through_the_same_samples(tmp_path):
    """What changes begins a column of the table."""
    run = read_run(record(tmp_path / 'bag'))
    compared = others(run, {'gains': 'fixed'})
    name, changes = [*OTHERS.items()][1]
    alone = OnlineEstimator(changes).run(run.y.stamps, run.y.values.ravel())
    np.testing.assert_array_equal(compared[name], alone.unknown_input[run.rows])
    text = table(run, compared, [(files.ORIGIN + 3 * 10**9, 'noise')])
    assert 'from 2 s' in text
    assert 'from 3 s' in text
    assert others(run, {'gains': 'self_tuning'}) == {}


def test_bag_without_estimates_is_refused(tmp_path):
    bag = record(tmp_path / 'bag', [f'/estimator/{name}' for name in KINDS])
    with pytest.raises(ConfigurationError, match='ended before an estimate arrived'):
        read_run(bag)
