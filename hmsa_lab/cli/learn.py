"""
Correct the levels of a sequence by the errors of its repeats.

Read the runs of one sequence, in their order, and correct its levels by the measured errors, such
as those from hysteresis or further modes. The first run executed the planned setpoints, and each
later run the levels learnt from the earlier ones. Print the error of each run, and write the
levels for the next run, for hmsa run --levels. After two runs that are worse than an earlier one,
these are the levels of the best run.

example: hmsa learn planned/run second/run --out next.yaml
"""

import argparse
import math
from pathlib import Path
from typing import Any

from hmsa.cli.options import add_command, bags, JSON, show
from hmsa.cli.terminal import progress
from hmsa.files import check_targets, write_text


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
    check_targets(arguments.out)
    from hmsa.identification.learning import learn_from, sequence_text
    from hmsa.runs.bags import read_run
    from hmsa.table import Column, Table

    with progress('reading'):
        found, targets = learn_from([read_run(x, joint=arguments.joint) for x in arguments.runs])
    if arguments.out is not None:
        write_text(arguments.out, sequence_text(found, targets, arguments.runs))
    rows = [(run, target.stretch, left.vibration, left.offset)
            for run, each in zip(arguments.runs, found.left, strict=True)
            for left, target in zip(each, targets, strict=True)]
    best = arguments.runs[found.best]
    lines: list[object] = [Table(
        (Column('run'), Column('setpoint'), Column('vibration', '%', '%'),
         Column('offset', '%', '+%')),
        tuple((str(x), f'{y:g}', 100.0 * vibration, 100.0 * offset)
              for x, y, vibration, offset in rows),
        'percentages are of the step', legend=(
            ('vibration', 'peak to peak in the first period after the move'),
            ('offset', 'mean minus the setpoint')))]
    lines.append('the moves end ' + ', '.join(
        f'{x - y.begin:.3g}' for x, y in zip(found.rests, targets, strict=True))
        + ' s after their begin')
    if math.isfinite(found.frequency):
        lines.append(f'second mode at {found.frequency:.4g} Hz')
    if found.repeated:
        lines.append(f'note: {best} left less than all later runs: the next levels are its own')
    elif found.best != len(arguments.runs) - 1:
        lines.append(f'note: {best} left less than later runs: the next levels start from it, '
                     'with smaller changes')
    return show(arguments, {
        'runs': [{'run': x, 'setpoints': [
            dict(zip(('stretch', 'vibration', 'offset'), y[1:], strict=True))
            for y in rows if y[0] is x]} for x in arguments.runs],
        'best': best, 'repeated': found.repeated, 'second_mode': found.frequency,
        'rests': list(found.rests),
        'levels': list(zip(found.level_times, found.levels, strict=True)),
        'file': arguments.out}, *lines, written=[arguments.out])
