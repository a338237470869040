"""Parameters of a running node, read and changed while its caller waits."""

from collections.abc import Mapping, Sequence
from contextlib import suppress
from difflib import get_close_matches
from typing import Any

from rcl_interfaces.msg import Parameter, ParameterType
from rcl_interfaces.srv import GetParameters, ListParameters, SetParametersAtomically
from rclpy.exceptions import InvalidTopicNameException
from rclpy.parameter import get_parameter_value, parameter_value_to_python
from rclpy.validate_topic_name import validate_topic_name

from hmsa_ros.errors import BadInputError
from hmsa_ros.nodes.service_call import ServiceCall
from hmsa_ros.nodes.visitor import Visitor

_SLICE_SECONDS = 0.05


class RemoteNode(Visitor):
    """
    The parameters of one node; a context manager.

    Parameters
    ----------
    name : str
        Name of the node.
    namespace : str
        Its namespace.
    timeout : float
        Patience in s.

    Raises
    ------
    BadInputError
        If no node can have that name.

    """

    def __init__(self, name: str, namespace: str = '', timeout: float = 10.0) -> None:
        try:
            validate_topic_name(name)
        except InvalidTopicNameException as error:
            raise BadInputError(
                f'node is {name!r}: expected the name of a node before that of a parameter, as '
                'in planner law.name') from error
        super().__init__('parameters', namespace, timeout)
        self._name, self._where = name, namespace

    def _ask(self, kind: Any, service: str, **request: Any) -> Any:
        return self.ask(
            ServiceCall(self.node, kind, f'{self._name}/{service}', kind.Request(**request)),
            f'no node {self._name} in namespace {self._where or "/"} replies: expected '
            'one that runs, with the same ROS_DOMAIN_ID and ROS_AUTOMATIC_DISCOVERY_RANGE as here')

    def _values(self, names: Sequence[str]) -> dict[str, Any]:
        """Return the messages of some parameters, by name."""
        known = list(self._ask(ListParameters, 'list_parameters').result.names)
        unknown = [x for x in names if x not in known]
        if unknown:
            near = get_close_matches(unknown[0], known, cutoff=0.5)
            raise BadInputError(
                f'{self._name} has no parameter {unknown[0]!r}: expected '
                + (f'{" or ".join(near)}; ' if near else 'another; ')
                + f'hmsa param get {self._name} lists all')
        # rclpy gives none at all where one has no value: they are asked for one by one then.
        wanted = sorted(names or known)
        values = list(self._ask(GetParameters, 'get_parameters', names=wanted).values)
        if len(values) != len(wanted):
            values = [
                next(iter(self._ask(GetParameters, 'get_parameters', names=[x]).values), None)
                for x in wanted]
        return dict(zip(wanted, values, strict=True))

    def get(self, names: Sequence[str] = ()) -> dict[str, Any]:
        """
        Return parameters by name, all of them unless some are named.

        Raises
        ------
        BadInputError
            If the node has no parameter of a name.
        HmsaError
            If it does not reply.

        """
        found = {
            x: None if y is None else parameter_value_to_python(y)
            for x, y in self._values(names).items()}
        return {x: list(y or ()) if hasattr(y, 'typecode') else y for x, y in found.items()}

    def set(self, name: str, text: str) -> tuple[Any, Any]:
        """
        Change a parameter to a value as in YAML; return the values before and after.

        Raises
        ------
        BadInputError
            If the node refuses it, with its reason.
        HmsaError
            If it does not reply.

        """
        before = self.set_all({name: text})[name]
        return before, self.get([name])[name]

    def set_all(self, texts: Mapping[str, str]) -> dict[str, Any]:
        """
        Change parameters together, all or none; return the values before.

        Raises
        ------
        BadInputError
            If the node refuses them, with its reason.
        HmsaError
            If it does not reply.

        """
        if not texts:
            return {}
        before = self._values(list(texts))
        result = self._ask(SetParametersAtomically, 'set_parameters_atomically', parameters=[
            Parameter(name=name, value=_value(
                text, None if before[name] is None else before[name].type))
            for name, text in texts.items()]).result
        if not result.successful:
            given = ', '.join(f'{x} {y}' for x, y in texts.items())
            raise BadInputError(f'{self._name} refused {given}: {result.reason}')
        return {x: None if y is None else parameter_value_to_python(y) for x, y in before.items()}


def _value(text: str, kind: int | None) -> Any:
    """Return a value as the type that a parameter has: 1 and 5e3, no word of YAML, for numbers."""
    value = get_parameter_value(text)
    if kind == ParameterType.PARAMETER_STRING:
        value.type, value.string_value = kind, text
    elif kind == ParameterType.PARAMETER_DOUBLE:
        with suppress(ValueError):
            value.type, value.double_value = kind, float(text)
    elif kind == ParameterType.PARAMETER_DOUBLE_ARRAY:
        with suppress(ValueError):
            numbers = filter(str.strip, text.strip(' []').split(','))
            value.double_array_value = [float(x) for x in numbers]
            value.type = kind
    return value
