"""Paths that an actuator follows, from arrays or files in seconds."""

from dataclasses import replace
from pathlib import Path as File
from typing import Any, TYPE_CHECKING

import numpy as np

from hmsa_ros.api.arguments import number
from hmsa_ros.columns import read_table
from hmsa_ros.errors import BadInputError, excerpt
from hmsa_ros.model.equations import Array
from hmsa_ros.model.moves import State
from hmsa_ros.model.units import NANOSECONDS
from hmsa_ros.planning.drafting import check_path, finish
from hmsa_ros.planning.path import along, Path
from hmsa_ros.planning.sequence import plan_sequence
from hmsa_ros.planning.setpoint import Setpoint
from hmsa_ros.planning.shapers.request import Request

if TYPE_CHECKING:
    from hmsa_ros.api.actuator import Actuator
    from hmsa_ros.planning.sequence import Segment


def read_path(file: File) -> tuple[Array, Array]:
    """
    Read the points of a path from CSV: the columns ``time`` in s and ``stretch``.

    `BadInputError` says why a file cannot be used.
    """
    table = read_table(file, ('time', 'stretch'))
    bad = ~(np.isfinite(table.columns['time']) & np.isfinite(table.columns['stretch']))
    if np.any(bad):
        raise BadInputError(
            f'{file} line {table.lines[np.argmax(bad)]} has no number for time or stretch: '
            'expected both in every line')
    return table.columns['time'], table.columns['stretch']


def path_of(actuator: 'Actuator', columns: tuple[Any, ...]) -> Path:
    """
    Return the path through times, stretches, rates and accelerations; the last may be None.

    Columns that are no path are a `BadInputError`.
    """
    given = [_column(x) for x in columns if x is not None]
    if columns[2] is None and columns[3] is not None:
        raise BadInputError('accelerations are given without rates: expected both')
    if len({len(x) for x in given}) > 1 or len(given[0]) < 2:
        raise BadInputError(
            f'the columns of the path have {", ".join(str(len(x)) for x in given)} numbers: '
            'expected as many in each, of at least 2 points')
    times, stretches, *more = given
    unit = actuator.model.units.time
    rows = [stretches, *(x * unit ** (i + 1) for i, x in enumerate(more))]
    none = np.full(len(times), np.nan)
    rates, accelerations = (*more, none, none)[:2]
    check_path(
        [(x, round(NANOSECONDS * t)) for *x, t in zip(  # type: ignore[misc]
            stretches.tolist(), (0.0 * times if rates is none else rates).tolist(),
            accelerations.tolist(), (times - times[0]).tolist(), strict=True)],
        actuator.model.material.rest)
    since = (times - times[0]) / unit
    return Path.through(since, *rows) if more else Path.smooth(since, stretches)


def _column(values: Any) -> Array:
    try:
        found = np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise BadInputError(
            f'a column of the path is {excerpt(values)}: expected numbers') from error
    if found.ndim != 1 or not np.all(np.isfinite(found)):
        raise BadInputError(
            f'a column of the path is {excerpt(values)}: expected one dimension of finite numbers')
    return found


def segments_along(
        actuator: 'Actuator', path: Path, ends: tuple[float, float], tolerance: float,
        period: float) -> 'tuple[Segment, ...]':
    """
    Plan to follow a path between rests at its ends, on a grid with a period in s.

    A number out of range is a `BadInputError`, what cannot be followed a `RefusedError`.
    """
    model = actuator.model
    if not 0.0 < number(tolerance, 'tolerance') <= 1.0:
        raise BadInputError(f'tolerance is {tolerance:g}: expected above 0 to 1')
    frame = Request.of(
        model.material, State(ends[0]), limits=model.limits, units=model.units,
        delivery=replace(model.delivery, period=number(period, 'period', 's', least=0.0)
                         / model.units.time))
    move = finish(along(replace(frame, target=ends[1]), path, tolerance))
    return plan_sequence([Setpoint(ends[1], np.inf)], frame, lambda request: move)
