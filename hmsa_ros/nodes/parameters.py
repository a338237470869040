"""
ROS parameters of a node, each declared from its `ParameterSpec`, for all joints or for one.

A test compares the files under ``config/`` with them. A parameter of the actuator is declared once
for all joints. If the parameter ``joints`` names them, each joint may override it:
``left.actuator.remanence`` takes precedence over ``actuator.remanence`` for the joint ``left``. An
override has no value until it is set.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
import math
from pathlib import Path
import re
from typing import Any
from weakref import WeakKeyDictionary

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.exceptions import ParameterException
from rclpy.node import Node
from rclpy.parameter import Parameter

from hmsa.bag.limits import load_yaml
from hmsa.errors import BadInputError, HmsaError, listed, nearest
from hmsa.files import read_at_most
from hmsa.interfaces import topics
from hmsa.interfaces.actuator import completed
from hmsa.interfaces.parameters import (
    FIXED,
    is_for,
    JOINT,
    LAW,
    ParameterSpec,
    present_name,
    sections_of,
    SENSOR_LATENCY,
)
from hmsa.plugins import NODES, registered

# A parameter file that is larger is not looked at again.
_LARGEST_FILE = 1 << 20
# Characters of an unknown name that are reported.
_LONGEST_NAME = 200
# Names that hmsa identify writes, or wrote in earlier versions, and no node declares.
_ONCE = {SENSOR_LATENCY, 'identification.verdict', 'identification.noise_std'}
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
    Declare parameters on a node, unless they are, and return their values by name.

    Raises
    ------
    BadInputError
        If a value from the command line or a file has the wrong type or is out of range.

    """
    values: dict[str, Any] = {}
    filled: Mapping[str, Any] | None = None
    for spec in specs:
        if node.has_parameter(spec.name):
            continue
        if filled is None and spec.name in FIXED:
            filled = from_files(node, values)
        values[spec.name] = declare_one(node, spec, (filled or {}).get(spec.name, spec.default))
    return values


def type_of(spec: ParameterSpec) -> Parameter.Type:
    """Return the type of a parameter in ROS."""
    if not isinstance(spec.default, list):
        return Parameter.Type.from_parameter_value(spec.default)
    return Parameter.Type.DOUBLE_ARRAY if spec.items is float else Parameter.Type.STRING_ARRAY


def typed(spec: ParameterSpec, given: Parameter) -> Parameter:
    """
    Return a given parameter with its declared type, or unchanged if it cannot be converted.

    The ROS tools infer the type from the text: an empty list has no type, ``off`` is a boolean,
    2 is no floating-point number, and 5e-05 is a text.
    """
    try:
        value = spec.taken(given.value)
    except BadInputError:
        return given
    if isinstance(spec.default, (list, str, float)):
        return Parameter(spec.name, type_of(spec), value)
    return given


def declare_one(node: Node, spec: ParameterSpec, default: Any = None) -> Any:
    """
    Declare a parameter and return its value; None if it has neither default nor value.

    Raises
    ------
    BadInputError
        If a value from the command line or a file has the wrong type or is out of range.

    """
    _declared(node)[spec.name] = spec
    overrides, kind = node._parameter_overrides, type_of(spec)
    if spec.name in overrides:
        overrides[spec.name] = typed(spec, overrides[spec.name])
    if isinstance(spec.default, list):
        node.declare_parameter(spec.name, kind, descriptor(spec), ignore_override=True)
        value = overrides[spec.name].value if spec.name in overrides else default
        if value is not None:
            value = spec.taken(value)
            # rclpy would read an empty list as one of bytes.
            node._parameters[spec.name] = Parameter(spec.name, kind, value)
        return value
    try:
        value = node.declare_parameter(
            spec.name, kind if default is None else default, descriptor(spec)).value
    except ParameterException as error:
        # The message of rclpy does not state the expected type.
        expected = type(spec.default).__name__
        if spec.minimum is not None or spec.maximum is not None:
            expected += f', {spec.range_text()}'
        raise BadInputError(
            f'parameter {spec.name} is {overrides[spec.name].value!r}: expected {expected}'
        ) from error
    return None if value is None else spec.taken(value)


def _declared(node: Node) -> dict[str, ParameterSpec]:
    """Return the declared parameters of a node by name, to which later values are converted."""
    if node not in _DECLARED:
        specs = _DECLARED[node] = {}
        node.add_pre_set_parameters_callback(lambda given: [
            typed(specs[x.name], x) if x.name in specs else x for x in given])
    return _DECLARED[node]


def checked(node: Node, given: Iterable[Parameter]) -> dict[str, Any]:
    """
    Return given values of a node's declared parameters by name, as the node uses them.

    Raises
    ------
    BadInputError
        If a value has the wrong type, is out of range or is not one of the choices.

    """
    specs = _declared(node)
    return {x.name: specs[x.name].taken(x.value) for x in given if x.name in specs}


def from_files(node: Node, values: Mapping[str, Any], joint: str = '') -> Mapping[str, Any]:
    """Return constants of the law, by plain name, from a file named by the start values."""
    # As parameters, they are recorded with the others, and a bag can be verified without the file.
    # Values of a joint take precedence; a joint without its own values reads no file.
    given = {spec.name: found.value for spec in LAW if (found := node._parameter_overrides.get(
        f'{joint}.{spec.name}' if joint else spec.name)) is not None}
    if joint and not given:
        return {}
    if any(given.get(x) for x in FIXED):
        # Changed to this law while it runs, the node would stop for this import of 1.7 s.
        import hmsa.model.laws.curve  # noqa: F401
    lists = {x.name for x in LAW if isinstance(x.default, list)}
    return completed({
        name: value for name, value in values.items() if not joint or name not in lists} | given)


def check_former_names(names: Iterable[str]) -> None:
    """Raise `BadInputError` for parameter names of earlier versions."""
    for name in names:
        if (new := present_name(name)) != name:
            raise BadInputError(f'parameter {name} has been renamed: expected {new}')


def check_names(node: Node) -> None:
    """
    Check that a node, which has declared all its parameters, has those with a start value.

    Raises
    ------
    BadInputError
        If a name is unknown; the closest one is suggested.

    """
    # Files may have sections for several nodes: names of other nodes of the package pass.
    strange = [x for x in node._parameter_overrides
               if not node.has_parameter(x) and not x.startswith('qos_overrides.')
               # Parameters of the driver's hardware class.
               and 'hardware' not in x.split('.')[:2]]
    if not strange:
        return
    nodes = registered(NODES)
    others = {spec.name for name in topics.NODES for spec in nodes[name].load().PARAMETERS} | _ONCE
    joints = node.get_parameter('joints').value or () if node.has_parameter('joints') else None
    for name in strange:
        joint, _, rest = name.partition('.')
        # A recorder has no parameter that lists the joints.
        if name in others or rest in others and (joints is None or joint in joints):
            continue
        raise unknown(node, name, others)


def unread_files(arguments: Sequence[str], nodes: Sequence[str]) -> Iterator[str]:
    """Yield a sentence for each given parameter file without a section for one of the nodes."""
    for option, name in zip(arguments, arguments[1:], strict=False):
        if option != '--params-file':
            continue
        path = Path(name)
        try:
            if not path.is_file():
                continue  # a pipe, which is read once
            text = read_at_most(path, _LARGEST_FILE, 'a parameter file')
            found = [x for x, _ in sections_of(load_yaml(text.decode('utf-8')))]
        except (HmsaError, OSError, ValueError):
            continue  # which ROS 2 has read in its own way
        if not any(is_for(x, node) for x in found for node in nodes):
            keys = ' and '.join(f'{x}:' for x in nodes)
            keep = 'keeps its' if len(nodes) == 1 else 'keep their'
            yield (
                f'{path} has no parameters for {" and ".join(nodes)}, which {keep} defaults: its '
                f'sections are {listed(found) or "none"}, expected {keys} or /**:')


def unknown(node: Node, name: str, others: Iterable[str] = ()) -> BadInputError:
    """Return the error of an unknown name, with the closest one of the node or ``others``."""
    near = nearest(name, [*node.get_parameters_by_prefix(''), *others])
    return BadInputError(
        f'parameter {name[:_LONGEST_NAME]} does not exist: expected one of the {node.get_name()}, '
        f'such as {near}')


JOINTS = ParameterSpec(
    'joints', [],
    'Joint names, if there are several or if one has its own parameters, such as '
    'left.actuator.remanence; empty for the single joint named by joint.')

# A token of a ROS name, since joint names are parts of topic names.
_TOKEN = re.compile(r'[A-Za-z][A-Za-z0-9_]*')


def joint_names(values: Mapping[str, Any]) -> tuple[str, ...]:
    """
    Return the joints named by ``joint`` and ``joints``: at least one, all different.

    Raises
    ------
    BadInputError
        If a name cannot be part of a topic name, or is repeated.

    """
    names = tuple(values[JOINTS.name])
    for name in names:
        if not _TOKEN.fullmatch(name) or '__' in name or name.endswith('_'):
            raise BadInputError(
                f'parameter joints names {name!r}: expected letters, digits and single '
                'underscores, starting with a letter')
        if names.count(name) > 1:
            raise BadInputError(
                f'parameter joints names {name!r} {names.count(name)} times: expected each '
                'joint once')
    return names or (str(values[JOINT.name]),)


@dataclass(frozen=True)
class JointParameters:
    """Values of a node's parameters, for all joints and for each one."""

    names: tuple[str, ...]  #: the joints
    values: Mapping[str, Any]  #: by full name; an override that is not set is missing

    def __getitem__(self, name: str) -> Any:
        """Return the value for all joints."""
        return self.values[name]

    def of(self, joint: str) -> dict[str, Any]:
        """Return the values of one joint by name, where its own values take precedence."""
        found = {}
        for name, value in self.values.items():
            of, _, rest = name.partition('.')
            if of not in self.names or rest not in self.values:
                found[name] = self.values.get(f'{joint}.{name}', value)
        return found

    def each(self, make: Callable[[str, dict[str, Any]], Any]) -> dict[str, Any]:
        """
        Return the results of a function of name and values, by joint.

        Raises
        ------
        BadInputError
            If a joint's values are refused; the message names the joint if there are several.

        """
        found = {}
        for name in self.names:
            try:
                found[name] = make(name, self.of(name))
            except BadInputError as error:
                if len(self.names) == 1:
                    raise
                raise BadInputError(f'joint {name}: {error}') from error
        return found

    def changed(self, given: Mapping[str, Any]) -> 'JointParameters':
        """Return a copy with changed values, by full name."""
        return replace(self, values={**self.values, **given})


def declare_joints(
        node: Node, specs: Sequence[ParameterSpec],
        own: Sequence[ParameterSpec]) -> JointParameters:
    """
    Declare parameters, those of ``own`` also for each joint; return their values.

    Raises
    ------
    BadInputError
        If a value has the wrong type or is out of range, or a joint has an invalid name.

    """
    values = dict(declare(node, specs))
    names = joint_names(values)
    for joint in names if values[JOINTS.name] else ():
        filled = from_files(node, values, joint)
        for general in own:
            spec = replace(general, name=f'{joint}.{general.name}')
            value = declare_one(node, spec, filled.get(general.name))
            if value is not None:
                values[spec.name] = value
    return JointParameters(names, values)
