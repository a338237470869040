"""``hmsa stop``: bring the actuators of a running planner to rest."""

import argparse
from typing import Any

from hmsa_ros.cli.options import add_options, NAMESPACE, TIMEOUT, timeout_of
from hmsa_ros.ending import ENDING
from hmsa_ros.errors import HmsaError


def add_parser(subparsers: Any) -> None:
    """Add the command."""
    parser = subparsers.add_parser(
        'stop', help='drop the rest of the sequence and come to rest without vibration',
        description='Have the running planner drop the rest of its sequence and bring the '
                    'actuators to rest without vibration, as its service ~/stop does. It waits '
                    'until they are at rest.',
        epilog='example: hmsa stop')
    add_options(parser, NAMESPACE, TIMEOUT)


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
