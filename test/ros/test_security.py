# SPDX-License-Identifier: Apache-2.0
"""Nothing that comes from outside is executed; the SROS 2 policy names what the nodes have."""

from pathlib import Path
from xml.etree import ElementTree

import pytest

rclpy = pytest.importorskip('rclpy', reason='rclpy is not installed: needs ROS 2 Jazzy')
pytestmark = pytest.mark.ros

from lifecycle_msgs.msg import Transition  # noqa: E402
from lifecycle_msgs.srv import ChangeState  # noqa: E402
from rig import node_process, Parameters, parameters, Process, ROOT  # noqa: E402

COLD_START = 120.0
"""Seconds: a node that has to compile on a busy machine."""

# Attacks: each would make the file MARK if anything ran it.


def attacks(mark: Path) -> list[str]:
    touch = f'touch {mark}'
    return [
        f"__import__('os').system('{touch}')",
        f"().__class__.__base__.__subclasses__()[0].__init__.__globals__['os'].system('{touch}')",
        f"z1 if __import__('os').system('{touch}') else z1",
        f"[__import__('os').system('{touch}') for _ in (1,)][0]",
        f"(lambda: __import__('os').system('{touch}'))()",
        f'f\'{{open({str(mark)!r}, "w")}}\'',
        f"open('{mark}', 'w')",
        f"eval('{touch}')",
        f'$({touch})',
        f'`{touch}`',
        f'0; {touch}',
        f'| {touch}',
        f'!!python/object/apply:os.system ["{touch}"]',
    ]


def test_parameters_through_services_execute_nothing(client, folder, tmp_path):
    mark = tmp_path / 'mark'
    arguments = parameters(namespace='/attack', autostart='false')
    with node_process(folder(), 'estimator', *arguments) as process:
        values = Parameters(client, '/attack/estimator')
        configure = ChangeState.Request(transition=Transition(id=Transition.TRANSITION_CONFIGURE))
        for text in attacks(mark):
            for name in ('variant', 'lambda', 'epsilon', 'order'):
                assert not values.set(**{name: text})[0].successful
            assert values.set(hardware_id=text)[0].successful  # a text like any other
            # A model is looked at as a whole, when the node is configured.
            assert values.set(phi=['0', '0', text])[0].successful
            answer = client.call('/attack/estimator/change_state', ChangeState, configure)
            assert not answer.success, text
        assert process.output.count("'phi': Phi_3") == len(attacks(mark))
    assert not mark.exists()


def test_arguments_and_files_execute_nothing(folder, tmp_path):
    mark = tmp_path / 'mark'
    processes = []
    for k, text in enumerate(attacks(mark)[-6:]):
        (tmp_path / f'{k}.yaml').write_text(f'/**: {{ros__parameters: {{epsilon: {text}}}}}\n')
        processes += [
            Process(folder(), 'estimator', '--ros-args', '--params-file', words)
            for words in (text, tmp_path / f'{k}.yaml')
        ]
        for process in processes[-2:]:
            assert process.wait() == 2, process.output
    assert not mark.exists()


# The policy.


def expand(name: str, profile: ElementTree.Element) -> str:
    """Return the full name, as sros2 does."""
    namespace = profile.get('ns').rstrip('/') + '/'
    if name.startswith('~'):
        return namespace + profile.get('node') + name[1:]
    return name if name.startswith('/') else namespace + name


@pytest.fixture(scope='module')
def policy():
    return ElementTree.parse(ROOT / 'config' / 'sros2_policy.xml').getroot()


def allowed(policy, enclave: str, kind: str, verb: str) -> list[str]:
    profile = policy.find(f"enclaves/enclave[@path='/fhaosmo_ros/{enclave}']/profiles/profile")
    items = profile.findall(f"{kind}s[@{verb}='ALLOW']/{kind}")
    return [expand(item.text, profile) for item in items]


def test_policy_has_the_form_that_sros2_reads(policy):
    """Schema 0.2.0 of sros2, as far as the file uses it."""
    assert (policy.tag, policy.attrib) == ('policy', {'version': '0.2.0'})
    (enclaves,) = policy
    assert enclaves.tag == 'enclaves'
    for enclave in enclaves:
        assert (enclave.tag, set(enclave.attrib)) == ('enclave', {'path'})
        (profiles,) = enclave
        (profile,) = profiles
        assert (profiles.tag, profile.tag) == ('profiles', 'profile')
        assert set(profile.attrib) == {'ns', 'node'}
        for rules in profile:
            ((verb, rule),) = rules.attrib.items()
            verbs = {'topics': ('publish', 'subscribe'), 'services': ('reply', 'request')}
            assert verb in verbs[rules.tag]
            assert rule == 'ALLOW'
            assert len(rules)
            for item in rules:
                assert item.tag == rules.tag[:-1]
                assert item.text.strip() == item.text
                assert not item.attrib


def names(answer) -> set[str]:
    return {name for name, _ in answer}


@pytest.mark.parametrize('name', ['estimator', 'plant'])
def test_policy_allows_exactly_what_the_node_has(client, start, policy, name):
    # With everything that is optional: a known input, simulated time, self-tuning.
    # In a namespace: other tests leave nodes of this name behind for a while.
    own = {'gains': 'self_tuning'} if name == 'estimator' else {}
    of_other_gains = {'/estimator/gamma'} if name == 'estimator' else set()
    model = {'phi': "['0', '0', 'u - z3']", 'use_sim_time': 'true'}
    start(name, *parameters(namespace='/policy', **model, **own))
    node = client.node
    for kind, verb, look in (
        ('topic', 'publish', node.get_publisher_names_and_types_by_node),
        ('topic', 'subscribe', node.get_subscriber_names_and_types_by_node),
        ('service', 'reply', node.get_service_names_and_types_by_node),
    ):
        listed = allowed(policy, name, kind, verb)
        assert len(set(listed)) == len(listed)
        listed = set(listed) - (of_other_gains if verb == 'publish' else set())

        def same(look=look, listed=listed) -> bool:
            try:
                return {n.removeprefix('/policy') for n in names(look(name, '/policy'))} == listed
            except Exception:  # rclpy: the node is not known yet
                return False

        try:
            client.wait(same, verb, COLD_START)
        except TimeoutError:
            found = {n.removeprefix('/policy') for n in names(look(name, '/policy'))}
            assert found == listed  # says what differs
            raise
    assert not names(node.get_client_names_and_types_by_node(name, '/policy'))


def test_operator_may_watch_and_call_all_of_it(policy):
    for kind, of_node, of_operator in (
        ('topic', 'publish', 'subscribe'), ('service', 'reply', 'request'),
    ):  # fmt: skip
        both = [n for name in ('estimator', 'plant') for n in allowed(policy, name, kind, of_node)]
        assert set(allowed(policy, 'operator', kind, of_operator)) == set(both)
