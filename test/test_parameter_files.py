# SPDX-License-Identifier: Apache-2.0
"""Parameter files: which sections serve which node, and what is refused."""

from fhaosmo_ros.core.parameters.errors import ConfigurationError
from fhaosmo_ros.core.parameters.files import load
from fhaosmo_ros.core.parameters.tables import ESTIMATOR_PARAMETERS
import pytest


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
