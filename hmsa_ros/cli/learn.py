"""
Correct the levels of a sequence by the errors of its repeats.

Read the runs of one sequence, in their order, and correct its levels by the measured errors, such
as those by hysteresis or a second mode. The first run has the planned setpoints; each of the
others executed the levels learnt from those before it. Print the error of each run, and write the
levels for the next run, for hmsa run --levels.

example: hmsa learn planned/run second/run --out next.yaml
"""

import argparse
import math
from pathlib import Path
from typing import Any

from hmsa_ros.cli.options import add_command, bags, JSON
from hmsa_ros.cli.progress import progress
from hmsa_ros.files import check_targets, json_text, write_text


def add_parser(subparsers: Any) -> None:
    """Add the command."""
    add_command(
        subparsers, __name__, __doc__,
        bags('runs'),
        ('--joint', 'NAME', str, 'joint to learn for, if the bags have several', {'default': ''}),
        ('--out', 'YAML', Path, 'file for the next levels'),
        JSON)


def run(arguments: argparse.Namespace) -> int:
    """Read, learn and print."""
    check_targets([] if arguments.out is None else [arguments.out])
    from hmsa_ros.identification.sequences import learn_from, sequence_text
    from hmsa_ros.recordings.bags import read_run
    from hmsa_ros.table import Column, Table

    with progress('reading'):
        found, targets = learn_from([read_run(x, joint=arguments.joint) for x in arguments.runs])
    if arguments.out is not None:
        write_text(arguments.out, sequence_text(found, targets, arguments.runs))
    if arguments.json:
        print(json_text({
            'runs': [{'run': str(x), 'setpoints': [
                {'stretch': z.stretch, 'vibration': y.vibration, 'offset': y.offset}
                for y, z in zip(left, targets, strict=True)]}
                for x, left in zip(arguments.runs, found.left, strict=True)],
            'best': str(arguments.runs[found.best]),
            'second_mode': found.frequency if math.isfinite(found.frequency) else None,
            'levels': [[x, y] for x, y in zip(
                found.level_times.tolist(), found.levels.tolist(), strict=True)],
            'file': None if arguments.out is None else str(arguments.out)}))
        return 0
    print(Table(
        (Column('run'), Column('setpoint'), Column('vibration', '%', '%'),
         Column('offset', '%', '+%')),
        tuple((str(x), f'{z.stretch:g}', 100.0 * y.vibration, 100.0 * y.offset)
              for x, left in zip(arguments.runs, found.left, strict=True)
              for y, z in zip(left, targets, strict=True)),
        'vibration: peak to peak in the first period after the move; offset: mean less the '
        'setpoint; in % of the step'))
    if math.isfinite(found.frequency):
        print(f'second mode at {found.frequency:.4g} Hz')
    if found.best != len(arguments.runs) - 1:
        print(f'note: {arguments.runs[found.best]} left less than later runs: the next levels '
              'start from it, with smaller changes')
    if arguments.out is not None:
        print(f'{arguments.out} written')
    return 0
