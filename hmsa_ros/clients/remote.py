"""Blocking access to the parameters of a running node."""

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from difflib import get_close_matches
from typing import Any

from rcl_interfaces.msg import Parameter, ParameterType
from rcl_interfaces.srv import (
    GetParameters,
    GetParameterTypes,
    ListParameters,
    SetParametersAtomically,
)
from rclpy.exceptions import InvalidTopicNameException
from rclpy.parameter import get_parameter_value, parameter_value_to_python
from rclpy.validate_topic_name import validate_topic_name

from hmsa.errors import BadInputError
from hmsa_ros.nodes.temporary_node import ServiceCall, TemporaryNode


def _ask(
        client: TemporaryNode, name: str, kind: Any, service: str,
        each: Callable[[], None] | None = None, **request: Any) -> Any:
    """Return a node's response to a request."""
    return client.ask(
        ServiceCall(client.node, kind, f'{name}/{service}', kind.Request(**request)),
        f'no node {name} in namespace {client.node.get_namespace()} replies: expected '
        'one that runs, with the same ROS_DOMAIN_ID and ROS_AUTOMATIC_DISCOVERY_RANGE as here',
        each, f'a reply of node {name} in namespace {client.node.get_namespace()} (does it run?)')


def remote_parameters(
        client: TemporaryNode, name: str, names: Sequence[str] = (),
        each: Callable[[], None] | None = None) -> dict[str, Any]:
    """
    Return parameters of a node by name, by default all of them; None if not set.

    ``each`` is called while waiting.

    Raises
    ------
    BadInputError
        If the node lacks one of the parameters.
    HmsaError
        If the node does not reply.

    """
    known = list(_ask(client, name, ListParameters, 'list_parameters', each).result.names)
    if unknown := [x for x in names if x not in known]:
        near = get_close_matches(unknown[0], known, cutoff=0.5)
        raise BadInputError(
            f'{name} has no parameter {unknown[0]!r}: expected '
            + (f'{" or ".join(near)}; ' if near else 'another; ')
            + f'hmsa param get {name} lists all')
    wanted = sorted(names or known)
    types = _ask(
        client, name, GetParameterTypes, 'get_parameter_types', each, names=wanted).types
    # rclpy returns nothing at all if one of them is not set.
    there = [x for x, kind in zip(wanted, types, strict=True)
             if kind != ParameterType.PARAMETER_NOT_SET]
    values = _ask(client, name, GetParameters, 'get_parameters', each, names=there).values
    return dict.fromkeys(wanted) | {
        x: parameter_value_to_python(y) for x, y in zip(there, values, strict=True)}


class RemoteNode(TemporaryNode):
    """
    The parameters of one node; a context manager.

    Parameters
    ----------
    name : str
        Name of the node.
    namespace : str
        Namespace of the node.
    timeout : float
        Time limit in s.

    Raises
    ------
    BadInputError
        If the name is not a valid node name.

    """

    def __init__(self, name: str, namespace: str = '', timeout: float = 10.0) -> None:
        try:
            validate_topic_name(name)
        except InvalidTopicNameException as error:
            raise BadInputError(
                f'node is {name!r}: expected the name of a node before that of a parameter, as '
                'in planner law.name') from error
        super().__init__('parameters', namespace, timeout)
        self._name = name

    def get(self, names: Sequence[str] = ()) -> dict[str, Any]:
        """Return parameters by name, by default all of them; see `remote_parameters`."""
        return remote_parameters(self, self._name, names)

    def set(self, name: str, text: str) -> tuple[Any, Any]:
        """Change a parameter as `set_all` does; return the values before and after."""
        before = self.set_all({name: text})[name]
        return before, self.get([name])[name]

    def set_all(self, texts: Mapping[str, str]) -> dict[str, Any]:
        """
        Change parameters to values in YAML syntax, all or none; return the previous values.

        Raises
        ------
        BadInputError
            If the node refuses them, with its reason.
        HmsaError
            If the node does not reply.

        """
        if not texts:
            return {}
        before = self.get(list(texts))
        result = _ask(
            self, self._name, SetParametersAtomically, 'set_parameters_atomically', parameters=[
                Parameter(name=x, value=_value(text, before[x]))
                for x, text in texts.items()]).result
        if not result.successful:
            given = ', '.join(f'{x} {y}' for x, y in texts.items())
            raise BadInputError(f'{self._name} refused {given}: {result.reason}')
        return before


def _value(text: str, before: Any) -> Any:
    """Return a value of the previous type; 1 and 5e3, no floats in YAML, serve as floats."""
    value = get_parameter_value(text)
    if isinstance(before, str):
        value.type, value.string_value = ParameterType.PARAMETER_STRING, text
    elif isinstance(before, float):
        with suppress(ValueError):
            value.type, value.double_value = ParameterType.PARAMETER_DOUBLE, float(text)
    elif isinstance(before, list) and all(isinstance(x, float) for x in before):
        with suppress(ValueError):
            numbers = filter(str.strip, text.strip(' []').split(','))
            value.double_array_value = [float(x) for x in numbers]
            value.type = ParameterType.PARAMETER_DOUBLE_ARRAY
    return value
