"""Setpoints on the command line."""

import argparse
import math
from pathlib import Path

from hmsa.cli.options import argument, Row
from hmsa.errors import BadInputError
from hmsa.model.moves import Setpoint


def sequence_of(
        arguments: argparse.Namespace) -> tuple[list[tuple[float, float]], list[list[float]]]:
    """
    Return times in s and flux densities in T of --levels, and the points of --path.

    Each point contains time in s, stretch, rate and acceleration. Raises `BadInputError` unless
    exactly one of setpoints, levels and path is given and valid.
    """
    given = [x for x, y in (
        ('setpoints', arguments.setpoints), ('--levels', arguments.levels),
        ('--path', arguments.path)) if y]
    if len(given) != 1:
        raise BadInputError(
            (f'both {" and ".join(given[:2])} are given' if given
             else 'neither setpoints nor --levels nor --path are given')
            + ': expected STRETCH:SECONDS ..., or --levels CSV, or --path CSV')
    if arguments.path is not None:
        from hmsa.api.paths import read_path, smooth_points

        return [], smooth_points(*read_path(arguments.path)).tolist()
    if arguments.levels is None:
        return [], []
    if arguments.levels.suffix.lower() in ('.yaml', '.yml'):
        from hmsa.identification.sequences import levels_in

        rows = levels_in(arguments.levels)
    else:
        from hmsa.identification.tables import read_levels

        times, levels = read_levels(arguments.levels)
        rows = list(zip(times.tolist(), levels.tolist(), strict=True))
    return [(x - rows[0][0], y) for x, y in rows], []


def setpoint(text: str) -> tuple[float, float]:
    """Read stretch and duration from ``'1.10:10'``; raise `BadInputError` if invalid."""
    stretches, span = setpoint_of_joints(text)
    if len(stretches) > 1:
        raise _no_setpoint(text)
    return stretches[0], span


def setpoint_of_joints(text: str) -> tuple[tuple[float, ...], float]:
    """Read stretches and duration from ``'1.10,1.20:10'``; raise `BadInputError` if invalid."""
    stretches, _, span = text.partition(':')
    try:
        found = [Setpoint(float(stretch), float(span)) for stretch in stretches.split(',')]
        if math.isinf(found[0].span):
            raise BadInputError('duration is inf: expected a finite number')
    except BadInputError as error:
        raise BadInputError(f'{text!r}: {error}') from error
    except ValueError:
        raise _no_setpoint(text) from None
    return tuple(x.stretch for x in found), found[0].span


def _no_setpoint(text: str) -> BadInputError:
    return BadInputError(f'{text!r}: expected STRETCH:DURATION, two numbers such as 1.10:10')


#: Options for the sequence: setpoints, or a file of levels or of a path.
SEQUENCE: tuple[Row, ...] = (
    ('setpoints', 'STRETCH:SECONDS', argument(setpoint_of_joints),
     'target stretch, or deflection of a beam, and its duration in s (move plus hold); with '
     'several joints, one stretch for all or one per joint, as in 1.10,1.20:2', {'nargs': '*'}),
    ('--levels', 'CSV', Path,
     'instead of setpoints: CSV with the columns time and flux_density, as hmsa excite writes it, '
     'or YAML of hmsa learn. The levels are sent unchanged if they respect the limits of coil and '
     'block; levels that do not end at rest are followed by a shaped move to rest'),
    ('--path', 'CSV', Path,
     'instead of setpoints: CSV with the columns time and stretch, as hmsa wave --path writes it. '
     'The planner, whose trajectory_mode must be path, follows it from rest to rest. With '
     'feedback: adapt, the planner corrects the path in progress'))
