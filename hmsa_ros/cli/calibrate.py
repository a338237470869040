"""
Calibrate the coil of a bench.

Calibrate a part of a bench, and write what the driver reads.

example: hmsa calibrate coil readings.csv --out coil.yaml
"""

import argparse
import math
from pathlib import Path
from typing import Any, TYPE_CHECKING

from hmsa_ros.cli.check_driver import setting
from hmsa_ros.cli.options import add_command, add_options, JSON
from hmsa_ros.cli.progress import progress
from hmsa_ros.cli.quantities import number_of
from hmsa_ros.errors import BadInputError, HmsaError
from hmsa_ros.files import check_targets, json_text, write_text, yaml_text

if TYPE_CHECKING:
    from collections.abc import Callable

    from hmsa_ros.device.calibration import CoilCalibration
    from hmsa_ros.model.equations import Array

# Readings of a probe that are averaged.
_READINGS = 20


def add_parser(subparsers: Any) -> None:
    """Add the command and its kinds."""
    parser = add_command(subparsers, __name__, __doc__)
    kinds = parser.add_subparsers(metavar='PART', required=True)
    coil = add_command(kinds, 'coil', _coil.__doc__)
    coil.set_defaults(run=_coil, parser=coil)
    coil.add_argument(
        'source', metavar='MODULE:NAME|CSV',
        help='hardware as in the parameter hardware of hmsa driver, with a coil constant that is '
             'roughly right; or readings with the columns current (A) and flux_density (T), in '
             'the order taken')
    add_options(
        coil,
        ('--set', 'KEY=VALUE', str, 'a setting of the hardware, as hardware.KEY of hmsa driver; '
         'may be given several times', {'action': 'append', 'default': []}),
        ('--limit', 'T', float, 'maximum flux density (default 0.01 T)', {'default': 0.01}),
        ('--steps', 'N', int, 'levels on each quarter of the loop (default 5)', {'default': 5}),
        ('--settle', 'S', float, 'time at each level before it is read (default 1 s)',
         {'default': 1.0}),
        ('--probe', 'MODULE:NAME', str,
         'makes the field probe: called without arguments, it returns an object whose read() '
         'returns a flux density in T (default: readings are typed, with or without a unit)'),
        ('--out', 'YAML', Path,
         'parameter file of the driver to write; a table is written beside it as CSV'),
        JSON)


def run(arguments: argparse.Namespace) -> int:
    """Calibrate the part named; the kinds have their own."""
    status: int = arguments.run(arguments)
    return status


def _coil(arguments: argparse.Namespace) -> int:
    """
    Flux density over current, against a field probe.

    Take the coil through a loop of levels, from 0 to --limit, to its negative and back, and read a
    field probe at each: an object of Python, or a person who types the readings. Or evaluate
    readings in a CSV. Prints the coil constant with its 95 % interval, saturation and hysteresis,
    and writes the settings of the driver. The coil is off at the end, and after Ctrl-C.

    example: hmsa calibrate coil my_lab:Coil --limit 0.1 --out coil.yaml
    """
    from hmsa_ros.device.calibration import calibrate_coil

    check_targets([] if arguments.out is None else [arguments.out])
    if not (arguments.limit > 0.0 and arguments.settle >= 0.0 and arguments.steps >= 2):
        raise BadInputError(
            f'--limit {arguments.limit:g}, --settle {arguments.settle:g} or --steps '
            f'{arguments.steps}: expected a limit above 0 T, at least 0 s and at least 2 steps')
    current, flux = _readings(arguments)
    found = calibrate_coil(current, flux)
    table = ''
    if arguments.out is not None:
        table = str(_write(arguments.out, found))
    if arguments.json:
        print(json_text({
            **{x: getattr(found, x) for x in (
                'tesla_per_ampere', 'std', 'interval', 'saturation', 'offset', 'misses',
                'hysteresis', 'model')},
            'current': found.current.tolist(), 'flux_density': found.flux_density.tolist(),
            'file': None if arguments.out is None else str(arguments.out)}))
        return 0
    low, high = found.interval
    print(f'{"coil constant":<16}{found.tesla_per_ampere:.6g} T/A, 95 % interval {low:.6g} to '
          f'{high:.6g}')
    for label, text in (
            ('saturation', f'{found.saturation:.4g} T' if math.isfinite(found.saturation)
             else 'does not show'),
            ('hysteresis', f'{100.0 * found.hysteresis:.2g} % of the range' if math.isfinite(
                found.hysteresis) else 'unknown: no current was approached from both sides'),
            ('probe offset', f'{found.offset:.3g} T'),
            ('model', f'{found.model}, off by at most {100.0 * found.misses:.2g} % of the range')):
        print(f'{label:<16}{text}')
    if arguments.out is not None:
        print(f'{arguments.out} written{f", and {table}" if found.model == "table" else ""}')
    return 0


def _readings(arguments: argparse.Namespace) -> 'tuple[Array, Array]':
    """Return currents in A and flux densities in T, from a file or from the coil."""
    path = Path(arguments.source)
    if path.suffix.lower() in ('.csv', '.txt', '.tsv'):
        from hmsa_ros.columns import read_table

        columns = read_table(path, ('current', 'flux_density')).columns
        return columns['current'], columns['flux_density']
    from hmsa_ros.device.calibration import held_coil, loop, read_loop

    read = _typed if arguments.probe is None else _probe(arguments.probe)
    settings = dict(setting(x) for x in arguments.set)
    with held_coil(arguments.source, settings, arguments.limit) as held:
        levels = loop(arguments.limit, arguments.steps)
        if arguments.probe is None:
            return read_loop(held, levels, arguments.settle, read, lambda text, share: None)
        with progress('starting') as update:
            return read_loop(held, levels, arguments.settle, read, update)


def _typed(current: float) -> float:
    """Ask for a reading until there is one; the end of the input is a `HmsaError`."""
    while True:
        try:
            return number_of(
                input(f'flux density at {current:.4g} A [T, or with a unit]: '), 'T', 'reading')
        except BadInputError as error:
            print(error)
        except EOFError:
            raise HmsaError('the readings end early: expected one for each level') from None


def _probe(name: str) -> 'Callable[[float], float]':
    """Return what reads a probe, some times; `BadInputError` if there is none."""
    from hmsa_ros.device.hardware import imported, told

    try:
        probe = imported(name)()
        probe.read()
    except BaseException as error:  # whatever a laboratory's module raises
        raise BadInputError(
            f'--probe {name} does not start ({told(error)}): expected MODULE:NAME that, called '
            'without arguments, returns an object with the method read') from error

    def read(_: float) -> float:
        try:
            values = [float(probe.read()) for _ in range(_READINGS)]
        except BaseException as error:
            raise HmsaError(f'{name}.read raised {told(error)}') from error
        return sum(values) / len(values)

    return read


def _write(out: Path, found: 'CoilCalibration') -> Path:
    """Write the driver's parameters, and a table beside them; return the path of that."""
    table = out.with_suffix('.csv')
    if found.model == 'table':
        rows = zip(found.current.tolist(), found.flux_density.tolist(), strict=True)
        write_text(table, '\n'.join(
            ['current,flux_density', *(f'{x!r},{y!r}' for x, y in rows)]) + '\n')
    low, high = found.interval
    write_text(out, '\n'.join([
        f'# {found.tesla_per_ampere:.6g} T/A, 95 % interval {low:.6g} to {high:.6g}, by hmsa '
        'calibrate coil',
        '/**/driver:', '  ros__parameters:',
        *(f'    {key}: {yaml_text(value)}' for key, value in found.settings(
            str(table.resolve())).items())]) + '\n')
    return table
