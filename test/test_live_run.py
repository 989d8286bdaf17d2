# SPDX-License-Identifier: Apache-2.0
"""A replay begins, restarts and changes parameters where the live estimator in the bag did."""

import re

import bag_files as files
from fhaosmo_ros.core.online.estimator import OnlineEstimator
from fhaosmo_ros.core.online.snapshots import Flag, pack
from fhaosmo_ros.core.parameters.files import dumps
from fhaosmo_ros.tools.bags.types import labelled_array
from fhaosmo_ros.tools.replay import command as replay
from fhaosmo_ros.topics import ARRAY, TEXT
import numpy as np
import pytest

COUNT = 4000
STAMPS, Y = files.signal(COUNT)
PARAMETERS = {'variant': 'fuzzy_adaptive', 'epsilon': 3.0}
EVENT = 'rcl_interfaces/msg/ParameterEvent'


class Live:
    """What a node does and publishes, as messages of a bag."""

    def __init__(self, name='/estimator', node=None, **parameters):
        self.name, self.node = name, node or name
        self.estimator = OnlineEstimator(PARAMETERS, **parameters)
        self.messages, self.rows = [], {}
        self._begins = True

    def run(self, begin, end, late=0):
        """Take samples whose stamps are `late` by so many nanoseconds."""
        for k in range(begin, end):
            stamp = int(STAMPS[k]) + late
            estimate = self.estimator.update(stamp, float(Y[k]))
            self.rows[stamp] = [*estimate.z, estimate.unknown_input, estimate.gamma]
            if self._begins or k % 500 == 499:
                self._tell(Flag.STARTED if self._begins else Flag(0), 90_000)
                self._begins = False
        return self

    def _tell(self, flags, delay):
        latest = self.estimator.latest
        data = labelled_array(*pack(flags, self.estimator.state_dict()))
        self.messages.append((f'{self.name}/snapshot', ARRAY, latest + delay, data))

    def tell_parameters(self, stamp, **values):
        """Publish all that the node is set to."""
        data = files.serialise(TEXT, data=dumps(values, self.node))
        self.messages.append((f'{self.node}/parameters', TEXT, int(stamp) + 200_000, data))

    def reset(self):
        self.estimator.reset()
        self._tell(Flag.RESET, 150_000)
        self._begins = True

    def change(self, stamp, name, value):
        self.estimator.configure({name: value})
        types, kinds = files.TYPES.types, ('byte', 'bool', 'integer', 'double')
        lists = {f'{kind}_array_value': np.zeros(0) for kind in kinds}
        given = types['rcl_interfaces/msg/ParameterValue'](
            type=3, bool_value=False, integer_value=0, double_value=value, string_value='',
            string_array_value=[], **lists,
        )  # fmt: skip
        name = f'{self.name.removeprefix(self.node)}.{name}'.strip('/.')
        parameter = types['rcl_interfaces/msg/Parameter'](name=name, value=given)
        data = files.serialise(
            EVENT, stamp=files.header(stamp).stamp, node=self.node, new_parameters=[],
            changed_parameters=[parameter], deleted_parameters=[],
        )  # fmt: skip
        self.messages.append(('/parameter_events', EVENT, int(stamp) + 100_000, data))
        self._tell(Flag.CHANGED, 100_100)


def write(path, keep, *lives, begin=0):
    """Write what a recorder gets of samples, or of so many, that comes at sample `begin`."""
    keep = slice(keep) if isinstance(keep, int) else keep
    messages = files.floats(STAMPS[keep], Y[keep]) + [m for live in lives for m in live.messages]
    messages = [m for m in messages if m[2] >= STAMPS[begin]]
    return files.write(path, sorted(messages, key=lambda m: m[2]))


def run(capsys, *arguments, code=0):
    """Return what a replay says, and the rows of its output by their stamps."""
    out = arguments[0].with_suffix('.npz')
    assert replay.main([*map(str, arguments), '-o', str(out), '--force']) == code
    said = capsys.readouterr()
    if code:
        return said.err
    with np.load(out) as arrays:
        names = ('z1', 'z2', 'z3', 'unknown_input', 'gamma')
        columns = [arrays[name] for name in names if name in arrays]
        stamps, rows = arrays['stamp_ns'].tolist(), np.column_stack(columns).tolist()
    return said.out + said.err, dict(zip(stamps, rows, strict=True))


def expect(found, live, first=0):
    """Compare with what the live estimator found, from its sample number `first` on."""
    assert list(found) == list(live.rows)[first:]
    np.testing.assert_array_equal(list(found.values()), [live.rows[stamp] for stamp in found])


@pytest.mark.parametrize('begin', [0, 700, 2600])
def test_every_live_estimate_comes_again(begin, tmp_path, capsys):
    """With known inputs that only the live estimator has seen, and parameters from the bag."""
    model = {'phi': ['0', '0', 'u - z3'], 'gains': 'fixed'}
    live = Live('/rig/estimator', **model)
    live.estimator.set_input(0.7)  # a set-point that was published once
    live.run(123, 1000)  # it discovered y later than the recorder
    live.change(STAMPS[999], 'epsilon', 1e-6)
    live.run(1000, 2000).reset()
    live.run(2000, 2300)
    live.change(STAMPS[2299], 'gamma_rate', 0.02)
    live.change(STAMPS[2299], 'epsilon', 2.0)
    live.run(2300, 2700)
    live.change(STAMPS[2699], 'gamma_rate', 0.0)
    live.run(2700, 3000)
    live.estimator.set_input(-0.4)
    live.messages += files.floats(STAMPS[3000:3001] - 1, np.array([-0.4]), '/rig/u')
    live.run(3000, 3400)
    live.change(STAMPS[3399], 'gamma_rate', 0.02)
    live.run(3400, COUNT)
    # The publisher's latest message, which a late recorder gets first.
    changed = {'gamma_rate': 0.02, 'epsilon': 2.0} if begin == 2600 else {}
    live.tell_parameters(STAMPS[begin], **PARAMETERS | model | changed, publish_rate=50.0)
    bag = write(tmp_path / 'bag', COUNT, live, begin=begin)
    text, found = run(capsys, bag)
    # The first snapshot after the begin is that of sample 123, 999 or 2699.
    expect(found, live, {0: 0, 700: 1000 - 123, 2600: 2700 - 123}[begin])
    assert 'parameters: /rig/estimator/parameters in the bag\n' in text
    assert 'followed /rig/estimator' in text
    [(same, count)] = re.findall(r'(\d+) of (\d+) snapshots are the same', text)
    assert int(same) == int(count) > 3


def test_parameters_of_the_bag_make_way(tmp_path, capsys):
    live = Live().run(0, 600)
    live.tell_parameters(STAMPS[0], variant='sign', epsilon=1.0)
    bag = write(tmp_path / 'bag', 600, live)
    text, found = run(capsys, bag, '-p', 'variant:=fuzzy_adaptive', '-p', 'epsilon:=3.0')
    assert 'in the bag, with variant, epsilon of the command line' in text
    expect(found, live)
    live.tell_parameters(STAMPS[0] - 1, epsilom=1.0)  # as of another version
    assert 'epsilom' in run(capsys, write(tmp_path / 'other', 600, live), code=2)


@pytest.mark.parametrize(('late', 'options', 'first', 'said'), [
    (0, ['--afresh'], 600, 'stamps: bag'),
    # As with sampling: clock, whose stamps no bag keeps.
    (17, [], 600, '/estimator not followed'),
    (0, ['-p', 'order:=2', '-p', "phi:=['0','0']"], 999, 'afresh after 399 samples'),
])  # fmt: skip
def test_what_cannot_be_followed_begins_afresh(late, options, first, said, tmp_path, capsys):
    bag = write(tmp_path / 'bag', 1500, Live().run(0, 1500, late), begin=600)
    text, found = run(capsys, bag, *options)
    assert said in text
    assert list(found) == STAMPS[first:1500].tolist()


def test_sample_that_the_bag_lacks_does_not_stop_the_following(tmp_path, capsys):
    live = Live()
    live.run(0, 1000).reset()
    live.run(1000, 2000)
    live.tell_parameters(STAMPS[0], **PARAMETERS)
    keep = np.delete(np.arange(2000), 1000)  # the one from which it started again
    _, got = run(capsys, write(tmp_path / 'bag', keep, live))
    assert got[int(STAMPS[999])] == live.rows[int(STAMPS[999])]
    assert got[int(STAMPS[1001])][4] == live.rows[int(STAMPS[1000])][4]  # gamma began afresh too


def test_changes_of_one_channel_are_its_own(tmp_path, capsys):
    lives = [Live(f'/estimator/{name}', '/estimator') for name in ('hip', 'knee')]
    for live, epsilon in zip(lives, (1e-6, 0.5), strict=True):
        live.run(0, 700)
        live.change(STAMPS[699], 'epsilon', epsilon)
        live.run(700, 1500)
    bag = write(tmp_path / 'bag', 1500, *lives)
    own = {'hip.epsilon': 3.0, 'knee.epsilon': 3.0, 'channels': ['hip', 'knee']}
    lives[0].tell_parameters(STAMPS[0], variant='fuzzy_adaptive', epsilon=7.0, **own)
    told = write(tmp_path / 'told', 1500, *lives)
    (tmp_path / 'p.yaml').write_text(dumps(PARAMETERS | {'channels': ['hip', 'knee']}))
    for live in lives:
        channel = ['--channel', live.name.removeprefix('/estimator/')]
        for arguments in ([bag, '--params-file', tmp_path / 'p.yaml'], [told]):
            text, found = run(capsys, *arguments, *channel)
            assert f'followed {live.name}' in text
            assert 'parameters differ' not in text
            expect(found, live)
    for arguments, said in (
        ([told, '--afresh', '--channel', 'hop'], '--channel: expected hip or knee, got hop'),
        ([bag], '(/estimator/hip, /estimator/knee)'),
        ([bag, '--node', '/middle'], 'expected --node and --channel'),
    ):
        assert said in run(capsys, *arguments, code=2)


@pytest.mark.parametrize('labels', [['a', 'b'], ['version', 'z_hat1'], ['flags', 'm1']])
def test_snapshot_of_another_version_is_refused(labels, tmp_path, capsys):
    data = labelled_array(labels, np.array([3.0, 1.0]))
    snapshot = '/e/snapshot', ARRAY, int(STAMPS[49]), data
    bag = files.write(tmp_path / 'bag', [*files.floats(STAMPS[:50], Y[:50]), snapshot])
    said = run(capsys, bag, code=2)
    assert "topic '/e/snapshot'" in said
    assert '--afresh does without it' in said
    assert list(run(capsys, bag, '--afresh')[1]) == STAMPS[:50].tolist()
