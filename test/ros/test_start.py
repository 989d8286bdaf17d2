# SPDX-License-Identifier: Apache-2.0
"""How a node starts: with what files and arguments say, or not at all, with one line why."""

import gc
from pathlib import Path
import signal
from threading import Timer

from fhaosmo_ros.__main__ import main
from fhaosmo_ros.core.parameters.tables import ESTIMATOR_PARAMETERS
import pytest
from running import DEADLINE, Estimator, Parameters
from yaml_texts import HOSTILE


def set_in_file(text: str) -> list[str]:
    return ['--ros-args', '--params-file', f'/**: {{ros__parameters: {{{text}}}}}\n']


def rules(*words: str) -> list[str]:
    return ['--ros-args', *(part for word in words for part in ('-p', word))]


# Node, arguments, words of the message; an argument with an end of line is put in a file. What is
# said of files and values as such: test_parameters.py.
E, P = 'estimator', 'plant'
OF_U = "phi:=['0', '0', 'u']"
OF_PLANT = 'plant: {ros__parameters: {order: 2}}\n'
REFUSED = [
    # Files.
    (E, [*set_in_file('lamda: [1]'), *set_in_file('lamda: [2]')],
     ["5.yaml: unknown parameter 'lamda'", "mean 'lambda'?"]),
    (E, [*set_in_file('lambda: [-3.0]'), '-p', 'lambda:=[-4.0]'], ["parameter 'lambda'", '-4.0']),
    (P, ['--ros-args', '-r', '__node:=plans', '--params-file', OF_PLANT],
     ["expected a section '/plans' or '/**', got plant"]),
    (P, ['--ros-args', '--params-file', '/nowhere/demo.yaml'],
     ['/nowhere/demo.yaml', 'expected a readable file', 'No such file']),
    ('arm', rules('robot_description_file:=/none.urdf'), ["'robot_description_file': expected"]),
    # Arguments.
    (E, rules(f'lambda:={HOSTILE["50000 brackets"]}'), ["'lambda'"]),
    (E, rules('estimator:noise:=0.1'), ["'noise'"]),
    (E, rules('epsilon'), ["-p: expected NAME:=VALUE, got 'epsilon'"]),
    (P, rules('use_sim_time:=1'), ["'use_sim_time': expected true or false, got 1"]),
    (P, ['fast'], ["'fast'", 'usage: plant']),
    (P, ['-p', 'order:=3'], ["'-p'", '--ros-args']),
    # Topics and messages.
    (E, rules('input_topic:=/a b'), ["'input_topic'", "'/a b'"]),
    (E, rules('input_topic:=/a', 'input_type:=sensor_msgs/JoinState'),
     ["'input_type'", 'written as in std_msgs/msg/Float64', 'sensor_msgs/JoinState']),
    (E, rules('input_type:=nobody/msg/No'),
     ["'input_type'", 'is installed here', 'nobody/msg/No']),
    (E, rules('input_type:=sensor_msgs/msg/Imu', 'input_field:=angular_velocty.z'),
     ["field 'angular_velocty.z'", 'sensor_msgs/msg/Imu', "mean 'angular_velocity.z'"]),
    (E, rules('input_type:=std_msgs/msg/Float64', 'input_stamp:=header'),
     ["'input_stamp'", 'messages with a header', 'std_msgs/msg/Float64']),
    # Of known inputs, and of a node that waits to be configured, too.
    (E, rules(OF_U, 'known_input_topics:=[/a b]'), ["'known_input_topics'", "'/a b'"]),
    (E, rules(OF_U, 'known_input_types:=[nobody/msg/No]', 'autostart:=false'),
     ["'known_input_types'", 'is installed here', 'nobody/msg/No']),
    (E, rules(OF_U, 'known_input_types:=[sensor_msgs/msg/Imu]', 'autostart:=false'),
     ['a field (input_field) is needed for sensor_msgs/msg/Imu']),
    # Channels.
    (E, rules('channels:=[a, b]', 'typed_outputs:=[wrench]'), ["'output_axis'", 'linear.x']),
    (E, rules('channels:=[hip]', 'hip.order:=2'),
     ["channel 'hip': parameter 'phi': expected 2 expressions"]),
    (E, rules('channels:=from_joint_names', 'hip.order:=2'), ["channel 'hip': parameter 'phi'"]),
    (E, rules('channels:=from_joint_names', 'input_type:=x'), ["'input_type'", 'JointState for']),
    (E, rules(f'channels:=[{"a" * 230}]'), ['the name of a topic', 'length', '/standard_dev']),
    # QoS.
    (E, rules('qos_overrides./estimator/state.publisher.reliability:=sometimes'),
     ["/estimator/state.publisher.reliability': expected one of reliable, best", 'sometimes']),
    *((E, rules(f'qos_overrides./y.subscription.depth:={depth}'), ['expected an integer >= 1'])
      for depth in ('-5', '0', 'five', 'true', '2.5', '4000000000', '[5]')),
    (P, rules('qos_overrides./y.publisher.durability:=1'), ['one of volatile', 'got 1']),
    (P, rules('qos_overrides./y.publisher.dept:=5'), ["y.publisher.dept'", "mean 'depth'"]),
]  # fmt: skip


def in_files(words: list[str], folder: Path) -> list[str]:
    """Put arguments that end with a line in files, and return them with the files' names."""
    result = []
    for k, word in enumerate(words):
        if word.endswith('\n'):
            path = folder / f'{k}.yaml'
            path.write_text(word)
            word = str(path)
        result.append(word)
    return result


@pytest.mark.filterwarnings('ignore::DeprecationWarning')  # of what the arm imports
@pytest.mark.parametrize(('node', 'words', 'expected'), REFUSED)
def test_one_line_says_what_is_wrong(node, words, expected, tmp_path, capfd):
    if node == 'arm':
        pytest.importorskip('pinocchio')
    # In this process; it is not to run.
    watch = Timer(DEADLINE, signal.raise_signal, [signal.SIGTERM])
    watch.start()
    try:
        assert main([node, *in_files(words, tmp_path)]) == 2
    finally:
        watch.cancel()
        gc.collect()  # the node itself: two of one name in a process make rcl warn
    out, err = capfd.readouterr()
    # rcl's own, where two nodes of a name are in one process
    (line,) = [x for x in err.splitlines() if 'Publisher already registered' not in x]
    assert out == ''
    assert line.startswith(f'{node}: error: ')
    assert line.isprintable()
    assert len(line) < 600
    assert not [noise for noise in ('Traceback', '.c:', 'Error(') if noise in line]
    for word in expected:
        assert word in line


def test_files_and_rules_reach_the_node_for_which_they_are(user, launch, tmp_path):
    """One that is renamed, in a namespace, with a file of another node, and lists over values."""
    text = (
        "/**: {ros__parameters: {order: 2, phi: ['0', '-z2'], lambda: 12, max_gap: 2e0, "
        'noise_std: 0.1, qos_overrides: {/rig/y: {subscription: {depth: 7}}}}}\n'
        'estimator: {ros__parameters: {epsilon: 0.9}}\n'
        '/rig/lead: {ros__parameters: {alpha: [7], spike_gate: 0.5}}\n'
    )
    files = in_files(['--params-file', text, '--params-file', OF_PLANT], tmp_path)
    own = ['lambda:=[12.0, 13.0, 14.0]', 'gamma_min:=0.07', 'plant:noise:=0.1']
    own.append('qos_overrides./rig/y.subscription.reliability:=reliable')
    process = launch('estimator', '-r', '__node:=lead', '-r', '__ns:=/rig', *files, *rules(*own))
    parameters = Parameters(user, '/rig/lead')
    expected = {
        'order': 2, 'phi': ['0', '-z2'], 'lambda': [12.0, 13.0, 14.0], 'max_gap': 2.0,
        'alpha': [7.0], 'spike_gate': 0.5, 'gamma_min': 0.07,
        'qos_overrides./rig/y.subscription.depth': 7,
        'qos_overrides./rig/y.subscription.reliability': 'reliable',
        'epsilon': ESTIMATOR_PARAMETERS['epsilon'].default,
    }  # fmt: skip
    assert parameters.all(expected) == expected
    assert 'noise_std' not in parameters.ask('list_parameters').result.names
    (line,) = [x for x in process.output().splitlines() if '[WARN]' in x]
    assert line.endswith(f'{files[3]}: sets nothing for node /rig/lead')


WITHOUT_EVENTS = """
import sys
sys.modules['rclpy.experimental'] = None  # an older rclpy
from fhaosmo_ros.__main__ import main
sys.exit(main(sys.argv[1:]))
"""


def test_without_the_events_executor_it_works_too(user, launch):
    process = launch(WITHOUT_EVENTS, namespace='/older', reliable=['y'], max_gap=60.0)
    rig = Estimator(user, process, '/older').listen()
    for y in (0.2, 0.21, 0.22):
        estimate = rig.feed(y)
    assert abs(estimate.z[0] - 0.22) < 0.1
