# SPDX-License-Identifier: Apache-2.0
"""From the declarations of the core to ROS parameters: descriptors, overrides, live changes."""

from collections.abc import Callable, Collection, Iterable, Mapping
from typing import Any

from fhaosmo_ros.core.parameters.declaration import (
    Parameter,
    Parameters,
    suggestion,
    Value,
)
from fhaosmo_ros.core.parameters.errors import ConfigurationError
from fhaosmo_ros.core.parameters.files import is_built_in
from fhaosmo_ros.core.parameters.yaml_text import parse
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
    parameter; the check accepts no other type. Bounds are a ROS range only where a slider of
    rqt_reconfigure makes sense; our own check holds all of them.
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
    if parameter.slider and parameter.kind == 'double':
        result.floating_point_range = [
            FloatingPointRange(from_value=float(parameter.lower), to_value=float(parameter.upper))
        ]
    elif parameter.slider:
        result.integer_range = [
            IntegerRange(from_value=int(parameter.lower), to_value=int(parameter.upper))
        ]
    return result


def overrides_of(node: Node) -> dict[str, Any]:
    """
    Return what files and the command line set, before anything is declared.

    The node was made with ``automatically_declare_parameters_from_overrides=True``: only so are
    names known that the node does not declare.
    """
    return {name: p.value for name, p in node.get_parameters_by_prefix('').items()}


def no_followers(_: Collection[str]) -> Mapping[str, str]:
    """Return no parameter that changes along with others."""
    return {}


class NodeParameters:
    """
    The parameters of a node: declared in ROS, and changed by its services.

    ROS has a copy of the values for its services; the node reads these ones. A live change is
    coerced once, when it comes in (pre-set callback); prepared as a set, and refused or accepted,
    before ROS takes it (on-set callback); and adopted afterwards (post-set callback).

    Parameters
    ----------
    node : Node
        Made with ``automatically_declare_parameters_from_overrides=True``.
    values : Parameters
        What `overrides_of` the node complete to.
    fixed : iterable of str
        Parameters that can't change in any state of the node.

    Attributes
    ----------
    values : Parameters
        The present values.

    """

    def __init__(self, node: Node, values: Parameters, fixed: Iterable[str]) -> None:
        self.values = values
        self._node = node
        self._coerced: dict[str, Value | ConfigurationError] = {}
        self._next: Parameters = values
        self._prepared: Any = None
        for name in overrides_of(node):
            if not is_built_in(name):  # declared as it came, without a descriptor
                node.undeclare_parameter(name)
        read_only = set(fixed)
        for name, value in values.items():
            node.declare_parameter(
                name,
                value,
                descriptor(values.table[name], name in read_only),
                ignore_override=True,
            )

    def on_change(
        self,
        prepare: Callable[[Parameters, Mapping[str, Value]], Any],
        adopt: Callable[[Any], None],
        followers: Callable[[Collection[str]], Mapping[str, str]] = no_followers,
    ) -> None:
        """
        Take live changes from now on.

        Parameters
        ----------
        prepare : callable
            Called with all values as they would be and with those that somebody sets, all of them
            checked; returns what `adopt` needs, or raises ConfigurationError. Changes nothing.
        adopt : callable
            Called with what `prepare` has returned, once ROS has accepted the changes.
        followers : callable
            Called with the names that somebody sets; returns the parameters that change along,
            and which of those names each of them follows.

        """
        self._prepare, self._adopt_change, self._followers = prepare, adopt, followers
        self._node.add_pre_set_parameters_callback(self._coerce)
        self._node.add_on_set_parameters_callback(self._check)
        self._node.add_post_set_parameters_callback(self._adopt)

    def _coerce(self, parameters: list[RosParameter]) -> list[RosParameter]:
        """Return the parameters, and those that follow, in their declared types if they fit."""
        table = self.values.table
        self._coerced = {}
        converted = {}
        for p in parameters:
            if not self._node.has_parameter(p.name):  # rclpy 7.1 refuses it too, without the name
                raise ParameterNotDeclaredException(f"'{p.name}'{suggestion(p.name, table)}")
            converted[p.name] = self._converted(p, table[p.name]) if p.name in table else p
        for name, leader in self._followers(list(converted)).items():
            self._coerced[name] = self._coerced[leader]
            converted[name] = RosParameter(name, converted[leader].type_, converted[leader].value)
        return list(converted.values())

    def _converted(self, parameter: RosParameter, declared: Parameter) -> RosParameter:
        """Return the parameter in its declared type, or as it is if `_check` is to refuse it."""
        try:
            value = declared.coerce(_read(parameter.value, declared))
        except ConfigurationError:
            self._coerced[parameter.name] = declared.error(parameter.value)
            return parameter
        self._coerced[parameter.name] = value
        return RosParameter(parameter.name, TYPES[declared.kind], value)

    def _changes(self, parameters: list[RosParameter]) -> dict[str, Value]:
        """Return those of our parameters among some that are set, as `_coerce` left them."""
        table, changes = self.values.table, {}
        for name in (p.name for p in parameters if p.name in table):
            value = self._coerced[name]
            if isinstance(value, ConfigurationError):
                raise value
            changes[name] = value
        return changes

    def _check(self, parameters: list[RosParameter]) -> SetParametersResult:
        table = self.values.table
        try:
            changes = self._changes(parameters)
            if changes:
                self._next = Parameters(table, {**self.values, **changes})
                self._prepared = self._prepare(self._next, changes)
        except ConfigurationError as error:
            self._node.get_logger().warning(f'rejected: {error}')
            for p in parameters:
                if p.name in table:  # rclpy has already put the rejected type there
                    kind = table[p.name].kind
                    self._node.describe_parameter(p.name).type = TYPES[kind].value
            return SetParametersResult(successful=False, reason=str(error))
        return SetParametersResult(successful=True)

    def _adopt(self, parameters: list[RosParameter]) -> None:
        changes = self._changes(parameters)
        if changes:
            self.values = self._next
            self._adopt_change(self._prepared)
            text = ', '.join(f'{name} = {value}' for name, value in changes.items())
            self._node.get_logger().info(f'set {text}')


def _read(value: Any, declared: Parameter) -> Any:
    """Return the number in a text: `ros2 param set` sends 1e-3 as one."""
    if isinstance(value, str) and declared.kind == 'double':
        try:
            return parse(value)
        except ConfigurationError:
            pass
    return value
