# SPDX-License-Identifier: Apache-2.0
"""The plant node: what it publishes belongs to the time at which it publishes it."""

from bisect import bisect

from fhaosmo_ros.core.simulation.plant import Plant
import numpy as np
import pytest
from running import Parameters, Rig, SECOND
from std_msgs.msg import Float64, Float64MultiArray

AMPLITUDE = 2.0
PHI = ['0', '0', '-6.0*z1 - 11.0*z2 - 6.0*z3']  # poles -1, -2, -3: stays bounded
OF_STATE = 'qos_overrides./stable/plant/state.publisher.depth'


class PlantRig(Rig):
    """A running plant, heard."""

    def __init__(self, user, process, namespace):
        super().__init__(user, process, f'{namespace}/plant')
        self.y = user.record(f'{namespace}/y', Float64)
        self.state = user.record(f'{namespace}/plant/state', Float64MultiArray)
        self.parameters = Parameters(user, self.name)
        user.wait(lambda: self.y and self.state, 'samples')

    def fresh(self, count: int) -> tuple[np.ndarray, np.ndarray]:
        """Return stamps [s] and y of samples that come from now on."""
        first = len(self.y)
        self.user.wait(lambda: len(self.y) >= first + count, 'samples')
        rows = [(m.stamp - self.y[0].stamp, m.message.data) for m in self.y[first:]]
        t, y = np.array(rows).T
        return t / SECOND, y


@pytest.fixture(scope='module')
def rig(user, launch):
    values = {'sample_rate': 250.0, 'disturbance_amplitude': AMPLITUDE, 'phi': PHI, OF_STATE: 7}
    return PlantRig(user, launch('plant', namespace='/stable', **values), '/stable')


def test_y_belongs_to_its_stamp(rig):
    t, y = rig.fresh(250)
    # The plant started before the first message arrived here: find its time by y itself.
    grid = np.arange(0.0, t[-1] + 20.0, 1e-3)
    reference = Plant(phi=PHI, disturbance_amplitude=AMPLITUDE).simulate(grid).y

    def residual(start: float) -> float:
        return np.median(np.abs(np.interp(t + start, grid, reference) - y))

    coarse = min(np.arange(0.0, 19.0, 0.05), key=residual)
    best = min(map(residual, np.arange(max(coarse - 0.06, 0.0), coarse + 0.06, 1e-4)))
    # Had y been computed for the tick's nominal time, timer jitter would show here: a millisecond
    # of it is speed * 1e-3.
    speed = max(abs(m.message.data[1]) for m in list(rig.state))
    assert best < 2e-4 * speed


def test_truth_is_labelled_and_y_is_its_first_state(rig):
    rig.user.wait(lambda: len(rig.state) > 60 and rig.y[-1].stamp > rig.state[59].stamp, 'samples')
    stamps, states = [sample.stamp for sample in rig.y], rig.state[10:60]
    assert states[-1].message.layout.dim[0].label == 'z1,z2,z3'
    for stamp, state in states:  # which the plant publishes behind the sample
        assert state.data[0] == rig.y[bisect(stamps, stamp) - 1].message.data
    assert rig.parameters.get(OF_STATE) == 7


def test_sample_rate_live_does_not_change_the_plant(rig):
    rig.parameters.set(disturbance='step', disturbance_offset=0.0, disturbance_start=0.0)
    rig.parameters.set(sample_rate=50.0)

    def as_meant() -> bool:  # at 50 Hz, in the steady state d / 6
        t, y = rig.fresh(20)
        period = np.median(np.diff(t))
        return period == pytest.approx(0.02, rel=0.2) and abs(y[-1] - AMPLITUDE / 6.0) < 1e-2

    rig.user.wait(as_meant, 'steady state')


def test_known_input_comes_from_its_topic_and_an_unstable_plant_says_so_once(user, launch):
    model = {'order': 1, 'phi': ['20.0*u + k*z1'], 'constants.k': -40.0, 'disturbance': 'none'}
    rig = PlantRig(user, launch('plant', namespace='/driven', **model), '/driven')
    u = user.publisher('/driven/u')
    u.publish(Float64(data=-3.0))
    user.wait(lambda: abs(rig.y[-1].message.data + 1.5) < 1e-3, 'y = -1.5')
    u.publish(Float64(data=float('nan')))
    rig.wait_said('rejected u = nan')
    _, y = rig.fresh(20)
    np.testing.assert_allclose(y, -1.5, rtol=0.0, atol=1e-3)
    assert 'constants.q' in rig.parameters.try_to_set(**{'constants.q': 1.0}).reason
    rig.parameters.set(**{'constants.k': 2000.0})
    words = 'has left the finite numbers'
    rig.wait_said(words)
    begin = user.node.get_clock().now().nanoseconds
    user.wait(lambda: user.node.get_clock().now().nanoseconds > begin + SECOND // 3, 'periods')
    assert len(rig.said(words)) == 1
    assert all(stamp < begin for stamp, _ in rig.y)
