"""
Read and change parameters of running nodes.

Read and change parameters of running nodes, as ros2 param does.

example: hmsa param set planner shaper robust
"""

import argparse
from typing import Any, TYPE_CHECKING

from hmsa.cli.options import add_command, JSON, NAMESPACE, show, TIMEOUT, timeout_of
from hmsa.ending import ENDING
from hmsa.files import yaml_text

if TYPE_CHECKING:
    from hmsa_ros.clients.remote import RemoteNode


def add_parser(subparsers: Any) -> None:
    """Add the command."""
    parser = add_command(subparsers, __name__, __doc__)
    actions = parser.add_subparsers(metavar='ACTION', required=True)
    node = ('node', 'NODE', str, 'name of the node, such as planner')
    add_command(
        actions, 'get', _get.__doc__,
        node, ('names', 'NAME', str, 'parameters (default all)', {'nargs': '*'}),
        NAMESPACE, TIMEOUT, JSON, run=_get)
    add_command(
        actions, 'set', _set.__doc__,
        node, ('name', 'NAME', str, 'the parameter'),
        ('value', 'VALUE', str, 'the value, as in YAML: 0.5, robust, [1, 2]'),
        NAMESPACE, TIMEOUT, run=_set)


def _get(arguments: argparse.Namespace) -> int:
    """
    Print parameters of a node.

    example: hmsa param get planner shaper
    """
    with _node(arguments) as node:
        found = node.get(arguments.names)
    return show(arguments, found, *(f'{x}: {yaml_text(y)}' for x, y in found.items()))


def _set(arguments: argparse.Namespace) -> int:
    """
    Change a parameter of a node.

    Change a parameter of a node. The planner uses it from the next request on.

    example: hmsa param set planner shaper robust
    """
    with _node(arguments) as node:
        before, after = node.set(arguments.name, arguments.value)
    print(f'{arguments.name}: {after} (was {before})')
    return 0


def _node(arguments: argparse.Namespace) -> 'RemoteNode':
    timeout = timeout_of(arguments)
    from hmsa_ros.clients.remote import RemoteNode

    ENDING.note()
    return RemoteNode(arguments.node, arguments.namespace, timeout)
