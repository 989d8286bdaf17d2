# SPDX-License-Identifier: Apache-2.0
"""What is wrong in a call of a command is said in one line, and nothing is left behind."""

import shlex

import bag_files as files
from fhaosmo_ros.__main__ import main
from fhaosmo_ros.tools.cli.command import shipped
import pytest
from robots import URDF

TUNE = (
    'tune -o out -pscheme:=explicit -pduration:=4.0 -pintegration_step:=1e-3 -psample_rate:=200.0 '
    '-precordings:=1 -pheld_out:=1 -psettled:=1.0 '
)
TABLE = "replay -p order:=2 -p phi:=['0','torque'] -p inputs:=[torque] "
WRONG = {
    # Bags.
    'replay /no/bag': ['/no/bag', 'does not exist'],
    'replay old.bag': ['ROS 1', '`rosbags-convert`', 'got another file'],
    'replay spoilt': ['whole bag', 'mcap recover'],
    'replay nameless': ['metadata.yaml', '`ros2 bag reindex`'],
    'replay empty': ["expected messages on topic '/y', got none"],
    'replay joints -p input_field:=position[3]': ['position[3]', 'a longer list, got one of 3'],
    'replay sqlite -p input_stamp:=source': ['input_stamp source: expected an mcap bag'],
    'replay bag --columns t,y': ['--columns: expected a .csv file, got'],
    # Tables.
    f'{TABLE} text.csv': ['text.csv: expected lines of numbers: could not convert str'],
    f'{TABLE} none.csv': ['none.csv: expected lines of numbers, got none'],
    f'{TABLE} late.csv --columns t,u': ['t, angle, u: of the time, y, torque, got t, u'],
    f'{TABLE} late.csv --columns t,anlge,u': ['t, angle, u: of', 'got t, anlge, u'],
    f'{TABLE} late.csv': ['late.csv: expected times of 0 to 9.2e+09 s, got nan in sample 0'],
    'replay nan.csv': ["'/y': expected samples that can be used, got rejected_measurements 2"],
    # Parameters.
    'replay bag -p input_topic:=/yy': ["'/yy'", '(/y)', "did you mean '/y'?"],
    'replay bag -p input_field:=date': ["'date'", "did you mean 'data'?"],
    'replay bag -p input_stamp:=header': ['input_stamp header', files.FLOAT],
    'replay bag -o bag/bag.mcap --force': ['output bag/bag.mcap: expected another place than the'],
    'replay bag -p order=3': ['NAME:=VALUE', "'order=3'"],
    'replay bag --smooth': ["expected 'noise_size' > 0"],
    "replay bag --name 'a b'": ["--name: expected a name such as /tuned, got 'a b'"],
    'replay bag --params-file lamda.yaml': ['error: lamda.yaml: ', "'lamda'", "mean 'lambda'"],
    'replay bag --params-file node.yaml': ["'estimator' or '/**'", 'got estimater'],
    # plot
    'plot both --plant no': ['--plant: expected a bag with /no/state, /no/unknown_input'],
    'plot both -o x.jpg': ['.png, .svg, .pdf', 'x.jpg'],
    'plot both --names no': ['of /no, got those of /estimator'],
    'plot bag': ['of an estimator, got those of none', 'replay'],
    # arm
    'calibrate --bag joints --payload': ['calibration_file:=FILE'],
    'calibrate --bag joints': ['one robot on /robot_description', '--robot URDF'],
    'calibrate --bag joints --robot joints/joints.mcap': ['--robot: expected a URDF'],
    'calibrate --bag joints --robot three.urdf': ['messages on /joint_states, got none'],
    'calibrate --bag joints --robot three.urdf --topic /y': ['joint states of turn', 'lacks'],
    # play, record, demo
    'play bag --topics /x': ["'/x'", '/y'],
    'play bag --topics /clock': ['expected a message to play'],
    "record -o out --topics 'a b'": ['--topics', "'a b'"],
    'record -o out --topics /nobody --duration 0.5': ['nothing was published'],
    'record -o bag': ['one that exists'],
    'record -o out --ros-args -p use_sim_time:=1': ["'use_sim_time' to '1'"],
    'demo --output out --duration 0': ['--duration', '1 to 3600', '0'],
    'demo --output out --params-file phi.yaml': ["'phi': expected 3 expressions"],
    'demo --output bag': ['bag', '--force'],
    # tune
    f'{TUNE} -pnoise:=1': ["unknown parameter 'noise'"],
    f'{TUNE} -pweights:=[1.0,2.0]': ['weights', '1 or 4 numbers'],
    f'{TUNE} -pband_of_d:=[3.0,1.0]': ['band_of_d', 'lower one first'],
    f'{TUNE} -pphi:=[0,0,z3**3] -prms_of_d:=100.0': ['expected states that stay finite'],
    f'{TUNE} -psettled:=4.0': ['more than 4 s'],
    f'{TUNE} --trials=0': ['--trials >= 1'],
    f'{TUNE} --jobs=0': ['--jobs >= 1'],
    f'{TUNE} --storage nodb://x': ['storage'],
    f'{TUNE} -o /proc/no/out': ['No such file or directory: /proc/no'],
    f'{TUNE} -o bag': ['expected a new name (or --force'],
    'tune --bag bag -o out -p structure:=cascade': ['got structure set'],
}
"""Words of the line, by the call."""


@pytest.fixture(scope='module')
def place(tmp_path_factory):
    """Return a folder with whole bags and broken ones, and wrong parameter files."""
    place = tmp_path_factory.mktemp('place')
    rows = files.floats(*files.signal(1000))
    for name in ('bag', 'spoilt', 'nameless'):
        files.write(place / name, rows)
    assert main(['replay', str(place / 'bag'), '-o', str(place / 'both')]) == 0
    data = (place / 'spoilt' / 'spoilt.mcap').read_bytes()
    data = data[:5000] + b'\xff' * 60 + data[5060:]  # longer than a record
    (place / 'spoilt' / 'spoilt.mcap').write_bytes(data)
    (place / 'nameless' / 'metadata.yaml').unlink()
    files.write(place / 'sqlite', rows, 'sqlite3')
    (place / 'old.bag').write_bytes(b'#ROSBAG V2.0')
    with files.Writer(place / 'empty', version=9) as writer:
        writer.add_connection('/y', files.FLOAT, typestore=files.TYPES)
        x = writer.add_connection('/x', files.FLOAT, typestore=files.TYPES)
        writer.write(x, 5, files.float64(1.0))
    files.write(place / 'joints', [('/y', files.JOINTS, 5, files.joint_state(5, [1.0, 2.0, 3.0]))])
    (place / 'three.urdf').write_text(URDF)
    (place / 'text.csv').write_bytes(b't,y,u\n0,1,2\n0.001,\xff,3\n')
    (place / 'late.csv').write_text('t,angle,u\nnan,1,2\n')
    (place / 'none.csv').touch()
    (place / 'nan.csv').write_text('t,y\n0,\n1,\n')
    (place / 'lamda.yaml').write_text('estimator: {ros__parameters: {lamda: 1.0}}')
    (place / 'node.yaml').write_text('estimater: {ros__parameters: {}}')
    text = shipped('config/demo.yaml').read_text()
    (place / 'phi.yaml').write_text(text.replace("phi: ['0', ", 'phi: ['))
    return place


@pytest.mark.parametrize('call', WRONG)
def test_wrong_input_is_said_in_one_line_and_leaves_nothing(call, place, capfd, monkeypatch):
    command, *arguments = shlex.split(call)
    if command in ('demo', 'play', 'record'):
        pytest.importorskip('rclpy', reason='no ROS 2 in this Python')
    elif command == 'calibrate':
        pytest.importorskip('pinocchio', reason='pinocchio is not installed (extra: arm)')
    elif '--storage' in arguments:
        pytest.importorskip('optuna', reason='optuna is not installed (extra: tune)')
    monkeypatch.chdir(place)
    before = sorted(place.rglob('*'))
    assert main([command, *arguments]) == 2
    error = capfd.readouterr().err
    lines = [line for line in error.splitlines() if line.startswith(f'{command}: error: ')]
    assert len(lines) == 1, error
    assert 'Traceback' not in error
    assert [word for word in WRONG[call] if word not in lines[0]] == [], lines
    assert sorted(place.rglob('*')) == before
