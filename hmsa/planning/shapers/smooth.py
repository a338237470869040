"""
Moves without a step of the level: the level is computed from a smooth path of the stretch.

The stretch is a flat output (`hmsa.model.simulation`): a path determines the load, and
one more derivative determines the amplifier level if the field lags. The path is the motion as it
would continue under the present level, faded into the target by a polynomial with three zero
derivatives at either end. It therefore starts with the present motion, field and level, and ends
at rest. The steps or ramps that commands use for the level are corrected to end exactly at rest.
"""

from dataclasses import replace
import math
from typing import NamedTuple

import numpy as np

from hmsa import motion
from hmsa.errors import HmsaError
from hmsa.model import law
from hmsa.model.equations import acceleration, Array, elastic_force
from hmsa.model.moves import Level, Move
from hmsa.model.simulation import branches_of, fade, held_along, loads_for, sampled
from hmsa.model.status import Code, RefusedError
from hmsa.planning.shapers.request import MOST_PERIODS, MoveRequest
from hmsa.planning.shapers.shooting import at_rest, Attempt, solve, Template, within_limits

# Points of a path, levels per natural period, and minimum and maximum number of levels.
_POINTS = 129
_OF_EACH, _FEWEST, _MOST = 32, 16, 300
_SHARES: Array = np.linspace(0.0, 1.0, _POINTS).astype(np.float64)
# The fading polynomial, from present motion (0) to target (1), with derivatives.
_FADED, _FADING, _CURVED = fade(_SHARES)
# Factor on the duration if limits are not kept, and number of bisections of the last increase.
_LONGER, _HALVINGS = 1.25, 5
# Factor on the duration if the command cannot be solved for, and maximum number of attempts.
_RETRY, _RETRIES = 1.08, 5
# Fraction of the slew limit that the path may use, and margin for corrections, relative.
_SLEW_SHARE, _SLACK = 0.95, 0.01


def smooth(request: MoveRequest) -> Move:
    """
    Command a move along a smooth path of the stretch, in the shortest time that limits allow.

    ``request.pace`` gives the minimum duration and the maximum rate. The move ends exactly at
    rest. Raise `RefusedError` if no path keeps the limits.
    """
    holding = request.holding_load()
    if at_rest(request):
        return Move(Code.HOLD, (Level(0.0, holding),), 0.0)
    packed = request.material.packed
    # Use the slower end: near a limit of the model, and where the force is flat, they differ.
    period = 2.0 * math.pi / min(
        law.natural_frequency(x, packed) for x in (request.target, request.state.stretch))
    path = _shortest(request, holding, period)
    for _ in range(_RETRIES):
        if path is None:
            break
        found = within_limits(_delivered(request, path, holding, period), request)
        if found is not None:
            return Move(Code.SMOOTH, *found)
        path = _path(request, holding, _RETRY * path.duration)
    units, limits, slew = request.units, request.limits, request.delivery.slew
    code = Code.FLUX_LIMIT if math.isinf(slew) else Code.SLEW_LIMIT
    ramps = '' if math.isinf(slew) else f', ramps of {units.slew_text(slew)}'
    raise RefusedError(code, (
        f'no smooth path of up to {MOST_PERIODS:g} natural periods leads to rest at '
        f'{request.named_target} within flux densities of '
        f'{units.load_text(limits.minimum)} to '
        f'{units.load_text(limits.maximum)}{ramps} and the largest rate'))


class _SmoothMove(NamedTuple):
    """Amplifier levels along a path, evenly spaced over its duration."""

    duration: float
    loads: Array
    slopes: Array


def _shortest(request: MoveRequest, holding: float, period: float) -> _SmoothMove | None:
    """Return the shortest path within the limits, else None."""
    shortest = short = duration = request.pace.periods * period
    longest = max(MOST_PERIODS * period, 2.0 * shortest)
    path = _path(request, holding, duration)
    while path is None and duration < longest:
        short, duration = duration, min(_LONGER * duration, longest)
        path = _path(request, holding, duration)
    for _ in range(_HALVINGS if path and duration > shortest else 0):
        middle = 0.5 * (short + duration)
        found = _path(request, holding, middle)
        if found is None:
            short = middle
        else:
            path, duration = found, middle
    return path


def _path(request: MoveRequest, holding: float, duration: float) -> _SmoothMove | None:
    """Return the levels of a path of a given duration, None if it does not keep the limits."""
    material, delivery, limits = request.material, request.delivery, request.limits
    packed = material.packed
    times: Array = duration * _SHARES
    try:
        free, rate, change, field, followed = _free(request, times)
    except HmsaError:
        return None
    away = request.target - free
    faded, fading, curved = _FADED, _FADING / duration, _CURVED / duration ** 2
    stretch: Array = free + faded * away
    speed: Array = (1.0 - faded) * rate + fading * away
    wanted: Array = (1.0 - faded) * change - 2.0 * fading * rate + curved * away
    if not (packed[law.LOWER] < stretch.min() and stretch.max() < packed[law.UPPER]
            and np.max(np.abs(speed)) <= max(request.pace.rate, float(np.max(np.abs(rate))))):
        return None
    loads = loads_for(stretch, speed, wanted, material)
    if material.creeps:
        loads = loads + held_along(times, stretch, followed, material)[0]
    if delivery.lag > 0.0:
        # The field that the present level would give needs no change of the level.
        more: Array = loads - field
        loads = request.load + more + delivery.lag * np.gradient(more, times[1], edge_order=2)
    slopes = np.gradient(loads, times[1], edge_order=2)
    slack = _SLACK * (abs(holding - request.load) + abs(holding))
    if not (limits.minimum - slack <= loads.min() and loads.max() <= limits.maximum + slack
            and np.max(np.abs(slopes)) <= _SLEW_SHARE * delivery.slew):
        return None
    return _SmoothMove(duration, loads, slopes)


def _free(
        request: MoveRequest, times: Array
) -> tuple[Array, Array, Array, Array, tuple[float, ...]]:
    """
    Return the motion under the present level.

    The result contains stretch, rate, acceleration, field and the initial branch states.
    """
    material, state = request.material, request.state
    load, field = request.load, request.field
    followed = branches_of(state, material)
    if not material.creeps and state.rate == 0.0 and field == load == law.elastic_force(
            state.stretch, material.packed):
        nothing = np.zeros(_POINTS)
        return np.full(_POINTS, state.stretch), nothing, nothing, nothing + load, followed
    stretch, rate, loads, *rows = sampled(
        (Level(0.0, load),), request.start, times, material, replace(
            request.delivery, slew=math.inf))
    pull = loads
    if material.creeps:
        force = elastic_force(stretch, material)
        pull = loads - material.branches[:, motion.RATIO] @ (
            force - np.array(rows[:len(followed)]))
    return stretch, rate, acceleration(stretch, rate, pull, material), loads, followed


def _delivered(request: MoveRequest, path: _SmoothMove, holding: float, period: float) -> Attempt:
    """Return the levels of a path as commands, corrected to end at rest."""
    delivery, limits = request.delivery, request.limits
    duration, along, slopes = path
    count = min(max(math.ceil(_OF_EACH * duration / period), _FEWEST), _MOST)
    each = duration / count
    if delivery.period > 0.0:
        each = delivery.period * max(
            1, math.floor(each / delivery.period + 1e-9),
            math.ceil(duration / (_MOST * delivery.period) - 1e-9))
        count = max(math.ceil(duration / each - 1e-9), 3 + (delivery.lag > 0.0))
    times = each * np.arange(count + 1)
    # Ramps delay a level in proportion to their duration.
    middle = (np.arange(count) + 0.5) / count
    steep = np.interp(middle, _SHARES, np.abs(slopes)) / delivery.slew
    loads = np.interp(middle + 0.5 * np.minimum(steep, 1.0) / count, _SHARES, along)
    inside: Array = ((limits.minimum < loads) & (loads < limits.maximum)).astype(np.float64)
    loads = np.clip(loads, limits.minimum, limits.maximum)
    # Corrections that change stretch and rate at the end, and the field.
    left = duration * (1.0 - middle)
    angle = 2.0 * math.pi / period * left
    window = inside * 4.0 * middle * (1.0 - middle)
    changes: list[Array] = [window * np.sin(angle), window * np.cos(angle)]
    if delivery.lag > 0.0:
        settling: Array = inside * np.exp(-left / max(delivery.lag, each))
        changes.append(settling)
    d_loads = np.zeros((count + 1, len(changes)))
    d_loads[:-1] = np.array(changes).T
    rounded = np.array([delivery.rounded(x) for x in times.tolist()])
    loads = np.append(loads, along[-1] if request.material.creeps else holding)
    return solve(
        Template(rounded, loads, np.zeros_like(d_loads), d_loads), request,
        wait=delivery.rounded(0.5 * each))
