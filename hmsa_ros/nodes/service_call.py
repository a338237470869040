"""A non-blocking service call that tolerates a lost response."""

from collections.abc import Callable, Iterable
import json
from time import monotonic
from typing import Any

from rcl_interfaces.msg import ParameterType
from rcl_interfaces.srv import GetParameters, GetParameterTypes, ListParameters
from rclpy.node import Node
from rclpy.parameter import parameter_value_to_python

from hmsa.bag.experiment import parameter_key


class ServiceCall:
    """
    One request to a service, repeated until there is a response.

    A server may respond to a client that it has just discovered before the return path is
    established. The response is then lost, and some return paths never recover. The request is
    therefore repeated with a new client each time, and must be harmless when executed twice. A
    response counts as lost after ``timeout`` in s. The node must be spun meanwhile.
    """

    def __init__(
            self, node: Node, service_type: type[Any], name: str, request: Any,
            timeout: float = 2.0) -> None:
        self._node = node
        self._service = service_type, name
        self._request = request
        self._timeout = timeout
        self._sent = 0.0
        # Clients with their futures; responses to all but the last one are overdue.
        self._asked: list[tuple[Any, Any]] = []

    @property
    def ready(self) -> bool:
        """Whether there is a server."""
        if not self._asked:
            self._asked.append((self._node.create_client(*self._service), None))
        return bool(self._asked[-1][0].service_is_ready())

    def answer(self) -> Any:
        """Return the response, or None if there is none yet; send the request when due."""
        for client, future in self._asked:
            if future is not None and future.done() and (response := future.result()) is not None:
                self._destroy_all_but(client)
                return response
        ready = self.ready
        client, future = self._asked[-1]
        if not ready:
            # The server has disappeared: start again with the next one.
            self._asked[-1] = client, None
        elif future is None:
            self._asked[-1] = client, client.call_async(self._request)
            self._sent = monotonic()
        elif monotonic() - self._sent > self._timeout:
            self._asked.append((self._node.create_client(*self._service), None))
        return None

    def close(self) -> None:
        """Destroy the clients; the call cannot be used again."""
        self._destroy_all_but(None)

    def _destroy_all_but(self, kept: Any) -> None:
        for client, _ in self._asked:
            if client is not kept:
                self._node.destroy_client(client)
        self._asked = [] if kept is None else [(kept, None)]


_SERVICES = {
    ListParameters: 'list_parameters', GetParameterTypes: 'get_parameter_types',
    GetParameters: 'get_parameters'}


class RemoteParameters:
    """Parameters of a node, requested when it is available and again when it comes back."""

    def __init__(self, node: Node, name: str) -> None:
        self._node = node
        self._name = name
        self._server = node.create_client(ListParameters, f'{name}/list_parameters')
        self._names: list[str] = []
        self._call: ServiceCall | None = None
        #: Whether the parameters were received, and the node is still available.
        self.known = False

    def poll(self, note: Callable[[dict[str, str]], None]) -> None:
        """Do the next step; ``note`` is called with the parameters as custom data."""
        if not self._server.service_is_ready():
            # Requested again when the node comes back, perhaps with other parameters.
            self._ask(None)
            self.known = False
        elif self.known:
            return
        elif self._call is None:
            self._ask(ListParameters)
        elif (answer := self._call.answer()) is None:
            return
        elif hasattr(answer, 'result'):
            self._names = list(answer.result.names)
            self._ask(GetParameterTypes, names=self._names)
        elif hasattr(answer, 'types'):
            # Overrides of a joint may be unset: rclpy returns nothing at all if one has no value.
            self._names = [x for x, kind in zip(self._names, answer.types, strict=False)
                           if kind != ParameterType.PARAMETER_NOT_SET]
            self._ask(GetParameters, names=self._names)
        else:
            self._ask(None)
            self.known = True
            note(self.texts(zip(self._names, answer.values, strict=False)))

    def _ask(self, kind: Any, **request: Any) -> None:
        """Call the service of a kind instead of the previous one; none for None."""
        if self._call is not None:
            self._call.close()
        self._call = None if kind is None else ServiceCall(
            self._node, kind, f'{self._name}/{_SERVICES[kind]}', kind.Request(**request))

    def texts(self, values: Iterable[tuple[str, Any]]) -> dict[str, str]:
        """Return parameters as custom data: keys of `parameter_key`, values as JSON."""
        return {parameter_key(self._name, name): json.dumps(
            parameter_value_to_python(value), default=list) for name, value in values}
