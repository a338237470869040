"""
Plan a periodic motion of the stretch without ROS.

Plan levels whose response is a wave of the stretch, from rest to rest without a field, and print
the frequencies that the coil allows. SHAPE is sine, triangle, square (two-step moves), sweep (a
sine from --frequency to --to) or a CSV with one period in the columns time and stretch; its mean
and peak become offset and amplitude. Execute the levels with hmsa run --levels.

example: hmsa wave sine --frequency 30 --amplitude 0.05 --out wave.csv
"""

import argparse
from pathlib import Path
from typing import Any, TYPE_CHECKING

from hmsa.cli.options import actuator_of, add_command, EXAMPLE, frequency, JSON, show
from hmsa.errors import BadInputError, meant
from hmsa.files import check_targets

if TYPE_CHECKING:
    from hmsa.api.actuator import Actuator


def add_parser(subparsers: Any) -> None:
    """Add the command."""
    add_command(
        subparsers, 'wave', __doc__,
        ('shape', 'SHAPE', str, 'sine, triangle, square, sweep or CSV'),
        ('--offset --mean', 'STRETCH', float, 'mean stretch (default: that without a field)'),
        frequency('--frequency', 'frequency', required=True),
        ('--amplitude', 'STRETCH', float, 'amplitude of the stretch', {'required': True}),
        ('--cycles', 'N', float,
         'cycles at full amplitude, besides those in which the wave fades in and out (default 10)',
         {'default': 10.0}),
        frequency('--to', 'last frequency of a sweep'),
        EXAMPLE,
        ('--out', 'FILE', Path,
         'levels to write, ending in .csv, .parquet or .mat; an existing file is replaced'),
        ('--path', 'CSV', Path,
         'points of the wave to write, for hmsa run --path and hmsa send --path; not available '
         'for square'),
        JSON)


def run(arguments: argparse.Namespace) -> int:
    """Print the possible range, plan and write; raise `BadInputError` for an invalid wave."""
    from hmsa.api.paths import bands_text, read_path, SHAPES

    if (arguments.shape == 'sweep') != (arguments.to is not None):
        raise BadInputError(
            f'the shape is {arguments.shape} and --to is {arguments.to}: expected --to HZ with '
            'sweep, and with no other shape')
    check_targets(
        arguments.out, arguments.path, sources=(Path(arguments.shape), arguments.params_file))
    actuator = actuator_of(arguments.params_file)
    shape: Any = arguments.shape
    if shape.lower().endswith('.csv') or (
            shape not in (*SHAPES, 'sweep') and Path(shape).is_dir()):
        times, stretches = read_path(Path(shape))
        shape = {'time': times, 'stretch': stretches}
    elif shape == 'sweep':
        shape = 'sine'
    elif shape not in SHAPES:
        known = (*SHAPES, 'sweep')
        raise BadInputError(
            f'the shape is {shape!r}: expected {", ".join(known)}, or a CSV with the columns time '
            'and stretch' + meant(shape, known))
    if arguments.path is not None:
        _write_path(arguments, actuator, shape)
    bands = actuator.wave_bands(shape, arguments.amplitude, arguments.offset)
    if not arguments.json:
        print(f'an amplitude of {arguments.amplitude:g} is possible '
              + (bands_text(bands) or 'at no frequency'))
    plan = actuator.wave(
        shape, arguments.frequency, arguments.amplitude, offset=arguments.offset,
        cycles=arguments.cycles, last=arguments.to)
    if arguments.out is not None:
        plan.save(arguments.out)
    duration = float(sum(x for x in plan.setpoints[:-1, 1]) + plan.move_times[-1])
    notes = [y for x in plan.segments for y in x.notes()]
    return show(
        arguments, {
            'bands': bands, 'duration': duration, 'levels': plan.levels, 'notes': notes},
        f'{len(plan.levels)} levels of {plan.flux_densities.min():.4g} to '
        f'{plan.flux_densities.max():.4g} T, at rest after '
        f'{duration:.4g} s', *(f'note: {x}' for x in notes),
        written=(arguments.out, arguments.path))


def _write_path(arguments: argparse.Namespace, actuator: 'Actuator', shape: Any) -> None:
    """Write the points of the wave; raise `BadInputError` for a square wave."""
    from hmsa.api.paths import wave_of, wave_path, wave_points
    from hmsa.columns import write_table

    if shape == 'square':
        raise BadInputError(
            'a square wave is not a path, because it jumps: expected --out FILE for its levels, '
            'or its extremes as setpoints of hmsa run, which feedback corrects one by one')
    first, last = arguments.frequency, arguments.to
    path = wave_path(
        actuator, wave_of(actuator, shape, arguments.amplitude, arguments.offset),
        (first, first if last is None else last), arguments.cycles)
    times, stretches = wave_points(path, actuator.model.units.time).T
    write_table(arguments.path, {'time': times, 'stretch': stretches})
