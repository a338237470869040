"""
Drive the running nodes from a page in the browser.

Serve one page on this host: stretch, flux density and status live, setpoints and sequences, stop,
feedback and its estimate, recordings and their reports. Open the printed address; anyone who has
it can move the actuator. When the last page is closed, and at the end, an actuator that the panel
moves comes to rest without vibration.

example: hmsa panel --port 8642 --out my_recordings
"""

import argparse
from pathlib import Path
from typing import Any

from hmsa.cli.options import add_command, JOINTS, NAMESPACE, setpoint_of_joints
from hmsa.cli.terminal import under_way
from hmsa.ending import ENDING
from hmsa.errors import BadInputError, check_number


def add_parser(subparsers: Any) -> None:
    """Add the command."""
    parser = add_command(
        subparsers, __name__, __doc__,
        ('--port', 'N', int, 'port on 127.0.0.1 (default 0: a free one)', {'default': 0}),
        NAMESPACE,
        JOINTS,
        ('--span', 'S', float, 'time shown in the charts (default 10 s)', {'default': 10.0}),
        ('--out', 'DIR', Path, 'folder of the recordings (default hmsa_panel)',
         {'default': Path('hmsa_panel')}))
    parser.add_argument(
        '--stop-on-close', action=argparse.BooleanOptionalAction, default=True,
        help='when the last page is closed, come to rest; otherwise a sequence continues to '
             'its planned rest')


def run(arguments: argparse.Namespace) -> int:
    """Serve until the end is requested; raise `BadInputError` if an option is invalid."""
    span: float = arguments.span
    check_number('span', span, 's', least=0.1, most=3600.0)
    try:
        import tornado  # noqa: F401
    except ImportError as error:
        raise BadInputError(
            'Tornado, which serves the panel, is not installed: install it (pip install '
            'tornado)') from error
    from hmsa_lab.panel.desk import Desk
    from hmsa_lab.panel.server import Server

    ENDING.note()
    with Server(arguments.port) as server:
        desk = Desk(
            server, setpoint_of_joints, arguments.out, arguments.namespace,
            tuple(arguments.joint.split(',')), span, stop_on_close=arguments.stop_on_close)
        print(f'panel: {server.address}', flush=True)
        with under_way():
            desk.run()
    return 0
