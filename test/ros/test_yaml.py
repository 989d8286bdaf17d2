# SPDX-License-Identifier: Apache-2.0
"""Parameter files: which sections serve which node, and that rcl reads them as we do."""

from pathlib import Path

from fhaosmo_ros.core.parameters.errors import ConfigurationError
from fhaosmo_ros.core.parameters.files import load, read
from fhaosmo_ros.core.parameters.tables import ESTIMATOR_PARAMETERS
import pytest
from yaml_texts import HOSTILE

CONFIGURATIONS = sorted((Path(__file__).resolve().parents[2] / 'config').glob('**/*.yaml'))


@pytest.fixture
def write(tmp_path):
    def write(text: str) -> str:
        path = tmp_path / 'file.yaml'
        path.write_text(text, encoding='utf-8')
        return str(path)

    return write


@pytest.mark.parametrize(
    ('section', 'node', 'matches'),
    [
        ('estimator', 'estimator', True),
        ('/estimator', 'estimator', True),
        ('/**', 'estimator', True),
        ('/**', '/rig/arm/estimator', True),
        ('/*', 'estimator', True),
        ('/*', '/rig/estimator', False),
        ('/rig/estimator', '/rig/estimator', True),
        ('/rig/*', '/rig/estimator', True),
        ('/rig/**', '/rig/arm/estimator', True),
        ('/**/estimator', '/rig/arm/estimator', True),
        ('/*/estimator', '/rig/arm/estimator', False),
        ('estimator', '/rig/estimator', False),
        ('/rig/estimator', 'estimator', False),
        ('plant', 'estimator', False),
        ('estimator2', 'estimator', False),
    ],
)
def test_sections(write, section, node, matches):
    path = write(f"'{section}': {{ros__parameters: {{epsilon: 0.3}}}}")
    assert load(path, node) == ({'epsilon': 0.3} if matches else {})


@pytest.mark.parametrize(
    ('section', 'node'),
    [
        ('estimater', 'estimator'),
        ('/Estimator', 'estimator'),
        ('estimators', '/rig/estimator'),
        ('/rig/estimatr', '/rig/estimator'),
        ('plan', 'plant'),
    ],
)
def test_misspelt_section_is_refused(write, section, node):
    path = write(f"'{section}': {{ros__parameters: {{epsilon: 0.3}}}}")
    with pytest.raises(ConfigurationError) as error:
        load(path, node)
    problem = f"no section is that of node '{node}', got '{section.lstrip('/')}'"
    assert str(error.value) == f"{path}: {problem}; did you mean '{node}'?"


def test_nested_namespaces(write):
    path = write('rig: {arm: {estimator: {ros__parameters: {epsilon: 0.3}}}}')
    assert load(path, '/rig/arm/estimator') == {'epsilon': 0.3}


def test_later_sections_win(write):
    path = write(
        'estimator: {ros__parameters: {epsilon: 0.3, max_gap: 2}}\n'
        '/**: {ros__parameters: {epsilon: 0.4}}\n'
    )
    assert load(path, 'estimator') == {'epsilon': 0.4, 'max_gap': 2.0}


def test_one_section_serves_both_nodes(write):
    path = write(
        '/**: {ros__parameters: {order: 2, epsilon: 0.3, noise_std: 0.1, use_sim_time: true, '
        'qos_overrides: {/y: {publisher: {depth: 5}}}}}'
    )
    assert load(path, 'estimator') == {'order': 2, 'epsilon': 0.3}
    assert load(path, 'plant') == {'order': 2, 'noise_std': 0.1}


@pytest.mark.parametrize(
    ('text', 'value'),
    [('1e-1', 0.1), ('1E2', 100.0), ('.5e0', 0.5), ('1.5e1', 15.0), ('4', 4.0), ('+3', 3.0)],
)
def test_numbers_are_read_as_rcl_reads_them(write, text, value):
    assert load(write(f'/**: {{ros__parameters: {{max_gap: {text}}}}}'), 'estimator') == {
        'max_gap': value
    }


def test_unknown_key_names_file_and_the_closest_name(write):
    path = write('/**: {ros__parameters: {noise_sd: 0.1}}')
    for node in ('estimator', 'plant'):
        with pytest.raises(ConfigurationError) as error:
            load(path, node)
        assert str(error.value) == (
            f"{path}: unknown parameter 'noise_sd'; did you mean 'noise_std'?"
        )


def test_nested_key_is_a_dotted_name(write):
    path = write('estimator: {ros__parameters: {gamma: {min: 0.1}}}')
    with pytest.raises(ConfigurationError, match=r"unknown parameter 'gamma.min'"):
        load(path, 'estimator')


def test_far_off_name_lists_what_is_known_in_order(write):
    path = write('/**: {ros__parameters: {qqq: 1}}')
    with pytest.raises(ConfigurationError) as error:
        load(path, 'estimator')
    names = str(error.value).partition('; known are ')[2].split(', ')
    assert names[: len(ESTIMATOR_PARAMETERS)] == list(ESTIMATOR_PARAMETERS)


@pytest.mark.parametrize(
    'text',
    [
        '- a\n- b',
        'estimator: 3',
        'estimator: {ros__parameters: 3}',
        'estimator: {ros_parameters: {epsilon: 0.3}}',
        'a: 1\n---\nb: 2',
        '\ttab: 1',
        'a: !!python/object/apply:os.system [true]',
    ],
)
def test_bad_structure_is_one_line_with_the_file(write, text):
    path = write(text)
    with pytest.raises(ConfigurationError) as error:
        load(path, 'estimator')
    assert str(error.value).startswith(f'{path}: ')
    assert '\n' not in str(error.value)


def test_file_that_is_not_text(tmp_path):
    path = tmp_path / 'binary.yaml'
    path.write_bytes(b'\xff\xfe\x00\x80')
    with pytest.raises(ConfigurationError, match='expected YAML'):
        load(path, 'estimator')


# The nodes.

rclpy = pytest.importorskip('rclpy', reason='rclpy is not installed: needs ROS 2 Jazzy')
pytestmark = pytest.mark.ros

from rig import node_process, Parameters, parameters  # noqa: E402


def test_a_file_reaches_a_renamed_node_in_a_namespace(client, folder, write):
    path = write(
        '/**:\n'
        '  ros__parameters:\n'
        '    order: 2\n'
        "    phi: ['0', '-z2']\n"
        '    lambda: [12, 13, 14]\n'
        '    max_gap: 2e0\n'
        '    noise_std: 0.1\n'
        'estimator:\n'
        '  ros__parameters:\n'
        '    epsilon: 0.9\n'
        '/rig/lead:\n'
        '  ros__parameters:\n'
        '    alpha: 7\n'
    )
    rename = ['-r', '__node:=lead', '-r', '__ns:=/rig', '--params-file', path]
    arguments = [*parameters(), *rename, '-p', 'gamma_max:=0.75']
    with node_process(folder(), 'estimator', *arguments):
        p = Parameters(client, '/rig/lead')
        expected = {
            'order': 2,
            'phi': ['0', '-z2'],
            'lambda': [12.0, 13.0, 14.0],
            'max_gap': 2.0,
            'alpha': [7.0],
            'gamma_max': 0.75,
            'epsilon': ESTIMATOR_PARAMETERS['epsilon'].default,
        }
        assert {name: p.get(name) for name in expected} == expected
        assert 'noise_std' not in p.names()


@pytest.mark.parametrize('text', HOSTILE.values(), ids=HOSTILE.keys())
def test_hostile_text_at_the_start_gives_no_more_than_a_line(write, text):
    """`run_node` shows both kinds of errors in one line; a RuntimeError is rcl's own."""
    spin = pytest.importorskip('fhaosmo_ros.nodes.middleware.spin')
    section = f'/**: {{ros__parameters: {{lambda: {text}}}}}'
    for kind, content in (('-p', f'lambda:={text}'), ('file', text), ('file', section)):
        arguments = ['-p', content] if kind == '-p' else ['--params-file', write(content)]
        message = ''
        try:
            spin._check_arguments('estimator', ['--ros-args', *arguments])
        except (ConfigurationError, RuntimeError) as error:
            message = spin._one_line(error)
        assert message.isprintable()
        assert len(message) < 600


@pytest.mark.parametrize('path', CONFIGURATIONS, ids=lambda p: p.stem)
def test_rcl_reads_shipped_files_as_we_do(path):
    """A bare y, for instance, is true for rcl."""
    context = rclpy.Context()
    rclpy.init(args=['--ros-args', '--params-file', str(path)], context=context)
    try:
        node = rclpy.create_node(
            'estimator', context=context, automatically_declare_parameters_from_overrides=True
        )
        for name, value in read(path, 'estimator').items():
            found = node.get_parameter(name).value
            assert (list(found) if isinstance(value, list) else found) == value, name
        node.destroy_node()
    finally:
        rclpy.shutdown(context=context)


def test_file_without_a_section_for_the_node_is_told(write, capfd):
    spin = pytest.importorskip('fhaosmo_ros.nodes.middleware.spin')
    path = write('plant: {ros__parameters: {order: 2}}')
    spin._check_arguments('plant', ['--ros-args', '--params-file', path])
    assert capfd.readouterr() == ('', '')
    spin._check_arguments('estimator', ['--ros-args', '--params-file', path])
    (line,) = capfd.readouterr().err.splitlines()
    assert line.startswith('[WARN]')
    assert line.endswith(f'[estimator]: {path}: sets nothing for node /estimator')
    renamed = ['--ros-args', '-r', '__node:=plans', '--params-file', path]
    with pytest.raises(ConfigurationError, match="got 'plant'; did you mean '/plans'"):
        spin._check_arguments('plant', renamed)


def test_rule_for_another_node_is_let_through():
    """As ROS does: one command line may serve several nodes."""
    spin = pytest.importorskip('fhaosmo_ros.nodes.middleware.spin')
    spin._check_arguments('estimator', ['--ros-args', '-p', 'plant:noise:=0.1'])
    with pytest.raises(ConfigurationError, match="'noise'"):
        spin._check_arguments('estimator', ['--ros-args', '-p', 'estimator:noise:=0.1'])


def test_list_takes_the_place_of_a_single_value(write):
    """Of these two, rcl returns the single one, whichever was set last."""
    spin = pytest.importorskip('fhaosmo_ros.nodes.middleware.spin')
    path = write('/**: {ros__parameters: {lambda: 7.0, alpha: [3.0], channels: hip}}')
    rules = ['-p', 'lambda:=[1.0, 2.0]', '-p', 'alpha:=4.0', '-p', 'channels:=knee']
    _, lists = spin._check_arguments('estimator', ['--ros-args', '--params-file', path, *rules])
    assert lists == {'lambda': [1.0, 2.0]}
