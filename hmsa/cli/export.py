"""
Write the samples and levels of a run as CSV, Parquet or Matlab file.

Write the samples of a run (time in s from the first sample, stretch, stretch rate in 1/s, flux
density in T) to FILE, and its levels (time in s, flux density in T) to a second file whose name
ends in _levels; a Matlab file contains both.

example: hmsa export hmsa_demo/run --out run.csv
"""

import argparse
from pathlib import Path
from typing import Any

from hmsa.cli.options import add_command
from hmsa.cli.terminal import progress


def add_parser(subparsers: Any) -> None:
    """Add the command."""
    add_command(
        subparsers, __name__, __doc__,
        ('run_path', 'RUN', Path, 'folder of a bag, or one of its files'),
        ('--out', 'FILE', Path,
         'file to write, ending in .csv, .parquet or .mat; an existing file is replaced',
         {'required': True}),
        ('--joint', 'NAME', str, 'joint to export, if the bag has several', {'default': ''}))


def run(arguments: argparse.Namespace) -> int:
    """Read and write."""
    from hmsa.runs.bags import read_run
    from hmsa.runs.record import write_run

    with progress() as update:
        found = read_run(arguments.run_path, joint=arguments.joint, progress=update)
    for path in write_run(arguments.out, found):
        print(path)
    return 0
