# SPDX-License-Identifier: Apache-2.0
"""From the declarations of the core to ROS parameters: descriptors, overrides, live changes."""

from collections.abc import Callable, Iterable, Mapping
from typing import Any

from fhaosmo_ros.core.parameters.declaration import Parameter, Parameters, shown, suggestion, Value
from fhaosmo_ros.core.parameters.errors import ConfigurationError
from fhaosmo_ros.core.parameters.files import is_built_in
from fhaosmo_ros.core.parameters.per_channel import followers
from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    SetParametersResult,
)
from rclpy.exceptions import ParameterNotDeclaredException
from rclpy.node import Node
from rclpy.parameter import Parameter as RosParameter

TYPES = {
    'bool': RosParameter.Type.BOOL,
    'int': RosParameter.Type.INTEGER,
    'double': RosParameter.Type.DOUBLE,
    'string': RosParameter.Type.STRING,
    'double_array': RosParameter.Type.DOUBLE_ARRAY,
    'string_array': RosParameter.Type.STRING_ARRAY,
}


def descriptor(parameter: Parameter, read_only: bool) -> ParameterDescriptor:
    """
    Return the ROS descriptor of a declared parameter.

    Typing is dynamic so that a wrong type reaches our own check, whose message names the
    parameter. Bounds are a ROS range only where a slider of rqt_reconfigure makes sense.
    """
    constraints = [parameter.allowed]
    if parameter.lengths:
        constraints.append(parameter.lengths)
    if parameter.logarithmic:
        constraints.append('logarithmic scale: change it by a factor')
    if not parameter.live and not read_only:
        constraints.append('fixed while the node is configured: set it after cleanup')
    result = ParameterDescriptor(
        name=parameter.name,
        type=TYPES[parameter.kind].value,
        description=parameter.text,
        additional_constraints='; '.join(constraints),
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
    for name, value in given.items():
        if is_built_in(name) and not isinstance(value, bool | int | float | str):
            raise ConfigurationError(f"parameter '{name}': expected one value, got {shown(value)}")
    return [RosParameter(name, value=v) for name, v in given.items() if is_built_in(name)]


class NodeParameters:
    """
    The parameters of a node: declared in ROS, and changed by its services.

    ROS has a copy of the values for its services; the node reads these ones. A live change is
    coerced and prepared as a set when it comes in (pre-set callback), refused or accepted before
    ROS takes it (on-set callback), and adopted afterwards (post-set callback).

    Parameters
    ----------
    node : Node
    values : Parameters
        Checked and complete; later the present ones.
    prepare : callable
        Gets all values as they would be, and the changes; returns what `adopt` needs, or raises
        ConfigurationError. Changes nothing.
    adopt : callable
        Gets what `prepare` has returned, once ROS has accepted the changes.
    fixed : iterable of str, optional
        Parameters that can't change in any state of the node; without it, those that are not live.

    """

    def __init__(
        self,
        node: Node,
        values: Parameters,
        prepare: Callable[[Parameters, Mapping[str, Value]], Any],
        adopt: Callable[[Any], None],
        fixed: Iterable[str] | None = None,
    ) -> None:
        self.values = values
        self._node = node
        self._prepare, self._adopt_change = prepare, adopt
        not_live = (name for name, parameter in values.table.items() if not parameter.live)
        self._read_only = set(not_live if fixed is None else fixed)
        self._refused: ConfigurationError | None = None
        self.extend(values)
        node.add_pre_set_parameters_callback(self._look_at)
        node.add_on_set_parameters_callback(self._check)
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
        self._refused, ours = None, [name for name in found if name in table]
        try:
            self._coerced = {name: table[name].coerce(found[name].value) for name in ours}
            for name in ours:
                for own in followers(name, self.values):
                    self._coerced.setdefault(own, self._coerced[name])
            if ours:
                self._next = Parameters(table, {**self.values, **self._coerced})
                self._prepared = self._prepare(self._next, self._coerced)
        except ConfigurationError as error:
            self._refused = error
            return parameters
        for name, value in self._coerced.items():
            found[name] = RosParameter(name, TYPES[table[name].kind], value)
        return list(found.values())

    def _check(self, parameters: list[RosParameter]) -> SetParametersResult:
        ours = [p.name for p in parameters if p.name in self.values.table]
        if not ours or self._refused is None:
            return SetParametersResult(successful=True)
        self._node.get_logger().warning(f'rejected: {self._refused}')
        for name in ours:  # rclpy has already put the rejected type there
            self._node.describe_parameter(name).type = TYPES[self.values.table[name].kind].value
        return SetParametersResult(successful=False, reason=str(self._refused))

    def _adopt(self, parameters: list[RosParameter]) -> None:
        if any(p.name in self.values.table for p in parameters):
            self.values = self._next
            self._adopt_change(self._prepared)
            text = ', '.join(f'{name} = {value}' for name, value in self._coerced.items())
            self._node.get_logger().info(f'set {text}')
