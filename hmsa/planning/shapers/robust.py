"""
Chained two-step commands, the nonlinear counterpart of ZVD and its higher orders.

Two two-step commands without a hold between them, through the equilibrium stretch of beta_p, leave
no vibration either, and tolerate model errors as a ZVD shaper does: the vibration that the first
command leaves meets that of the second half a period later. A chain of order n goes through the
equilibrium stretches of the levels of order n - 1, which for a linear oscillator gives the levels
of n convolved ZV shapers.
"""

from dataclasses import replace
import math

from hmsa.errors import check_number
from hmsa.model import law
from hmsa.model.delivery import IDEAL
from hmsa.model.moves import Level, Move, State
from hmsa.model.status import Code
from hmsa.planning.shapers.creeping import arrival
from hmsa.planning.shapers.request import MOST_ORDER, MoveRequest
from hmsa.planning.shapers.two_step import two_step

# Relative rounding error of times.
_ROUNDING = 1e-12


def robust(request: MoveRequest) -> Move:
    """
    Command a move through ``request.order`` chained two-step commands.

    The move has ``order + 1`` levels on ideal hardware, and takes about ``order`` times as long as
    the two-step command, which is the chain of order 1. If there is no chain, the result is that
    of `two_step`. Raise `BadInputError` if the order is not 1 to `MOST_ORDER`.
    """
    check_number('order', request.order, least=1, most=MOST_ORDER)
    move = two_step(request)
    if request.order == 1 or move.code is not Code.TWO_STEP:
        return move
    # Waypoints are independent of the hardware: they come from the ideal command.
    ideal = replace(request, delivery=IDEAL, material=request.material.elastic)
    chain = two_step(ideal)
    for _ in range(request.order - 1):
        waypoints = [
            float(law.equilibrium_stretch(x.load, request.material.packed))
            for x in chain.levels[:-1]]
        chain = _chain(ideal, [*waypoints, request.target])
        if chain.code is not Code.ROBUST:
            break
    if chain.code is Code.ROBUST and (request.material.creeps or not request.delivery.ideal):
        chain = _chain(request, [*waypoints, request.target])
    return chain if chain.code is Code.ROBUST else move._replace(reason=(
        f'no cascade of order {request.order} leads to {request.named_target} ({chain.code}): '
        'a single two-step command is used'))


def _chain(request: MoveRequest, waypoints: list[float]) -> Move:
    """Return the two-step commands through waypoints, without a hold at any of them."""
    levels: list[Level] = []
    begin = 0.0
    state = request.state
    for waypoint in waypoints:
        move = two_step(replace(request, state=state, target=waypoint))
        if move.code is not Code.TWO_STEP:
            return move
        last = move.levels[-1]
        if levels and begin > levels[-1].time and request.delivery.period > 0.0:
            # At rest at the end of a ramp: the next command starts on the command grid.
            begin = math.ceil(begin / request.delivery.period - 1e-9) * request.delivery.period
        levels += [Level(begin + x.time, x.load) for x in move.levels]
        begin += move.duration
        if levels[-1].time >= (1.0 - _ROUNDING) * begin:
            # There is no ramp to complete: the next command starts at once.
            levels.pop()
        if request.material.creeps:
            state = arrival(replace(request, state=state, target=waypoint), move)
        else:
            state = State(waypoint, 0.0, last.load)
    if begin > levels[-1].time and levels[-1].load == last.load:
        return Move(Code.ROBUST, tuple(levels), begin)
    return Move(Code.ROBUST, (*levels, Level(begin, last.load)), begin)
