# SPDX-License-Identifier: Apache-2.0
"""The study of use without tuning anew: page, filters and command."""

import numpy as np
import pytest
from studies import everywhere, evidence
from studies.comparison.methods.adaptive import HUBER, IMM
from studies.comparison.methods.linear import LINEAR_LIMIT

MOTOR, TUNED = everywhere.PLANTS['motor'], everywhere.CONDITIONS['as tuned']


@pytest.mark.parametrize('derivatives', [0, 2])
@pytest.mark.parametrize('rate', [100.0, 1000.0])
def test_peers_without_their_options_are_the_kalman_filter(derivatives, rate):
    """Its covariance converges to the steady one; three equal models are one."""
    condition = TUNED._replace(rate=rate)
    r = everywhere.recording(MOTOR, condition, 'chirp', 10.0)
    setting = everywhere.setting_of(MOTOR, condition)
    member = {'derivatives': derivatives, 'bandwidth': 15.0, 'decay': 4.5}
    values = everywhere.at(member, setting.model.order, rate)
    [expected] = everywhere.errors_of(LINEAR_LIMIT, setting, values, [r])
    for name, options in ((HUBER, {}), (IMM, {'spread': 1.0 + 1e-9, 'stay': 1.0})):
        [found] = everywhere.errors_of(name, setting, values | options, [r])
        assert found == pytest.approx(expected, rel=1e-3)


def test_what_differs_between_conditions():
    usual = everywhere.recording(MOTOR, TUNED, 'sine', 10.0)
    for name, c in everywhere.CONDITIONS.items():
        r = everywhere.recording(MOTOR, c, 'sine', 10.0)
        assert len(r.t) == 10.0 * c.rate, name
        np.testing.assert_allclose(np.sqrt(np.mean(r.d**2)), c.size * MOTOR.size, rtol=0.05)
        if c.rate == everywhere.RATE and c.size == c.speed == 1.0:
            np.testing.assert_array_equal(r.z, usual.z, err_msg=name)
        noise = np.std((r.y - r.z[:, 0])[: len(r.t) // 2])
        if c.kind in {'white', '0.75', '0.9', 'off'}:
            assert noise == pytest.approx(c.noise * MOTOR.noise, rel=0.15), name


def test_the_command_in_short(tmp_path):
    assert everywhere.main(['--quick', '--jobs', '1', '--output', str(tmp_path)]) == 0
    found = evidence.read(everywhere.NAME, tmp_path)
    assert [c['condition'] for c in found] == list(everywhere.QUICK.conditions)
    assert all(0.0 < c[everywhere.SELF] < 1.25 for c in found)
    assert found[0][everywhere.ONCE] == 1.0
