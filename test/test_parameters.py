# SPDX-License-Identifier: Apache-2.0
"""Declared parameters, those of many channels, parameter files, and YAML from anybody."""

from array import array
import time
import warnings

from fhaosmo_ros.core import ConfigurationError, Observer, OnlineEstimator
from fhaosmo_ros.core.parameters.declaration import Parameter
from fhaosmo_ros.core.parameters.files import dumps, load, loads
from fhaosmo_ros.core.parameters.per_channel import complete, select
from fhaosmo_ros.core.parameters.removed import REMOVED
from fhaosmo_ros.core.parameters.tables import (
    CHANNEL_PARAMETERS,
    ESTIMATOR_PARAMETERS,
    NODE_TABLES,
)
from fhaosmo_ros.core.parameters.yaml_text import MAX_DEPTH, MAX_LENGTH, parse
from fhaosmo_ros.tools.cli.command import values_of
from fhaosmo_ros.tools.replay.command import make_estimator, options
from hypothesis import given, HealthCheck, settings
from hypothesis import strategies as st
import numpy as np
import pytest
from yaml_texts import ANY_TEXT, HOSTILE


def test_defaults_are_what_is_allowed_and_no_list_is_shared():
    for parameter in [p for table in NODE_TABLES.values() for p in table.values()]:
        got = parameter.coerce(parameter.default)
        assert (got, type(got)) == (parameter.default, type(parameter.default)), parameter.name
    ESTIMATOR_PARAMETERS.defaults()['phi'].append('0')
    assert len(ESTIMATOR_PARAMETERS['phi'].default) == 3


LIMITS = {'unit': 'm', 'lower': 0.0, 'upper': 2.0, 'lower_open': True}
DECLARED = {
    'bool': Parameter('p', True, 'A switch.'),
    'int': Parameter('p', 2, 'A count.', lower=1, upper=9),
    'double': Parameter('p', 0.5, 'A length.', **LIMITS),
    'string': Parameter('p', 'sign', 'A choice.', choices=('sign', 'fuzzy')),
    'double_array': Parameter('p', [0.5], 'Lengths.', **LIMITS),
    'string_array': Parameter('p', ['0'], 'Expressions.'),
}


@pytest.mark.parametrize(('kind', 'expected', 'values'), [
    ('bool', False, [False, np.bool_(False)]),
    ('int', 9, [9, np.int64(9)]),
    ('double', 2.0, [2, 2.0, np.float64(2.0), '2e0']),
    ('double_array', [2.0], [2, '2', [2], (2.0,), '[2]', np.array([2]), array('d', [2])]),
    # As in C and rcl, unlike YAML 1.1.
    ('double_array', [0.5, 1.0], [[0.5, 1], '[0.5, 1]', '[5e-1, .1E1]', '[5.e-1, +1e0]']),
    ('string_array', ['0', '0.5', '-z3'], [[0, 0.5, '-z3'], '[0, 0.5, -z3]', ('0', '0.5', '-z3')]),
])  # fmt: skip
def test_what_is_meant_is_taken_in_the_declared_type(kind, expected, values):
    for value in values:
        got = DECLARED[kind].coerce(value)
        assert (got, type(got)) == (expected, type(expected))
        assert kind != 'double_array' or all(isinstance(item, float) for item in got)


@pytest.mark.parametrize(('kind', 'allowed', 'values'), [
    ('bool', 'true or false', [0, 1, 'true', 1.0]),
    ('int', 'an integer >= 1 and <= 9', [0, 10, 1.0, '1', True, [1]]),
    ('double', 'a number > 0 and <= 2 [m]',
     [0, 2.1, float('nan'), float('inf'), True, 'x', '[1]', [1.0], 10**400]),
    ('string', 'one of sign, fuzzy', ['fuzy', 'qqq', '', 1]),
    ('double_array', 'a list of numbers > 0 and <= 2 [m]',
     [[1.0, 0.0], [float('nan')], [True], ['1'], [[1.0]], [10**400],
      '[', '[1, 2', 'a: b', '[[1]]', '!!python/x', '[~]']),
    ('string_array', 'a list of strings', [['0', True], ['0', ['z1']], 5, '[0, true]']),
])  # fmt: skip
def test_all_else_is_refused_in_one_line(kind, allowed, values):
    for value in [*values, None, {}, {'a': 1}, object, [], b'0', 1j, [None]]:
        with pytest.raises(ConfigurationError) as error:
            DECLARED[kind].coerce(value)
        message = str(error.value)
        assert message.isprintable()
        assert len(message) < 600
        assert message.startswith(f"parameter 'p': expected {allowed}, got ")
        assert message.endswith("got 'fuzy'; did you mean 'fuzzy'?") == (value == 'fuzy')


def test_unknown_and_old_names_are_told():
    for table in NODE_TABLES.values():
        name = next(iter(table))
        with pytest.raises(ConfigurationError, match=f"unknown parameter '{name}x'.*{name}"):
            table.coerce({name + 'x': 1.0})
        assert not REMOVED.keys() & table.keys()
    for name, successor in REMOVED.items():
        for wrong, values in ((name, {}), (f'hip.{name}', {'channels': ['hip']})):
            with pytest.raises(ConfigurationError) as error:
                complete(values | {wrong: 1.0}, ESTIMATOR_PARAMETERS)
            assert str(error.value) == f"parameter '{wrong}' is gone: {successor}"


@pytest.mark.parametrize(('values', 'reason'), [
    ({'lambda': [1.0, 2.0]}, r"'lambda': expected 1 or 4 values, got \[1.0, 2.0\]"),
    ({'fuzzy_widths': [1.0] * 5}, "'fuzzy_widths': expected 1 to 4 values"),
    ({'phi': ['0', '0']}, r'expected 3 expressions \(order = 3\), got 2'),
    ({'unknown_input': False, 'unknown_input_derivatives': 1}, 'expected unknown_input = true'),
    ({'scheme': 'predict_correct'}, "scheme = 'explicit' or 'implicit' with cascade"),
    ({'structure': 'levant', 'unknown_input': False}, 'unknown_input = true'),
    ({'gains': 'self_tuning', 'unknown_input': False}, 'unknown_input'),
    ({'event_deviations': 4.0}, r"'event_deviations'.*self_tuning.*'fixed'"),
    ({'measurement_delay': 0.04, 'input_delay': 0.05}, 'input_delay'),
    ({'smoothing_lag': 0.1}, "'noise_size'"),
    ({'smoothing_lag': 0.1, 'noise_size': 1.0, 'predict_to_now': True}, 'past or of the present'),
])  # fmt: skip
def test_values_that_do_not_fit_together_are_refused(values, reason):
    with pytest.raises(ConfigurationError, match=reason):
        OnlineEstimator(values)


def test_default_gains_with_the_plant_of_a_user_are_warned_of():
    """Whether a value is given or is the default makes no difference."""
    model = {'order': 2, 'phi': ['0', '-z2']}
    with pytest.warns(UserWarning, match='gains to self_tuning'):
        Observer(model)
    with warnings.catch_warnings():
        warnings.simplefilter('error')
        for fine in ({}, {'phi': ['0', '0', '-z3']}, model | {'lambda': 3.0},
                     model | {'gains': 'self_tuning'}):  # fmt: skip
            Observer(fine)


NAMES = ['hip', 'knee_2']


@pytest.mark.parametrize(('values', 'reason'), [
    ({'channels': ['hip', 'hip']}, 'every name once'), ({'channels': []}, 'a list of strings'),
    *(({'channels': [*NAMES, name]}, 'names of letters')
      for name in ('', '2hip', 'hip/left', 'a__b', 'a.b')),
    ({'channels': ['lambda']}, r"names that no parameter has \(there is one 'lambda'\)"),
    *(({'channels': NAMES, name: 1.0}, f"unknown parameter '{name}'")
      for name in ('hpi.lambda', 'hip.lamda', 'hip.publish_rate')),
    ({'channels': NAMES, 'hip.epsilon': -1}, "parameter 'hip.epsilon': expected a number > 0"),
])  # fmt: skip
def test_bad_names_and_values_are_refused(values, reason):
    with pytest.raises(ConfigurationError, match=reason):
        select(values, ESTIMATOR_PARAMETERS)


def replayed(*words):
    return make_estimator(options().parse_args(['bag', *words]))[0]


def test_one_file_serves_channels_and_plant_and_a_replay_takes_one_channel(tmp_path):
    rig = tmp_path / 'rig.yaml'
    values = 'channels: [hip, knee], sample_rate: 50.0, epsilon: 5.0, hip: {epsilon: 7.0}'
    rig.write_text(setting(values))
    channels = {'channels': ['hip', 'knee'], 'epsilon': 5.0, 'hip.epsilon': 7.0}
    assert load(rig, 'estimator') == channels
    assert load(rig, 'plant') == {'sample_rate': 50.0}
    words = ['--params-file', str(rig), '-p', 'knee.lambda:=3']
    default = CHANNEL_PARAMETERS.defaults()
    assert replayed(*words, '--channel', 'hip') == default | {'epsilon': 7.0}
    assert replayed(*words, '--channel', 'hip', '-p', 'epsilon:=6')['epsilon'] == 6.0
    assert replayed(*words, '--channel', 'knee') == default | {'epsilon': 5.0, 'lambda': [3.0]}
    for wrong, said in (
        (words, 'hip or knee, got none'), (['--channel', 'hip'], 'none, .* got hip'),
        (['-p', 'channels:=from_joint_names'], 'the name of a joint'),
    ):  # fmt: skip
        with pytest.raises(ConfigurationError, match=f'--channel: expected {said}'):
            replayed(*wrong)


def setting(values: str, section: str = '/**') -> str:
    return f"'{section}': {{ros__parameters: {{{values}}}}}"


def loaded(folder, text: str | bytes, node: str = 'estimator'):
    """Return what a file of this text sets for a node."""
    path = folder / 'file.yaml'
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return load(path, node)


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
    (setting('alpha: [1, .5E0]'), 'estimator', {'alpha': [1.0, 0.5]}),
    *((setting('epsilon: 0.3', section), node, {'epsilon': 0.3}) for section, node in (
        ('estimator', 'estimator'), ('/estimator', 'estimator'), ('/rig/*', '/rig/estimator'),
        ('/**', '/rig/arm/estimator'), ('/**/estimator', '/rig/arm/estimator'),
    )),
    *((setting('epsilon: 0.3', section), node, {}) for section, node in (
        ('/*', '/rig/estimator'), ('/*/estimator', '/rig/arm/estimator'),
        ('estimator', '/rig/estimator'), ('/rig/estimator', 'estimator'),
    )),
])  # fmt: skip
def test_values_of_the_sections_of_a_node(tmp_path, text, node, values):
    assert loaded(tmp_path, text, node) == values


@pytest.mark.parametrize(('text', 'node', 'words'), [
    (setting('noise_sd: 0.1'), 'estimator', "'noise_sd'; did you mean 'noise_std'?"),
    (setting('gamma: {min: 0.1}'), 'estimator', "unknown parameter 'gamma.min'"),
    (setting('', 'estimators'), '/rig/estimator',
     "expected a section '/rig/estimator' or '/**', got estimators"),
    (setting('', 'plan'), 'plant', "expected a section 'plant' or '/**', got plan"),
    *((text, 'estimator', '') for text in (
        '- a', 'estimator: 3', 'estimator: {ros__parameters: 3}', '\ttab: 1',
        'estimator: {ros_parameters: {epsilon: 0.3}}',
    )),
    (b'\xff\xfe\x00\x80', 'estimator', 'expected YAML'),
    (b'#' * (3 * MAX_LENGTH), 'estimator', f'at most {MAX_LENGTH} are read'),
    # rcl merges them; a YAML library keeps the last one: nobody can rely on either.
    (2 * '/**:\n  ros__parameters: {epsilon: 1.0}\n', 'estimator',
     "expected YAML, got: the key '/**' twice (line 3)"),
    (setting('channels: [a], a.epsilon: 1.0, a: {epsilon: 2.0}'), 'estimator',
     "section '/**': 'a.epsilon' is set twice"),
], ids=range(13))  # fmt: skip
def test_bad_file_is_one_line_with_its_name(tmp_path, text, node, words):
    message = refusal_of(loaded, tmp_path, text, node)
    assert message.startswith(f'{tmp_path}/file.yaml: ')
    assert words in message


# YAML from anybody


REASONS = {
    'key twice': "the key 'a' twice (line 1)", 'laughs': 'the alias *a, which ROS does not',
    'closed brackets': f'nested deeper than {MAX_DEPTH}', 'many values': 'more than 50000 values',
    'hexadecimal digits': 'an integer of more than 1024 bits', 'bool': "'x', which is no bool",
    'very long text': f'2000000 characters, at most {MAX_LENGTH}',
    'list as key': 'a key that is no plain text', 'two documents': 'a single document',
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
    refusal_of(lambda: ESTIMATOR_PARAMETERS.coerce(values_of([f'lambda:={text}'])))
    for whole in (text, setting(f'lambda: {text}')):
        assert refusal_of(loads, whole, 'estimator', ESTIMATOR_PARAMETERS)


SHORT = [text for text in HOSTILE.values() if len(text) < 20]
PIECES = st.sampled_from([*'[]{}?:,-&*!ab01. \n"\'|>#%@`\t\r', *SHORT])


@settings(max_examples=300, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(st.one_of(ANY_TEXT, st.lists(PIECES, max_size=30).map(''.join)))
def test_any_text_is_content_or_one_line(text):
    refusal_of(parse, text)
    for name in ('lambda', 'phi'):
        refusal_of(ESTIMATOR_PARAMETERS[name].coerce, text)


@pytest.mark.parametrize(('text', 'content'), [
    ('', None), ('{<<: {a: =}}', {'<<': {'a': '='}}), ('[!!float 3, !!str 3]', [3.0, '3']),
    ('[2001-02-30]', ['2001-02-30']),
    ('[1, 0x10, 1e-3, .inf, yes, ~, a]', [1, 16, 0.001, float('inf'), True, None, 'a']),
    ('a: &anchor [1]', {'a': [1]}), ('1' * 300, int('1' * 300)),
])  # fmt: skip
def test_content(text, content):
    assert parse(text) == content
    parse('[' * MAX_DEPTH + ']' * MAX_DEPTH)


def test_written_file_has_no_alias():
    gains = [1.0, 2.0]
    text = dumps({'lambda': gains, 'alpha': gains})
    assert loads(text, 'estimator', ESTIMATOR_PARAMETERS) == {'lambda': gains, 'alpha': gains}
    assert 'a longer integer' in refusal_of(ESTIMATOR_PARAMETERS['epsilon'].coerce, 10**5000)
