"""
Design the sequence to record for hmsa identify.

Design the sequence of levels that identifies the actuator best. It respects the limits of coil and
stretch and ends at rest. The table compares it with unshaped steps and with the paper's sequence,
repeated for the same duration.

example: hmsa excite --params-file actuator.yaml --duration 2 --out levels.csv
"""

import argparse
import math
from pathlib import Path
from typing import Any, TYPE_CHECKING

from hmsa.cli.options import add_command, assume_example, frequency, JSON, show
from hmsa.cli.terminal import progress
from hmsa.files import check_targets, write_text
from hmsa.table import Column, Table

if TYPE_CHECKING:
    from hmsa.identification.excitation import Excitation, Program
    from hmsa.model.parameters import ActuatorParameters


def add_parser(subparsers: Any) -> None:
    """Add the command."""
    add_command(
        subparsers, __name__, __doc__,
        ('--params-file', 'YAML', Path,
         'parameter file with estimates of the block, flux_density_min, flux_density_max and '
         'slew_limit (default: the example block)'),
        ('--duration', 'S', float, 'duration in s (default 180 periods of the block)'),
        ('--free', 'NAME,...', str, 'parameters to identify, as in hmsa identify; +modes designs '
         'a smaller motion that excites the modes of the parameter file, or two typical ones',
         {'default': ''}),
        ('--stretch-min', 'X', float,
         'minimum stretch (default 0.6; a deflection of -0.6 for a beam)'),
        ('--stretch-max', 'X', float,
         'maximum stretch (default 2; a deflection of 0.6 for a beam)'),
        frequency(
            '--rate', 'sample rate of the sensor in Hz (default 1000)', default=1000.0),
        ('--noise', 'X', float, 'standard deviation of the stretch samples (default 0.001)',
         {'default': 1e-3}),
        ('--out', 'CSV', Path,
         'CSV to write, with the columns time and flux_density; an existing file is replaced'),
        JSON)


def run(arguments: argparse.Namespace) -> int:
    """Design, write and print a sequence."""
    from hmsa.identification.excitation import Bounds, excite
    from hmsa.identification.files import read_belief
    from hmsa.identification.quantities import free_of

    check_targets(arguments.out, sources=[arguments.params_file])
    belief = read_belief(arguments.params_file)
    if arguments.params_file is None:
        assume_example()
    with progress('designing the sequence'):
        found = excite(
            belief.actuator, Bounds.of(belief, arguments.stretch_min, arguments.stretch_max),
            duration=arguments.duration, rate=arguments.rate, noise=arguments.noise,
            free=free_of(arguments.free, belief.actuator.law))
    if arguments.out is not None:
        rows = zip(found.best.level_times, found.best.levels, strict=True)
        lines = ['time,flux_density', *(f'{x:.9f},{y:.9g}' for x, y in rows)]
        write_text(arguments.out, '\n'.join(lines) + '\n')
    return show(arguments, {
        'duration': found.duration, **_record(found.best), 'improvement': found.improvement,
        'plain': _record(found.plain), 'paper': _record(found.paper),
    }, *_lines(found, belief.actuator), written=[arguments.out])


def _record(program: 'Program') -> dict[str, Any]:
    """Return a sequence as JSON."""
    return {
        'levels': list(zip(program.level_times, program.levels, strict=True)),
        'std': program.std, 'stretch_min': program.reach[0],
        'stretch_max': program.reach[1], 'ends_at_rest': program.ends_at_rest}


def _lines(found: 'Excitation', actuator: 'ActuatorParameters') -> tuple[str, Table]:
    """Return a description of the sequence, and its comparison with others."""
    from hmsa.identification.quantities import modulus_of

    best, gains = found.best, found.gains
    labels = {'shear_modulus': modulus_of(actuator.law)[0]}
    least = min(gains, key=lambda x: gains[x])
    return (
        f'{len(best.levels)} levels in {found.duration:.4g} s, {actuator.coordinate.name} '
        f'{best.reach[0]:.3f} to {best.reach[1]:.3f}, '
        + ('at rest at the end' if best.ends_at_rest else 'still moving at the end'),
        Table(
            tuple(Column(x, '', '.1f') for x in (
                'standard deviation', 'this', 'unshaped steps', 'paper', 'gain')),
            tuple((
                labels.get(name, name),
                *(_share(name, x.std[name]) for x in (best, found.plain, found.paper)),
                gains.get(name)) for name in best.std),
            f'gain: unshaped steps over this; the minimum, {gains[least]:.1f}, is that of '
            f'{labels.get(least, least)}'))


def _share(name: str, value: float) -> str:
    if not math.isfinite(value):
        return 'unknown'
    return f'{value:.1e}' if name == 'stretch_bias' else f'{100.0 * value:.2g} %'
