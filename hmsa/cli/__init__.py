"""
The ``hmsa`` command.

Each command is a module with ``add_parser(subparsers)`` and ``run(arguments)``, registered by its
package as an entry point of ``hmsa.commands``. Its docstring is the help. A command with
subcommands has a function for each instead of ``run``. Slow modules (rclpy, SciPy, matplotlib) are
imported within these functions, so that ``hmsa --help`` answers immediately.
"""

import argparse
from collections.abc import Sequence
from contextlib import nullcontext
from difflib import get_close_matches
import os
import re
import sys
from typing import Any, NoReturn

from hmsa import __version__
from hmsa.cli.options import check_needs
from hmsa.cli.terminal import collecting, show_notes, tolerate, under_way, unshown
from hmsa.ending import ENDING
from hmsa.errors import complain, HmsaError
from hmsa.plugins import COMMANDS, registered

# Commands of rosbag2 and others, with those for the same purpose.
_MEANT = {
    'record': 'hmsa recorder', 'play': 'hmsa player', 'sim': 'hmsa simulate',
    'calib': 'hmsa calibrate'}


class _Help(argparse.HelpFormatter):
    """Keep the line breaks of examples, so that they can be copied."""

    def _fill_text(self, text: str, width: int, indent: str) -> str:
        before, example, rest = text.partition('example: ')
        if not example:
            return super()._fill_text(text, width, indent)
        words = f'{super()._fill_text(before, width, indent)}\n' if before else ''
        return f'{words}{example}{rest}'


class Parser(argparse.ArgumentParser):
    """Argument parser that reports bad input in one line, with exit status 2."""

    def __init__(self, **settings: Any) -> None:
        """Pass settings to argparse."""
        super().__init__(**{'formatter_class': _Help, **settings})
        # A setpoint such as -0.2:1 is not an option.
        self._negative_number_matcher = re.compile(r'-\.?\d')

    def _check_value(self, action: argparse.Action, value: Any) -> None:
        """Raise `ArgumentError` for a value that is not a choice, with the closest one."""
        choices = [str(x) for x in action.choices or ()]
        if not choices or value in choices:
            return
        meant = _MEANT.get(value)
        if meant is None:
            meant = next(iter(get_close_matches(str(value), choices, 1)), None)
        raise argparse.ArgumentError(action, f'invalid choice: {value!r}: ' + (
            f'expected one of {", ".join(choices)}' if meant is None
            else f'did you mean {meant}?'))

    def error(self, message: str) -> NoReturn:
        """Print one line on standard error and exit with status 2."""
        self.exit(2, f'hmsa: error: {message}; see {self.prog} --help\n')


def build_parser(name: str = '') -> Parser:
    """Return the parser of a command, or of all commands if there is none of that name."""
    parser = Parser(
        prog='hmsa',
        description='Plan and send magnetic-field commands that take hard-magnetic soft actuators '
                    'to a target stretch without residual vibration.',
        epilog='example: hmsa demo')
    parser.add_argument('--version', action='version', version=f'hmsa_ros {__version__}')
    subparsers = parser.add_subparsers(metavar='COMMAND', required=True)
    commands = registered(COMMANDS)
    # Nodes share a module.
    for module in dict.fromkeys(
            x.load() for x in ([commands[name]] if name in commands else commands.values())):
        before = set(subparsers.choices)
        module.add_parser(subparsers)
        for added in subparsers.choices.keys() - before:
            command = subparsers.choices[added]
            command.set_defaults(
                parser=command, run=getattr(module, 'run', None),
                is_node=command.get_default('is_node') or False)
    return parser


def main(argv: Sequence[str] | None = None) -> int:
    """
    Run the ``hmsa`` command; return its exit status.

    0: success, 1: failed run, 2: bad input, 130: interrupted (SIGINT; 143 SIGTERM, 129 SIGHUP).
    """
    words = list(sys.argv[1:] if argv is None else argv)
    tolerate()
    # A command is started without importing the modules of the others.
    parser = build_parser(''.join(words[:1]))
    own = split_ros_args(words)
    for_ros = words[len(own):]
    arguments, unknown = parser.parse_known_args(own)
    if for_ros and not arguments.is_node:
        unknown += for_ros
    if unknown:
        options = arguments.parser._option_string_actions
        near = get_close_matches(unknown[0].partition('=')[0], options, 1, 0.75)
        arguments.parser.error(
            f'unrecognized arguments: {" ".join(unknown)}'
            + (f'; did you mean {near[0]}?' if near else ''))
    arguments.ros_args = for_ros
    ENDING.interrupt()
    try:
        # A node has its log.
        with collecting(at_once=arguments.is_node), (
                nullcontext() if arguments.is_node else under_way(arguments.parser.prog)):
            check_needs(arguments)
            status: int = arguments.run(arguments)
        show_notes()
        print(end='', flush=True)  # also where standard output is closed
        return status
    except HmsaError as error:
        # Another actuator than the assumed one may not have been refused.
        return complain(error, notes=unshown() if hasattr(error, 'code') else ())
    except ImportError as error:
        if not of_ros(error):
            raise
        return complain(HmsaError(
            f'{arguments.parser.prog} needs ROS 2, Jazzy or Kilted ({error}): source its setup '
            'file (source /opt/ros/jazzy/setup.bash), or install it with this package (in its '
            'clone: pip install ".[ros]")'))
    except KeyboardInterrupt:
        return ENDING.status
    except BrokenPipeError:
        # The reader of the output (head, less) has ended, so nothing can be reported, and Python
        # would fail at its end to write what is left.
        nowhere = os.open(os.devnull, os.O_WRONLY)
        for stream in (sys.stdout, sys.stderr):
            os.dup2(nowhere, stream.fileno())
        return 0
    except OSError as error:
        if error.filename is not None:
            raise
        # Otherwise Python would try to write the remaining output again at its end.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return complain(HmsaError(
            f'cannot write to standard output ({error.strerror}): expected free space'), 1)


def of_ros(error: ImportError) -> bool:
    """Return whether a module of ROS is missing, or cannot load its libraries."""
    name = (error.name or '').partition('.')[0]
    return name.endswith(('_msgs', '_srvs', '_interfaces')) or name.startswith(
        ('rcl', 'rosidl', 'ament_', 'rpyutils')) or 'rclpy' in str(error)


def split_ros_args(words: list[str]) -> list[str]:
    """Return the words before ``--ros-args``, for argparse; the rest is for a node."""
    return words[:words.index('--ros-args')] if '--ros-args' in words else words
