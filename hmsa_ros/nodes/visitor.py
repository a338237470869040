"""Start of ROS in a process, and nodes of commands that look at a running system for a while."""

from collections.abc import Callable, Sequence
import re
from time import monotonic
from typing import Any, TypeVar
from uuid import uuid4

import rclpy
from rclpy.exceptions import InvalidNamespaceException
from rclpy.experimental.events_executor import EventsExecutor
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from rclpy.validate_namespace import validate_namespace

from hmsa_ros.ending import ENDING
from hmsa_ros.errors import BadInputError, HmsaError
from hmsa_ros.middleware import prepare_middleware
from hmsa_ros.nodes.service_call import ServiceCall

T = TypeVar('T')
#: At most so long callbacks are waited for at a time, in s.
SLICE_SECONDS = 0.05


def start_ros(
        arguments: Sequence[str] | None = None, context: rclpy.Context | None = None) -> None:
    """
    Start rclpy, which answers no signals.

    Raises
    ------
    BadInputError
        If its log cannot be written.

    """
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
    Create a node, its name made unique, with a context of its own; Ctrl-C stays Python's.

    Raises
    ------
    BadInputError
        If there can be no such namespace, or ROS does not start.

    """
    try:
        validate_namespace(f'/{namespace.removeprefix("/")}')
    except InvalidNamespaceException as error:
        raise BadInputError(f'namespace {namespace!r}: {error}') from error
    context = rclpy.Context()
    start_ros(context=context)
    return rclpy.create_node(
        f'{name}_{uuid4().hex[:8]}', namespace=namespace, context=context, **options)


class Visitor:
    """A node of `visit` that waits for up to ``timeout`` s; a context manager."""

    def __init__(self, name: str, namespace: str, timeout: float) -> None:
        self._timeout = timeout
        self.node = visit(name, namespace)
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
            time: Callable[[], float] = monotonic) -> None:
        """
        Serve callbacks, and call ``each`` about 20 times a second, until a condition holds.

        Raises
        ------
        HmsaError
            If it does not come true within a timeout in s, by default its own, of ``time``.
        KeyboardInterrupt
            If a signal that was noted asks for the end.

        """
        timeout = self._timeout if timeout is None else timeout
        deadline = time() + timeout
        while not condition():
            if time() > deadline:
                raise HmsaError(f'waited {timeout:g} s: {failure}')
            ENDING.check()
            self._executor.spin_once(timeout_sec=SLICE_SECONDS)
            if each is not None:
                each()

    def ask(
            self, call: ServiceCall, failure: str, each: Callable[[], None] | None = None) -> Any:
        """Return the response to a call; raise `HmsaError` where none comes (see `spin_until`)."""
        answers: list[Any] = []

        def answered() -> bool:
            answers[:] = [x for x in [call.answer()] if x is not None]
            return bool(answers)

        try:
            self.spin_until(answered, failure, each)
        finally:
            call.close()
        return answers[0]


def leave(node: Node) -> None:
    """Take a node of `visit` off the graph."""
    node.destroy_node()
    rclpy.try_shutdown(context=node.context)
