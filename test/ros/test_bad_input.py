# SPDX-License-Identifier: Apache-2.0
"""What a user gets wrong: one line that says so, and nothing else happens."""

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
import signal
import subprocess

import pytest

rclpy = pytest.importorskip('rclpy', reason='rclpy is not installed: needs ROS 2 Jazzy')
pytestmark = pytest.mark.ros

from fhaosmo_ros.nodes import plant  # noqa: E402
from fhaosmo_ros.nodes.estimator import node as estimator  # noqa: E402
from rig import command, DEADLINE, parameters, ROOT  # noqa: E402

NODES = {'estimator': estimator, 'plant': plant}

FILES = {
    'unknown': '/**: {ros__parameters: {lamda: [15.0]}}',
    'unknown_too': '/**: {ros__parameters: {lamda: [16.0]}}',
    'lambda': '/**: {ros__parameters: {lambda: [15.0, 15.0]}}',
    'alpha': 'estimator: {ros__parameters: {alpha: [1.0, 2.0, 3.0, 4.0, 5.0]}}',
    'negative': '/**: {ros__parameters: {alpha: [30.0, -3.0, 30.0, 30.0]}}',
    'expression': "/**: {ros__parameters: {phi: ['0', '0', '__import__(1)']}}",
    'triangular': "/**: {ros__parameters: {phi: ['0', 'z3', '-z3']}}",
    'too_few': "/**: {ros__parameters: {phi: ['0', '-z2']}}",
    'broken': 'estimator: [b\n  c: d: e',
    'no_section': 'lambda: [15.0]',
    'empty': '',
    'mixed': '/**: {ros__parameters: {lambda: [15, 15.5, 16, 17]}}',
    'mixed_phi': '/**: {ros__parameters: {phi: [0, 0, -z3]}}',
    'empty_list': '/**: {ros__parameters: {lambda: []}}',
    'nothing': '/**: {ros__parameters: {max_gap: }}',
    'not_a_number': '/**: {ros__parameters: {epsilon: .nan}}',
    'gamma': '/**: {ros__parameters: {gamma_min: 0.9, gamma_max: 0.8}}',
    'integer': '/**: {ros__parameters: {order: 3.0}}',
    'constant': '/**: {ros__parameters: {constants: {m: }}}',
    'renamed': 'lead: {ros__parameters: {lambda: []}}',
}

# name: (node, arguments, words of the message)
CASES = {
    'unknown key': (
        'estimator',
        'unknown',
        ["unknown.yaml: unknown parameter 'lamda'", "mean 'lambda'?"],
    ),
    'length of lambda': (
        'estimator',
        'lambda',
        ["lambda.yaml: parameter 'lambda'", '1 or 4', '[15.0, 15.0]'],
    ),
    'length of alpha': ('estimator', 'alpha', ["'alpha'", '1 or 4', '5.0]']),
    'negative gain': (
        'estimator',
        'negative',
        ["negative.yaml: parameter 'alpha'", '> 0', '-3.0'],
    ),
    'command line over a file': (
        'estimator',
        ['--ros-args', '--params-file', 'negative', '-p', 'alpha:=[-4.0]'],
        ["error: parameter 'alpha'", '> 0', '[-4.0]'],
    ),
    'file over a file': (
        'estimator',
        ['--ros-args', '--params-file', 'unknown', '--params-file', 'unknown_too'],
        ["unknown_too.yaml: unknown parameter 'lamda'"],
    ),
    'forbidden expression': ('estimator', 'expression', ["'phi'", 'allowed', '__import__']),
    'forbidden in the plant': ('plant', 'expression', ["'phi'", 'allowed', '__import__']),
    'not triangular': ('estimator', 'triangular', ["'phi'", 'Phi_2', 'z3', 'z1..z2']),
    'number of expressions': ('plant', 'too_few', ["'phi'", '3 expressions', 'got 2']),
    'malformed file': ('estimator', 'broken', ['broken.yaml', 'expected YAML']),
    'no section': ('estimator', 'no_section', ['no_section.yaml', 'ros__parameters']),
    'empty file': ('estimator', 'empty', ['empty.yaml', 'ros__parameters']),
    'mixed list': ('estimator', 'mixed', ["'lambda'", 'one type', '[15, 15.5, 16, 17]']),
    'mixed expressions': ('estimator', 'mixed_phi', ["'phi'", 'one type', "[0, 0, '-z3']"]),
    'empty list': ('estimator', 'empty_list', ["'lambda'", 'list of numbers > 0', '[]']),
    'no value': ('estimator', 'nothing', ["'max_gap'", 'a number', 'None']),
    'constant without value': ('estimator', 'constant', ["'constants.m'", 'a number', 'None']),
    'nan in a file': ('estimator', 'not_a_number', ["'epsilon'", 'a number > 0', 'nan']),
    'bounds crossed': ('estimator', 'gamma', ['gamma_min', 'gamma_max', '0.9', '0.8']),
    'number for an integer': ('estimator', 'integer', ["'order'", 'an integer', '3.0']),
    'section of a renamed node': (
        'estimator',
        ['--ros-args', '-r', '__node:=lead', '--params-file', 'renamed'],
        ["'lambda'", '[]'],
    ),
    'missing file': (
        'plant',
        ['--ros-args', '--params-file', '/nowhere/demo.yaml'],
        ['/nowhere/demo.yaml', 'expected a readable file', 'No such file'],
    ),
    'folder for a file': ('plant', ['--ros-args', '--params-file', '/tmp'], ['/tmp', 'readable']),
    'unknown name': ('estimator', parameters(lamda=4), ["'lamda'", "mean 'lambda'?"]),
    "the plant's name": ('estimator', parameters(noise_std=0.1), ["'noise_std'"]),
    'bad value': ('estimator', parameters(max_gap='soon'), ["'max_gap'", 'a number', "'soon'"]),
    'bad choice': ('estimator', parameters(variant='fuzy'), ['fuzzy_adaptive', "'fuzy'", 'mean']),
    'empty list as argument': ('estimator', parameters(lambda_='[]'), ["'lambda'", '[]']),
    'mixed list as argument': (
        'estimator',
        parameters(lambda_='[15, 15.5, 16, 17]'),
        ["'lambda'", 'one type', '15.5'],
    ),
    'no topic': ('estimator', parameters(input_topic='/a b'), ["'input_topic'", "'/a b'"]),
    'no type': (
        'estimator',
        parameters(input_topic='/a', input_type='sensor_msgs/JoinState'),
        ["'input_type'", "mean 'sensor_msgs/msg/JointState'?"],
    ),
    'half a rule': ('estimator', ['--ros-args', '-p', 'epsilon'], ["'-p epsilon'"]),
    'no rule': ('estimator', ['--ros-args', '-p'], ['-p']),
    'unexpected argument': ('plant', ['fast'], ["'fast'", 'usage: plant']),
    'unexpected option': ('plant', ['--fast'], ["'--fast'", 'usage: plant']),
    'forgotten --ros-args': ('plant', ['-p', 'order:=3'], ["'-p'", '--ros-args']),
    'unknown ROS option': ('plant', ['--ros-args', '--fast'], ['--fast']),
    'order': ('plant', parameters(order=0), ["'order'", '>= 1', 'got 0']),
    'u in an unknown name': ('plant', parameters(phi="['v','0','0']"), ["'phi'", 'v', 'u']),
}


IN_PROCESSES = {
    'unknown key',
    'length of lambda',
    'negative gain',
    'forbidden in the plant',
    'malformed file',
    'mixed list',
    'missing file',
    'unknown name',
    'bad value',
    'unexpected argument',
    'empty list as argument',
}
"""A process takes a second: the other cases call the same function in this one."""


@pytest.fixture(scope='module')
def files(tmp_path_factory):
    folder = tmp_path_factory.mktemp('files')
    for name, text in FILES.items():
        (folder / f'{name}.yaml').write_text(text + '\n')
    return folder


def _arguments(case: str, files: Path) -> list[str]:
    _, arguments, _ = CASES[case]
    if isinstance(arguments, str):
        arguments = ['--ros-args', '--params-file', arguments]
    return [str(files / f'{a}.yaml') if a in FILES else a for a in arguments]


@pytest.fixture(scope='module')
def ended(files):
    """Processes that have ended, run two at a time."""

    def run(case: str) -> subprocess.CompletedProcess:
        return subprocess.run(
            command(CASES[case][0], *_arguments(case, files)),
            cwd=ROOT, capture_output=True, text=True, timeout=DEADLINE,
        )  # fmt: skip

    with ThreadPoolExecutor(2) as pool:
        cases = sorted(IN_PROCESSES)
        return dict(zip(cases, pool.map(run, cases), strict=True))


@pytest.mark.parametrize('case', sorted(IN_PROCESSES))
def test_process_ends_with_one_line_that_says_what_is_wrong(ended, case):
    done = ended[case]
    _check(case, done.returncode, done.stdout, done.stderr)


@pytest.mark.parametrize('case', sorted(set(CASES) - IN_PROCESSES))
def test_one_line_says_what_is_wrong(files, case, capfd):
    handlers = {n: signal.getsignal(n) for n in (signal.SIGINT, signal.SIGTERM)}
    try:
        code = NODES[CASES[case][0]].main(_arguments(case, files))
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
    _check(case, code, *capfd.readouterr())


def _check(case: str, code: int, out: str, err: str) -> None:
    node, _, words = CASES[case]
    assert code == 2
    assert out == ''
    (line,) = err.splitlines()
    assert line.startswith(f'{node}: error: ')
    for word in words:
        assert word in line
    for noise in ('Traceback', '.c:', 'Error(', '/project/'):
        assert noise not in line
