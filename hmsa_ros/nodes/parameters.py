"""
Declaration of ROS parameters on a node, each from its `ParameterSpec`.

The files under ``config/`` are held against them by a test.
"""

from collections.abc import Iterable, Mapping
import difflib
from importlib import import_module
import math
from typing import Any

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.exceptions import ParameterException
from rclpy.node import Node

from hmsa_ros.contract import topics
from hmsa_ros.contract.actuator import completed
from hmsa_ros.contract.parameters import FIXED, LAW, ParameterSpec
from hmsa_ros.errors import BadInputError

# What hmsa identify once wrote beside the rest.
_ONCE = {'identification.verdict', 'identification.noise_std'}


def descriptor(spec: ParameterSpec) -> ParameterDescriptor:
    """Return the descriptor that ``ros2 param describe`` shows."""
    text = f'{spec.description} [{spec.unit}]' if spec.unit else spec.description
    descriptor = ParameterDescriptor(description=text, read_only=spec.read_only)
    # An empty list says nothing of its type: rclpy would take it for one of bytes and
    # refuse every other. `declare` checks instead.
    descriptor.dynamic_typing = isinstance(spec.default, list)
    if spec.choices:
        descriptor.additional_constraints = 'one of: ' + ', '.join(spec.choices)
    if descriptor.dynamic_typing or (spec.minimum is None and spec.maximum is None):
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


def declare_one(node: Node, spec: ParameterSpec, default: Any) -> Any:
    """
    Declare a parameter with a default, or with a type and without a value; return its value.

    Raises
    ------
    BadInputError
        If a value from the command line or a file has the wrong type.

    """
    try:
        # The range is checked by `ParameterSpec`, whose message names what was expected; rclpy's
        # does not.
        return node.declare_parameter(spec.name, default, descriptor(spec)).value
    except ParameterException as error:
        override = node._parameter_overrides.get(spec.name)
        got = 'a value of another kind' if override is None else repr(override.value)
        expected = type(spec.default).__name__
        if spec.minimum is not None or spec.maximum is not None:
            expected += f', {spec.range_text()}'
        raise BadInputError(f'parameter {spec.name} is {got}: expected {expected}') from error


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
               if not node.has_parameter(x) and not x.startswith('qos_overrides.')]
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
