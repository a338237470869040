"""
Plan a sequence of setpoints without ROS.

Plan a sequence of setpoints, dimensionless as in the paper: each setpoint is a stretch and its
duration (move plus hold) in units of L sqrt(rho/G). With --params-file times are in seconds and
flux densities in tesla.

example: hmsa plan 1.10:10 1.20:10 1.40:10 --json
"""

import argparse
from dataclasses import asdict
import math
from pathlib import Path
from typing import Any, TYPE_CHECKING

from hmsa.cli.options import (
    add_command,
    argument,
    assume_options,
    law_of,
    LAW_OPTION,
    MATERIAL,
    of_unit,
    setpoint,
    show,
    temperature_option,
)
from hmsa.cli.terminal import progress
from hmsa.errors import add_words, BadInputError
from hmsa.files import check_targets
from hmsa.table import Column, Table

if TYPE_CHECKING:
    from hmsa.api.actuator import Actuator
    from hmsa.api.plan import Plan
    from hmsa.model.delivery import Delivery
    from hmsa.model.moves import Limits
    from hmsa.model.parameters import NondimensionalParameters
    from hmsa.model.units import Units
    from hmsa.planning.sequence import Segment

    Nominal = tuple[NondimensionalParameters, Limits, Delivery, Units]

# Units of time and load in the paper, as shown in messages and tables.
_TIME, _LOAD = 'L sqrt(rho/G)', 'mu0 G/Br'
# Options that describe a coil.
_WINDING = ('inductance', 'resistance', 'tesla_per_ampere')


def add_parser(subparsers: Any) -> None:
    """Add the command."""
    add_command(
        subparsers, __name__, __doc__,
        ('setpoints', 'STRETCH:DURATION', argument(setpoint),
         'target stretch, or deflection of a beam, and duration (move plus hold)',
         {'nargs': '*'}),
        ('--path', 'CSV', Path,
         'instead of setpoints, with --params-file: a path to follow from rest to rest, with the '
         'columns time (s) and stretch; the smoothest curve through them'),
        ('--start', 'S', float,
         'initial stretch, at rest (default 1; 0 for the deflection of a beam)'),
        *((option, metavar, float, text) for option, metavar, text in MATERIAL), LAW_OPTION,
        ('--bulk-ratio', 'K', float,
         'bulk over shear modulus of a compressible block, 1 to 1e6 (default constant volume)'),
        ('--shaper', 'NAME', str,
         'two_step (default), robust, minimax, minimum_time, modal, smooth, step, zv, zvd, ei or '
         'umzv'),
        ('--order', 'N', int,
         'order of a shaper (default 2). robust: a cascade of N two-step commands; minimax: as '
         'long as robust; modal: N half periods for a block with modes, and half a period more '
         'for each order above 2 for a beam',
         {'default': 2, 'needs': ('--shaper robust', '--shaper minimax', '--shaper modal')}),
        ('--errors', 'G,C,J', str,
         'relative errors in shear modulus, damping and J_lim that minimax must tolerate (default '
         '0.1,0.1,0.1, or the 95 %% confidence ellipsoid that hmsa identify stored in '
         '--params-file)',
         {'needs': ('--shaper minimax',)}),
        ('--periods', 'N', float,
         'minimum duration of a smooth move in natural periods (default 1)',
         {'default': 1.0, 'needs': ('--shaper smooth',)}),
        ('--max-rate', 'R', float, 'maximum stretch rate of a smooth move (default unlimited)',
         {'default': math.inf, 'needs': ('--shaper smooth',)}),
        ('--params-file', 'YAML', Path,
         'parameter file (YAML) of planner and plant, for a plan in seconds and tesla; actuator '
         'and coil are those of the file, shaper and its settings those of the options'),
        temperature_option(
            'with --params-file: temperature of block and coil in degrees Celsius; the file has '
            'the coefficients, thermal.* (default: its thermal.reference)'),
        of_unit('--tesla-per-ampere', 'T/A', 'field of the coil per current, for levels in A'),
        ('--amplifier',
         'with --params-file: also compare the move times and flux densities of amplifiers from '
         'fast to slow; with --tesla-per-ampere, --inductance and --resistance also current and '
         'voltage'),
        *((*of_unit(*x), {'needs': ('--amplifier',)}) for x in (
            ('--inductance', 'H', 'inductance L of the coil'),
            ('--resistance', 'ohm', 'resistance R of the coil'))),
        ('--out', 'FILE', Path,
         'with --params-file: levels to write, ending in .csv (for hmsa simulate and hmsa run '
         '--levels), .parquet or .mat; an existing file is replaced'),
        ('--json', 'print JSON in full precision'))


def run(arguments: argparse.Namespace) -> int:
    """
    Plan and print, in seconds and tesla if a parameter file is given.

    Raises `BadInputError` for a file of levels without one.
    """
    si = arguments.params_file is not None
    if bool(arguments.setpoints) == (arguments.path is not None) or arguments.path and not si:
        raise BadInputError(
            'expected STRETCH:DURATION such as 1.10:10, or --path CSV with --params-file')
    return _in_units(arguments) if si else _without_dimension(arguments)


def _in_units(arguments: argparse.Namespace) -> int:
    """Plan in seconds and tesla."""
    from hmsa.api.plan import table_of

    check_targets(arguments.out, sources=(arguments.path, arguments.params_file))
    actuator = _actuator(arguments)
    assume_options(arguments)
    shaper = arguments.shaper or 'two_step'
    if arguments.path is not None:
        return _along(actuator, arguments)
    plan = actuator.plan(arguments.setpoints, shaper, **_more(arguments))
    if arguments.out is not None:
        plan.save(arguments.out)
    group, units, per_ampere = (
        actuator.model.material, actuator.model.units, arguments.tesla_per_ampere)
    record = _record(plan, per_ampere)
    amplifiers = []
    if arguments.amplifier:
        with progress('planning for amplifiers'):
            amplifiers.append(actuator.amplifiers(
                arguments.setpoints, shaper=shaper, **_more(arguments),
                **{x: getattr(arguments, x) for x in _WINDING}))
        record['amplifiers'] = amplifiers[0].records()
    shown = [
        Column('span', 's', head='duration'),
        Column('flux_density_p', 'T'), Column('time_p', 's'), Column('flux_density_1', 'T')]
    if per_ampere is not None:
        shown += [Column('current_p', 'A'), Column('current_1', 'A')]
    return show(
        arguments, record, table_of(
            plan.segments, (Column(group.coordinate.name), *shown),
            [(x['stretch'], *(x[y.name] for y in shown)) for x in record['segments']],
            Column('between', 'T at s'), units.time, units.level, _caption(actuator)),
        *([f'{arguments.out} written'] if arguments.out is not None else []),
        *(f'\n{x}' for x in amplifiers))


def _record(plan: 'Plan', per_ampere: float | None) -> dict[str, Any]:
    """Return a plan in seconds and tesla as JSON."""
    group, units = plan.actuator.model.material, plan.actuator.model.units
    thermal = plan.actuator.block.thermal
    return ({'temperature': thermal.reference} if thermal else {}) | {
        'c1': group.c1, 'zeta': group.zeta, 'j_lim': group.j_lim, 'time_unit': units.time,
        'flux_density_unit': units.load,
        'segments': [_si_row(x, units, per_ampere) for x in plan.segments]}


def _caption(actuator: 'Actuator') -> str:
    group, unit = actuator.model.material, actuator.model.units.time
    thermal = actuator.block.thermal
    return (f'c1 {group.c1:.6g}, zeta {group.zeta:.6g}, time unit L sqrt(rho/G) {unit:.6g} s' + (
        f', at {thermal.reference:g} degrees Celsius' if thermal else ''))


def _without_dimension(arguments: argparse.Namespace) -> int:
    """Plan in the units of the paper."""
    from hmsa.api.plan import table_of
    from hmsa.model.equations import signed_root
    from hmsa.model.moves import check_target, Setpoint, State
    from hmsa.model.status import Code, RefusedError
    from hmsa.model.units import Units
    from hmsa.planning.sequence import plan_sequence
    from hmsa.planning.shapers.request import as_errors, ERRORS, MoveRequest, SmoothLimits

    if arguments.temperature is not None:
        raise BadInputError(
            '--temperature is given: expected --params-file with it, since a temperature changes '
            'parameters in SI units')
    if arguments.out is not None:
        raise BadInputError(
            '--out is given: expected --params-file with it, since the file has seconds and '
            'tesla')
    group = _group(arguments)
    for stretch, _ in arguments.setpoints:
        check_target(stretch, group.rest)
    errors = _errors(arguments)
    try:
        segments = plan_sequence(
            [Setpoint(*x) for x in arguments.setpoints],
            MoveRequest.of(
                group, State(group.rest if arguments.start is None else arguments.start),
                units=Units(time_name=f' {_TIME}', load_name=f' {_LOAD}'), order=arguments.order,
                errors=ERRORS if errors is None else as_errors(errors),
                pace=SmoothLimits(arguments.periods, arguments.max_rate)),
            arguments.shaper or 'two_step')
    except RefusedError as error:
        if error.code is not Code.SPELL_TOO_SHORT:
            raise
        raise RefusedError(
            error.code, f'{error}; if seconds were meant, name the actuator with '
            '--params-file') from error
    rows = [_row(x) for x in segments]
    return show(arguments, {'segments': rows}, table_of(
        segments, (
            Column(group.coordinate.name), Column('duration', _TIME), Column('b_p'),
            Column('tau_p', _TIME), Column('b_1')),
        [[x[y] for y in ('stretch', 'span', 'b_p', 'tau_p', 'b_1')] for x in rows],
        Column('between', 'b at tau'), 1.0, lambda load: float(signed_root(load)),
        'nondimensional as in the paper, b = sqrt(Br B/(mu0 G)); in seconds and tesla with '
        '--params-file'))


def nominal(arguments: argparse.Namespace) -> 'Nominal':
    """Return the model for planning; raise `BadInputError` if file and options conflict."""
    from hmsa.model.delivery import Delivery
    from hmsa.model.moves import Limits
    from hmsa.model.units import Units

    if arguments.params_file is None:
        return _group(arguments), Limits(), Delivery(), Units()
    model = _actuator(arguments).model
    return model.material, model.limits, model.delivery, model.units


def _actuator(arguments: argparse.Namespace) -> 'Actuator':
    """Return the actuator of the file; raise `BadInputError` for options that the file sets."""
    from hmsa.api.actuator import Actuator

    fixed = [f'--{x.replace("_", "-")}' for x in ('zeta', 'j_lim', 'c1', 'law', 'bulk_ratio')
             if getattr(arguments, x, None) is not None]
    if fixed:
        raise BadInputError(
            f'both --params-file and {", ".join(fixed)} are given: expected only one of them, '
            'since the file sets these values')
    actuator, given = Actuator.from_yaml(arguments.params_file), getattr(
        arguments, 'temperature', None)
    return actuator if given is None else actuator.at_temperature(given)


def _along(actuator: 'Actuator', arguments: argparse.Namespace) -> int:
    """Plan a path from a file, and print what it demands; raise `BadInputError` for others."""
    from hmsa.api.paths import following, path_of, read_path
    from hmsa.columns import remedy
    from hmsa.model.status import Code, RefusedError

    if extra := [f'--{x}' for x in ('shaper', 'start', 'amplifier') if getattr(arguments, x)]:
        raise BadInputError(f'--path and {extra[0]} are given: expected only one of them')
    points, per_ampere = read_path(arguments.path), arguments.tesla_per_ampere
    try:
        plan = actuator.follow(*points)
    except RefusedError as error:
        if error.code is Code.TOO_LONG:
            add_words(error, f'if times are in ms, {remedy("time", "ms", True)}')
        raise
    if arguments.out is not None:
        plan.save(arguments.out)
    found = following(plan, path_of(actuator, (*points, None, None)))
    record = _record(plan, per_ampere)
    record['path'] = asdict(found)
    name = actuator.model.material.coordinate.name
    columns = [
        Column('lowest', '', '.6g', f'minimum {name}'),
        Column('highest', '', '.6g', 'maximum'), Column('duration', 's'),
        Column('peak rate', '1/s', '.4g'), Column('levels'), Column('peak field', 'T', '.4g'),
        Column('peak field rate', 'T/s', '.4g'), Column('deviation', '', '.2g')]
    row: list[float] = [
        found.low, found.high, found.duration, found.peak_rate, found.levels,
        found.peak_flux_density, found.peak_flux_density_rate, found.deviation]
    if per_ampere is not None:
        columns.append(Column('peak current', 'A', '.4g'))
        row.append(found.peak_flux_density / per_ampere)
        record['path']['peak_current'] = row[-1]
    return show(
        arguments, record, Table(
            tuple(columns), (tuple(row),),
            _caption(actuator), tuple(x for y in plan.segments for x in y.notes()),
            (('deviation', 'maximum distance of a simulation from the path'),)),
        written=[arguments.out])


def _more(arguments: argparse.Namespace) -> dict[str, Any]:
    """Return the planning options for `Actuator.plan`."""
    return {
        'start': arguments.start, 'order': arguments.order, 'errors': _errors(arguments),
        'periods': arguments.periods, 'max_rate': arguments.max_rate}


def _group(arguments: argparse.Namespace) -> 'NondimensionalParameters':
    """Return the dimensionless parameters given by options."""
    from hmsa.interfaces.parameters import LAW
    from hmsa.model.laws import LAWS
    from hmsa.model.parameters import NondimensionalParameters

    without = [f'--{x.replace("_", "-")}' for x in ('amplifier', *_WINDING)
               if getattr(arguments, x, None)]
    if without:
        raise BadInputError(
            f'{", ".join(without)} is given: expected --params-file with it, since an amplifier '
            'has units')
    given: dict[str, Any] = {
        x: value for x in ('zeta', 'j_lim', 'c1') if (value := getattr(arguments, x)) is not None}
    if getattr(arguments, 'law', None) is not None:
        name, constants = law_of(arguments.law)
        law = LAWS[name]
        if law.endless:
            given['j_lim'] = math.inf
        elif law.scaled is not None:
            # In a dimensionless plan, only ratios of moduli matter.
            given['law'] = law.scaled({x.name: x.default for x in LAW} | {
                'actuator.remanence': 1.0} | {f'law.{x}': y for x, y in constants.items()})[1]
    if getattr(arguments, 'bulk_ratio', None) is not None:
        from hmsa.model.compressible import check, condensed

        elastic, j_lim = given.get('law'), given.get('j_lim', NondimensionalParameters.j_lim)
        check(arguments.bulk_ratio, elastic)
        given['law'] = condensed(elastic, j_lim, arguments.bulk_ratio)
    return NondimensionalParameters(**given)


def _errors(arguments: argparse.Namespace) -> list[float] | None:
    """Return the parameter errors for minimax, if given."""
    if arguments.errors is None:
        return None
    try:
        return [float(x) for x in arguments.errors.split(',')]
    except ValueError:
        raise BadInputError(
            f'--errors is {arguments.errors!r}: expected three numbers such as 0.1,0.1,0.05'
        ) from None


def _si_row(
        segment: 'Segment', units: 'Units', per_ampere: float | None) -> dict[str, Any]:
    """Return a segment with times in s, flux densities in T and any currents in A."""
    row = _row(segment)
    levels = [[units.duration(x.time), units.level(x.load)] for x in segment.move.levels]
    first, last = levels[0][1] if segment.shaped else None, units.level(segment.held)
    row |= {
        'span': units.duration(row['span']),
        'time_p': None if row['tau_p'] is None else units.duration(row['tau_p']),
        'flux_density_p': first, 'flux_density_1': last, 'levels': levels}
    if per_ampere is not None:
        row |= {'current_p': None if first is None else first / per_ampere,
                'current_1': last / per_ampere}
    return row


def _row(segment: 'Segment') -> dict[str, Any]:
    """Return a segment for the JSON output, with null for undefined numbers."""
    from hmsa.model.equations import signed_root

    move, shaped = segment.move, segment.shaped
    beta_p = move.levels[0].load if shaped else None
    beta_1, duration = segment.held, move.duration
    return {
        'stretch': segment.setpoint.stretch,
        'span': segment.setpoint.span,
        'beta_p': beta_p,
        'b_p': None if beta_p is None else float(signed_root(beta_p)),
        'tau_p': duration if shaped and math.isfinite(duration) else None,
        'beta_1': beta_1,
        'b_1': float(signed_root(beta_1)),
        'start_stretch': segment.start.stretch,
        'start_rate': segment.start.rate,
        'status': str(move.code),
    } | ({'vibration': move.vibration} if move.tail else {}) | (
        {} if segment.left is None else {'left': asdict(segment.left)})
