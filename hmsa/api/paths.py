"""Paths for an actuator to follow, from arrays or files, with times in seconds."""

from dataclasses import dataclass, replace
import math
from pathlib import Path as File
from typing import Any, TYPE_CHECKING

import numpy as np

from hmsa.api.arguments import columns_of, grid_of, number, numbers
from hmsa.columns import read_table
from hmsa.errors import BadInputError, excerpt, meant
from hmsa.model.equations import Array
from hmsa.model.moves import Setpoint, State
from hmsa.model.status import Code, RefusedError
from hmsa.model.units import NANOSECONDS
from hmsa.planning.drafting import check_path
from hmsa.planning.path import along, Path
from hmsa.planning.sequence import plan_sequence
from hmsa.planning.shapers.request import MoveRequest
from hmsa.planning.waves import sampled_shape, Shape, sine, triangle, Wave

if TYPE_CHECKING:
    from hmsa.api.actuator import Actuator
    from hmsa.api.plan import Plan

# Shapes of waves; a square wave is a sequence of moves between its extremes.
SHAPES: dict[str, Shape] = {'square': sine, 'sine': sine, 'triangle': triangle}
# Points between two spline knots of a wave.
_OF_EACH = 8
# Number of samples at which the deviation from a path is determined.
_FEWEST_LOOKED, _MOST_LOOKED = 2_000, 200_000
# Number of frequencies at which a sweep is checked against the limits.
_SWEPT = 50


def read_path(file: File) -> tuple[Array, Array]:
    """
    Read the points of a path from CSV: the columns ``time`` in s and ``stretch``.

    Raise `BadInputError` if the file cannot be used.
    """
    table = read_table(file, ('time', 'stretch'))
    table.check_complete(file)
    times = table.columns['time']
    back = np.flatnonzero(np.diff(times) <= 0.0)
    if len(back):
        raise BadInputError(
            f'{file} line {table.lines[back[0] + 1]} has the time {times[back[0] + 1]:.9g} s '
            f'after {times[back[0]]:.9g} s: expected increasing times')
    return times, table.columns['stretch']


def path_of(actuator: 'Actuator', columns: tuple[Any, ...]) -> Path:
    """
    Return the path through times, stretches, rates and accelerations; the last may be None.

    Raise `BadInputError` if the columns describe no path.
    """
    given = [_column(x, ('s', '', '1/s', '1/s^2')[i])
             for i, x in enumerate(columns) if i < 2 or x is not None]
    if columns[2] is None and columns[3] is not None:
        raise BadInputError('accelerations are given without rates: expected both')
    if len({len(x) for x in given}) > 1 or len(given[0]) < 2:
        raise BadInputError(
            f'the columns of the path have {", ".join(str(len(x)) for x in given)} numbers: '
            'expected as many in each, of at least 2 points')
    times, stretches, *more = given
    # Missing rates are checked as zero, missing accelerations as unknown.
    rates, accelerations = (*more, *[0.0 * times, np.full_like(times, np.nan)][len(more):])
    check_path(
        [((x, y, z), round(NANOSECONDS * t)) for x, y, z, t in zip(
            stretches.tolist(), rates.tolist(), accelerations.tolist(),
            (times - times[0]).tolist(), strict=True)], actuator.model.material.rest)
    unit = actuator.model.units.time
    since = (times - times[0]) / unit
    return Path.through(since, stretches, *(
        x * unit ** i for i, x in enumerate(more, 1))) if more else Path.smooth(since, stretches)


def _column(values: Any, unit: str = '') -> Array:
    found = numbers(values, 'columns of the path', unit=unit)
    if found.ndim != 1 or not np.all(np.isfinite(found)):
        raise BadInputError(
            f'a column of the path is {excerpt(values)}: expected one dimension of finite numbers')
    return found


def wave_of(
        actuator: 'Actuator', shape: Any, amplitude: float, offset: float | None) -> Wave:
    """
    Return a wave from the name of its shape, or from one period of times and stretches.

    Raise `BadInputError` if the arguments describe no wave.
    """
    rest = actuator.block.rest
    mean = number(rest if offset is None else offset, 'offset')
    size = number(amplitude, 'amplitude', above=0.0)
    if isinstance(shape, str):
        if shape not in SHAPES:
            raise BadInputError(
                f'shape is {excerpt(shape)}: expected one of {", ".join(SHAPES)}, or one '
                'period of times and stretches' + meant(shape, SHAPES))
        form = SHAPES[shape]
    else:
        times, stretches = columns_of(shape, ('time', 'stretch'), 'samples of a wave')
        form = sampled_shape(times, stretches)
    for stretch in (mean - size, mean + size):
        actuator.model.material.check(stretch, 'an extreme of the wave')
    if mean + size == mean:
        raise BadInputError(f'amplitude is {size:g}: expected more beside the offset {mean:g}')
    return Wave(form, mean, size)


def bands(actuator: 'Actuator', shape: Any, amplitude: float, offset: float | None) -> Array:
    """Return the frequency bands in Hz that the actuator's limits allow, shape (n, 2)."""
    wave, frame = wave_of(actuator, shape, amplitude, offset), _frame(actuator)
    if isinstance(shape, str) and shape == 'square':
        high, low, rest = wave.mean + wave.amplitude, wave.mean - wave.amplitude, frame.target
        try:
            moves = [float(actuator.plan([(y, 1e9)], start=x).move_times[0])
                     for x, y in ((rest, high), (high, low), (low, high), (low, rest))]
        except RefusedError:
            return np.empty((0, 2))
        return np.array([[0.0, 0.5 / max(moves)]])
    found: Array = np.array(wave.reach(frame)).reshape(-1, 2) / actuator.model.units.time
    return found


def bands_text(found: Array) -> str:
    """Return frequency bands in Hz in words, which are empty if there are none."""
    return ', '.join(
        f'above {low:.4g} Hz' if math.isinf(high) else f'at {low:.4g} to {high:.4g} Hz' if low
        else f'below {high:.4g} Hz' for low, high in found.tolist())


def wave_path(
        actuator: 'Actuator', wave: Wave, sweep: tuple[float, float], cycles: float) -> Path:
    """
    Return the path of a wave that starts and ends at rest without a field.

    The frequency sweeps between two values in Hz. Raise `RefusedError` if the limits do not allow
    a frequency, `BadInputError` if one is out of range.
    """
    model, frame = actuator.model, _frame(actuator)
    unit = model.units.time
    first, last = (number(x, 'frequency', 'Hz', above=0.0) * unit for x in sweep)
    cycles = number(cycles, 'cycles', least=1.0, most=1e6)
    if not all(wave.within(frame, x) for x in np.geomspace(
            first, last, _SWEPT if last != first else 1)):
        reach = bands_text(np.array(wave.reach(frame)).reshape(-1, 2) / unit)
        raise RefusedError(
            Code.FLUX_LIMIT,
            f'an amplitude of {wave.amplitude:g} about {wave.mean:g} needs more than '
            f'flux density and slew limits allow at {sweep[0]:g}'
            + (f' to {sweep[1]:g}' if last != first else '') + ' Hz: expected '
            + (f'a frequency {reach}' if reach else 'less'))
    return wave.path(frame, first, last, cycles)


def wave_points(path: Path, unit: float) -> Array:
    """Return times in s and stretches of a wave's path with a time scale in s, shape (n, 2)."""
    count = len(path.breaks) - 1
    times = np.interp(
        np.arange(_OF_EACH * count + 1) / _OF_EACH, np.arange(count + 1), path.breaks)
    return np.column_stack([times * unit, path.course(times)[0]])


def smooth_points(times: Array, stretches: Array) -> Array:
    """
    Return time, stretch, rate and acceleration of the smooth path through points, shape (n, 4).

    Raise `BadInputError` if the points describe no path.
    """
    times, stretches = _column(times), _column(stretches)
    if len(times) < 2 or np.any(np.diff(times) <= 0.0):
        raise BadInputError(
            f'the path has {len(times)} points: expected at least 2, at increasing times')
    since = times - times[0]
    return np.column_stack([since, *Path.smooth(since, stretches).course(since)])


def _frame(actuator: 'Actuator') -> MoveRequest:
    """Return the request to stay at rest without a field."""
    model = actuator.model
    return MoveRequest.of(
        model.material, limits=model.limits, units=model.units, delivery=model.delivery)


@dataclass(frozen=True)
class Following:
    """Demands of a path that a plan follows; all in SI."""

    duration: float
    levels: int
    low: float  #: lowest stretch ...
    high: float  #: ... and highest
    peak_rate: float  #: of the stretch, in 1/s
    peak_flux_density: float
    peak_flux_density_rate: float  #: in T/s, from each level to the next
    deviation: float  #: maximum distance from the path in a simulation of the plan


def following(plan: 'Plan', path: Path) -> Following:
    """Return the demands of a planned path, with the deviation of a simulation from it."""
    unit = plan.actuator.model.units.time
    duration = float(path.breaks[-1] - path.breaks[0]) * unit
    count = min(max(_OF_EACH * len(path.breaks), _FEWEST_LOOKED), _MOST_LOOKED)
    motion = plan.simulate(until=duration, rate=count / duration)
    course, rates, _ = path.course(np.minimum(motion.times, duration) / unit + path.breaks[0])
    return Following(
        duration, len(plan.levels), float(np.min(course)), float(np.max(course)),
        float(np.max(np.abs(rates))) / unit, float(np.max(np.abs(plan.flux_densities))),
        plan.flux_density_rate,
        float(np.max(np.abs(motion.stretches - course))))


def followed(
        actuator: 'Actuator', path: Path, ends: tuple[float, float], tolerance: float,
        period: float = 0.0) -> 'Plan':
    """
    Plan a command that follows a path between rests at its ends; the grid period is in s.

    Raise `BadInputError` if a number is out of range, `RefusedError` if the path cannot be
    followed.
    """
    from hmsa.api.plan import Plan

    tolerance = number(tolerance, 'tolerance', above=0.0, most=1.0)
    frame = replace(_frame(actuator), state=State(ends[0]), target=ends[0])
    if period := grid_of(period):
        frame = replace(frame, delivery=replace(
            frame.delivery, period=period / actuator.model.units.time))
    move = along(replace(frame, target=ends[1]), path, tolerance)
    return Plan(actuator, plan_sequence(
        [Setpoint(ends[1], np.inf)], frame, lambda request: move), 'path')
