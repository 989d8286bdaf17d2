# SPDX-License-Identifier: Apache-2.0
"""Parameter files: which sections serve which node, and what is refused."""

from fhaosmo_ros.core.parameters.errors import ConfigurationError
from fhaosmo_ros.core.parameters.files import load
from fhaosmo_ros.core.parameters.tables import ESTIMATOR_PARAMETERS
import pytest


@pytest.fixture
def path(tmp_path):
    return str(tmp_path / 'file.yaml')


def write(path: str, text: str) -> str:
    with open(path, 'w', encoding='utf-8') as file:
        file.write(text)
    return path


def error_of(path: str, node: str) -> str:
    with pytest.raises(ConfigurationError) as error:
        load(path, node)
    message = str(error.value)
    assert message.startswith(f'{path}: ')
    assert '\n' not in message
    return message.removeprefix(f'{path}: ')


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
def test_sections(path, section, node, matches):
    write(path, f"'{section}': {{ros__parameters: {{epsilon: 0.3}}}}")
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
def test_misspelt_section_is_refused(path, section, node):
    write(path, f"'{section}': {{ros__parameters: {{epsilon: 0.3}}}}")
    problem = f"no section is that of node '{node}', got '{section.lstrip('/')}'"
    assert error_of(path, node) == f"{problem}; did you mean '{node}'?"


BOTH = (
    '/**: {ros__parameters: {order: 2, epsilon: 0.3, noise_std: 0.1, use_sim_time: true, '
    'qos_overrides: {/y: {publisher: {depth: 5}}}}}'
)
NESTED = 'rig: {arm: {estimator: {ros__parameters: {epsilon: 0.3}}}}'
LATER = (
    'estimator: {ros__parameters: {epsilon: 0.3, max_gap: 2}}\n'
    '/**: {ros__parameters: {epsilon: 0.4}}\n'
)


@pytest.mark.parametrize(
    ('text', 'node', 'values'),
    [
        (NESTED, '/rig/arm/estimator', {'epsilon': 0.3}),
        (LATER, 'estimator', {'epsilon': 0.4, 'max_gap': 2.0}),
        (BOTH, 'estimator', {'order': 2, 'epsilon': 0.3}),
        (BOTH, 'plant', {'order': 2, 'noise_std': 0.1}),
        *(
            (f'/**: {{ros__parameters: {{max_gap: {text}}}}}', 'estimator', {'max_gap': value})
            for text, value in (
                ('1e-1', 0.1), ('1E2', 100.0), ('.5e0', 0.5), ('1.5e1', 15.0), ('4', 4.0),
                ('+3', 3.0),
            )
        ),
    ],
)  # fmt: skip
def test_values(path, text, node, values):
    assert load(write(path, text), node) == values


@pytest.mark.parametrize(
    ('text', 'words'),
    [
        ('/**: {ros__parameters: {noise_sd: 0.1}}', "'noise_sd'; did you mean 'noise_std'?"),
        ('/**: {ros__parameters: {gamma: {min: 0.1}}}', "unknown parameter 'gamma.min'"),
        ('/**: {ros__parameters: {qqq: 1}}', f'; known are {", ".join(ESTIMATOR_PARAMETERS)}, '),
        ('- a\n- b', ''),
        ('estimator: 3', ''),
        ('estimator: {ros__parameters: 3}', ''),
        ('estimator: {ros_parameters: {epsilon: 0.3}}', ''),
        ('a: 1\n---\nb: 2', ''),
        ('\ttab: 1', ''),
        ('a: !!python/object/apply:os.system [true]', ''),
    ],
)
def test_bad_file_is_one_line_with_its_name(path, text, words):
    assert words in error_of(write(path, text), 'estimator')


def test_file_that_is_not_text(path):
    with open(path, 'wb') as file:
        file.write(b'\xff\xfe\x00\x80')
    assert 'expected YAML' in error_of(path, 'estimator')
