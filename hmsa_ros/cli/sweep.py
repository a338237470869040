"""``hmsa sweep``: two-step plans over grids of parameters."""

import argparse
from collections import Counter
from pathlib import Path
import sys
from typing import Any

# Column, option, and what it is.
_AXES = (
    ('start', '--start', 'initial stretch, at rest (default 1)'),
    ('target', '--target', 'stretch to come to rest at (default 1.1)'),
    ('zeta', '--zeta', 'nondimensional damping coefficient, at least 0 (default 0.2)'),
    ('j_lim', '--j-lim', 'chain limit of the Gent model, above 0 (default 5)'),
    ('c1', '--c1', 'shape 2 H^2/L^2, above 0 (default 2)'),
)


def add_parser(subparsers: Any) -> None:
    """Add the command."""
    parser = subparsers.add_parser(
        'sweep', help='plan over grids of parameters or a table of cases',
        description='Plan the two-step command for all combinations of the values given, '
                    'nondimensional as in the paper. GRID is a value, FIRST:LAST:POINTS or '
                    'log:FIRST:LAST:POINTS, or several of these separated by commas. A case '
                    'that cannot be planned gives the reason in its status; the others are '
                    'still planned.',
        epilog='example: hmsa sweep --zeta 0:2:1000 --j-lim log:0.1:100:50 --out sweep.csv')
    for _, option, text in _AXES:
        parser.add_argument(option, metavar='GRID', help=text)
    parser.add_argument(
        '--cases', type=Path, metavar='FILE.csv',
        help='CSV with some of the columns start, target, zeta, j_lim, c1; each row is combined '
             'with the grids of the other columns')
    parser.add_argument(
        '--out', type=Path, metavar='FILE',
        help='file to write, ending in .csv or .parquet; an existing file is replaced (default: '
             'CSV on standard output)')
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Plan and write."""
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeRemainingColumn,
    )

    from hmsa_ros.studies.sweep import open_writer, parse_grid, read_cases, Sweep

    grids = {
        column: parse_grid(getattr(arguments, column), column)
        for column, _, _ in _AXES if getattr(arguments, column) is not None}
    cases = None if arguments.cases is None else read_cases(arguments.cases)
    sweep = Sweep(grids, cases)
    counts: Counter[str] = Counter()
    console = Console(stderr=True)
    with open_writer(arguments.out) as write, Progress(
            TextColumn('planning'), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn(),
            console=console, transient=True, disable=not console.is_terminal) as progress:
        task = progress.add_task('', total=sweep.size)
        for block in sweep.blocks():
            write(block)
            counts.update(block.status.tolist())
            progress.advance(task, block.status.size)
    words = ', '.join(f'{count:,} {status}' for status, count in counts.most_common())
    print(f'{sweep.size:,} plans: {words}', file=sys.stderr)
    if arguments.out is not None:
        print(arguments.out)
    return 0
