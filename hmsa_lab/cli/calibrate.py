"""
Calibrate coil, delays and statics of a bench.

Calibrate a part of a bench, and write its parameters for driver and planner.

example: hmsa calibrate coil readings.csv --out coil.yaml
"""

import argparse
from contextlib import nullcontext, redirect_stdout
from dataclasses import asdict
import math
from pathlib import Path
import sys
from typing import Any, TYPE_CHECKING

from hmsa.cli.options import add_command, assume_example, JSON, Row, show
from hmsa.cli.pictures import paper_of, picture_options
from hmsa.cli.terminal import progress, under_way
from hmsa.errors import BadInputError, check_number, HmsaError
from hmsa.files import check_targets, write_text, yaml_text
from hmsa.interfaces.quantities import quantity_of
from hmsa_lab.cli.check_driver import SETTINGS, settings_of

if TYPE_CHECKING:
    from collections.abc import Callable

    from hmsa.model.equations import Array
    from hmsa_lab.bench.assembly import SensorScale
    from hmsa_lab.bench.bench import Bench

# Number of readings of a probe that are averaged.
_READINGS = 20
_SIMULATED = 'hmsa_lab.bench.bench:'
# Fraction of the range below which hysteresis is negligible.
_NO_HYSTERESIS = 1e-4
# Largest remaining drift of the stretch at the end of a level, as a fraction of the range.
_SETTLED = 0.01

_LIMIT: Row = ('--limit', 'T', float, 'maximum flux density (default 0.01 T)', {'default': 0.01})
_SOURCE: tuple[Row, ...] = (
    ('source', 'MODULE:NAME', str,
     'hardware as in the parameter hardware of hmsa driver, with a sensor', {'nargs': '?'}),
    ('--simulate', 'calibrate a simulated bench with delays and noise'), SETTINGS, _LIMIT)


def add_parser(subparsers: Any) -> None:
    """Add the command and its kinds."""
    parser = add_command(subparsers, __name__, __doc__)
    kinds = parser.add_subparsers(metavar='PART', required=True)
    add_command(
        kinds, 'coil', _coil.__doc__,
        ('source', 'MODULE:NAME|CSV', str,
         'hardware as in the parameter hardware of hmsa driver, with an approximate coil '
         'constant; or readings with the columns current (A) and flux_density (T), in the '
         'order taken'),
        SETTINGS, _LIMIT,
        ('--steps', 'N', int, 'levels on each quarter of the loop (default 5)', {'default': 5}),
        ('--settle', 'S', float, 'time at each level before it is read (default 1 s)',
         {'default': 1.0}),
        ('--probe', 'MODULE:NAME', str,
         'class, or function without arguments, that returns the field probe: an object whose '
         'read() '
         'returns a flux density in T (default: type the readings, with or without a unit)'),
        ('--hysteresis',
         'also write the hysteresis of an iron core, which the driver then compensates, and '
         'demagnetise the core at the end'),
        ('--out', 'YAML', Path,
         'parameter file of the driver to write; a table is written beside it as CSV'),
        JSON, *picture_options('readings and model to draw'), run=_coil)
    add_command(
        kinds, 'latency', _latency.__doc__, *_SOURCE,
        ('--steps', 'N', int, 'number of levels (default 24)', {'default': 24}),
        ('--params-file', 'YAML', Path,
         'parameter file with the sizes of the actuator, and rough values (default: none)'),
        ('--probe', 'MODULE:NAME', str,
         'class, or function without arguments, that returns a field probe: an object whose '
         'read() '
         'returns a flux density in T, or a list of (flux density, NaN, time in ns)'),
        ('--lag', 'S', float, 'known time constant of the coil, if there is no probe'),
        ('--out', 'YAML', Path, 'parameter file of driver and planner to write'),
        JSON, *picture_options('response of the field to draw, or of the stretch'), run=_latency)
    add_command(
        kinds, 'static', _static.__doc__, *_SOURCE,
        ('--steps', 'N', int, 'levels on each quarter of the staircase (default 5)',
         {'default': 5}),
        ('--settle', 'S', float,
         'time at each level; samples of the second half count (default 2 s)', {'default': 2.0}),
        ('--gauge', 'MODULE:NAME', str,
         'class, or function without arguments, that returns a gauge: an object whose read() '
         'returns the '
         'length of the actuator in the unit of its rest length'),
        ('--out', 'YAML', Path,
         'parameter file of driver and planner to write; the table is written beside it as CSV'),
        JSON, *picture_options('staircase to draw'), run=_static)


def _coil(arguments: argparse.Namespace) -> int:
    """
    Flux density over current, against a field probe.

    Set levels from 0 to --limit, to its negative and back, and read a field probe at each level,
    by a Python class or by hand; or evaluate readings from a CSV. Prints the coil constant with
    its 95 % interval, saturation and hysteresis, and writes the settings of the driver. The coil
    is off at the end, and after Ctrl-C.

    example: hmsa calibrate coil my_lab:Coil --limit 0.1 --out coil.yaml
    """
    from hmsa_lab.bench.assembly import fit_core
    from hmsa_lab.bench.calibration import calibrate_coil

    source, out = Path(arguments.source), arguments.out
    # Whether the table beside the file is written depends on the readings.
    paper = paper_of(
        arguments, *(x for x in _files(out) if x == out or x.resolve() != source.resolve()),
        sources=[source])
    if not (arguments.limit > 0.0 and arguments.settle >= 0.0 and arguments.steps >= 2):
        raise BadInputError(
            f'--limit {arguments.limit:g}, --settle {arguments.settle:g} or --steps '
            f'{arguments.steps}: expected a limit above 0 T, at least 0 s and at least 2 steps')
    current, flux = _readings(arguments)
    found = calibrate_coil(current, flux)
    if found.model == 'table':
        check_targets(*_files(out), sources=[source])
    core, left = None, math.nan
    try:
        core, left = fit_core(found.curve(current), flux)
    except BadInputError:
        if arguments.hysteresis:
            raise
    if arguments.picture:
        from hmsa_lab.bench.report import draw_coil

        draw_coil(arguments.picture, current, flux, found, paper)
    low, high = found.interval
    constant = f'{found.tesla_per_ampere:.6g} T/A, 95 % interval {low:.6g} to {high:.6g}'
    table = None
    if arguments.out is not None:
        if found.model == 'table':
            table = _write_table(arguments.out, {
                'current [A]': found.current, 'flux_density [T]': found.flux_density})
        settings = found.settings(str(table and table.resolve()))
        if core is not None and arguments.hysteresis:
            settings |= {'hardware.coil.play_widths': list(core.widths),
                         'hardware.coil.play_weights': list(core.weights)}
        _write_parameters(
            arguments.out, f'{constant}, by hmsa calibrate coil', {'driver': settings})
    hysteresis = 'unknown: no current was approached from both sides'
    if not math.isnan(found.hysteresis):
        hysteresis = f'{100.0 * found.hysteresis:.2g} % of the range'
        if core is not None and found.hysteresis >= _NO_HYSTERESIS:
            hysteresis += f', {100.0 * left:.2g} % from the model' + (
                '' if arguments.hysteresis else ' that --hysteresis writes')
    return show(
        arguments, {
            **{x: getattr(found, x) for x in (
                'tesla_per_ampere', 'std', 'interval', 'saturation', 'offset', 'misses',
                'hysteresis', 'model')},
            'compensated': left, 'current': found.current, 'flux_density': found.flux_density,
            'file': arguments.out},
        f'coil constant   {constant}',
        'saturation      ' + (f'{found.saturation:.4g} T' if math.isfinite(found.saturation)
                              else 'does not show'),
        f'hysteresis      {hysteresis}', f'probe offset    {found.offset:.3g} T',
        f'model           {found.model}, largest error {100.0 * found.misses:.2g} % of the range',
        written=(arguments.out, table))


def _readings(arguments: argparse.Namespace) -> 'tuple[Array, Array]':
    """Return currents in A and flux densities in T, from a file or from the coil."""
    from hmsa.plugins import HARDWARE, registered

    path = Path(arguments.source)
    if path.suffix.lower() in ('.csv', '.txt', '.tsv') or (
            path.is_dir() and arguments.source not in registered(HARDWARE)):
        from hmsa.columns import read_currents

        return read_currents(path)
    import numpy as np

    from hmsa_lab.bench.assembly import CoilModel
    from hmsa_lab.bench.calibration import decay, loop

    read = _typed if arguments.probe is None else _probe(arguments.probe)
    rows = []
    with _bench(arguments.source, arguments, rate=0.0) as bench:
        coil = getattr(bench.coil.instrument.hardware, 'coil', None)
        if not isinstance(coil, CoilModel):
            raise BadInputError(
                f'{arguments.source} has no coil of currents: expected an Assembly of a source '
                'and a CoilModel (hmsa_lab.bench.assembly); for another class, give a CSV of '
                'readings with the columns current and flux_density')
        levels = loop(arguments.limit, arguments.steps)
        # No progress is shown over typed input.
        with progress('starting') if arguments.probe else nullcontext() as update:
            for i, level in enumerate(levels):
                bench.hold(arguments.settle, [level])
                current = coil.current(level)
                if update is not None:
                    update(f'{current:.4g} A', i / len(levels))
                rows.append((current, read(current)))
        if arguments.hysteresis:
            for level in decay(arguments.limit):
                bench.hold(arguments.settle, [level])
    current, flux = np.array(rows).T
    return current, flux


def _typed(current: float) -> float:
    """Ask until a reading is valid; raise `HmsaError` at the end of the input."""
    with redirect_stdout(sys.stderr), under_way():  # the question is not a result
        while True:
            try:
                return quantity_of(
                    input(f'flux density at {current:.4g} A [T, or with a unit]: '), 'T',
                    'reading')
            except BadInputError as error:
                print(error)
            except EOFError:
                raise HmsaError(
                    'the readings end early: expected one for each level') from None


def _probe(name: str) -> 'Callable[[float], float]':
    """Return a function that averages readings of a probe; raise `BadInputError` if invalid."""
    from hmsa_ros.device.hardware import described

    probe = _made(name, '--probe')

    def read(_: float) -> float:
        try:
            values = [float(probe.read()) for _ in range(_READINGS)]
        except BaseException as error:
            raise HmsaError(f'{name}.read raised {described(error)}') from error
        return sum(values) / len(values)

    return read


def _made(name: str, option: str) -> Any:
    """Return a probe or gauge that can be read; raise `BadInputError` if there is none."""
    from hmsa_ros.device.hardware import described, imported

    try:
        found = imported(name)()
        found.read()
    except BaseException as error:  # any error of the laboratory's module
        raise BadInputError(
            f'{option} {name} does not start ({described(error)}): expected MODULE:NAME that, '
            'called without arguments, returns an object with the method read') from error
    return found


def _files(out: Path | None) -> tuple[Path, ...]:
    """Return a parameter file and the table beside it."""
    return () if out is None else (out, out.with_suffix('.csv'))


def _write_table(out: Path, columns: 'dict[str, Array]') -> Path:
    """Write columns to a table next to a parameter file; return its path."""
    from hmsa.columns import write_table

    _, table = _files(out)
    write_table(table, columns)
    return table


def _write_parameters(out: Path, words: str, nodes: 'dict[str, dict[str, Any]]') -> None:
    """Write parameters by node, below a comment."""
    lines = [f'# {words}']
    for node, values in nodes.items():
        if values:
            lines += [f'/**/{node}:', '  ros__parameters:', *(
                f'    {key}: {yaml_text(value)}' for key, value in values.items())]
    write_text(out, '\n'.join(lines) + '\n')


def _checked(arguments: argparse.Namespace, least: int) -> str:
    """Check the options, with a minimum number of steps; return the name of the hardware."""
    if arguments.simulate is (arguments.source is not None):
        raise BadInputError('expected either MODULE:NAME of hardware or --simulate')
    check_number('--steps', arguments.steps, least=least)
    check_number('--limit', arguments.limit, 'T', above=0.0)
    return f'{_SIMULATED}SimulatedBench' if arguments.simulate else str(arguments.source)


def _bench(name: str, arguments: argparse.Namespace, rate: float = 1000.0) -> 'Bench':
    """Return running hardware whose sensor is read at a rate in Hz."""
    from hmsa_lab.bench.bench import Bench

    return Bench(name, settings_of(arguments), arguments.limit, rate)


def _scale(bench: 'Bench') -> 'SensorScale | None':
    """Return the scale of a sensor; None if the hardware does not have one."""
    from hmsa_lab.bench.assembly import SensorScale

    found = getattr(bench.coil.instrument.hardware, 'scale', None)
    return found if isinstance(found, SensorScale) else None


def _latency(arguments: argparse.Namespace) -> int:
    """
    Transport, coil lag and sensor latency.

    Step through levels up to --limit and read samples, and a field probe where there is one.
    Prints the delay of the field after the timestamp of its command, the time constant of the
    field, and by how much timestamps of the samples are too late, with 95 % intervals. Without a
    probe the latency includes delays that the device does not report. The coil is off at the end,
    and after Ctrl-C.

    example: hmsa calibrate latency my_lab:Bench --probe my_lab:Hall --limit 0.05 --out delays.yaml
    """
    name = _checked(arguments, 2)
    paper = paper_of(arguments, arguments.out, sources=[arguments.params_file])
    if arguments.lag is not None:
        check_number('--lag', arguments.lag, 's', least=0.0, most=1.0)
        if arguments.probe is not None or arguments.simulate:
            raise BadInputError(
                '--lag is given with a probe, which measures it: expected one of both')
    from hmsa.identification.files import read_belief
    from hmsa_lab.bench.calibration import measure_delays, steps_of

    actuator = read_belief(arguments.params_file).actuator
    if arguments.params_file is None and not arguments.simulate:
        assume_example()
    probe = _made(f'{_SIMULATED}SimulatedProbe', '--simulate') if arguments.simulate else (
        None if arguments.probe is None else _made(arguments.probe, '--probe'))
    with _bench(name, arguments) as bench, progress() as update:
        scale = _scale(bench)
        found = measure_delays(
            bench, steps_of(actuator, arguments.limit, arguments.steps), probe, actuator,
            arguments.lag, update)
    if arguments.picture:
        from hmsa_lab.bench.report import draw_delays

        draw_delays(arguments.picture, found, paper)
    delays = {'transport': found.transport, 'lag': found.lag, 'latency': found.latency}
    notes = list(found.notes)
    if arguments.out is not None:
        if scale is None:
            notes.append(f'{name} has no setting sensor.latency: take '
                         f'{found.setting.value:.6g} s off the timestamps of its samples')
        _write_parameters(arguments.out, 'by hmsa calibrate latency; times in s', {
            'driver': {} if scale is None else {
                'hardware.sensor.latency': scale.latency + found.setting.value},
            'planner': {'coil_time_constant': max(found.lag.value, 0.0)} if math.isfinite(
                found.lag.value) else {}})
    return show(
        arguments, {
            **{x: asdict(y) for x, y in delays.items()}, 'jitter': found.jitter,
            'setting': found.setting.value, 'verdict': found.motion.verdict, 'notes': notes,
            'file': arguments.out},
        *(f'{x:<16}' + ('unknown' if math.isnan(y.value) else (
            f'{1e3 * y.value:.4g} ms, 95 % interval {1e3 * y.low:.4g} to {1e3 * y.high:.4g}'))
          for x, y in delays.items()),
        f'jitter          {1e3 * found.jitter:.3g} ms, of what the device reports',
        *(f'note: {x}' for x in notes), written=[arguments.out])


def _static(arguments: argparse.Namespace) -> int:
    """
    Stretch at rest over flux density, and the scale of the sensor.

    Hold a slow staircase of levels, from 0 to --limit, to its negative and back. Writes the table
    of the hyperelastic model "table" for the planner, and the scale of the sensor for which the
    stretch without a field is 1. With --gauge, also writes gain and offset of the sensor. The coil
    is off at the end, and after Ctrl-C.

    example: hmsa calibrate static my_lab:Bench --limit 0.05 --settle 5 --out static.yaml
    """
    # A table needs six levels.
    paper, name = paper_of(arguments, *_files(arguments.out)), _checked(arguments, 3)
    check_number('--settle', arguments.settle, 's', least=0.1)
    from hmsa_lab.bench.calibration import hold_staircase, scale_at_rest, scale_by_gauge, statics

    gauge = None if arguments.gauge is None else _made(arguments.gauge, '--gauge')
    with _bench(name, arguments) as bench, progress() as update:
        scale = _scale(bench)
        level, stretch, length, drift = hold_staircase(
            bench, arguments.limit, arguments.steps, arguments.settle,
            None if gauge is None else lambda _: float(gauge.read()), update)
    found, misses = statics(level, stretch), math.nan
    notes = []
    if drift > _SETTLED:
        notes.append(f'the stretch still goes by {100.0 * drift:.2g} % of the range at the end of '
                     'a level: raise --settle')
    if scale is None:
        notes.append(f'{name} has no scale of its sensor (an Assembly has): it shows '
                     f'{found.rest:.6g} without a field, expected 1')
    elif gauge is not None:
        scale, misses = scale_by_gauge(scale, level, stretch, length)
    else:
        scale = scale_at_rest(scale, found.rest)
    if arguments.picture:
        from hmsa_lab.bench.report import draw_statics

        draw_statics(arguments.picture, level, stretch, found, paper)
    sensor = {} if scale is None else {
        f'hardware.sensor.{x}': getattr(scale, x) for x in ('gain', 'offset', 'rest_length')}
    table = None
    if arguments.out is not None:
        table = _write_table(
            arguments.out, {'stretch': found.stretch, 'flux_density': found.level})
        _write_parameters(arguments.out, 'by hmsa calibrate static', {
            'driver': sensor, 'planner': {'law.name': 'table', 'law.file': str(table.resolve())}})
    return show(
        arguments, {
            'level': found.level, 'stretch': found.stretch, 'rest': found.rest,
            'apart': found.apart, 'drift': drift, 'scale': sensor, 'misses': misses,
            'notes': notes, 'file': arguments.out},
        f'stretch         {found.stretch[0]:.4f} to {found.stretch[-1]:.4f}, {len(found.level)} '
        f'levels of {found.level[0]:.4g} to {found.level[-1]:.4g} T',
        f'branches        apart by {100.0 * found.apart:.2g} % of the range',
        f'without a field {found.rest:.6g} as the sensor shows it',
        *(f'{x.removeprefix("hardware."):<20}{y:.6g}' for x, y in sensor.items()),
        *(f'note: {x}' for x in notes), written=(arguments.out, table))
