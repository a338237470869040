"""
Declaration of ROS parameters on a node, each from its `ParameterSpec`.

The files under ``config/`` are held against them by a test.
"""

from collections.abc import Iterable, Mapping
import difflib
from importlib import import_module
import math
import re
from typing import Any
from weakref import WeakKeyDictionary

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.exceptions import ParameterException
from rclpy.node import Node
from rclpy.parameter import Parameter

from hmsa_ros.errors import BadInputError
from hmsa_ros.interfaces import topics
from hmsa_ros.interfaces.actuator import completed
from hmsa_ros.interfaces.parameters import FIXED, LAW, ParameterSpec, present_name

# What hmsa identify once wrote beside the rest.
_ONCE = {'identification.verdict', 'identification.noise_std'}
# What PyYAML takes for a text.
_POWER = re.compile(r'[+-]?\d+e[+-]\d+')
_DECLARED: WeakKeyDictionary[Node, dict[str, ParameterSpec]] = WeakKeyDictionary()


def descriptor(spec: ParameterSpec) -> ParameterDescriptor:
    """Return the descriptor that ``ros2 param describe`` shows."""
    text = f'{spec.description} [{spec.unit}]' if spec.unit else spec.description
    descriptor = ParameterDescriptor(description=text, read_only=spec.read_only)
    if spec.choices:
        descriptor.additional_constraints = 'one of: ' + ', '.join(spec.choices)
    if isinstance(spec.default, list) or (spec.minimum is None and spec.maximum is None):
        return descriptor
    if isinstance(spec.default, int):
        descriptor.integer_range = [IntegerRange(
            from_value=int(-2**63 if spec.minimum is None else spec.minimum),
            to_value=int(2**63 - 1 if spec.maximum is None else spec.maximum), step=0)]
    else:
        descriptor.floating_point_range = [FloatingPointRange(
            from_value=-math.inf if spec.minimum is None else spec.minimum,
            to_value=math.inf if spec.maximum is None else spec.maximum, step=0.0)]
    return descriptor


def declare(node: Node, specs: Iterable[ParameterSpec]) -> Mapping[str, Any]:
    """
    Declare parameters on a node and return their values by name.

    Raises
    ------
    BadInputError
        If a value from the command line or a file has the wrong type or is out of range.

    """
    values: dict[str, Any] = {}
    filled: Mapping[str, Any] | None = None
    for spec in specs:
        if filled is None and spec.name in FIXED:
            filled = from_files(node, values)
        values[spec.name] = spec.taken(
            declare_one(node, spec, (filled or {}).get(spec.name, spec.default)))
    return values


def type_of(spec: ParameterSpec) -> Parameter.Type:
    """Return the type of a parameter in ROS."""
    if not isinstance(spec.default, list):
        return Parameter.Type.from_parameter_value(spec.default)
    return Parameter.Type.DOUBLE_ARRAY if spec.items is float else Parameter.Type.STRING_ARRAY


def typed(spec: ParameterSpec, given: Parameter) -> Parameter:
    """
    Return what is given as a parameter of the type declared, or as it is if it cannot be one.

    The tools of ROS guess the type from the text: that of an empty list is unknown, ``off`` is a
    truth value, and 5e-05 a text.
    """
    value = given.value
    if type(spec.default) is float and isinstance(value, str) and _POWER.fullmatch(value):
        return Parameter(spec.name, value=float(value))
    try:
        value = spec.taken(value)
    except BadInputError:
        return given
    if isinstance(spec.default, (list, str)):
        return Parameter(spec.name, type_of(spec), value)
    return given


def declare_one(node: Node, spec: ParameterSpec, default: Any = None) -> Any:
    """
    Declare a parameter with a default, or without one and then perhaps a value; return its value.

    Raises
    ------
    BadInputError
        If a value from the command line or a file has the wrong type.

    """
    specs, overrides = _declared(node), node._parameter_overrides
    specs[spec.name] = spec
    if spec.name in overrides:
        overrides[spec.name] = typed(spec, overrides[spec.name])
    if isinstance(spec.default, list):
        node.declare_parameter(
            spec.name, type_of(spec), descriptor(spec), ignore_override=True)
        value = overrides[spec.name].value if spec.name in overrides else default
        if value is None:
            return None
        # rclpy would take an empty list for one of bytes.
        node._parameters[spec.name] = Parameter(spec.name, type_of(spec), spec.taken(value))
        return value
    try:
        # The range is checked by `ParameterSpec`, whose message names what was expected; rclpy's
        # does not.
        return node.declare_parameter(
            spec.name, type_of(spec) if default is None else default, descriptor(spec)).value
    except ParameterException as error:
        override = overrides.get(spec.name)
        got = 'a value of another kind' if override is None else repr(override.value)
        expected = type(spec.default).__name__
        if spec.minimum is not None or spec.maximum is not None:
            expected += f', {spec.range_text()}'
        raise BadInputError(f'parameter {spec.name} is {got}: expected {expected}') from error


def _declared(node: Node) -> dict[str, ParameterSpec]:
    """Return what is declared on a node by name; what is set later gets the types of these."""
    if node not in _DECLARED:
        specs = _DECLARED[node] = {}
        node.add_pre_set_parameters_callback(lambda given: [
            typed(specs[x.name], x) if x.name in specs else x for x in given])
    return _DECLARED[node]


def from_files(node: Node, values: Mapping[str, Any], joint: str = '') -> Mapping[str, Any]:
    """Return constants of the law out of a file which the start values name, by plain name."""
    # As parameters they are recorded with the rest: a bag can be verified without the file. Of a
    # joint, own values go before those for all; nothing is read where it has none.
    given = {spec.name: found.value for spec in LAW if (found := node._parameter_overrides.get(
        f'{joint}.{spec.name}' if joint else spec.name)) is not None}
    if joint and not given:
        return {}
    lists = {x.name for x in LAW if isinstance(x.default, list)}
    return completed({
        name: value for name, value in values.items() if not joint or name not in lists} | given)


def check_former_names(names: Iterable[str]) -> None:
    """Refuse names that parameters had in earlier versions by `BadInputError`."""
    for name in names:
        if (new := present_name(name)) != name:
            raise BadInputError(f'parameter {name} has been renamed: expected {new}')


def check_names(node: Node) -> None:
    """
    Refuse start values of parameters that a node, all of whose are declared, does not have.

    Raises
    ------
    BadInputError
        If a name is unknown; the nearest one is suggested.

    """
    # Files may have sections for several nodes: names of other nodes of the package pass.
    unknown = [x for x in node._parameter_overrides
               if not node.has_parameter(x) and not x.startswith('qos_overrides.')
               # Of the driver, which gives them to a laboratory's class.
               and 'hardware' not in x.split('.')[:2]]
    if not unknown:
        return
    others = {spec.name for name in topics.NODES
              for spec in import_module(f'hmsa_ros.nodes.{name}').PARAMETERS} | _ONCE
    joints = node.get_parameter('joints').value or () if node.has_parameter('joints') else None
    for name in unknown:
        joint, _, rest = name.partition('.')
        # A recorder has no parameter that would say which joints there are.
        if name in others or rest in others and (joints is None or joint in joints):
            continue
        near = difflib.get_close_matches(name, [*node._parameters, *others], 1, 0.0)
        raise BadInputError(
            f'parameter {name} does not exist: expected one of the {node.get_name()}, such as '
            f'{near[0]}')
