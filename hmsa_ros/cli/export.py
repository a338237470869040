"""``hmsa export``: the samples and levels of a run as tables."""

import argparse
from pathlib import Path
from typing import Any

from hmsa_ros.cli.options import add_options
from hmsa_ros.cli.progress import progress
from hmsa_ros.errors import BadInputError


def add_parser(subparsers: Any) -> None:
    """Add the command."""
    parser = subparsers.add_parser(
        'export', help='write the samples and levels of a run as CSV or Parquet',
        description='Write the samples of a run (time in s from the first sample, stretch, '
                    'stretch rate in 1/s, flux density in T) to FILE, and its levels (time, flux '
                    'density) to a second file whose name ends in _levels.',
        epilog='example: hmsa export hmsa_demo/run --out run.csv')
    parser.add_argument(
        'run_path', type=Path, metavar='RUN', help='folder of a bag, or an .mcap file')
    add_options(
        parser,
        ('--out', 'FILE', Path,
         'file to write, ending in .csv or .parquet; an existing file is replaced',
         {'required': True}),
        ('--joint', 'NAME', str, 'joint to export, if the bag has several', {'default': ''}))


def run(arguments: argparse.Namespace) -> int:
    """Read and write; raise `BadInputError` if the bag has several runs."""
    from hmsa_ros.recordings.bags import read_runs
    from hmsa_ros.recordings.tables import levels_of, samples_of, write_table

    out: Path = arguments.out
    with progress() as update:
        runs = read_runs(
            arguments.run_path, joints=[arguments.joint] if arguments.joint else [],
            progress=update)
    if len(runs) > 1:
        raise BadInputError(
            f'{arguments.run_path} has the runs {", ".join(x.label for x in runs)}: expected '
            'one; name its actuator with --joint')
    write_table(out, samples_of(runs[0]))
    print(out)
    if runs[0].levels:
        levels = out.with_name(f'{out.stem}_levels{out.suffix}')
        write_table(levels, levels_of(runs[0]))
        print(levels)
    return 0
