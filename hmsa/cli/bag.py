"""
Inspect, verify and recover bags.

Inspect, verify and recover recordings (MCAP bags as rosbag2 writes them).

example: hmsa bag info hmsa_demo/run
"""

import argparse
from dataclasses import asdict
from pathlib import Path
import sys
from typing import Any

from hmsa.bag.limits import CHUNK_SIZE, MEBIBYTE
from hmsa.cli.options import add_command, JSON, show
from hmsa.cli.terminal import progress, under_way
from hmsa.errors import check_number, printable

_LARGEST_CHUNK = 65536


def add_parser(subparsers: Any) -> None:
    """Add the command."""
    parser = add_command(subparsers, __name__, __doc__)
    actions = parser.add_subparsers(metavar='ACTION', required=True)
    tolerance = (
        '--tolerance', 'D', float,
        'maximum difference in stretch, or in the deflection of a beam (default %(default)g)',
        {'default': 1e-9})
    params_file = (
        '--params-file', 'YAML', Path,
        'parameter file (YAML) of the actuator, for a bag without its parameters')
    out = ('--out', 'DIR', str, 'folder of the new bag; must not exist', {'required': True})
    max_chunk = (
        '--max-chunk', 'MIB', float,
        'largest chunk or message to read, in MiB (default %(default)g)',
        {'default': CHUNK_SIZE / MEBIBYTE})
    for function, options in (
            (_info, [('--parameters', 'also print the parameters of the recorded nodes'), JSON]),
            (_recover, [out]), (_verify, [tolerance, params_file, JSON])):
        add_command(
            actions, function.__name__.strip('_'), function.__doc__,
            ('bag', 'BAG', str, 'folder of a bag, or one of its files'), *options, max_chunk,
            run=function)


def _chunk_size(arguments: argparse.Namespace) -> int:
    """Return the size in bytes of the largest chunk to read."""
    most: float = arguments.max_chunk
    check_number('largest chunk', most, 'MiB', above=0.0, most=_LARGEST_CHUNK)
    return max(1, round(most * MEBIBYTE))


def _info(arguments: argparse.Namespace) -> int:
    """
    List the contents of a bag.

    Print topics, counts, rates, losses and duration of a bag, and with --parameters the parameters
    of the nodes. The exit status is 1 if messages that the bag lists cannot be read.

    example: hmsa bag info hmsa_demo/run --json
    """
    from hmsa.bag.info import summarize, to_json, to_text
    from hmsa.bag.reader import BagReader
    from hmsa.runs.topics import unanswered

    with progress('reading'):
        reader = BagReader(arguments.bag, max_chunk_size=_chunk_size(arguments))
        summary, notes = summarize(reader), tuple(unanswered(reader))
    with under_way():  # a pager takes the lines when it likes
        print(to_json(summary, notes) if arguments.json else to_text(
            summary, notes, parameters=arguments.parameters))
    # A bag that is still written, or whose recorder was killed, is readable as far as it goes.
    return 1 if summary.unreadable or summary.closed and not summary.complete else 0


def _verify(arguments: argparse.Namespace) -> int:
    """
    Simulate the recorded commands and compare with the recorded motion.

    Simulate the recorded commands with the recorded parameters and print the maximum difference
    from the recorded motion. The exit status is 1 if it exceeds the tolerance, if the bag is
    damaged, or if a command was not applied.

    example: hmsa bag verify hmsa_demo/run --tolerance 1e-6
    """
    from hmsa.runs.bags import read_runs
    from hmsa.runs.parameters import read_parameter_file
    from hmsa.runs.verify import verify_run

    check_number('tolerance', arguments.tolerance, least=0.0)
    parameters = read_parameter_file(arguments.params_file) if arguments.params_file else None
    with progress('verifying'):
        runs = read_runs(
            arguments.bag, parameters=parameters, max_chunk_size=_chunk_size(arguments))
        results = [verify_run(x) for x in runs]
    problems = list(runs[0].summary.problems) if runs[0].summary else []
    # A bag that is not completely readable is not verified, and an unapplied command is a loss.
    passed = not problems and all(
        x.largest_difference <= arguments.tolerance and not x.unapplied_count for x in results)
    show(
        arguments, {
            'passed': passed, 'tolerance': arguments.tolerance, 'problems': problems,
            'actuators': [asdict(x) for x in results]},
        *(printable(
            f'{x.states}: {x.sample_count} samples, {x.command_count} commands'
            + f' of {x.commands}' * bool(x.commands)
            + f' ({x.late_count} late), largest difference of the {run.plant.coordinate.name} '
            f'{x.largest_difference:.3g} at {x.where:.6f} s' + (f'; {x.note}' if x.note else ''))
          for run, x in zip(runs, results, strict=True)))
    return 0 if passed else 1


def _recover(arguments: argparse.Namespace) -> int:
    """
    Copy the readable messages of a damaged bag to a new bag.

    Copy everything readable in a bag to a new bag. A bag of SQLite, or compressed as a whole,
    becomes MCAP.

    example: hmsa bag recover cut_off_run --out saved_run
    """
    from hmsa.bag.writer import recover
    with progress('recovering'):
        result = recover(
            arguments.bag, arguments.out, max_chunk_size=_chunk_size(arguments))
    for problem in result.problems:
        print(f'hmsa: note: {problem}', file=sys.stderr)
    print(printable(f'{result.message_count} messages recovered to {result.folder}'))
    return 0
