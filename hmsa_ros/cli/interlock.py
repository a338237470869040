"""
Switch the coils of a driver off in an emergency: open its interlock.

Open the interlock of a driver: it switches its coils off, refuses all commands and has the planner
refuse all requests until the interlock is closed. Close it again to go on. Succeed once the driver
reports that. The interlock is software: it does not replace a switch in the supply of the
amplifier.

example: hmsa interlock open
"""

import argparse
from typing import Any

from hmsa.cli.options import add_command, TIMEOUT, timeout_of
from hmsa.ending import ENDING
from hmsa.interfaces.topics import DRIVER


def add_parser(subparsers: Any) -> None:
    """Add the command."""
    add_command(
        subparsers, __name__, __doc__,
        ('state', 'STATE', str, 'open, to switch the coils off, or close',
         {'choices': ('open', 'close')}),
        ('--driver', 'NAME', str, f'name of the driver (default {DRIVER})', {'default': DRIVER}),
        ('--namespace', 'NS', str, 'namespace of the driver', {'default': ''}),
        TIMEOUT)


def run(arguments: argparse.Namespace) -> int:
    """Open or close, and wait; raise `HmsaError` if the driver does not report that."""
    timeout, closed = timeout_of(arguments), arguments.state == 'close'
    from hmsa_ros.clients.interlock import InterlockLink

    ENDING.note()
    with InterlockLink(arguments.driver, arguments.namespace, timeout) as link:
        link.turn(closed=closed)
    print('interlock closed: the next request moves the actuator again' if closed else
          'interlock open: the driver switches the coil off, until hmsa interlock close')
    return 0
