"""
Moves without a step of the level: the stretch follows a smooth path, the level follows from it.

The stretch is a flat output (M. Fliess, J. Lévine, P. Martin, P. Rouchon, Int. J. Control 61,
1327 (1995)): a path of it gives the load by the equation of motion, and the amplifier's level by
one derivative more where the field lags. The path is the motion as it would go on under the
level in force, faded into the target by a polynomial with three derivatives that are zero at
either end. So it begins with whatever motion, field and level there are, and ends at rest. What
commands carry of the level, a staircase or ramps, is corrected to end there exactly.
"""

from dataclasses import dataclass, replace
import math

import numpy as np

from hmsa_ros import motion
from hmsa_ros.errors import HmsaError
from hmsa_ros.model import law
from hmsa_ros.model.equations import Array
from hmsa_ros.model.moves import Level, Move
from hmsa_ros.model.simulation import (
    followed_by,
    sampled,
    with_followed,
)
from hmsa_ros.model.status import Code, RefusedError
from hmsa_ros.planning.shapers.free import at_rest
from hmsa_ros.planning.shapers.pace import MOST_PERIODS
from hmsa_ros.planning.shapers.request import Request
from hmsa_ros.planning.shooting import Attempt, solve, Template

# Points of a path, levels of a natural period, and how many there are at least and at most.
_POINTS = 129
_OF_EACH, _FEWEST, _MOST = 32, 16, 300
_SHARES: Array = np.linspace(0.0, 1.0, _POINTS).astype(np.float64)
_LEFT = 1.0 - _SHARES
# How far a path has faded from the motion as it would go on into the target, with derivatives.
_FADED = _SHARES ** 4 * (35.0 - 84.0 * _SHARES + 70.0 * _SHARES ** 2 - 20.0 * _SHARES ** 3)
_FADING = 140.0 * (_SHARES * _LEFT) ** 3
_CURVED = 420.0 * (_SHARES * _LEFT) ** 2 * (_LEFT - _SHARES)
# Growth of the duration where limits are not kept, and how often the last growth is halved.
_LONGER, _HALVINGS = 1.25, 5
# How much longer a command may get that cannot be solved for, and how often.
_RETRY, _RETRIES = 1.08, 5
# Share of the slew limit that the path may use, and of the limits that corrections may need.
_SLEW_SHARE, _SLACK = 0.95, 0.01


def smooth(request: Request) -> Move:
    """
    Command a move along a smooth path of the stretch, in the shortest time that limits allow.

    ``request.pace`` has its least duration and largest rate. The move ends at rest exactly. Where
    no path keeps the limits: `RefusedError`.
    """
    holding = request.holding_load()
    if _there(request):
        return Move(Code.HOLD, (Level(0.0, holding),), 0.0)
    packed = request.material.packed
    # Of the slower end: near a limit of the law, and where the force hardly rises, they differ.
    period = 2.0 * math.pi / min(
        law.natural_frequency(x, packed) for x in (request.target, request.state.stretch))
    path = _shortest(request, holding, period)
    for _ in range(_RETRIES):
        if path is None:
            break
        found = _delivered(request, path, holding, period)
        if found is not None and request.keeps(found[0]):
            return Move(Code.SMOOTH, *found)
        path = _path(request, holding, _RETRY * path.duration)
    raise RefusedError(*_refusal(request))


def _there(request: Request) -> bool:
    """Return whether the target is held already, by whatever load creep needs."""
    if not request.material.creep or request.delivery.lag > 0.0:
        return at_rest(request)
    return request.state.stretch == request.target and request.state.rate == 0.0


@dataclass(frozen=True)
class _Path:
    """Levels of the amplifier that lead along a path, evenly spaced over its duration."""

    duration: float
    loads: Array
    slopes: Array


def _shortest(request: Request, holding: float, period: float) -> _Path | None:
    """Return the shortest path within the limits, None if there is none."""
    shortest = request.pace.periods * period
    longest = max(MOST_PERIODS * period, 2.0 * shortest)
    short, duration = shortest, shortest
    path = _path(request, holding, duration)
    while path is None:
        if duration >= longest:
            return None
        short, duration = duration, min(_LONGER * duration, longest)
        path = _path(request, holding, duration)
    for _ in range(_HALVINGS if duration > shortest else 0):
        middle = 0.5 * (short + duration)
        found = _path(request, holding, middle)
        if found is None:
            short = middle
        else:
            path, duration = found, middle
    return path


def _path(request: Request, holding: float, duration: float) -> _Path | None:
    """Return the levels of a path of some duration, None if it does not keep the limits."""
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
    # The acceleration is linear in the load.
    zero, one = np.empty(_POINTS), np.empty(_POINTS)
    law.accelerations(stretch, speed, np.zeros(_POINTS), packed, zero)
    law.accelerations(stretch, speed, np.ones(_POINTS), packed, one)
    loads: Array = (wanted - zero) / (one - zero)
    if material.creep:
        loads = loads + _branches(request, stretch, followed, times[1])
    if delivery.lag > 0.0:
        # The field as it would go on needs no change of the level.
        more: Array = loads - field
        loads = request.load + more + delivery.lag * np.gradient(more, times[1], edge_order=2)
    slopes: Array = np.gradient(loads, times[1], edge_order=2)
    slack = _SLACK * (abs(holding - request.load) + abs(holding))
    if not (limits.minimum - slack <= loads.min() and loads.max() <= limits.maximum + slack
            and np.max(np.abs(slopes)) <= _SLEW_SHARE * delivery.slew):
        return None
    return _Path(duration, loads, slopes)


def _free(
        request: Request, times: Array) -> tuple[Array, Array, Array, Array, tuple[float, ...]]:
    """
    Return the motion under the level in force.

    Stretch, rate, acceleration, field, and what branches follow at first.
    """
    material, state = request.material, request.state
    load, field = request.load, request.field
    followed = followed_by(state, material)
    if not material.creep and state.rate == 0.0 and field == load == law.elastic_force(
            state.stretch, material.packed):
        nothing = np.zeros(_POINTS)
        return np.full(_POINTS, state.stretch), nothing, nothing, nothing + load, followed
    stretch, rate, loads, *rows = sampled(
        (Level(0.0, load),), request.start, times, material, replace(
            request.delivery, slew=math.inf))
    stretch, rate, pull = stretch.copy(), rate.copy(), loads
    if material.creep:
        force = np.array([law.elastic_force(x, material.packed) for x in stretch.tolist()])
        pull = loads - material.branches[:, motion.RATIO] @ (force - np.array(rows))
    change = np.empty(_POINTS)
    law.accelerations(stretch, rate, pull, material.packed, change)
    return stretch, rate, change, loads, followed


def _branches(
        request: Request, stretch: Array, followed: tuple[float, ...], step: float) -> Array:
    """Return the force of the branches along a path."""
    material = request.material
    forces = np.empty(_POINTS)
    law.evaluate(law.FORCE, stretch, material.packed, forces)
    behind = np.empty((_POINTS, len(followed)))
    times: Array = (step * np.arange(_POINTS)).astype(np.float64)
    motion.trail(times, forces, with_followed(material, followed), behind)
    held: Array = (forces[:, np.newaxis] - behind) @ material.branches[:, motion.RATIO]
    return held


def _delivered(request: Request, path: _Path, holding: float, period: float) -> Attempt:
    """Return a path's levels as commands carry them, corrected to end at rest."""
    delivery, limits = request.delivery, request.limits
    count = min(max(math.ceil(_OF_EACH * path.duration / period), _FEWEST), _MOST)
    each = path.duration / count
    if delivery.period > 0.0:
        each = delivery.period * max(
            1, math.floor(each / delivery.period + 1e-9),
            math.ceil(path.duration / (_MOST * delivery.period) - 1e-9))
        count = max(math.ceil(path.duration / each - 1e-9), 3 + (delivery.lag > 0.0))
    times = each * np.arange(count + 1)
    # Ramps to a level make it late: the more, the longer they take.
    middle = (np.arange(count) + 0.5) / count
    steep = np.interp(middle, _SHARES, np.abs(path.slopes)) / delivery.slew
    loads = np.interp(middle + 0.5 * np.minimum(steep, 1.0) / count, _SHARES, path.loads)
    inside: Array = ((limits.minimum < loads) & (loads < limits.maximum)).astype(np.float64)
    loads = np.clip(loads, limits.minimum, limits.maximum)
    # Corrections that act on stretch and rate at the end, and on the field.
    left = path.duration * (1.0 - middle)
    angle = 2.0 * math.pi / period * left
    window = inside * 4.0 * middle * (1.0 - middle)
    changes: list[Array] = [window * np.sin(angle), window * np.cos(angle)]
    if delivery.lag > 0.0:
        settling: Array = inside * np.exp(-left / max(delivery.lag, each))
        changes.append(settling)
    d_loads = np.zeros((count + 1, len(changes)))
    d_loads[:-1] = np.array(changes).T
    rounded = np.array([delivery.rounded(x) for x in times.tolist()])
    loads = np.append(loads, path.loads[-1] if request.material.creep else holding)
    return solve(
        Template(rounded, loads, np.zeros_like(d_loads), d_loads), request,
        wait=delivery.rounded(0.5 * each))


def _refusal(request: Request) -> tuple[Code, str]:
    units, limits, slew = request.units, request.limits, request.delivery.slew
    code = Code.FLUX_LIMIT if math.isinf(slew) else Code.SLEW_LIMIT
    ramps = '' if math.isinf(slew) else f', ramps of {units.slew_text(slew)}'
    return code, (
        f'no smooth path of up to {MOST_PERIODS:g} natural periods leads to rest at '
        f'{request.named_target} within {units.drive.plural} of '
        f'{units.load_text(limits.minimum)} to '
        f'{units.load_text(limits.maximum)}{ramps} and the largest rate')
