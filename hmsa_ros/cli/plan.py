"""``hmsa plan``: plan a sequence without ROS."""

import argparse
from collections.abc import Sequence
import json
import math
from typing import Any, TYPE_CHECKING

from hmsa_ros.cli.setpoints import setpoint

if TYPE_CHECKING:
    from hmsa_ros.core.sequence import Segment


def add_parser(subparsers: Any) -> None:
    """
    Add the command.

    Parameters
    ----------
    subparsers : argparse action
        Where to add it.

    """
    parser = subparsers.add_parser(
        'plan', help='plan a sequence of setpoints without ROS',
        description='Plan a sequence of setpoints, nondimensional as in the paper: a stretch '
                    'and the span of time for which it lasts, in units of L sqrt(rho/G).',
        epilog='example: hmsa plan 1.10:10 1.20:10 1.40:10 --json')
    parser.add_argument(
        'setpoints', nargs='+', type=setpoint, metavar='STRETCH:SPAN',
        help='stretch to come to rest at, and time from leaving the last setpoint to leaving '
             'this one')
    parser.add_argument(
        '--start', type=float, default=1.0, metavar='S',
        help='stretch at rest at the start (default 1)')
    parser.add_argument(
        '--zeta', type=float, default=0.2, metavar='Z',
        help='nondimensional damping coefficient, at least 0 (default 0.2)')
    parser.add_argument(
        '--j-lim', type=float, default=5.0, metavar='J',
        help='chain limit of the Gent model, above 0 (default 5)')
    parser.add_argument(
        '--c1', type=float, default=2.0, metavar='C',
        help='shape 2 H^2/L^2, above 0 (default 2)')
    parser.add_argument(
        '--shaper', default='two_step', metavar='NAME',
        help='two_step (default), robust, minimum_time, step, zv, zvd or ei')
    parser.add_argument('--json', action='store_true', help='print JSON in full precision')
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """
    Plan and print.

    Parameters
    ----------
    arguments : argparse.Namespace
        As parsed.

    Returns
    -------
    int
        Exit status.

    Raises
    ------
    BadInputError
        If a setpoint cannot be had or a parameter is out of range.

    """
    from hmsa_ros.core.moves import State
    from hmsa_ros.core.parameters import NondimensionalParameters
    from hmsa_ros.core.sequence import plan_sequence, Setpoint

    material = NondimensionalParameters(arguments.zeta, arguments.j_lim, arguments.c1)
    segments = plan_sequence(
        [Setpoint(*x) for x in arguments.setpoints], material, start=State(arguments.start),
        shaper=arguments.shaper)
    rows = [_row(segment) for segment in segments]
    if arguments.json:
        print(json.dumps({'segments': rows}, indent=2))
    else:
        _print_table(rows, segments)
    return 0


def _row(segment: 'Segment') -> dict[str, float | str | None]:
    """Return a segment as the JSON output shows it; null where there is no such number."""
    from hmsa_ros.core.model import signed_root

    levels = segment.move.levels
    shaped = len(levels) > 1
    beta_p = levels[0].load if shaped else None
    beta_1 = levels[-1].load
    duration = segment.move.duration
    return {
        'stretch': segment.setpoint.stretch,
        'span': segment.setpoint.span,
        'beta_p': beta_p,
        'b_p': None if beta_p is None else float(signed_root(beta_p)),
        'tau_p': duration if shaped and math.isfinite(duration) else None,
        'beta_1': beta_1,
        'b_1': float(signed_root(beta_1)),
        'start_stretch': segment.start.stretch,
        'start_rate': segment.start.rate,
        'status': str(segment.move.code),
    }


def _print_table(
        rows: Sequence[dict[str, float | str | None]], segments: Sequence['Segment']) -> None:
    from rich.console import Console
    from rich.table import Table

    table = Table(caption='nondimensional: time in L sqrt(rho/G), b = sqrt(Br B/(mu0 G))')
    for name in ('stretch', 'span', 'b_p', 'tau_p', 'b_1'):
        table.add_column(name, justify='right')
    table.add_column('status')
    for row in rows:
        table.add_row(*(
            '-' if row[name] is None else f'{row[name]:.6g}'
            for name in ('stretch', 'span', 'b_p', 'tau_p', 'b_1')), str(row['status']))
    console = Console()
    console.print(table)
    for segment in segments:
        if segment.move.reason:
            console.print(f'note: {segment.move.reason}', highlight=False, soft_wrap=True)
