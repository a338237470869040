"""
Show the running nodes live in the terminal.

Show stretch and target, command, progress of the plan, status of the last request, and losses,
live in the terminal. Quit with q or Ctrl-C. Without a terminal it prints one line per second.

example: hmsa watch --joint actuator --span 5
"""

import argparse
from collections.abc import Iterator
from contextlib import contextmanager
import json
import os
import select
import sys
from time import monotonic, sleep
from typing import Any, TYPE_CHECKING

from hmsa_ros.cli.options import add_command
from hmsa_ros.ending import ENDING
from hmsa_ros.errors import BadInputError

if TYPE_CHECKING:
    from collections.abc import Callable

    from rich.console import Console
    from rich.text import Text

    from hmsa_ros.watch.listener import Listener
    from hmsa_ros.watch.scene import Scene

# Interval of lines without a terminal, and of looks in between, in s.
_LINE_SECONDS = 1.0
_LOOK_SECONDS = 0.1


def add_parser(subparsers: Any) -> None:
    """Add the command."""
    add_command(
        subparsers, __name__, __doc__,
        ('--namespace', 'NS', str, 'namespace of planner and plant', {'default': ''}),
        ('--joint', 'NAME', str, 'joint to show, or several separated by commas (default all)',
         {'default': ''}),
        ('--span', 'S', float, 'time shown in the charts (default 10 s)', {'default': 10.0}),
        ('--rate', 'HZ', float, 'refresh rate, 0.1 to 30 Hz (default 5)', {'default': 5.0}),
        ('--once', 'print one view and exit; status 1 if there is nothing to show'),
        ('--timeout', 'S', float, 'seconds that --once waits (default 5)', {'default': 5.0}),
        ('--json', 'print one JSON object per line, every second'))


def run(arguments: argparse.Namespace) -> int:
    """Watch until the end is requested; raise `BadInputError` if an option is out of range."""
    for name, least, largest in (('span', 0.1, 3600.0), ('rate', 0.1, 30.0),
                                 ('timeout', 0.0, 1e6)):
        value = getattr(arguments, name)
        if not least <= value <= largest:
            raise BadInputError(f'{name} is {value:g}: expected {least:g} to {largest:g}')

    from rich.console import Console

    from hmsa_ros.watch.listener import Listener

    console = Console(highlight=False)
    with Listener(
            namespace=arguments.namespace, joints=[x for x in arguments.joint.split(',') if x],
            span=arguments.span) as listener:
        ENDING.note()
        if arguments.once:
            return _once(listener, console, arguments)
        if arguments.json or not console.is_terminal or console.is_dumb_terminal:
            return _lines(listener, arguments.json)
        return _live(listener, console, arguments)


def _once(
        listener: 'Listener', console: 'Console', arguments: argparse.Namespace) -> int:
    """Print one view once it is complete, or after the timeout."""
    from hmsa_ros.watch.screen import as_json

    end = monotonic() + arguments.timeout
    scene = listener.look()
    # At least two looks, to determine the sample rate.
    while not (scene.joints and scene.request and scene.sample_rate > 0.0):
        if monotonic() >= end or ENDING.asked:
            break
        sleep(_LOOK_SECONDS)
        scene = listener.look()
    if arguments.json:
        print(json.dumps(as_json(scene)))
    else:
        for text in _screen(console, arguments.span)(scene):
            console.print(text)
    return 0 if scene.joints or scene.request else 1


def _lines(listener: 'Listener', as_objects: bool) -> int:
    """Print a line each second."""
    from hmsa_ros.watch.screen import as_json, line

    due = monotonic() + _LINE_SECONDS
    while not ENDING.asked:
        sleep(min(_LOOK_SECONDS, max(due - monotonic(), 0.0)))
        scene = listener.look()
        if monotonic() >= due:
            due += _LINE_SECONDS
            print(json.dumps(as_json(scene)) if as_objects else line(scene), flush=True)
    return 0


def _screen(console: 'Console', span: float) -> 'Callable[[Scene], list[Text]]':
    """Return a function that formats a scene for the present size of the terminal."""
    from hmsa_ros.watch.screen import Screen

    screen = Screen(span, unicode=console.encoding.lower().startswith('utf'))
    return lambda scene: screen.lines(scene, console.width, console.height)


def _live(
        listener: 'Listener', console: 'Console', arguments: argparse.Namespace) -> int:
    """Show the view until a key or a signal ends it."""
    from rich.console import Group
    from rich.live import Live

    lines = _screen(console, arguments.span)
    scene = listener.look()
    with _keys() as key_pressed, Live(
            get_renderable=lambda: Group(*lines(scene)), console=console, screen=True,
            auto_refresh=False) as live:
        due = monotonic()
        while not ENDING.asked:
            due = max(due + 1.0 / arguments.rate, monotonic())
            while monotonic() < due:
                if key_pressed(min(_LOOK_SECONDS, max(due - monotonic(), 0.0))) in ('q', 'Q'):
                    return 0
                scene = listener.look()
            live.refresh()
    return 0


@contextmanager
def _keys() -> Iterator[Any]:
    """Yield a function that reads pressed keys without echo; restore the terminal afterwards."""
    if not sys.stdin.isatty():
        yield sleep
        return
    import termios

    file = sys.stdin.fileno()
    before = termios.tcgetattr(file)
    settings = termios.tcgetattr(file)
    settings[3] &= ~(termios.ICANON | termios.ECHO)
    # Suspending would leave the alternate screen behind.
    settings[6][termios.VSUSP] = b'\0'

    def key(seconds: float) -> str:
        ready, _, _ = select.select([file], [], [], seconds)
        if not ready:
            return ''
        pressed = os.read(file, 1)
        # A terminal that has disappeared also ends the view.
        return pressed.decode('ascii', 'ignore') if pressed else 'q'

    try:
        termios.tcsetattr(file, termios.TCSADRAIN, settings)
        yield key
    finally:
        termios.tcsetattr(file, termios.TCSADRAIN, before)
