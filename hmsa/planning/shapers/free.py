"""
Levels of free heights, for moves that a single intermediate level cannot bring to rest.

The number of free levels equals the number of conditions: two for stretch and rate, and a third
one if the field lags and must arrive with them. Levels have equal durations, the shortest first,
with any command grid and ramps. If only ramps limit the command, the fastest one ramps without a
pause and reverses twice.
"""

from collections.abc import Iterator
from itertools import product
import math

import numpy as np

from hmsa.model import law
from hmsa.model.moves import Level, Move
from hmsa.model.simulation import branches_of
from hmsa.model.status import Code, RefusedError
from hmsa.planning.shapers.request import AT_REST, MoveRequest
from hmsa.planning.shooting import (
    Attempt,
    first_kept,
    heights,
    on_time,
    soonest_kept,
    Template,
)

# Total durations of the levels to try, in half periods at the target.
_LENGTHS = (0.7, 0.85, 1.0, 1.2, 1.4, 1.7, 2.0, 2.5, 3.0, 4.0, 5.0, 7.0)
# Initial ramps of the search for two swings, in quarter periods.
_SWINGS = (0.3, 0.1, 0.7, 0.03, 1.2)
_NUMBERS = {2: 'two', 3: 'three'}


def at_rest(request: MoveRequest) -> bool:
    """Return whether stretch, rate and (if it lags) field are those of the target."""
    state, packed = request.state, request.material.packed
    if abs(state.stretch - request.target) > AT_REST or not request.still:
        return False
    delivery, holding = request.delivery, request.balance(branches_of(state, request.material))
    stiffness = float(law.elastic_stiffness(request.target, packed))
    return delivery.lag == 0.0 or max(abs(request.field - holding), abs(
        request.load - holding) * (not math.isinf(delivery.slew))) <= AT_REST * stiffness


def free_heights(request: MoveRequest) -> Attempt:
    """Return the shortest levels of free heights that keep the limits, else None."""
    delivery = request.delivery
    if delivery.period > 0.0 or delivery.lag > 0.0 or math.isinf(delivery.slew):
        return first_kept(_equal(request), request)
    found = soonest_kept(_swings(request), request) or first_kept(_equal(request), request)
    return on_time(found, request)


def free_levels(request: MoveRequest) -> Move:
    """Come to rest with levels of free heights; raise `RefusedError` if none keep the limits."""
    found = free_heights(request)
    if found is None:
        raise RefusedError(*_refusal(request))
    return Move(Code.MINIMUM_TIME, *found, no_single(request))


def through(request: MoveRequest, duration: float) -> Move:
    """
    Come to rest after a given time with levels of equal duration.

    Raise `RefusedError` if the limits allow no such move.
    """
    count, period, holding = request.unknowns, request.delivery.period, request.holding_load()
    edges = duration / count * np.arange(count + 1)
    if period > 0.0:
        edges = period * np.round(edges / period)
    found = first_kept([heights([Level(x, holding) for x in edges.tolist()])] if np.all(
        np.diff(edges) > 0.0) else (), request)
    if found is None:
        raise RefusedError(
            Code.NOT_CONVERGED,
            f'no {count} levels of equal duration lead to {request.named_target} in '
            f'{request.units.time_text(duration)}: expected more time')
    return Move(Code.MINIMUM_TIME, *found)


def no_single(request: MoveRequest) -> str:
    """Return the reason why levels of free heights are used."""
    settled = ' and a push that settles the field' if request.delivery.lag > 0.0 else ''
    return (f'no single intermediate flux density{settled} within the limits leads as soon from '
            f'{request.named_state} to rest at {request.target:g}: '
            f'{_NUMBERS[request.unknowns]} are used')


def _equal(request: MoveRequest) -> Iterator[Template]:
    """Yield guesses of levels with equal durations."""
    delivery, holding, count = request.delivery, request.holding_load(), request.unknowns
    half, before = math.pi / request.frequency, 0.0
    for share in _LENGTHS:
        each = (share * half + delivery.lag + delivery.ramp(holding - request.load)) / count
        if delivery.period > 0.0:
            each = math.ceil(each / delivery.period) * delivery.period
        each = delivery.rounded(each)
        if each > before:
            before = each
            yield heights([
                Level(0.0, 0.5 * (request.load + holding)),
                *(Level((1 + i) * each, holding) for i in range(count))])


def _swings(request: MoveRequest) -> Iterator[tuple[float, Template]]:
    """Yield guesses of two levels that ramps just reach, with their durations."""
    slew, start, holding = request.delivery.slew, request.load, request.holding_load()
    longest = 0.5 * math.pi / request.frequency
    for share, rest, sign in product(_SWINGS, _SWINGS, (1.0, -1.0)):
        turn = share * longest
        high, low = start + sign * slew * turn, holding - sign * slew * rest * longest
        if sign * (high - low) > 0.0:
            last = turn + abs(high - low) / slew
            yield last + rest * longest, Template(
                np.array([0.0, turn, last]),
                np.array([high, low, holding]),
                sign / slew * np.array([[0.0, 0.0], [1.0, 0.0], [2.0, -1.0]]),
                np.array([[1.0, 0.0], [0.0, 1.0], [0.0, 0.0]]))


def _refusal(request: MoveRequest) -> tuple[Code, str]:
    units, delivery, limits = request.units, request.delivery, request.limits
    slow, ramps = delivery.slew < math.inf, f'ramps of {units.slew_text(delivery.slew)}'
    if delivery.lag > 0.0:
        return Code.SLEW_LIMIT if slow else Code.FLUX_LIMIT, (
            f'no command for a coil time constant of {units.time_text(delivery.lag)} brings '
            f'{request.named_target} and the field to rest together within '
            + (f'{ramps} and ' if slow else '')
            + f'flux densities of {units.load_text(limits.minimum)} to '
            f'{units.load_text(limits.maximum)}')
    if request.material.creeps:
        return Code.NO_TWO_STEP, (
            f'no two flux densities within the limits bring {request.named_target} of this '
            'creeping elastomer to rest: expected wider limits, a smaller move or several '
            'setpoints')
    if delivery.period > 0.0:
        return Code.NO_TWO_STEP, (
            f'no command on a grid of {units.time_text(delivery.period)} within the limits '
            f'brings {request.named_target} to rest')
    return Code.SLEW_LIMIT, f'no command through {ramps} brings {request.named_target} to rest'
