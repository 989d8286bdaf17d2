# SPDX-License-Identifier: Apache-2.0
"""The SROS 2 policy names what the nodes have."""

from xml.etree import ElementTree

from fhaosmo_ros.topics import TYPED_ESTIMATES
import pytest
from rclpy.node import NodeNameNonExistentError
from running import ROOT

KNOWN_INPUT = {'phi': ['0', '0', 'u - z3']}
NODES = {
    'estimator': {'gains': 'self_tuning', 'typed_outputs': [*TYPED_ESTIMATES], **KNOWN_INPUT},
    'plant': KNOWN_INPUT, 'arm': {'wrench_frame': 'tool'},
}  # fmt: skip
"""With what makes them have all that is optional."""
POLICY = ElementTree.parse(ROOT / 'config' / 'sros2_policy.xml').getroot()


def allowed(enclave: str, kind: str, verb: str) -> list[str]:
    """Return the full names, as sros2 expands them."""
    profile = POLICY.find(f"enclaves/enclave[@path='/fhaosmo_ros/{enclave}']/profiles/profile")
    items = profile.findall(f"{kind}s[@{verb}='ALLOW']/{kind}")
    space = profile.get('ns').rstrip('/') + '/'
    own = [item.text.replace('~', space + profile.get('node')) for item in items]
    return [name if name.startswith('/') else space + name for name in own]


@pytest.mark.parametrize('name', NODES)
def test_policy_allows_exactly_what_the_node_has(user, launch, name):
    # In a namespace: other tests leave nodes of this name behind for a while.
    launch(name, namespace='/policy', use_sim_time=True, **NODES[name])

    def has(look) -> list[str]:
        try:
            return sorted(topic.removeprefix('/policy') for topic, _ in look(name, '/policy'))
        except NodeNameNonExistentError:
            return []

    for kind, verb, look in (
        ('topic', 'publish', user.node.get_publisher_names_and_types_by_node),
        ('topic', 'subscribe', user.node.get_subscriber_names_and_types_by_node),
        ('service', 'reply', user.node.get_service_names_and_types_by_node),
    ):
        # gamma is that of fixed gains
        listed = sorted(n for n in allowed(name, kind, verb) if n != '/estimator/gamma')
        user.wait(lambda look=look, listed=listed: has(look) == listed, f'{verb}: {listed}')
    assert not has(user.node.get_client_names_and_types_by_node)


def test_operator_may_watch_and_call_all_of_it():
    for kind, of_node, of_operator in (
        ('topic', 'publish', 'subscribe'), ('service', 'reply', 'request'),
    ):  # fmt: skip
        both = {n for name in NODES for n in allowed(name, kind, of_node)}
        assert set(allowed('operator', kind, of_operator)) == both
