"""Parameters of other nodes, requested step by step, without waiting."""

from collections.abc import Callable, Iterable
import json
from typing import Any

from rcl_interfaces.msg import ParameterType
from rcl_interfaces.srv import GetParameters, GetParameterTypes, ListParameters
from rclpy.node import Node
from rclpy.parameter import parameter_value_to_python

from hmsa_ros.bag.experiment import parameter_key
from hmsa_ros.nodes.service_call import ServiceCall

_SERVICES = {
    ListParameters: 'list_parameters', GetParameterTypes: 'get_parameter_types',
    GetParameters: 'get_parameters'}


class RemoteParameters:
    """The parameters of a node, requested once it is there and again when it comes back."""

    def __init__(self, node: Node, name: str) -> None:
        self._node = node
        self._name = name
        self._server = node.create_client(ListParameters, f'{name}/list_parameters')
        self._names: list[str] = []
        self._call: ServiceCall | None = None
        self._done = False

    def poll(self, note: Callable[[dict[str, str]], None]) -> None:
        """Take the next step towards the node's parameters, for ``note`` as custom data."""
        if not self._server.service_is_ready():
            # Asked again when it comes back, perhaps with other parameters.
            self._ask(None)
            self._done = False
        elif self._done:
            return
        elif self._call is None:
            self._ask(ListParameters)
        elif (answer := self._call.answer()) is None:
            return
        elif hasattr(answer, 'result'):
            self._names = list(answer.result.names)
            self._ask(GetParameterTypes, names=self._names)
        elif hasattr(answer, 'types'):
            # A joint may have none of its own: rclpy gives none at all where one has no value.
            self._names = [x for x, kind in zip(self._names, answer.types, strict=False)
                           if kind != ParameterType.PARAMETER_NOT_SET]
            self._ask(GetParameters, names=self._names)
        else:
            self._ask(None)
            self._done = True
            note(self.texts(zip(self._names, answer.values, strict=False)))

    def _ask(self, kind: Any, **request: Any) -> None:
        """Call the service of a kind in place of the last one; none for None."""
        if self._call is not None:
            self._call.close()
        self._call = None if kind is None else ServiceCall(
            self._node, kind, f'{self._name}/{_SERVICES[kind]}', kind.Request(**request))

    def texts(self, values: Iterable[tuple[str, Any]]) -> dict[str, str]:
        """Return parameters as custom data: keys of `parameter_key`, values as JSON."""
        return {parameter_key(self._name, name): json.dumps(
            parameter_value_to_python(value), default=list) for name, value in values}
