"""
Compare runs in numbers, and in a picture.

Print move time, offset and residual vibration of each setpoint for several runs, and how far each
curve is from that of the first run.

example: hmsa compare run_zv run_two_step --picture both.pdf --width 85
"""

import argparse
from typing import Any

from hmsa_ros.cli.options import add_bags, add_command, add_options, JSON
from hmsa_ros.cli.pictures import add_picture_options, paper_of
from hmsa_ros.cli.progress import progress
from hmsa_ros.errors import BadInputError
from hmsa_ros.files import json_text


def add_parser(subparsers: Any) -> None:
    """Add the command."""
    parser = add_command(subparsers, __name__, __doc__)
    add_bags(parser, 'runs')
    add_options(
        parser,
        ('--joint', 'NAME', str, 'joint to compare, if the bags have several', {'default': ''}),
        JSON)
    add_picture_options(parser, named='pictures of all runs to write')


def run(arguments: argparse.Namespace) -> int:
    """Read, compare and print; raise `BadInputError` for a single run."""
    paper = paper_of(arguments)
    if len(arguments.runs) < 2:
        raise BadInputError(
            f'only {arguments.runs[0]} is given: expected two runs or more, such as hmsa compare '
            'first/run second/run')
    from hmsa_ros.api.motion import compare, draw_all, read

    with progress('reading'):
        motions = [read(x, joint=arguments.joint) for x in arguments.runs]
        found = compare(*motions)
        if arguments.picture:
            draw_all(motions, arguments.picture, paper)
    if arguments.json:
        print(json_text({
            'runs': [str(x) for x in arguments.runs], 'setpoints': found.records(),
            'files': [str(x) for x in arguments.picture]}))
        return 0
    print(found)
    for picture in arguments.picture:
        print(picture)
    return 0
