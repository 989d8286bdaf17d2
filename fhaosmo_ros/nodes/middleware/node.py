# SPDX-License-Identifier: Apache-2.0
"""What every node is: its parameters, declared in the core, become those of ROS, also live."""

from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import Any

from fhaosmo_ros.core.parameters.declaration import Parameter, Parameters, suggestion
from fhaosmo_ros.core.parameters.errors import ConfigurationError
from fhaosmo_ros.core.parameters.per_channel import BUILT_IN, complete, is_built_in, split
from fhaosmo_ros.core.parameters.tables import NODE_TABLES
from rcl_interfaces.msg import ParameterDescriptor
from rclpy.exceptions import ParameterNotDeclaredException
from rclpy.node import Node
from rclpy.parameter import Parameter as RosParameter
from rosgraph_msgs.msg import Clock

POLICIES = {p.name: p for p in (
    Parameter('depth', 1, '', lower=1, upper=100_000),
    Parameter('history', '', '', choices=('keep_last', 'keep_all')),
    Parameter('reliability', '', '', choices=('reliable', 'best_effort')),
    Parameter('durability', '', '', choices=('volatile', 'transient_local')),
)}  # fmt: skip
"""QoS policies that a user may override."""


class RefusedError(ParameterNotDeclaredException):
    """
    A change that is refused, with the reason as its whole text.

    Of what a callback raises, this is the kind that rclpy answers to who has asked for the change.
    """

    def __init__(self, reason: str) -> None:
        Exception.__init__(self, reason)


def descriptor(parameter: Parameter, read_only: bool) -> ParameterDescriptor:
    """
    Return the ROS descriptor of a declared parameter.

    Typing is dynamic so that a wrong type reaches our own check, whose message names the
    parameter, and so bounds are no ROS range.
    """
    constraints = [parameter.allowed, *filter(None, [parameter.lengths])]
    if not (parameter.live or read_only):
        constraints.append('fixed while the node is configured: set it after cleanup')
    return ParameterDescriptor(
        name=parameter.name,
        type=RosParameter.Type.from_parameter_value(parameter.default).value,
        description=parameter.text,
        additional_constraints='; '.join(constraints),
        read_only=read_only,
        dynamic_typing=True,
    )


def built_in(given: Mapping[str, Any]) -> list[RosParameter]:
    """
    Return those given parameters that are rclpy's own: use_sim_time, QoS overrides.

    They are checked here: rclpy ends with a traceback, or goes on without the topic.
    """
    result = []
    for name in filter(is_built_in, given):
        policy = name.rpartition('.')[2]
        if name in BUILT_IN:
            declared = Parameter(name, False, '')
        elif policy in POLICIES:
            declared = replace(POLICIES[policy], name=name)
        else:
            problem = f'expected one of {", ".join(POLICIES)} at its end'
            raise ConfigurationError(
                f"parameter '{name}': {problem}{suggestion(policy, POLICIES)}"
            )
        result.append(RosParameter(name, value=declared.coerce(given[name])))
    return result


class BaseNode(Node):
    """
    A node whose parameters are declared in ROS, and changed by its services.

    ROS has a copy of the values for its services; the node reads its own `values`. A live change
    is coerced, prepared and perhaps refused as a set before ROS takes it (pre-set callback), and
    adopted afterwards (post-set callback). A subclass has the methods for it: `_prepare` gets all
    values as they would be, and the changes; it returns what `_adopt` gets once ROS has accepted
    them, or raises ConfigurationError, and changes nothing.

    `given` is all that files and the command line set, also rclpy's own, such as use_sim_time;
    what can't be used raises ConfigurationError. `fixed` parameters can't change in any state of
    the node; without it, those that are not live.
    """

    def __init__(
        self, name: str, given: Mapping[str, Any], fixed: Iterable[str] | None = None
    ) -> None:
        values = complete(given, NODE_TABLES[name])
        super().__init__(name, parameter_overrides=built_in(given), enable_logger_service=True)
        values = self._with_channels(values)
        not_live = (p.name for p in values.table.values() if not p.live)
        self._read_only = set(not_live if fixed is None else fixed)
        self.values = values
        for key, value in values.items():
            declared = descriptor(values.table[key], key in self._read_only)
            self.declare_parameter(key, value, declared, ignore_override=True)
        self.add_pre_set_parameters_callback(self._look_at)
        self.add_post_set_parameters_callback(self._take_over)

    def create_subscription(
        self, msg_type: Any, topic: str, callback: Any, *arguments: Any, **options: Any
    ) -> Any:
        """Return a subscription; that of /clock, which rclpy makes, passes over negative times."""

        def take_time(message: Clock) -> None:
            if message.clock.sec >= 0:  # else rclpy 7.1 ends the node
                callback(message)
                return
            self.get_logger().warning(
                f'rejected a time on /clock: expected seconds >= 0, got {message.clock.sec}',
                throttle_duration_sec=5.0,
            )

        take = take_time if msg_type is Clock else callback
        return super().create_subscription(msg_type, topic, take, *arguments, **options)

    def _with_channels(self, values: Parameters) -> Parameters:
        """Return the values with those of channels whose names are not known before."""
        return values

    def _look_at(self, parameters: list[RosParameter]) -> list[RosParameter]:
        """Coerce and prepare a set; return it, and those that follow, in the declared types."""
        table, found = self.values.table, {p.name: p for p in parameters}
        for name in found:
            if not self.has_parameter(name):  # rclpy 7.1 refuses it too, without the name
                raise ParameterNotDeclaredException(f"'{name}'{suggestion(name, table)}")
        ours = [name for name in found if name in table]
        if not ours or self._read_only & found.keys():  # which rclpy refuses
            return parameters
        try:
            changes = {name: table[name].coerce(found[name].value) for name in ours}
            for own, value in self.values.items():  # of a channel, while it is the common value
                common = split(own)[1]
                if common in changes and value == self.values[common]:
                    changes.setdefault(own, changes[common])
            values = Parameters(table, {**self.values, **changes})
            self._next = values, changes, self._prepare(values, changes)
        except ConfigurationError as error:
            self.get_logger().warning(f'rejected: {error}')
            raise RefusedError(str(error)) from None
        coerced = {name: RosParameter(name, value=value) for name, value in changes.items()}
        return list({**found, **coerced}.values())

    def _take_over(self, parameters: list[RosParameter]) -> None:
        if any(p.name in self.values.table for p in parameters):
            self.values, changes, prepared = self._next
            self._adopt(prepared)
            text = ', '.join(f'{name} = {value}' for name, value in changes.items())
            self.get_logger().info(f'set {text}')
