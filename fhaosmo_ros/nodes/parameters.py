# SPDX-License-Identifier: Apache-2.0
"""From the declarations of the core to ROS parameters: descriptors, overrides, live changes."""

from collections.abc import Callable, Iterable, Mapping
from typing import Any

from fhaosmo_ros.core.errors import ConfigurationError
from fhaosmo_ros.core.parameter import Parameter, ParameterTable, suggestion
from fhaosmo_ros.core.parameter_file import is_built_in, parse, select
from rcl_interfaces.msg import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    SetParametersResult,
)
from rclpy.exceptions import ParameterNotDeclaredException
from rclpy.node import Node
from rclpy.parameter import Parameter as RosParameter
import yaml

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
    parameter; the check lets no other type through.
    """
    constraints = parameter.allowed + (f'; {parameter.lengths}' if parameter.lengths else '')
    result = ParameterDescriptor(
        name=parameter.name,
        type=TYPES[parameter.kind].value,
        description=parameter.text,
        additional_constraints=constraints,
        read_only=read_only,
        dynamic_typing=True,
    )
    if parameter.lower is not None and parameter.upper is not None:
        if parameter.kind == 'double':
            bounds = FloatingPointRange(
                from_value=float(parameter.lower), to_value=float(parameter.upper)
            )
            result.floating_point_range = [bounds]
        elif parameter.kind == 'int':
            result.integer_range = [
                IntegerRange(from_value=int(parameter.lower), to_value=int(parameter.upper))
            ]
    return result


def overrides_of(node: Node) -> dict[str, Any]:
    """Return what files and the command line set, before it is declared."""
    return {name: p.value for name, p in node.get_parameters_by_prefix('').items()}


def declare(
    node: Node,
    table: ParameterTable,
    check: Callable[[Mapping[str, Any]], None],
    fixed: Iterable[str] | None = None,
) -> dict[str, Any]:
    """
    Declare a table's parameters on a node and return their values.

    Parameters
    ----------
    node : Node
        Made with ``automatically_declare_parameters_from_overrides=True``: so the names that
        nobody declared can be told.
    table : ParameterTable
        What to declare.
    check : callable
        Gets all values before anything is declared; raises ConfigurationError.
    fixed : names, optional
        Parameters that can't change in any state of the node: by default those that are not live.

    Raises
    ------
    ConfigurationError
        An unknown name or a bad value among the overrides.

    """
    overrides = overrides_of(node)
    values: dict[str, Any] = table.defaults() | select(overrides, table)
    check(values)
    for name in overrides:
        if not is_built_in(name):  # declared as it came, without a descriptor
            node.undeclare_parameter(name)
    fixed = [n for n, p in table.items() if not p.live] if fixed is None else list(fixed)
    for name, parameter in table.items():
        node.declare_parameter(
            name, values[name], descriptor(parameter, name in fixed), ignore_override=True
        )
    return values


def values_of(node: Node, table: ParameterTable) -> dict[str, Any]:
    """Return the present values of a table's parameters, in their own types."""
    return {name: p.coerce(node.get_parameter(name).value) for name, p in table.items()}


def on_change(
    node: Node,
    table: ParameterTable,
    check: Callable[[Mapping[str, Any]], None],
    apply: Callable[[Mapping[str, Any]], None],
    complete: Callable[[list[RosParameter]], list[RosParameter]] = list,
) -> None:
    """
    Connect live changes: values are brought into their type, checked as a set, applied.

    Parameters
    ----------
    check : callable
        Gets the changes; raises ConfigurationError and changes nothing.
    apply : callable
        Gets the same changes once ROS has accepted all of them.
    complete : callable
        Gets what somebody wants to set; returns it with what is to change along.

    """

    def convert(parameters: list[RosParameter]) -> list[RosParameter]:
        for p in parameters:
            if not node.has_parameter(p.name):  # rclpy 7.1 refuses it too, but loses the name
                raise ParameterNotDeclaredException(f"'{p.name}'{suggestion(p.name, table)}")
        return complete([_converted(p, table) for p in parameters])

    def validate(parameters: list[RosParameter]) -> SetParametersResult:
        try:
            check(_values(parameters, table))
        except ConfigurationError as error:
            node.get_logger().warning(f'rejected: {error}')
            for p in parameters:
                if p.name in table:  # rclpy has already put the rejected type there
                    node.describe_parameter(p.name).type = TYPES[table[p.name].kind].value
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def adopt(parameters: list[RosParameter]) -> None:
        changes = _values(parameters, table)
        if changes:
            apply(changes)
            text = ', '.join(f'{name} = {value}' for name, value in changes.items())
            node.get_logger().info(f'set {text}')

    node.add_pre_set_parameters_callback(convert)
    node.add_on_set_parameters_callback(validate)
    node.add_post_set_parameters_callback(adopt)


def _values(parameters: list[RosParameter], table: ParameterTable) -> dict[str, Any]:
    ours = {p.name: p.value for p in parameters if p.name in table}
    return dict(table.coerce(ours))


def _converted(parameter: RosParameter, table: ParameterTable) -> RosParameter:
    """Return the parameter in its declared type where the value allows it, else as it is."""
    declared = table.get(parameter.name)
    if declared is None:
        return parameter
    try:
        value = declared.coerce(_read(parameter.value, declared))
    except ConfigurationError:
        return parameter  # the check that follows says why
    return RosParameter(parameter.name, TYPES[declared.kind], value)


def _read(value: Any, declared: Parameter) -> Any:
    """Return the numbers in a text: `ros2 param set` sends 1e-3 as one."""
    if isinstance(value, str) and declared.kind in ('double', 'double_array'):
        try:
            return parse(value)
        except yaml.YAMLError:
            pass
    return value
