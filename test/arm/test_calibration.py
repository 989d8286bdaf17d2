# SPDX-License-Identifier: Apache-2.0
"""What a recording of free motion says of an arm, and the file and commands around it."""

import numpy as np
import pytest

pytest.importorskip('pinocchio')

import bag_files as files
from fhaosmo_ros.core.arm.identification import identify, noise_of, payload_of_motion
from fhaosmo_ros.core.arm.model import ArmModel, Calibration
from fhaosmo_ros.core.parameters.errors import ConfigurationError
from fhaosmo_ros.tools.arm import calibrate, replay
from fhaosmo_ros.topics import TEXT
from robots import JOINTS, motion, URDF

PERIOD = 0.004
OFFSET = np.array([0.5, -0.3, 0.2])


def recorded(seed=1, duration=40.0, noise=0.05, payload=(0.0, 0.0, 0.0, 0.0), resting=()):
    """Return a free motion of an arm heavier than its URDF, with friction, an offset and noise."""
    model = ArmModel(URDF)
    model.set_inertial(model.inertial * np.array([1.1, 1.2, 0.8])[:, np.newaxis])
    model.set_payload(payload)
    t, q, v, torque = motion(model, np.arange(0.0, duration, PERIOD), seed, resting)
    rubbing = np.array([1.0, 3.0, 2.0]) * np.tanh(v / 0.05) + np.array([0.2, 0.5, 0.3]) * v
    random = np.random.default_rng(seed)
    q = q + 1e-5 * random.standard_normal(q.shape)
    return t, q, torque + rubbing + OFFSET + noise * random.standard_normal(q.shape)


@pytest.fixture(scope='module')
def found():
    """Return what is found with a pause, and a clock that is set forward."""
    t, q, torque = recorded()
    kept = (t < 13.0) | (t > 20.0)
    return identify(ArmModel(URDF), (t + 1.7e9 * (t > 30.0))[kept], q[kept], torque[kept])


def test_what_the_urdf_leaves_is_explained_also_in_another_motion_and_a_payload_is_found(found):
    assert np.all(found.after < 0.05 * found.before)
    assert not found.notes
    np.testing.assert_allclose(found.calibration.torque_noise, 0.05, rtol=0.1)
    np.testing.assert_allclose(found.calibration.position_noise, 1e-5, rtol=0.1)
    rounded = np.round(np.sin(1e-3 * np.arange(10_000))[:, np.newaxis], 4)
    assert 0.5 < noise_of(rounded)[0] / (1e-4 / np.sqrt(12.0)) < 2.0
    model, carried = ArmModel(URDF), [1.5, 0.02, 0.0, 0.35]
    other = recorded(seed=7, duration=20.0, payload=carried)
    _, by_urdf, _ = payload_of_motion(model, *other, Calibration.of_urdf(model))
    payload, before, after = payload_of_motion(model, *other, found.calibration)
    np.testing.assert_allclose(payload, carried, atol=0.03)
    assert np.all(after <= before)
    assert np.all(after < 0.1 * by_urdf)
    other = recorded(seed=3, duration=12.0)
    payload, before, after = payload_of_motion(model, *other, found.calibration)
    assert payload[0] < 0.01
    assert np.all(after < 1.1 * before)
    with pytest.raises(ConfigurationError, match='at least 10 s of samples'):
        payload_of_motion(model, *(array[:1000] for array in other), found.calibration)


def test_links_that_cannot_exist_are_not_found():
    pseudo_inertia = pytest.importorskip('pinocchio').PseudoInertia.FromDynamicParameters
    model = ArmModel(URDF)
    model.set_payload([0.5, 0.0, 0.0, 0.4])
    # So much noise that plain fits leave physics.
    t, q, torque = recorded(duration=12.0, noise=3.0)
    inertial = identify(model, t, q, torque - 5.0 * np.gradient(q, t, axis=0)).calibration.inertial
    model.set_inertial(inertial)  # without payload, and without what rotors add
    assert all(np.linalg.eigvalsh(pseudo_inertia(link).toMatrix())[0] > 0.0 for link in inertial)


def test_joints_that_do_not_move_enough_are_named_and_one_that_rests_keeps_its_urdf():
    t, q, torque = recorded(duration=20.0, resting=[2])
    q[:, 0] = 0.3 * t
    model = ArmModel(URDF)
    found = identify(model, t, q, torque)
    one_way, rests = found.notes
    assert one_way == 'turn moved one way only: its friction cannot be told from its offset'
    assert rests.startswith('elbow hardly moved')
    assert found.calibration.inertial[2, 0] == pytest.approx(model.inertial[2, 0], rel=0.2)


def test_torque_constants_are_found_by_gravity_or_taken_from_other_joints():
    t, q, torque = recorded(noise=0.02)
    q[:, 0], torque[:, 0] = 0.2, 0.02 * np.random.default_rng(2).standard_normal(len(t))
    constants = np.array([9.0, 12.0, 9.0])
    found = identify(ArmModel(URDF), t, q, torque / constants, torque_constants=0.0)
    # The URDF is 20 % wrong, and so is what is found by it.
    of_gravity = found.calibration.torque_constants[1:]
    np.testing.assert_allclose(of_gravity, constants[1:], rtol=0.3)
    assert found.calibration.torque_constants[0] == pytest.approx(of_gravity.mean())
    assert [note.split()[0] for note in found.notes] == ['turn:', 'turn']
    known = identify(ArmModel(URDF), t, q, torque / constants, torque_constants=constants)
    np.testing.assert_array_equal(known.calibration.torque_constants, constants)
    with pytest.raises(ConfigurationError, match='torque_constants: expected them'):
        identify(ArmModel(URDF), t, q, 0.0 * q, torque_constants=0.0)


def test_the_file_gives_back_what_was_written_and_others_are_refused(found):
    text = found.calibration.dumps()
    assert Calibration.loads(text).dumps() == text
    for old, new, expected in (
        ('offset:', 'ofset:', 'ofset'),
        ('  - elbow\n', '', 'numbers of shape'),
        (f'- {found.calibration.offset[0].item()}', '- .nan', 'offset: expected finite numbers'),
    ):
        assert old in text
        with pytest.raises(ConfigurationError, match=expected):
            Calibration.loads(text.replace(old, new, 1))
    for text in ('', '[1, 2', 'a: b', 'arm_calibration: 3'):
        with pytest.raises(ConfigurationError, match='expected a file of `calibrate`'):
            Calibration.loads(text)


def test_commands_calibrate_find_a_payload_and_replay_a_bag(tmp_path, capsys):
    messages = [('/robot_description', TEXT, 1, files.serialise(TEXT, data=URDF))]
    times, positions, torques = recorded(duration=15.0)
    for t, q, torque in zip(times, positions, np.roll(torques, 5, axis=0), strict=True):
        stamp, set_back = 10**12 + round(t * 1e9), 10**11 * (t > 8.0)
        data = files.joint_state(stamp - set_back, q, JOINTS, torque)
        messages.append(('/joint_states', files.JOINTS, stamp, data))
    bag = files.write(tmp_path / 'free', messages)
    file, table, late = tmp_path / 'three.yaml', tmp_path / 'torque.csv', 'torque_delay:=0.02'
    assert calibrate.main(['--bag', str(bag), '-o', str(file), '-p', late]) == 0
    held_out = capsys.readouterr().out
    wrong = ['-p', 'torque_constants:=[-1.0]']
    assert calibrate.main(['--bag', str(bag), '-o', str(file), *wrong]) == 2
    assert 'by the URDF alone, the efforts of all joints' in capsys.readouterr().err
    assert replay.main([str(bag), '-o', str(tmp_path / 'wrong.csv'), *wrong]) == 0
    assert 'the efforts of all joints have the wrong sign' in capsys.readouterr().out
    known = ['-p', f'calibration_file:={file}', '-p', late]
    assert calibrate.main(['--bag', str(bag), '--payload', *known]) == 0
    left = [
        [float(line.split()[column]) for line in said.splitlines() if line.startswith(JOINTS)]
        for said, column in ((held_out, 2), (capsys.readouterr().out, 1))
    ]
    np.testing.assert_allclose(*left, rtol=0.2)
    assert (tmp_path / 'three.png').stat().st_size > 10_000
    assert replay.main([str(bag), '-o', str(table), *known]) == 0
    rows = np.genfromtxt(table, delimiter=',', skip_header=1, usecols=range(7))
    assert np.abs(rows[500:, 1:4]).mean() < 0.012  # also where friction turns round
    assert Calibration.loads(file.read_text()).log_odds >= calibrate.LEAST
