"""
Simulate the response to levels of the field without ROS.

Simulate the response of an actuator to levels of the field, without ROS: a CSV with the columns
time (s) and flux_density (T), each in force from its time on. Print the response to each level;
write samples with --out and figures with --picture.

example: hmsa simulate levels.csv --params-file actuator.yaml --picture run.png
"""

import argparse
from dataclasses import asdict
from pathlib import Path
from typing import Any

from hmsa.cli.options import actuator_of, add_command, EXAMPLE, frequency, JSON, show
from hmsa.cli.pictures import paper_of, picture_options
from hmsa.cli.terminal import progress


def add_parser(subparsers: Any) -> None:
    """Add the command."""
    add_command(
        subparsers, __name__, __doc__,
        ('levels', 'LEVELS.csv', Path, 'CSV of time, flux_density'),
        EXAMPLE,
        ('--until', 'S', float, 'end in s (default: when the last level has settled)'),
        ('--start', 'X', float, 'initial stretch, at rest (default 1; 0 for a beam)'),
        frequency(
            '--rate',
            'sample rate in Hz (default 1000, or 40 samples per period of the actuator)'),
        ('--noise', 'X', float, 'standard deviation of the stretch samples (default 0)',
         {'default': 0.0}),
        ('--seed', 'N', int, 'seed of the noise (default 0)',
         {'default': 0, 'needs': ('--noise',)}),
        ('--out', 'FILE', Path,
         'samples to write, ending in .csv, .parquet or .mat; an existing file is replaced'),
        JSON, *picture_options('pictures to write', panels=True))


def run(arguments: argparse.Namespace) -> int:
    """Simulate, write and print."""
    from hmsa.runs.record import levels_beside

    out: Path | None = arguments.out
    paper = paper_of(
        arguments, *(() if out is None else (out, levels_beside(out))),
        sources=(arguments.levels, arguments.params_file))
    actuator = actuator_of(arguments.params_file)
    with progress('simulating'):
        motion = actuator.simulate(arguments.levels, **{
            x: getattr(arguments, x) for x in ('until', 'start', 'rate', 'noise', 'seed')})
        written = [] if out is None else motion.save(out)
        if arguments.picture:
            motion.plot(arguments.picture, **asdict(paper))
    report, files = motion.report(), [*written, *arguments.picture]
    return show(arguments, {
        'samples': len(motion.times), 'duration': motion.times[-1], 'rows': report.records(),
        'files': files}, report, *files)
