"""``hmsa bag``: what is in a recording, and how to save one that was cut off."""

import argparse
from dataclasses import asdict
import json
import sys
from typing import Any

from hmsa_ros.errors import BadInputError


def add_parser(subparsers: Any) -> None:
    """
    Add the command.

    Parameters
    ----------
    subparsers : argparse action
        Where to add it.

    """
    parser = subparsers.add_parser(
        'bag', help='look into recordings and recover them',
        description='Look into recordings (MCAP bags as rosbag2 writes them) and recover them.')
    actions = parser.add_subparsers(metavar='ACTION', required=True)
    info = actions.add_parser(
        'info', help='print what is in a bag',
        description='Print topics, counts, rates, losses, duration and parameters of a bag.')
    info.add_argument('bag', metavar='BAG', help='folder of a bag, or an .mcap file')
    info.add_argument('--json', action='store_true', help='print one JSON object')
    info.set_defaults(run=run, action=_info)
    recover = actions.add_parser(
        'recover', help='make a readable bag out of a cut-off one',
        description='Write everything that can be read of a bag to a new one.')
    recover.add_argument('bag', metavar='BAG', help='folder of a bag, or an .mcap file')
    recover.add_argument(
        '--out', metavar='DIR', required=True, help='folder of the new bag; must not exist')
    recover.set_defaults(run=run, action=_recover)
    verify = actions.add_parser(
        'verify', help='integrate the recorded commands and compare with the recorded stretch',
        description='Integrate the recorded commands with the recorded parameters and print '
                    'the largest difference from the recorded stretch.')
    verify.add_argument('bag', metavar='BAG', help='folder of a bag, or an .mcap file')
    verify.add_argument(
        '--tolerance', type=float, default=1e-9, metavar='D',
        help='largest difference of the stretch that passes (default %(default)g)')
    verify.add_argument('--json', action='store_true', help='print one JSON object')
    verify.set_defaults(run=run, action=_verify)


def run(arguments: argparse.Namespace) -> int:
    """
    Carry out one action.

    Parameters
    ----------
    arguments : argparse.Namespace
        With ``action`` and what it needs.

    Returns
    -------
    int
        Exit status.

    """
    status: int = arguments.action(arguments)
    return status


def _info(arguments: argparse.Namespace) -> int:
    """Print what is in a bag."""
    from hmsa_ros.bag.info import summarize, to_json, to_text
    summary = summarize(arguments.bag)
    print(to_json(summary) if arguments.json else to_text(summary))
    return 0


def _verify(arguments: argparse.Namespace) -> int:
    """Compare recorded and integrated motion; 1 if they differ."""
    from hmsa_ros.bag.verify import verify
    if not arguments.tolerance >= 0.0:
        raise BadInputError(f'tolerance is {arguments.tolerance:g}: expected at least 0')
    results = verify(arguments.bag)
    passed = all(result.largest_difference <= arguments.tolerance for result in results)
    if arguments.json:
        print(json.dumps({
            'passed': passed, 'tolerance': arguments.tolerance,
            'actuators': [asdict(result) for result in results]}, indent=2))
    else:
        for result in results:
            print(f'{result.states}: {result.sample_count} samples, {result.command_count} '
                  f'commands ({result.late_count} late), largest difference of the stretch '
                  f'{result.largest_difference:.3g} at {result.where:.6f} s')
    return 0 if passed else 1


def _recover(arguments: argparse.Namespace) -> int:
    """Write a new bag."""
    from hmsa_ros.bag.recover import recover
    result = recover(arguments.bag, arguments.out)
    for problem in result.problems:
        print(f'hmsa: note: {problem}', file=sys.stderr)
    print(f'{result.message_count} messages recovered to {result.folder}')
    return 0
