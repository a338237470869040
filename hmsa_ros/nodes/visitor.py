"""Nodes of commands that look at a running system for a while."""

from typing import Any
from uuid import uuid4

import rclpy
from rclpy.exceptions import InvalidNamespaceException
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from rclpy.validate_namespace import validate_namespace

from hmsa_ros.errors import BadInputError
from hmsa_ros.middleware import prepare_middleware


def visit(name: str, namespace: str, **options: Any) -> Node:
    """
    Create a node, its name made unique, with a context of its own; Ctrl-C stays Python's.

    Raises
    ------
    BadInputError
        If there can be no such namespace.

    """
    try:
        validate_namespace(f'/{namespace.removeprefix("/")}')
    except InvalidNamespaceException as error:
        raise BadInputError(f'namespace {namespace!r}: {error}') from error
    prepare_middleware()
    context = rclpy.Context()
    rclpy.init(context=context, signal_handler_options=SignalHandlerOptions.NO)
    return rclpy.create_node(
        f'{name}_{uuid4().hex[:8]}', namespace=namespace, context=context, **options)


def leave(node: Node) -> None:
    """Take a node of `visit` off the graph."""
    node.destroy_node()
    rclpy.try_shutdown(context=node.context)
