"""Start of ROS in a process, and nodes of commands that look at a running system for a while."""

from collections.abc import Sequence
import re
from typing import Any
from uuid import uuid4

import rclpy
from rclpy.exceptions import InvalidNamespaceException
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from rclpy.validate_namespace import validate_namespace

from hmsa_ros.errors import BadInputError
from hmsa_ros.middleware import prepare_middleware


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


def leave(node: Node) -> None:
    """Take a node of `visit` off the graph."""
    node.destroy_node()
    rclpy.try_shutdown(context=node.context)
