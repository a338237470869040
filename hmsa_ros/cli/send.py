"""
Publish a sequence of setpoints to the running planner.

Publish a sequence of setpoints or levels to the running planner, starting now, and print the
status. With --wait, Ctrl-C brings the actuator to rest.

example: hmsa send 1.10:2 1.20:2 --wait
"""

import argparse
import sys
from typing import Any, TYPE_CHECKING

from hmsa.cli.options import add_command, JOINTS, NAMESPACE, SEQUENCE, sequence_of, timeout_of
from hmsa.cli.terminal import show_notes
from hmsa.ending import ENDING
from hmsa.errors import HmsaError

if TYPE_CHECKING:
    from hmsa_ros.clients.client import PlannerClient

# Fraction of real time below which simulated time is reported as slow.
SLOW = 0.9


def add_parser(subparsers: Any) -> None:
    """Add the command."""
    add_command(
        subparsers, __name__, __doc__,
        *SEQUENCE,
        ('--wait',
         'report progress until the end of the sequence, and fail unless the samples show that '
         'all setpoints were reached, or there are no samples'),
        ('--recorded', 'wait until a recorder has subscribed, then send'),
        NAMESPACE,
        JOINTS,
        ('--timeout', 'S', float,
         'time to wait for a reply, and beyond the end of the sequence (default 10 s)',
         {'default': 10.0}))


def run(arguments: argparse.Namespace) -> int:
    """Send and, if requested, wait; raise `HmsaError` if the sequence is not carried out."""
    from hmsa_ros.clients.client import PlannerClient

    timeout = timeout_of(arguments)
    levels, path = sequence_of(arguments)
    ENDING.note()
    show_notes()
    with PlannerClient(
            namespace=arguments.namespace, joints=arguments.joint.split(','),
            timeout=timeout) as client:
        client.find_planner()
        client.check_alone()
        if arguments.recorded:
            client.find_recorder()
        client.find_plant()
        try:
            _carry_out(client, arguments, levels, path)
        except KeyboardInterrupt:
            if not (arguments.wait and client.requested):
                raise
            print('interrupted: stopping', file=sys.stderr, flush=True)
            print(client.stop().message, file=sys.stderr)
            return ENDING.status
    return 0


def _carry_out(
        client: 'PlannerClient', arguments: argparse.Namespace, levels: Any, path: Any) -> None:
    """Send, and report progress until the end if requested."""
    length = sum(span for _, span in arguments.setpoints) + sum(
        x[-1][0] for x in (levels, path) if x)
    if (pace := client.pace()) < SLOW:
        print(
            f'simulated time runs at {pace:.3g} of real time: the sequence of {length:g} s takes '
            f'about {length / pace:.2g} s', file=sys.stderr, flush=True)
    verdict = client.send_sequence(arguments.setpoints, levels, path)
    print(verdict.message, flush=True)
    if not arguments.wait:
        return
    seen = ''

    def report(now: object) -> None:
        nonlocal seen
        line = f'setpoint {now.setpoint} of {now.setpoints}: {now.state}'  # type: ignore
        if line != seen and now.setpoint:  # type: ignore[attr-defined]
            seen = line
            print(line, file=sys.stderr, flush=True)

    verdict = client.follow(verdict, each=report, timeout=length + arguments.timeout)
    if verdict.failure:
        raise HmsaError(verdict.failure)
    print(f'done: {verdict.state}, {verdict.basis}')
