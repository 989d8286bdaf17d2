# SPDX-License-Identifier: Apache-2.0
"""Parameters of many channels: common values, and a channel's own in their place."""

import argparse

from fhaosmo_ros.core.parameters.errors import ConfigurationError
from fhaosmo_ros.core.parameters.files import load, select
from fhaosmo_ros.core.parameters.per_channel import (
    channel_names,
    of_channel,
    UNNAMED,
    with_channels,
)
from fhaosmo_ros.core.parameters.tables import (
    CHANNEL_PARAMETERS,
    ESTIMATOR_PARAMETERS,
    PLANT_NODE_PARAMETERS,
)
from fhaosmo_ros.tools.cli.options import add_parameter_options, channel_parameters
import pytest

NAMES = ['hip', 'knee_2']


def test_no_channels_is_one_without_a_name():
    assert channel_names({}) == UNNAMED
    assert list(with_channels(ESTIMATOR_PARAMETERS, UNNAMED)) == list(ESTIMATOR_PARAMETERS)


@pytest.mark.parametrize(
    ('names', 'reason'),
    [
        (['hip', 'hip'], 'every name once'),
        (['hip', ''], 'names of letters'),
        (['2hip'], 'names of letters'),
        (['hip/left'], 'names of letters'),
        (['a__b'], 'names of letters'),
        (['hip.left'], 'names of letters'),
        (['lambda'], "names that no parameter has (there is one 'lambda')"),
        ([], 'a list of strings'),
    ],
)
def test_bad_names_are_refused(names, reason):
    with pytest.raises(ConfigurationError, match="parameter 'channels': expected ") as error:
        channel_names({'channels': names})
    assert reason in str(error.value)


def test_own_value_wins_and_the_common_one_serves_the_rest():
    values = select(
        {'channels': NAMES, 'epsilon': 5, 'hip.epsilon': 7, 'knee_2.lambda': 3},
        ESTIMATOR_PARAMETERS,
    )
    hip, knee = (of_channel(values, name) for name in NAMES)
    assert (hip['epsilon'], knee['epsilon']) == (7.0, 5.0)
    assert knee['lambda'] == [3.0]
    assert 'lambda' not in hip


def test_own_parameters_are_declared_and_checked_as_the_common_ones():
    table = with_channels(ESTIMATOR_PARAMETERS, NAMES, {'epsilon': 9.0})
    assert len(table) == len(ESTIMATOR_PARAMETERS) + 2 * len(CHANNEL_PARAMETERS)
    with pytest.raises(ConfigurationError, match=r"'hip.epsilon': expected a number > 0 .*got -1"):
        table.coerce({'hip.epsilon': -1})
    assert table['hip.order'].live == ESTIMATOR_PARAMETERS['order'].live
    assert table['hip.epsilon'].default == 9.0  # the common value
    assert table['hip.max_gap'].default == ESTIMATOR_PARAMETERS['max_gap'].default


@pytest.mark.parametrize('name', ['hpi.lambda', 'hip.lamda', 'hip.publish_rate'])
def test_unknown_names_are_told(name):
    with pytest.raises(ConfigurationError, match=f"unknown parameter '{name}'"):
        select({'channels': NAMES, name: 1.0}, ESTIMATOR_PARAMETERS)


@pytest.fixture
def rig(tmp_path):
    path = tmp_path / 'rig.yaml'
    path.write_text(
        '/**:\n  ros__parameters:\n    channels: [hip, knee]\n    sample_rate: 50.0\n'
        '    epsilon: 5.0\n    hip:\n      epsilon: 7.0\n'
    )
    return path


def test_one_file_serves_channels_and_plant(rig):
    channels = {'channels': ['hip', 'knee'], 'epsilon': 5.0, 'hip.epsilon': 7.0}
    assert load(rig, 'estimator') == channels
    assert load(rig, 'plant', PLANT_NODE_PARAMETERS) == {'sample_rate': 50.0}


def replayed(*words):
    parser = argparse.ArgumentParser()
    add_parameter_options(parser)
    return channel_parameters(parser.parse_args(words))


def test_a_replay_takes_the_parameters_of_one_channel(rig):
    words = ['--params-file', str(rig), '-p', 'knee.lambda:=3']
    assert replayed(*words, '--channel', 'hip') == {'epsilon': 7.0}
    assert replayed(*words, '--channel', 'knee') == {'epsilon': 5.0, 'lambda': [3.0]}
    with pytest.raises(ConfigurationError, match='--channel: expected hip or knee, got none'):
        replayed(*words)
    with pytest.raises(ConfigurationError, match=r'--channel: expected none, .* got hip'):
        replayed('--channel', 'hip')
