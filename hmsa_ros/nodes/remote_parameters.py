"""Parameters of other nodes, requested step by step, without waiting."""

from collections.abc import Callable, Iterable
import json
from time import monotonic
from typing import Any

from rcl_interfaces.srv import GetParameters, ListParameters
from rclpy.node import Node
from rclpy.parameter import parameter_value_to_python

from hmsa_ros.bag.experiment import parameter_key

# An answer that has not come by then does not come: it was sent before the way back was known.
_PATIENCE_SECONDS = 2.0


class RemoteParameters:
    """The parameters of a node, requested once it is there and again when it comes back."""

    def __init__(self, node: Node, name: str) -> None:
        """Create clients; nothing is asked yet."""
        self._name = name
        self._list = node.create_client(ListParameters, f'{name}/list_parameters')
        self._get = node.create_client(GetParameters, f'{name}/get_parameters')
        self._future: Any = None
        self._asked = 0.0
        self._names: list[str] = []
        self._done = False

    def poll(self, note: Callable[[dict[str, str]], None]) -> None:
        """Take the next step towards the node's parameters, for ``note`` as custom data."""
        if self._done:
            # Asked again when it comes back, perhaps with other parameters.
            self._done = bool(self._list.service_is_ready())
        elif self._future is None:
            if self._list.service_is_ready() and self._get.service_is_ready():
                self._ask(self._list, ListParameters.Request())
        elif self._future.done():
            answer, self._future = self._future.result(), None
            if hasattr(answer, 'result'):
                self._names = list(answer.result.names)
                self._ask(self._get, GetParameters.Request(names=self._names))
            else:
                self._done = True
                note(self.texts(zip(self._names, answer.values, strict=False)))
        elif (not self._list.service_is_ready()
                or monotonic() - self._asked > _PATIENCE_SECONDS):
            # From the beginning, once it is there.
            for client in (self._list, self._get):
                client.remove_pending_request(self._future)
            self._future = None

    def _ask(self, client: Any, request: Any) -> None:
        self._future = client.call_async(request)
        self._asked = monotonic()

    def texts(self, values: Iterable[tuple[str, Any]]) -> dict[str, str]:
        """Return parameters as custom data: keys of `parameter_key`, values as JSON."""
        return {parameter_key(self._name, name): json.dumps(
            parameter_value_to_python(value), default=list) for name, value in values}
