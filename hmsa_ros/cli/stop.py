"""
Drop the rest of the sequence and come to rest without vibration.

Have the running planner drop the rest of its sequence and bring the actuators to rest without
vibration. Succeed once the plant or driver has acknowledged the stop and its samples, if any, do
not contradict it. Otherwise fail, and print the state and the remedy. The field stays on: in an
emergency, run hmsa interlock open, or switch the amplifier off.

example: hmsa stop
"""

import argparse
from typing import Any

from hmsa.cli.options import add_command, NAMESPACE, TIMEOUT, timeout_of
from hmsa.ending import ENDING


def add_parser(subparsers: Any) -> None:
    """Add the command."""
    add_command(subparsers, __name__, __doc__, NAMESPACE, TIMEOUT)


def run(arguments: argparse.Namespace) -> int:
    """Stop and wait; raise `HmsaError` if that is not acknowledged."""
    timeout = timeout_of(arguments)
    from hmsa_ros.clients.link import Link

    ENDING.note()
    with Link(arguments.namespace, timeout) as link:
        print(link.stop().message)
    return 0
