"""Start of ROS in a process; temporary nodes of commands, and calls that do not block them."""

from collections.abc import Callable, Iterable, Sequence
from contextlib import nullcontext
import json
import math
import os
import re
from time import monotonic
from typing import Any, TypeVar
from uuid import uuid4

from rcl_interfaces.msg import ParameterType
from rcl_interfaces.srv import GetParameters, GetParameterTypes, ListParameters
import rclpy
from rclpy.exceptions import InvalidNamespaceException
from rclpy.experimental.events_executor import EventsExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter, parameter_value_to_python
from rclpy.signals import SignalHandlerOptions
from rclpy.validate_namespace import validate_namespace

from hmsa.bag.metadata import parameter_key
from hmsa.cli.terminal import under_way
from hmsa.ending import ENDING
from hmsa.errors import BadInputError, HmsaError
from hmsa_ros.middleware import prepare_middleware

T = TypeVar('T')
#: Maximum time in s of one wait for callbacks.
SLICE_SECONDS = 0.05
_LAST_DOMAIN = 232


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


def start_ros(
        arguments: Sequence[str] | None = None, context: rclpy.Context | None = None) -> None:
    """
    Start rclpy without signal handlers.

    Raises
    ------
    BadInputError
        If the log cannot be written, or ROS_DOMAIN_ID is out of range.

    """
    domain = os.environ.get('ROS_DOMAIN_ID', '').strip()
    # Other domains have no ports in DDS, which would end the process.
    if domain and not (domain.isdecimal() and int(domain) <= _LAST_DOMAIN):
        raise BadInputError(
            f'ROS_DOMAIN_ID is {domain!r}: expected a whole number of 0 to {_LAST_DOMAIN}')
    prepare_middleware()
    try:
        rclpy.init(
            args=arguments, context=context, signal_handler_options=SignalHandlerOptions.NO)
    except Exception as error:  # rclpy raises errors of several unrelated classes here
        found = re.search(r'initialize logging: ([^\n]*?)(: \d+)?(, at |$)', str(error))
        if found is None:
            raise
        raise BadInputError(
            f'ROS cannot write its log ({found[1]}): set ROS_LOG_DIR to a folder where it can'
        ) from error


def visit(name: str, namespace: str, **options: Any) -> Node:
    """
    Create a node with a unique name and its own context; Python handles Ctrl-C.

    Raises
    ------
    BadInputError
        If the namespace is invalid, or ROS does not start.

    """
    try:
        validate_namespace(f'/{namespace.removeprefix("/")}')
    except InvalidNamespaceException as error:
        raise BadInputError(f'namespace {namespace!r}: {error}') from error
    context = rclpy.Context()
    start_ros(context=context)
    return rclpy.create_node(
        f'{name}_{uuid4().hex[:8]}', namespace=namespace, context=context, **options)


class TemporaryNode:
    """A node of `visit` with a default timeout in s; a context manager."""

    def __init__(self, name: str, namespace: str, timeout: float) -> None:
        self.timeout = timeout
        # Nobody asks it for parameters or types; the services take a third of its start.
        self.node = visit(
            name, namespace, start_parameter_services=False, parameter_overrides=[
                Parameter('start_type_description_service', value=False)])
        self._executor = EventsExecutor(context=self.node.context)
        self._executor.add_node(self.node)

    def __enter__(self: T) -> T:
        return self

    def __exit__(self, *_: object) -> None:
        self._executor.shutdown()
        leave(self.node)

    def spin_until(
            self, condition: Callable[[], bool], failure: str | Callable[[], str],
            each: Callable[[], None] | None = None, timeout: float | None = None,
            time: Callable[[], float] = monotonic, awaited: str = '') -> None:
        """
        Serve callbacks, and call ``each`` about 20 times a second, until a condition is true.

        While it takes long, lines on standard error say what is ``awaited``, if that is given.

        Raises
        ------
        HmsaError
            If it does not become true within a timeout in s of ``time``, by default the node's.
        KeyboardInterrupt
            If a signal requested the end.

        """
        timeout = self.timeout if timeout is None else timeout
        deadline = time() + timeout
        longest = f' up to {timeout:g} s' if timeout < math.inf else ''
        with under_way(f'waiting{longest} for {awaited}') if awaited else nullcontext():
            while not condition():
                if time() > deadline:
                    words = failure if isinstance(failure, str) else failure()
                    raise HmsaError(f'waited {timeout:g} s: {words}')
                ENDING.check()
                self._executor.spin_once(timeout_sec=SLICE_SECONDS)
                if each is not None:
                    each()

    def ask(
            self, call: ServiceCall, failure: str, each: Callable[[], None] | None = None,
            awaited: str = '') -> Any:
        """Return the response to a call; raise `HmsaError` after a timeout (see `spin_until`)."""
        answers: list[Any] = []

        def answered() -> bool:
            answers[:] = [x for x in [call.answer()] if x is not None]
            return bool(answers)

        try:
            self.spin_until(answered, failure, each, awaited=awaited)
        finally:
            call.close()
        return answers[0]


def leave(node: Node) -> None:
    """Destroy a node of `visit` and its context."""
    node.destroy_node()
    rclpy.try_shutdown(context=node.context)
