"""A call of a service whose answer may be lost, without waiting."""

from collections.abc import Callable, Iterable
import json
from time import monotonic
from typing import Any

from rcl_interfaces.msg import ParameterType
from rcl_interfaces.srv import GetParameters, GetParameterTypes, ListParameters
from rclpy.node import Node
from rclpy.parameter import parameter_value_to_python

from hmsa_ros.bag.experiment import parameter_key


class ServiceCall:
    """
    One request to a service, sent again while no answer comes.

    A server answers a client that it has just discovered before the way back is known to all: the
    answer is lost then, and its client would wait for ever; some ways back stay lost. So it is
    sent again by a client of its own each time, and a request must do no harm when it is carried
    out twice. An answer counts as lost after ``timeout`` in s; meanwhile the node must be served.
    """

    def __init__(
            self, node: Node, service_type: type[Any], name: str, request: Any,
            timeout: float = 2.0) -> None:
        self._node = node
        self._service = service_type, name
        self._request = request
        self._timeout = timeout
        self._sent = 0.0
        # Clients with the answers that they wait for; all but the last may only be late.
        self._asked: list[tuple[Any, Any]] = []

    @property
    def ready(self) -> bool:
        """Whether there is a server."""
        if not self._asked:
            self._asked.append((self._node.create_client(*self._service), None))
        return bool(self._asked[-1][0].service_is_ready())

    def answer(self) -> Any:
        """Return the response, or None as long as there is none; send what is due."""
        for client, future in self._asked:
            if future is not None and future.done() and (response := future.result()) is not None:
                self._destroy_all_but(client)
                return response
        ready = self.ready
        client, future = self._asked[-1]
        if not ready:
            # Whoever was asked is gone: the next server is asked from the beginning.
            self._asked[-1] = client, None
        elif future is None:
            self._asked[-1] = client, client.call_async(self._request)
            self._sent = monotonic()
        elif monotonic() - self._sent > self._timeout:
            self._asked.append((self._node.create_client(*self._service), None))
        return None

    def close(self) -> None:
        """Destroy what the call holds; it cannot be used any more."""
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
    """The parameters of a node, requested once it is there and again when it comes back."""

    def __init__(self, node: Node, name: str) -> None:
        self._node = node
        self._name = name
        self._server = node.create_client(ListParameters, f'{name}/list_parameters')
        self._names: list[str] = []
        self._call: ServiceCall | None = None
        #: Whether they were given, and the node is still there.
        self.known = False

    def poll(self, note: Callable[[dict[str, str]], None]) -> None:
        """Take the next step towards the node's parameters, for ``note`` as custom data."""
        if not self._server.service_is_ready():
            # Asked again when it comes back, perhaps with other parameters.
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
            # A joint may have none of its own: rclpy gives none at all where one has no value.
            self._names = [x for x, kind in zip(self._names, answer.types, strict=False)
                           if kind != ParameterType.PARAMETER_NOT_SET]
            self._ask(GetParameters, names=self._names)
        else:
            self._ask(None)
            self.known = True
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
