# SPDX-License-Identifier: Apache-2.0
"""Parameter files: which sections serve which node, and what is refused; YAML from anybody."""

import time

from fhaosmo_ros.core.parameters.errors import ConfigurationError
from fhaosmo_ros.core.parameters.files import dumps, load, loads
from fhaosmo_ros.core.parameters.tables import ESTIMATOR_PARAMETERS
from fhaosmo_ros.core.parameters.yaml_text import MAX_DEPTH, MAX_LENGTH, parse
from fhaosmo_ros.tools.cli.options import assigned
from hypothesis import given, HealthCheck, settings
from hypothesis import strategies as st
import pytest
from yaml_texts import ANY_TEXT, HOSTILE


@pytest.fixture
def loaded(tmp_path):
    """Return a function from a file's text, and a node, to what the file sets for it."""
    path = tmp_path / 'file.yaml'

    def load_text(text: str, node: str = 'estimator'):
        path.write_text(text, encoding='utf-8')
        return load(path, node)

    load_text.path = path
    return load_text


def error_of(loaded, text: str, node: str = 'estimator') -> str:
    with pytest.raises(ConfigurationError) as error:
        loaded(text, node)
    message = str(error.value)
    assert message.startswith(f'{loaded.path}: ')
    assert '\n' not in message
    return message.removeprefix(f'{loaded.path}: ')


def setting(values: str, section: str = '/**') -> str:
    return f"'{section}': {{ros__parameters: {{{values}}}}}"


@pytest.mark.parametrize(('section', 'node', 'matches'), [
    ('estimator', 'estimator', True), ('/estimator', 'estimator', True),
    ('/**', 'estimator', True), ('/**', '/rig/arm/estimator', True), ('/*', 'estimator', True),
    ('/*', '/rig/estimator', False), ('/rig/estimator', '/rig/estimator', True),
    ('/rig/*', '/rig/estimator', True), ('/**/estimator', '/rig/arm/estimator', True),
    ('/*/estimator', '/rig/arm/estimator', False), ('estimator', '/rig/estimator', False),
    ('/rig/estimator', 'estimator', False), ('estimator2', 'estimator', False),
])  # fmt: skip
def test_sections(loaded, section, node, matches):
    assert loaded(setting('epsilon: 0.3', section), node) == ({'epsilon': 0.3} if matches else {})


@pytest.mark.parametrize(('section', 'node'), [
    ('/Estimator', 'estimator'), ('estimators', '/rig/estimator'), ('plan', 'plant'),
])  # fmt: skip
def test_misspelt_section_is_refused(loaded, section, node):
    problem = f"no section is that of node '{node}', got '{section.lstrip('/')}'"
    assert error_of(loaded, setting('', section), node) == f"{problem}; did you mean '{node}'?"


BOTH = (
    '/**: {ros__parameters: {order: 2, epsilon: 0.3, noise_std: 0.1, use_sim_time: true, '
    'qos_overrides: {/y: {publisher: {depth: 5}}}}}'
)
NESTED = 'rig: {arm: {estimator: {ros__parameters: {epsilon: 0.3}}}}'
LATER = (
    'estimator: {ros__parameters: {epsilon: 0.3, max_gap: 2}}\n'
    '/**: {ros__parameters: {epsilon: 0.4}}\n'
)


@pytest.mark.parametrize(('text', 'node', 'values'), [
    (NESTED, '/rig/arm/estimator', {'epsilon': 0.3}),
    (LATER, 'estimator', {'epsilon': 0.4, 'max_gap': 2.0}),
    (BOTH, 'estimator', {'order': 2, 'epsilon': 0.3}),
    (BOTH, 'plant', {'order': 2, 'noise_std': 0.1}),
    (setting('phi: [0, -z2]'), 'plant', {'phi': ['0', '-z2']}),
    *((setting(f'max_gap: {text}'), 'estimator', {'max_gap': float(text)})
      for text in ('1E2', '.5e0', '4', '+3')),
])  # fmt: skip
def test_values(loaded, text, node, values):
    assert loaded(text, node) == values


@pytest.mark.parametrize(('text', 'words'), [
    (setting('noise_sd: 0.1'), "'noise_sd'; did you mean 'noise_std'?"),
    (setting('gamma: {min: 0.1}'), "unknown parameter 'gamma.min'"),
    (setting('qqq: 1'), f'; known are {", ".join(ESTIMATOR_PARAMETERS)}, '),
    *((text, '') for text in ('- a\n- b', 'estimator: 3', 'estimator: {ros__parameters: 3}',
                              'estimator: {ros_parameters: {epsilon: 0.3}}', '\ttab: 1')),
])  # fmt: skip
def test_bad_file_is_one_line_with_its_name(loaded, text, words):
    assert words in error_of(loaded, text)


def test_file_that_is_not_text(tmp_path):
    path = tmp_path / 'file.yaml'
    path.write_bytes(b'\xff\xfe\x00\x80')
    assert 'expected YAML' in refusal_of(load, path, 'estimator')


# YAML from anybody


LISTS = ('lambda', 'phi', 'channels')
REASONS = {
    'key twice': "the key 'a' twice (line 1)", 'unknown alias': 'the alias *a, which ROS does not',
    'laughs': 'the alias *a', 'closed brackets': f'nested deeper than {MAX_DEPTH}',
    'many values': 'more than 50000 values', '4301 digits': 'which is no int',
    'hexadecimal digits': 'an integer of more than 1024 bits', 'bool': "'x', which is no bool",
    'very long text': f'2000000 characters, at most {MAX_LENGTH}',
    'list as key': 'a key that is no plain text', 'two documents': 'a second document (line 2)',
    'timestamp': "the tag 'tag:yaml.org,2002:timestamp'",
}  # fmt: skip
"""Why some of the hostile texts are refused."""


def refusal_of(function, *arguments):
    """Return the one line with which a call is refused, None if it is not."""
    start, message = time.process_time(), None
    try:
        repr(function(*arguments))
    except ConfigurationError as error:
        message = str(error)
        assert message.isprintable()
        assert len(message) < 600
    assert time.process_time() - start < 5.0
    return message


@pytest.mark.parametrize('name', HOSTILE)
def test_hostile_text_is_content_or_one_line(name):
    text = HOSTILE[name]
    reason = refusal_of(parse, text)
    if name in REASONS:
        assert reason.startswith('expected YAML, got: ')
        assert REASONS[name] in reason
    assert refusal_of(ESTIMATOR_PARAMETERS['lambda'].coerce, text)
    refusal_of(assigned, [f'lambda:={text}'], ESTIMATOR_PARAMETERS)
    for whole in (text, setting(f'lambda: {text}')):
        assert refusal_of(loads, whole, 'estimator', ESTIMATOR_PARAMETERS)


SHORT = [text for text in HOSTILE.values() if len(text) < 20]
PIECES = st.sampled_from([*'[]{}?:,-&*!ab01. \n"\'|>#%@`\t\r', *SHORT])


@settings(max_examples=300, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(st.one_of(ANY_TEXT, st.lists(PIECES, max_size=30).map(''.join)))
def test_any_text_is_content_or_one_line(text):
    refusal_of(parse, text)
    for name in LISTS:
        refusal_of(ESTIMATOR_PARAMETERS[name].coerce, text)


@pytest.mark.parametrize(('text', 'content'), [
    ('', None), ('{<<: {a: =}}', {'<<': {'a': '='}}), ('[!!float 3, !!str 3]', [3.0, '3']),
    ('[2001-02-30, 2001-02-03 04:05:06]', ['2001-02-30', '2001-02-03 04:05:06']),
    ('[1, 0x10, 1e-3, .inf, yes, ~, a]', [1, 16, 0.001, float('inf'), True, None, 'a']),
    ('a: &anchor [1]', {'a': [1]}), ('1' * 300, int('1' * 300)),
])  # fmt: skip
def test_content(text, content):
    assert parse(text) == content
    parse('[' * MAX_DEPTH + ']' * MAX_DEPTH)


def test_section_or_parameter_given_twice_is_refused():
    """Rcl merges them; a YAML library keeps the last one: nobody can rely on either."""
    twice = '/**:\n  ros__parameters: {epsilon: 1.0}\n' * 2
    message = refusal_of(loads, twice, 'estimator', ESTIMATOR_PARAMETERS)
    assert message == "expected YAML, got: the key '/**' twice (line 3)"
    nested = setting('channels: [a], a.epsilon: 1.0, a: {epsilon: 2.0}')
    message = refusal_of(loads, nested, 'estimator', ESTIMATOR_PARAMETERS)
    assert message == "section '/**': 'a.epsilon' is set twice"


def test_written_file_has_no_alias_and_is_read_up_to_a_bound(tmp_path):
    gains = [1.0, 2.0]
    text = dumps({'lambda': gains, 'alpha': gains})
    assert loads(text, 'estimator', ESTIMATOR_PARAMETERS) == {'lambda': gains, 'alpha': gains}
    path = tmp_path / 'zero.yaml'
    path.write_text('#' * (3 * MAX_LENGTH))
    assert f'at most {MAX_LENGTH} are read' in refusal_of(load, path, 'estimator')
    assert 'a longer integer' in refusal_of(ESTIMATOR_PARAMETERS['epsilon'].coerce, 10**5000)
