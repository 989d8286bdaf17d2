# SPDX-License-Identifier: Apache-2.0
"""From the declarations of the core to ROS parameters: descriptors, overrides, live changes."""

from collections.abc import Callable, Iterable, Mapping
from typing import Any

from fhaosmo_ros.core.parameters.declaration import Parameter, Parameters, shown, suggestion, Value
from fhaosmo_ros.core.parameters.errors import ConfigurationError
from fhaosmo_ros.core.parameters.files import BUILT_IN, is_built_in
from fhaosmo_ros.core.parameters.per_channel import followers
from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.exceptions import ParameterNotDeclaredException
from rclpy.node import Node
from rclpy.parameter import Parameter as RosParameter


class RefusedError(ParameterNotDeclaredException):
    """
    A change that is refused, with the reason as its whole text.

    Of what a callback raises, this is the kind that rclpy answers to who has asked for the change.
    """

    def __init__(self, reason: str) -> None:
        Exception.__init__(self, reason)


def type_of(parameter: Parameter) -> RosParameter.Type:
    """Return the ROS type of a declared parameter."""
    return RosParameter.Type[{'int': 'INTEGER'}.get(parameter.kind, parameter.kind.upper())]


def descriptor(parameter: Parameter, read_only: bool) -> ParameterDescriptor:
    """
    Return the ROS descriptor of a declared parameter.

    Typing is dynamic so that a wrong type reaches our own check, whose message names the
    parameter. Bounds are a ROS range only where a slider of rqt_reconfigure makes sense.
    """
    fixed = not parameter.live and not read_only
    constraints = (
        parameter.allowed,
        parameter.lengths,
        'fixed while the node is configured: set it after cleanup' if fixed else '',
    )
    result = ParameterDescriptor(
        name=parameter.name,
        type=type_of(parameter).value,
        description=parameter.text,
        additional_constraints='; '.join(filter(None, constraints)),
        read_only=read_only,
        dynamic_typing=True,
    )
    bounds = {'from_value': parameter.lower, 'to_value': parameter.upper}
    if parameter.slider and parameter.kind == 'double':
        result.floating_point_range = [FloatingPointRange(**bounds)]
    elif parameter.slider:
        result.integer_range = [IntegerRange(**bounds)]
    return result


def built_in(given: Mapping[str, Any]) -> list[RosParameter]:
    """Return those given parameters that are rclpy's own, such as use_sim_time."""
    own = {name: value for name, value in given.items() if is_built_in(name)}
    for name, value in own.items():
        flag = name in BUILT_IN
        if not isinstance(value, bool if flag else bool | int | float | str):
            expected = 'true or false' if flag else 'one value'
            problem = f'expected {expected}, got {shown(value)}'
            raise ConfigurationError(f"parameter '{name}': {problem}")
    return [RosParameter(name, value=value) for name, value in own.items()]


class NodeParameters:
    """
    The parameters of a node: declared in ROS, and changed by its services.

    ROS has a copy of the values for its services; the node reads these ones. A live change is
    coerced, prepared and perhaps refused as a set before ROS takes it (pre-set callback), and
    adopted afterwards (post-set callback).

    `values` are the present ones. `prepare` gets all values as they would be, and the changes; it
    returns what `adopt` gets once ROS has accepted them, or raises ConfigurationError, and changes
    nothing. `fixed` parameters can't change in any state of the node; without it, those that are
    not live.
    """

    def __init__(
        self,
        node: Node,
        values: Parameters,
        prepare: Callable[[Parameters, Mapping[str, Value]], Any],
        adopt: Callable[[Any], None],
        fixed: Iterable[str] | None = None,
    ) -> None:
        self._node, self._prepare, self._adopt_change = node, prepare, adopt
        not_live = (name for name, parameter in values.table.items() if not parameter.live)
        self._read_only = set(not_live if fixed is None else fixed)
        self.extend(values)
        node.add_pre_set_parameters_callback(self._look_at)
        node.add_post_set_parameters_callback(self._adopt)

    def extend(self, values: Parameters) -> None:
        """Go on with values, perhaps of a larger table: what is new is declared."""
        for name, value in values.items():
            if not self._node.has_parameter(name):
                declared = descriptor(values.table[name], name in self._read_only)
                self._node.declare_parameter(name, value, declared, ignore_override=True)
        self.values = values

    def _look_at(self, parameters: list[RosParameter]) -> list[RosParameter]:
        """Coerce and prepare a set; return it, and those that follow, in the declared types."""
        table, found = self.values.table, {p.name: p for p in parameters}
        for name in found:
            if not self._node.has_parameter(name):  # rclpy 7.1 refuses it too, without the name
                raise ParameterNotDeclaredException(f"'{name}'{suggestion(name, table)}")
        ours = [name for name in found if name in table]
        if not ours or self._read_only & found.keys():  # which rclpy refuses
            return parameters
        try:
            changes = {name: table[name].coerce(found[name].value) for name in ours}
            for name in ours:
                for own in followers(name, self.values):
                    changes.setdefault(own, changes[name])
            values = Parameters(table, {**self.values, **changes})
            self._next = values, changes, self._prepare(values, changes)
        except ConfigurationError as error:
            self._node.get_logger().warning(f'rejected: {error}')
            raise RefusedError(str(error)) from None
        coerced = {
            name: RosParameter(name, type_of(table[name]), v) for name, v in changes.items()
        }
        return list({**found, **coerced}.values())

    def _adopt(self, parameters: list[RosParameter]) -> None:
        if any(p.name in self.values.table for p in parameters):
            self.values, changes, prepared = self._next
            self._adopt_change(prepared)
            text = ', '.join(f'{name} = {value}' for name, value in changes.items())
            self._node.get_logger().info(f'set {text}')
