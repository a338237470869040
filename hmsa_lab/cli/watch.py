"""
Show the running nodes as lines of text, one per second.

Each line contains stretch, target and flux density of each joint, progress and status of the last
request, late commands, losses and missing nodes or topics. Quit with Ctrl-C. For charts, use hmsa
panel.

example: hmsa watch --joint actuator
"""

import argparse
import json
from time import monotonic, sleep
from typing import Any, TYPE_CHECKING

from hmsa.cli.options import add_command
from hmsa.cli.terminal import under_way
from hmsa.ending import ENDING
from hmsa.errors import check_number

if TYPE_CHECKING:
    from hmsa_lab.panel.listener import Listener, Scene

# Interval of lines, and of looks in between, in s.
_LINE_SECONDS = 1.0
_LOOK_SECONDS = 0.1


def add_parser(subparsers: Any) -> None:
    """Add the command."""
    add_command(
        subparsers, __name__, __doc__,
        ('--namespace', 'NS', str, 'namespace of planner and plant', {'default': ''}),
        ('--joint', 'NAME', str, 'joint to show, or several separated by commas (default all)',
         {'default': ''}),
        ('--once', 'print one line and exit; status 1 if there is nothing to show'),
        ('--timeout', 'S', float, 'seconds that --once waits (default 5)',
         {'default': 5.0, 'needs': ('--once',)}),
        ('--json', 'print one JSON object per line'))


def run(arguments: argparse.Namespace) -> int:
    """Watch until the end is requested; raise `BadInputError` if an option is out of range."""
    check_number('timeout', arguments.timeout, 's', least=0.0, most=1e6)

    from hmsa_lab.panel.listener import Listener

    with Listener(
            namespace=arguments.namespace,
            joints=[x for x in arguments.joint.split(',') if x]) as listener:
        ENDING.note()
        if arguments.once:
            return _once(listener, arguments)
        due = monotonic() + _LINE_SECONDS
        with under_way():
            while not ENDING.asked:
                sleep(min(_LOOK_SECONDS, max(due - monotonic(), 0.0)))
                scene = listener.look()
                if monotonic() >= due:
                    due += _LINE_SECONDS
                    _print(scene, arguments.json)
    return 0


def _once(listener: 'Listener', arguments: argparse.Namespace) -> int:
    """Print one line once it is complete, or after the timeout."""
    begin, scene = monotonic(), listener.look()
    with under_way(f'waiting up to {arguments.timeout:g} s for samples and a status'):
        # At least two looks, to determine the sample rate.
        while not (scene.joints and scene.request and scene.sample_rate > 0.0):
            if monotonic() >= begin + arguments.timeout or ENDING.asked:
                break
            sleep(_LOOK_SECONDS)
            scene = listener.look()
    _print(scene, arguments.json)
    return 0 if scene.joints or scene.request else 1


def _print(scene: 'Scene', as_object: bool) -> None:
    """Print a scene as a line of text, or as a JSON object."""
    from hmsa_lab.panel.listener import as_json, line

    print(json.dumps(as_json(scene)) if as_object else line(scene), flush=True)
