"""
Joints of one node: their names, and parameters that hold for all of them or for one.

A parameter of the actuator is declared once for all joints. Where the parameter ``joints`` names
them, each may have a value of its own beside it: ``left.actuator.remanence`` overrides
``actuator.remanence`` for the joint ``left``, and is not set unless somebody sets it.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
import re
from typing import Any

from rclpy.node import Node
from rclpy.parameter import Parameter

from hmsa_ros.errors import BadInputError
from hmsa_ros.interfaces.parameters import JOINT, ParameterSpec
from hmsa_ros.nodes.parameters import declare, declare_one, from_files

JOINTS = ParameterSpec(
    'joints', [],
    'Joint names, if there are several or if one has its own parameters, such as '
    'left.actuator.remanence; empty for the single joint named by joint.')

# A token of a ROS name: the joint is a part of the names of its topics.
_TOKEN = re.compile(r'[A-Za-z][A-Za-z0-9_]*')


def joint_names(values: Mapping[str, Any]) -> tuple[str, ...]:
    """
    Return the joints that ``joint`` and ``joints`` name: at least one, all different.

    Raises
    ------
    BadInputError
        If a name cannot be a part of a topic's name, or is there twice.

    """
    names = tuple(values[JOINTS.name]) or (str(values[JOINT.name]),)
    if not values[JOINTS.name]:
        return names
    for name in names:
        if not _TOKEN.fullmatch(name) or '__' in name or name.endswith('_'):
            raise BadInputError(
                f'parameter joints names {name!r}: expected letters, digits and single '
                'underscores, starting with a letter')
    for name in names:
        if names.count(name) > 1:
            raise BadInputError(
                f'parameter joints names {name!r} {names.count(name)} times: expected each '
                'joint once')
    return names


@dataclass(frozen=True)
class JointParameters:
    """Values of a node's parameters, for all joints and for each."""

    names: tuple[str, ...]  #: the joints
    #: what is declared, and set: an override that is not is missing; by full name
    specs: Mapping[str, ParameterSpec]
    values: Mapping[str, Any]
    own: frozenset[str]  #: parameters that a joint may have a value of its own for

    def __getitem__(self, name: str) -> Any:
        """Return the value for all joints."""
        return self.values[name]

    def of(self, joint: str) -> dict[str, Any]:
        """Return the values of one joint by name, its own before those for all."""
        return {
            name: self.values.get(f'{joint}.{name}', self.values[name])
            if name in self.own else self.values[name]
            for name in self.specs if name in self.values
            and (name in self.own or not self._is_override(name))}

    def each(self, make: Callable[[str, dict[str, Any]], Any]) -> dict[str, Any]:
        """
        Return by joint what is made of its name and values.

        Raises
        ------
        BadInputError
            If one is refused; it names the joint where there are several.

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

    def _is_override(self, name: str) -> bool:
        joint, _, rest = name.partition('.')
        return joint in self.names and rest in self.own

    def changed(self, parameters: Iterable[Parameter]) -> 'JointParameters':
        """Return a copy with parameters set and checked; those not declared here are skipped."""
        values = dict(self.values)
        for parameter in parameters:
            if parameter.name in self.specs:
                values[parameter.name] = self.specs[parameter.name].taken(parameter.value)
        return replace(self, values=values)


def declare_joints(
        node: Node, specs: Sequence[ParameterSpec],
        own: Sequence[ParameterSpec]) -> JointParameters:
    """
    Declare parameters, those of ``own`` once more for each joint; return their values.

    Raises
    ------
    BadInputError
        If a value has the wrong type or is out of range, or a joint's name cannot be one.

    """
    values = dict(declare(node, specs))
    names = joint_names(values)
    declared = {spec.name: spec for spec in specs}
    for joint in names if values[JOINTS.name] else ():
        filled = from_files(node, values, joint)
        for general in own:
            spec = replace(general, name=f'{joint}.{general.name}')
            declared[spec.name] = spec
            value = declare_one(node, spec, filled.get(general.name))
            if value is not None:
                values[spec.name] = spec.taken(value)
    return JointParameters(
        names, declared, values, frozenset(spec.name for spec in own))
