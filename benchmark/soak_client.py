# SPDX-License-Identifier: Apache-2.0
"""A client of a soak that changes the estimator's parameters, well and badly, and resets it."""

from collections import Counter
from time import monotonic, sleep
from typing import Any

from fhaosmo_ros.nodes.recording.private_node import PrivateNode
from rcl_interfaces.msg import Parameter as ParameterMessage
from rclpy.parameter import Parameter
from rclpy.parameter_client import AsyncParameterClient
from results import CannotMeasureError
from std_srvs.srv import Trigger

GOOD = (
    {'variant': 'sign'}, {'variant': 'fuzzy'}, {'variant': 'fuzzy_adaptive'},
    {'scheme': 'explicit', 'variant': 'fuzzy'}, {'scheme': 'implicit'},
    {'lambda': [15.0], 'alpha': [30.0]}, {'epsilon': 0.5}, {'publish_rate': 250.0},
    {'estimate_from': 'filtered'}, {'gamma_rate': 4.0, 'gamma_min': 0.4, 'gamma_max': 0.6},
)  # fmt: skip
BAD = (
    {'variant': 'fuzy'}, {'lambda': [-1.0]}, {'alpha': [1.0, 2.0]}, {'epsilon': float('nan')},
    {'gamma_min': 0.9, 'gamma_max': 0.2}, {'order': 7}, {'publish_rate': 0.0},
    {'no_such_parameter': 1.0},
)  # fmt: skip
ANSWERED = 10.0
"""Seconds that an answer may take."""


class SoakClient(PrivateNode):
    """
    Calls the estimator's services while it is open.

    Attributes
    ----------
    counts : Counter
        Calls by kind, and 'wrong answers': a bad set that was accepted, a good one refused.

    """

    def __init__(self) -> None:
        self.counts: Counter[str] = Counter()
        super().__init__('soak_client')
        self._parameters = AsyncParameterClient(self.node, '/estimator')
        self._reset = self.node.create_client(Trigger, '/estimator/reset')
        self._base: dict[str, Any] = {}

    def learn(self) -> None:
        """Remember the present parameters as those that `restore` puts back."""
        names = sorted({name for changes in GOOD for name in changes})
        if not self._parameters.wait_for_services(ANSWERED):
            raise CannotMeasureError("the estimator's parameter services did not appear")
        answer = self._wait(self._parameters.get_parameters(names))
        for name, value in zip(names, answer.values, strict=True):
            message = ParameterMessage(name=name, value=value)
            self._base[name] = Parameter.from_parameter_msg(message).value

    def call(self, kind: str) -> None:
        """Make the next call of a kind of `soak_plant.CALLS`."""
        turn = self.counts[kind]
        if kind == 'reset':
            right = self._wait(self._reset.call_async(Trigger.Request())).success
        elif kind == 'good parameters':
            right = self._set(GOOD[turn % len(GOOD)])
        else:
            right = not self._set(BAD[turn % len(BAD)])
        self.counts[kind] += 1
        self.counts['wrong answers'] += not right

    def restore(self) -> None:
        """Put the parameters back."""
        self.counts['wrong answers'] += not self._set(self._base)

    def _set(self, values: dict[str, Any]) -> bool:
        parameters = [Parameter(name, value=value) for name, value in values.items()]
        answer = self._wait(self._parameters.set_parameters_atomically(parameters))
        return bool(answer.result.successful)

    def _wait(self, future: Any) -> Any:
        deadline = monotonic() + ANSWERED
        while not future.done():
            if monotonic() > deadline:
                raise CannotMeasureError(f'the estimator did not answer within {ANSWERED:g} s')
            sleep(0.002)
        return future.result()
