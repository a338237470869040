"""
Compare runs in numbers, and in a picture.

Print move time, offset and residual vibration of each setpoint for several runs, and the largest
distance of each curve from that of the first run. For folders of hmsa run --repeat, print mean,
standard deviation and maximum over the repeats. Their pictures show the mean around each arrival,
and the standard deviation as a band.

example: hmsa compare run_zv run_two_step --picture both.pdf --width 85
"""

import argparse
from dataclasses import asdict
from pathlib import Path
from typing import Any, TYPE_CHECKING

from hmsa.cli.options import add_command, bags, JSON, show
from hmsa.cli.pictures import paper_of, picture_options
from hmsa.cli.terminal import progress
from hmsa.errors import BadInputError

if TYPE_CHECKING:
    from hmsa.report.looks import Paper


def add_parser(subparsers: Any) -> None:
    """Add the command."""
    add_command(
        subparsers, __name__, __doc__,
        bags('runs'),
        ('--joint', 'NAME', str, 'joint to compare, if the bags have several', {'default': ''}),
        JSON, *picture_options('pictures of all runs to write', panels=True))


def run(arguments: argparse.Namespace) -> int:
    """Read, compare and print; raise `BadInputError` for a single run."""
    paper = paper_of(arguments)
    if len(arguments.runs) < 2:
        raise BadInputError(
            f'only {arguments.runs[0]} is given: expected two runs or more, such as hmsa compare '
            'first/run second/run')
    from hmsa.report.comparison import repeats_in

    repeats = [repeats_in(x) for x in arguments.runs]
    if any(repeats):
        if paper.panels:
            raise BadInputError(
                'pictures of repeats have a panel for each setpoint: leave out --panels')
        return _compare_repeats(arguments, [x or [y] for x, y in zip(
            repeats, arguments.runs, strict=True)], paper)
    from hmsa.api.motion import compare, read

    with progress('reading'):
        found = compare(
            *(read(x, joint=arguments.joint) for x in arguments.runs),
            picture=arguments.picture or None, **(asdict(paper) if arguments.picture else {}))
    return show(arguments, {
        'runs': arguments.runs, 'setpoints': found.records(), 'files': arguments.picture,
    }, found, *arguments.picture)


def _compare_repeats(
        arguments: argparse.Namespace, groups: 'list[list[Path]]', paper: 'Paper') -> int:
    """Compare runs of which at least one was repeated."""
    from hmsa.report.comparison import Part, statistics, statistics_table
    from hmsa.runs.bags import read_run

    labels = [x.parent.name if x.name == 'run' else x.name for x in map(
        Path.resolve, arguments.runs)]
    if len(set(labels)) < len(labels):
        labels = [f'{x} ({i})' for i, x in enumerate(labels, 1)]
    with progress('reading'):
        parts = {label: [Part.of(read_run(x, joint=arguments.joint)) for x in group]
                 for label, group in zip(labels, groups, strict=True)}
        found = {label: statistics([x.evaluation.findings for x in group])
                 for label, group in parts.items()}
        if arguments.picture:
            from hmsa.report.picture import draw_bands
            draw_bands(arguments.picture, parts, paper)
    return show(arguments, {
        'runs': list(found), 'setpoints': [
            {'run': label, **x} for label, group in found.items() for x in group],
        'files': arguments.picture,
    }, statistics_table(found), *arguments.picture)
