"""Start of ROS in a process, and temporary nodes of commands that inspect a running system."""

from collections.abc import Callable, Sequence
from contextlib import nullcontext
import os
import re
from time import monotonic
from typing import Any, TypeVar
from uuid import uuid4

import rclpy
from rclpy.exceptions import InvalidNamespaceException
from rclpy.experimental.events_executor import EventsExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.signals import SignalHandlerOptions
from rclpy.validate_namespace import validate_namespace

from hmsa.cli.terminal import under_way
from hmsa.ending import ENDING
from hmsa.errors import BadInputError, HmsaError
from hmsa_ros.middleware import prepare_middleware
from hmsa_ros.nodes.service_call import ServiceCall

T = TypeVar('T')
#: Maximum time in s of one wait for callbacks.
SLICE_SECONDS = 0.05
_LAST_DOMAIN = 232


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
            self, condition: Callable[[], bool], failure: str,
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
        with under_way(f'waiting up to {timeout:g} s for {awaited}') if awaited else nullcontext():
            while not condition():
                if time() > deadline:
                    raise HmsaError(f'waited {timeout:g} s: {failure}')
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
