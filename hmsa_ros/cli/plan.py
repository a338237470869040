"""``hmsa plan``: plan a sequence without ROS."""

import argparse
from collections.abc import Mapping, Sequence
import math
from pathlib import Path
from typing import Any, TYPE_CHECKING

from hmsa_ros.cli.options import add_options, MATERIAL
from hmsa_ros.cli.setpoints import setpoint
from hmsa_ros.errors import BadInputError
from hmsa_ros.files import json_text
from hmsa_ros.planning.setpoint import impossible

if TYPE_CHECKING:
    from hmsa_ros.model.delivery import Delivery
    from hmsa_ros.model.mismatch import Uncertainty
    from hmsa_ros.model.moves import Limits, State
    from hmsa_ros.model.parameters import NondimensionalParameters
    from hmsa_ros.model.units import Units
    from hmsa_ros.planning.sequence import Segment

    Nominal = tuple[NondimensionalParameters, Limits, Delivery, Units]


def add_parser(subparsers: Any) -> None:
    """Add the command."""
    parser = subparsers.add_parser(
        'plan', help='plan a sequence of setpoints without ROS',
        description='Plan a sequence of setpoints, dimensionless as in the paper: each '
                    'setpoint is a stretch and its duration (move plus hold) in units of '
                    'L sqrt(rho/G). With --params-file times are in seconds and flux densities '
                    'in tesla.',
        epilog='example: hmsa plan 1.10:10 1.20:10 1.40:10 --json')
    parser.add_argument(
        'setpoints', nargs='+', type=setpoint, metavar='STRETCH:SPAN',
        help='stretch, or deflection of a beam, to come to rest at, and how long this setpoint '
             'lasts (move plus hold)')
    add_options(
        parser,
        ('--start', 'S', float,
         'initial stretch, at rest (default 1; 0 for the deflection of a beam)'),
        *((option, metavar, float, text) for option, metavar, text in MATERIAL),
        ('--shaper', 'NAME', str,
         'two_step (default), robust, minimax, minimum_time, smooth, step, zv, zvd, ei or umzv'),
        ('--order', 'N', int,
         'number of two-step commands that robust cascades; minimax takes as long (default 2)',
         {'default': 2}),
        ('--errors', 'G,C,J', str,
         'relative errors in shear modulus, damping and J_lim that minimax must tolerate (default '
         '0.1,0.1,0.1, or the 95 %% confidence ellipsoid that hmsa identify stored in '
         '--params-file)'),
        ('--periods', 'N', float,
         'minimum duration of a smooth move in natural periods (default 1)',
         {'default': 1.0}),
        ('--max-rate', 'R', float, 'maximum stretch rate of a smooth move (default any)',
         {'default': math.inf}),
        ('--params-file', 'YAML', Path,
         'parameter file (YAML) of planner and plant, for a plan in seconds and tesla'),
        ('--json', 'print JSON in full precision'))


def run(arguments: argparse.Namespace) -> int:
    """Plan and print, in seconds and tesla for the actuator of a parameter file."""
    from hmsa_ros.planning.sequence import plan_sequence
    from hmsa_ros.planning.setpoint import Setpoint
    from hmsa_ros.planning.shapers.pace import Pace

    group, limits, delivery, units = nominal(arguments)
    time, load = units.time, units.load
    segments = plan_sequence(
        [Setpoint(stretch, span / time)
         for stretch, span in _possible(arguments.setpoints, group.rest)],
        group, start=_start(arguments, group.rest), shaper=arguments.shaper or 'two_step',
        limits=limits, delivery=delivery, units=units, order=arguments.order,
        errors=_errors(arguments), pace=Pace(arguments.periods, arguments.max_rate * time))
    if arguments.params_file is None:
        facts = {}
        rows = [_row(x) for x in segments]
        columns = 'stretch', 'span', 'b_p', 'tau_p', 'b_1'
        caption = 'nondimensional: time in L sqrt(rho/G), b = sqrt(Br B/(mu0 G))'
    else:
        facts = {'c1': group.c1, 'zeta': group.zeta, 'j_lim': group.j_lim, 'time_unit': time,
                 'flux_density_unit': load}
        rows = [_si_row(x, time, load) for x in segments]
        columns = 'stretch', 'span', 'flux_density_p', 'time_p', 'flux_density_1'
        caption = (f'times in s, flux densities in T; c1 {group.c1:.6g}, zeta {group.zeta:.6g}, '
                   f'time unit {time:.6g} s')
    if arguments.json:
        print(json_text({**facts, 'segments': rows}))
    else:
        _print_table(rows, columns, caption, group.coordinate.name)
        _print_reasons(segments)
    return 0


def nominal(arguments: argparse.Namespace) -> 'Nominal':
    """Return what options or a file plan with; raise `BadInputError` if both say something."""
    from hmsa_ros.model.delivery import Delivery
    from hmsa_ros.model.moves import Limits
    from hmsa_ros.model.parameters import NondimensionalParameters
    from hmsa_ros.model.units import Units
    from hmsa_ros.recordings.model import model_of

    given = {name: value for name in ('zeta', 'j_lim', 'c1')
             if (value := getattr(arguments, name)) is not None}
    if arguments.params_file is None:
        return NondimensionalParameters(**given), Limits(), Delivery(), Units()
    if given:
        fixed = ', '.join(f'--{name.replace("_", "-")}' for name in given)
        raise BadInputError(
            f'both --params-file and {fixed} are given: expected only one of them, since the file '
            'sets these values')
    model = model_of(arguments.params_file)
    return model.material, model.limits, model.delivery, model.units


def _possible(setpoints: Sequence[tuple[float, float]], rest: float) -> list[tuple[float, float]]:
    """Return setpoints after checking that an actuator with a rest there may have them."""
    for stretch, _ in setpoints:
        if reason := impossible(stretch, rest):
            raise BadInputError(reason)
    return list(setpoints)


def _start(arguments: argparse.Namespace, rest: float) -> 'State':
    """Return the state at the start, unless given at rest without a field."""
    from hmsa_ros.model.moves import State

    return State(rest if arguments.start is None else arguments.start)


def _errors(arguments: argparse.Namespace) -> 'Uncertainty':
    """Return the errors for which minimax plans."""
    from hmsa_ros.planning.shapers.request import as_errors, ERRORS

    if arguments.errors is not None:
        try:
            return as_errors([float(x) for x in arguments.errors.split(',')])
        except ValueError as error:
            if isinstance(error, BadInputError):
                raise
            raise BadInputError(
                f'--errors is {arguments.errors!r}: expected three numbers such as 0.1,0.1,0.05'
            ) from None
    if arguments.shaper != 'minimax' or arguments.params_file is None:
        return ERRORS
    from hmsa_ros.identification.files import errors_of, read_belief

    return errors_of(read_belief(arguments.params_file), ERRORS)


def _si_row(segment: 'Segment', time: float, load: float) -> dict[str, Any]:
    """Return a segment with its times in s and its flux densities in T as well."""
    row: dict[str, Any] = _row(segment)
    levels = segment.move.levels
    return row | {
        'span': row['span'] * time,
        'time_p': None if row['tau_p'] is None else row['tau_p'] * time,
        'flux_density_p': None if row['beta_p'] is None else row['beta_p'] * load,
        'flux_density_1': row['beta_1'] * load,
        'levels': [[x.time * time, x.load * load] for x in levels]}


def _row(segment: 'Segment') -> dict[str, float | str | None]:
    """Return a segment as the JSON output shows it; null where there is no such number."""
    from hmsa_ros.model.equations import signed_root

    levels, tail = segment.move.levels, segment.move.tail
    shaped = len(levels) > max(len(tail), 1)
    beta_p = levels[0].load if shaped else None
    # Where a span ends before the creep does, the last level is another.
    beta_1 = segment.holding if tail else levels[-1].load
    duration = segment.move.duration
    told = {'vibration': segment.move.vibration} if tail else {}
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
        'status': str(segment.move.code),
    } | told


def _print_table(
        rows: Sequence[Mapping[str, float | str | None]], columns: Sequence[str], caption: str,
        coordinate: str) -> None:
    from rich.console import Console
    from rich.table import Table

    table = Table(caption=caption)
    for name in columns:
        table.add_column(coordinate if name == 'stretch' else name, justify='right')
    table.add_column('status')
    for row in rows:
        table.add_row(*(
            '-' if row[name] is None else f'{row[name]:.6g}' for name in columns),
            str(row['status']))
    Console().print(table)


def _print_reasons(segments: Sequence['Segment']) -> None:
    for segment in segments:
        if segment.move.reason:
            print(f'note: {segment.move.reason}')
        if segment.move.tail:
            step = abs(segment.setpoint.stretch - segment.start.stretch) or 1.0
            print(
                f'note: {len(segment.move.tail)} levels follow creep at stretch '
                f'{segment.setpoint.stretch:g}; they leave a vibration of at most '
                f'{100.0 * segment.move.vibration / step:.2g} % of the move')
