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
from hmsa_ros.contract.actuator import actuator_from, completed
from hmsa_ros.contract.parameters import (
    BLOCK,
    FIXED,
    INITIAL_STRETCH,
    JOINT,
    LAW,
    ParameterSpec,
)
from hmsa_ros.errors import BadInputError

__all__ = [
    'actuator_from', 'BLOCK', 'check_names', 'declare', 'descriptor', 'from_files',
    'INITIAL_STRETCH', 'JOINT', 'ParameterSpec', 'refusal']


# What hmsa identify once wrote beside the rest.
_ONCE = {'identification.verdict', 'identification.noise_std'}


def descriptor(spec: ParameterSpec) -> ParameterDescriptor:
    """
    Return the descriptor that ``ros2 param describe`` shows.

    Parameters
    ----------
    spec : ParameterSpec
        What is declared.

    Returns
    -------
    rcl_interfaces.msg.ParameterDescriptor
        With description, range and additional constraints.

    """
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
    Declare parameters on a node and return their values.

    Parameters
    ----------
    node : rclpy.node.Node
        Node to declare on.
    specs : iterable of ParameterSpec
        What to declare.

    Returns
    -------
    mapping of str to object
        Values by name.

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
        try:
            # The range is checked by `check`, whose message names what was expected; rclpy's
            # does not.
            value = node.declare_parameter(
                spec.name, (filled or {}).get(spec.name, spec.default),
                descriptor(spec)).value
        except ParameterException as error:
            raise refusal(node, spec) from error
        values[spec.name] = spec.taken(value)
    return values


def from_files(node: Node, values: Mapping[str, Any], joint: str = '') -> Mapping[str, Any]:
    """
    Return constants of the law out of a file which the start values name.

    As parameters they are recorded with the rest: a bag can be verified without the file.

    Parameters
    ----------
    node : rclpy.node.Node
        Whose start values count.
    values : mapping of str to object
        Declared so far.
    joint : str
        Whose own values go before those for all; nothing is read where it has none.

    Returns
    -------
    mapping of str to object
        By name, without the joint.

    Raises
    ------
    BadInputError
        If the file cannot be used.

    """
    given = {spec.name: found.value for spec in LAW if (found := node._parameter_overrides.get(
        f'{joint}.{spec.name}' if joint else spec.name)) is not None}
    if joint and not given:
        return {}
    lists = {x.name for x in LAW if isinstance(x.default, list)}
    return completed({
        name: value for name, value in values.items() if not joint or name not in lists} | given)


def check_names(node: Node) -> None:
    """
    Refuse start values of parameters that there are not, as a mistyped name gives them.

    Files may have sections for several nodes, so that names of other nodes of the package pass.

    Parameters
    ----------
    node : rclpy.node.Node
        With all its parameters declared.

    Raises
    ------
    BadInputError
        If a name is unknown; the nearest one is suggested.

    """
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


def refusal(node: Node, spec: ParameterSpec) -> BadInputError:
    """
    Return the error for a start value that rclpy has refused.

    Parameters
    ----------
    node : rclpy.node.Node
        On which it was to be declared.
    spec : ParameterSpec
        What was to be declared.

    Returns
    -------
    BadInputError
        To raise.

    """
    override = node._parameter_overrides.get(spec.name)
    got = 'a value of another kind' if override is None else repr(override.value)
    expected = type(spec.default).__name__
    if spec.minimum is not None or spec.maximum is not None:
        expected += f', {spec.range_text()}'
    return BadInputError(f'parameter {spec.name} is {got}: expected {expected}')
