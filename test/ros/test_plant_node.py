# SPDX-License-Identifier: Apache-2.0
"""The plant node: what it publishes belongs to the time at which it publishes it."""

import re
import time

import numpy as np
import pytest

rclpy = pytest.importorskip('rclpy', reason='rclpy is not installed: needs ROS 2 Jazzy')
pytestmark = pytest.mark.ros

from fhaosmo_ros.core.simulation.disturbance import KINDS  # noqa: E402
from fhaosmo_ros.core.simulation.plant import Plant  # noqa: E402
from rig import Parameters, parameters  # noqa: E402
from std_msgs.msg import Float64, Float64MultiArray  # noqa: E402

AMPLITUDE = 2.0
OMEGA = 3.0


class PlantRig:
    def __init__(self, client, namespace: str) -> None:
        self.client = client
        self.parameters = Parameters(client, f'{namespace}/plant')
        self.y = client.record(f'{namespace}/y', Float64)
        self.state = client.record(f'{namespace}/plant/state', Float64MultiArray)
        self.d = client.record(f'{namespace}/plant/unknown_input', Float64)

    def fresh(self, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return stamps [s], y and d of samples that come from now on."""
        ticks = self.ticks(self.d, count)
        stamps = np.array([y.stamp - self.y[0].stamp for y, _ in ticks]) * 1e-9
        return stamps, *np.array([(y.message.data, d.message.data) for y, d in ticks]).T

    def ticks(self, messages: list, count: int) -> list:
        """Return pairs of a sample and what the plant published behind it, from now on."""
        first = len(self.y)
        pairs = []

        def look() -> bool:
            samples, others = self.y[first:], list(messages)
            after = np.searchsorted([m.stamp for m in samples], [m.stamp for m in others])
            # Behind a sample and before the next one; a stall may have lost one of the two.
            pairs[:] = [
                (samples[k - 1], others[i])
                for i, k in enumerate(after)
                if k and (i == 0 or after[i - 1] != k)
            ]
            return len(pairs) >= count

        self.client.wait(look, 'ticks')
        return pairs[:count]

    def set(self, **values) -> None:
        result = self.parameters.set_atomically(**values)
        assert result.successful, result.reason


@pytest.fixture(scope='module')
def rig(client, start):
    start(
        'plant',
        *parameters(
            sample_rate=250.0,
            phi="['0', '0', '-6.0*z1 - 11.0*z2 - 6.0*z3']",  # poles -1, -2, -3: stays bounded
            disturbance_amplitude=AMPLITUDE,
            disturbance_omega=OMEGA,
        ),
    )
    rig = PlantRig(client, '')
    client.wait(lambda: len(rig.y) > 10 and len(rig.d) > 10 and rig.state, 'samples')
    return rig


def test_y_belongs_to_its_stamp(client, start):
    """y against the plant simulated at the messages' source stamps."""
    start('plant', *parameters(namespace='/exact', sample_rate=250.0))
    rig = PlantRig(client, '/exact')
    client.wait(lambda: len(rig.y) >= 500 and len(rig.state) >= 500, 'samples')
    samples = list(rig.y)
    t = np.array([m.stamp - samples[0].stamp for m in samples]) * 1e-9
    y = np.array([m.message.data for m in samples])
    z = np.array([m.message.data for m in list(rig.state)])
    # The plant started before the first message arrived here: find its time by y itself.
    grid = np.arange(0.0, 40.0, 1e-3)
    reference = Plant().simulate(grid)
    starts = grid[: len(grid) - int(t[-1] * 1000) - 2]
    coarse = [np.abs(np.interp(t + s, grid, reference.y) - y).max() for s in starts[::50]]
    begin = starts[::50][int(np.argmin(coarse))]
    candidates = np.arange(max(begin - 0.06, 0.0), begin + 0.06, 1e-4)
    offset = min(
        candidates, key=lambda s: np.median(np.abs(np.interp(t + s, grid, reference.y) - y))
    )
    residual = np.interp(t + offset, grid, reference.y) - y
    speed = np.abs(z[:, 1]).max()
    # Had y been computed for the tick's nominal time, timer jitter would show here: a millisecond
    # of it is speed * 1e-3.
    assert np.median(np.abs(residual)) < 2e-4 * speed
    assert np.ptp(t) > 1.0


def test_truth_is_labelled_and_y_is_its_first_state(rig):
    message = rig.state[-1].message
    assert message.layout.dim[0].label == 'z1,z2,z3'
    for sample, state in rig.ticks(rig.state, 50):
        assert state.message.data[0] == sample.message.data


@pytest.mark.parametrize('kind', KINDS)
def test_each_disturbance_live(rig, kind):
    rig.set(disturbance=kind, disturbance_offset=0.5, disturbance_start=0.0)
    low, high = 0.5 - AMPLITUDE, 0.5 + AMPLITUDE

    def settled() -> bool:
        value = rig.d[-1].message.data
        return {'none': value == 0.0, 'step': value == high, 'square': value in (low, high)}.get(
            kind, low < value < high
        )

    rig.fresh(5)  # those of the kind before may have been on their way
    rig.client.wait(settled, f'{kind} on the wire')
    if kind in ('sine', 'chirp'):
        t, _, d = rig.fresh(250)
        assert low <= d.min() < d.max() <= high
        assert np.ptp(d) > 0.1
        # d' <= amplitude * omega, here with the chirp's last omega
        assert np.abs(np.diff(d)).max() <= AMPLITUDE * 10.0 * np.diff(t).max() * 1.5 + 1e-3
    if kind == 'sine':
        # d'' = -omega^2 (d - offset): fit sine and cosine at the stamps
        basis = np.stack([np.sin(OMEGA * t), np.cos(OMEGA * t), np.ones_like(t)], axis=1)
        coefficients = np.linalg.lstsq(basis, d, rcond=None)[0]
        assert np.hypot(*coefficients[:2]) == pytest.approx(AMPLITUDE, rel=0.05)
        assert coefficients[2] == pytest.approx(0.5, abs=0.1)


def test_noise_live(rig):
    def roughness() -> float:
        """Standard deviation of y about its own neighbours."""
        _, y, _ = rig.fresh(250)
        return float(np.std(np.diff(y, 2)) / np.sqrt(6.0))

    rig.set(disturbance='none')
    rig.set(noise_std=0.05)
    rig.fresh(5)
    assert roughness() == pytest.approx(0.05, rel=0.25)
    rig.set(noise_std=0.0)
    rig.fresh(5)
    assert roughness() < 1e-3


def test_sample_rate_live_does_not_change_the_plant(rig):
    rig.set(disturbance='step', disturbance_offset=0.0, disturbance_start=0.0)
    for rate in (50.0, 125.0):
        rig.set(sample_rate=rate)

        def sampled(rate=rate) -> bool:
            t, y, _ = rig.fresh(50)
            assert np.isfinite(y).all()
            return np.median(np.diff(t)) == pytest.approx(1.0 / rate, rel=0.2)

        rig.client.wait(sampled, f'rate of {rate} Hz')
    rig.client.wait(
        lambda: abs(rig.y[-1].message.data - AMPLITUDE / 6.0) < 1e-2, 'steady state d / 6'
    )
    rig.set(sample_rate=250.0)


def test_known_input_comes_from_its_topic(client, start):
    arguments = parameters(
        namespace='/driven',
        sample_rate=200.0,
        order=1,
        phi="['2.0*u - 4.0*z1']",
        disturbance='none',
    )
    process = start('plant', *arguments)
    rig = PlantRig(client, '/driven')
    u = client.publisher('/driven/u')
    client.wait(lambda: u.matched() >= 1 and len(rig.y) > 5, 'samples and subscription of u')

    def send(value: float, expected: float) -> None:
        def arrived() -> bool:
            u(value)
            return abs(rig.y[-1].message.data - expected) < 1e-3

        client.wait(arrived, f'y = {expected}')

    send(1.0, 0.5)
    send(-3.0, -1.5)
    u(float('nan'))
    client.wait(lambda: 'rejected u = nan' in process.output, 'complaint about u')
    _, y, _ = rig.fresh(20)
    np.testing.assert_allclose(y, -1.5, rtol=0.0, atol=1e-3)


def test_unstable_plant_says_so_once_and_publishes_nothing_more(client, start):
    process = start(
        'plant',
        *parameters(namespace='/unstable', sample_rate=500.0, order=1, phi="['2000.0*z1 + 1.0']"),
    )
    rig = PlantRig(client, '/unstable')
    client.wait(lambda: 'has left the finite numbers' in process.output, 'error')
    said = re.search(r'\[(\d+)\.(\d{9})\].*has left the finite numbers', process.output)
    error = int(said[1] + said[2])  # ns
    client.wait(lambda: time.time_ns() > error + 3e8, '150 periods')
    assert all(y.stamp <= error for y in rig.y)
    assert process.output.count('has left the finite numbers') == 1
    assert all(np.isfinite(sample.message.data) for sample in rig.y)
