"""
Drop the rest of the sequence and come to rest without vibration.

Call the service ~/stop of the running planner: it drops the rest of its sequence and brings the
actuators to rest without vibration. Return when they are at rest. The field stays on: in an
emergency, open the interlock of the driver (topic driver/interlock), or switch the amplifier off.

example: hmsa stop
"""

import argparse
from typing import Any

from hmsa_ros.cli.options import add_command, NAMESPACE, TIMEOUT, timeout_of
from hmsa_ros.ending import ENDING
from hmsa_ros.errors import HmsaError


def add_parser(subparsers: Any) -> None:
    """Add the command."""
    add_command(subparsers, __name__, __doc__, NAMESPACE, TIMEOUT)


def run(arguments: argparse.Namespace) -> int:
    """Stop and wait; raise `HmsaError` if there is no planner, or it does not come to rest."""
    timeout = timeout_of(arguments)
    from hmsa_ros.lab.client import PlannerClient

    ENDING.note()
    with PlannerClient(namespace=arguments.namespace, timeout=timeout) as client:
        client.find_planner()
        if not client.stop():
            raise HmsaError(
                f'the planner has not come to rest ({client.verdict.state}: '
                f'{client.verdict.message}): expected rest; hmsa watch shows the motion')
        print(f'stopped: {client.verdict.state.replace("_", " ")}')
    return 0
