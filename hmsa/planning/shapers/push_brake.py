"""Full push, full brake, hold: the fastest command within load limits on ideal hardware."""

from dataclasses import replace
from itertools import pairwise
import math

import numpy as np

from hmsa import motion
from hmsa.errors import HmsaError
from hmsa.model import law
from hmsa.model.moves import Level, Move, State
from hmsa.model.simulation import paces, sampled
from hmsa.model.status import Code, RefusedError
from hmsa.planning.shapers.request import MoveRequest
from hmsa.planning.shapers.shooting import (
    at_rest,
    Attempt,
    continuation,
    first_kept,
    free_levels,
    heights,
    on_time,
    solve,
    Template,
    within_limits,
)

_RTOL = 1e-12
# Relative margin below the limits, for levels that change when times are rounded.
_MARGIN = 1e-4
# Extra grid periods of push and brake to try if the minimum numbers give no solution.
_MORE_PERIODS = ((0, 0), (1, 0), (0, 1), (1, 1), (2, 2), (3, 3))
# With a lag: inverse of the relative increment of the command duration, and duration of the last
# level in lags.
_STRIDES, _PUSH = 12, math.log(2.0)
# Heights to try, as fractions of those that the limits allow.
_SHARES = (1.0, 0.5, 0.25, 0.1, 0.05)
# Strides of the search along a push, in radians of the vibration, and their maximum number.
_STRIDE, _MOST_STEPS = 0.05, 8_000
_SHORTEST_STRIDE = 0.03


def push_brake(request: MoveRequest) -> Move:
    """
    Push with the load limit on one side, brake with the other, then hold.

    With bounded load the fastest transfer is bang-bang with one switch, and with two if the field
    lags. It exists from any state, in motion or above critical damping, if the limits leave room
    on both sides of the holding load; otherwise raise `RefusedError`. Without limits, the push is
    twice the change of load of the move.
    """
    holding = request.holding_load()
    if at_rest(request):
        return Move(Code.HOLD, (Level(0.0, holding),), 0.0)
    least, most = _bounds(request, holding)
    lags = request.delivery.lag > 0.0
    if lags and request.delivery.period > 0.0:
        found = _fastest_on_grid(request, least, most)
    else:
        # On a command grid or with ramps, full height may leave no time to switch.
        found = next(filter(None, (_attempt(
            request, *(holding + share * (x - holding) for x in (least, most)))
            for share in _SHARES)), None)
    if found is not None:
        return Move(Code.MINIMUM_TIME, *found)
    if lags:
        return free_levels(request)._replace(reason='')
    raise RefusedError(
        Code.NOT_CONVERGED,
        f'no command of two levels within the limits was found from {request.named_state} to '
        f'rest at {request.target:g}')


def _attempt(request: MoveRequest, low: float, high: float) -> Attempt:
    """Push and brake with given loads; None if this yields no command within the limits."""
    push, brake = (high, low) if _upwards(request, low, high) else (low, high)
    elastic = replace(request, material=request.material.elastic)
    try:
        pushing, braking = _durations(elastic, push, brake)
    except HmsaError as error:
        # Where the elastic force decreases, the motion under a push may diverge.
        if request.delivery.lag > 0.0 or not isinstance(error, RefusedError):
            return None
        raise
    delivery, holding = request.delivery, request.holding_load()
    if delivery.period > 0.0:
        return first_kept((_on_grid(
            request, (push, pushing), (brake, braking), *x) for x in _MORE_PERIODS), request)
    up, down = delivery.ramp(push - request.load), delivery.ramp(push - brake)
    turn = max(pushing, up)
    found = solve(
        Template.of((Level(0.0, push), Level(turn, brake), Level(
            turn + max(braking, down), holding)), [('time', 1), ('time', 2)]), elastic,
        replace(delivery, lag=0.0))
    if found is not None and (request.material.creeps or delivery.lag > 0.0):
        found = _carried(request, found[0])
    return within_limits(on_time(found, request), request)


def _carried(request: MoveRequest, plain: tuple[Level, ...]) -> Attempt:
    """
    Solve for the times of push, brake and, with a lag, second push.

    Branches and lag are increased gradually if they are too strong to include at once.
    """
    material, delivery, creep = request.material, request.delivery, request.material.creep.held
    push, brake, holding = (x.load for x in plain)
    # The second push ends when the field, previously at the brake level, is at the holding load.
    length = math.log1p((holding - brake) / (push - holding))
    # Effective fraction of each branch for a motion at this frequency.
    speeds = paces(material, request.behind(request.target)) / request.frequency
    felt = 1.0 / (1.0 + speeds ** 2)

    def grown(share: float) -> tuple[float, ...]:
        return tuple((1.0 + ratio) ** share - 1.0 for ratio in creep.ratios)

    def closer(levels: tuple[Level, ...], share: float, aim: float) -> Attempt:
        faster = math.sqrt((1.0 + felt @ grown(aim)) / (1.0 + felt @ grown(share)))
        lag, times = aim * delivery.lag, [x.time / faster for x in levels]
        guess = [Level(0.0, push), Level(times[1], brake), Level(times[2], holding)]
        if lag > 0.0:
            guess[2:] = Level(times[2], push), Level(
                times[2] + delivery.ramp(push - brake) + lag * length
                + delivery.ramp(push - holding), holding)
        found = solve(
            Template.of(guess, [('time', 1 + i) for i in range(len(guess) - 1)]),
            replace(request, material=replace(material, creep=replace(creep, ratios=grown(aim)))),
            replace(delivery, lag=lag))
        return found if found is None or aim == 1.0 else (found[0][:len(guess)], found[1])

    found = continuation(plain, closer, _SHORTEST_STRIDE)
    ordered = found and all(x.time < y.time for x, y in pairwise(found[0]))
    return found if ordered else None


def _on_grid(
        request: MoveRequest, push: tuple[float, float], brake: tuple[float, float], more: int,
        longer: int) -> Template:
    """Return a guess of push and brake, (load, duration) each, on the grid; heights are free."""
    period, holding = request.delivery.period, request.holding_load()
    first = max(1, math.ceil(push[1] / period)) + more
    second = max(1, math.ceil(brake[1] / period)) + longer
    return heights((
        Level(0.0, holding + (push[0] - holding) * push[1] / (first * period)),
        Level(first * period, holding + (brake[0] - holding) * brake[1] / (second * period)),
        Level((first + second) * period, holding)))


def _fastest_on_grid(request: MoveRequest, least: float, most: float) -> Attempt:
    """Return the shortest three levels on the grid that keep the limits, else None."""
    period, lag, holding = request.delivery.period, request.delivery.lag, request.holding_load()
    longest = math.ceil((2.0 * math.pi / request.frequency + 3.0 * lag) / period) + 6

    def guess(count: int) -> Template:
        last = max(1, min(count // 3, math.ceil(_PUSH * lag / period)))
        return heights((
            Level(0.0, 0.5 * (least + holding)),
            Level(max(1, (count - last) // 2) * period, holding),
            Level((count - last) * period, holding), Level(count * period, holding)))

    # On a fine grid, increase the duration in strides, then search the last stride again.
    shortest = count = 3
    while count < longest:
        found = first_kept([guess(count)], request)
        if found is not None:
            return first_kept(map(guess, range(shortest, count)), request) or found
        shortest, count = count + 1, count + max(1, count // _STRIDES)
    return None


def _bounds(request: MoveRequest, holding: float) -> tuple[float, float]:
    """Return the loads for push and brake: the limits, or twice the change of the move."""
    state = request.state
    change = abs(holding - law.elastic_force(state.stretch, request.material.packed))
    mass = law.mass(state.stretch, request.material.packed)
    room = 2.0 * (change + mass * abs(state.rate) * request.frequency)
    least = max(request.limits.minimum, holding - room)
    most = min(request.limits.maximum, holding + room)
    if math.isfinite(request.limits.minimum):
        least = holding - (1.0 - _MARGIN) * (holding - request.limits.minimum)
    if math.isfinite(request.limits.maximum):
        most = holding + (1.0 - _MARGIN) * (request.limits.maximum - holding)
    if not least < holding < most:
        raise RefusedError(
            Code.FLUX_LIMIT,
            f'{request.named_target} is held by {request.units.load_text(holding)}, on the '
            'limit itself: expected limits with room on both sides to push and to brake')
    return least, most


def _turn(request: MoveRequest, state: State, load: float) -> tuple[float, float] | None:
    """Return time and stretch of the turning point under a load, None if none is found."""
    status, time, stretch, _, _ = motion.turning_point(
        state.stretch, state.rate, math.copysign(1.0, state.rate), load, 1.0,
        request.material.packed, _RTOL)
    return (time, stretch) if status == motion.DONE else None


def _upwards(request: MoveRequest, least: float, most: float) -> bool:
    """Return whether to push upwards: full braking would stop below the target."""
    state = request.state
    turned = None if state.rate == 0.0 else _turn(
        request, state, least if state.rate > 0.0 else most)
    return request.target > (state.stretch if turned is None else turned[1])


def _durations(request: MoveRequest, push: float, brake: float) -> tuple[float, float]:
    """Return approximate durations of the push and of the brake that turns at the target."""
    material, target = request.material, request.target
    direction = math.copysign(1.0, push - brake)
    pushed, stride = (Level(0.0, push),), _STRIDE / (request.frequency + material.zeta)

    def turn(start: State, way: float, load: float) -> tuple[float, float]:
        if way * start.rate <= 0.0:
            return 0.0, start.stretch
        # The motion runs into a limiting stretch: count it as far beyond the target.
        return _turn(request, start, load) or (
            0.0, float(material.packed[law.UPPER if way > 0.0 else law.LOWER]))

    # If moving away, the push first has to stop the motion.
    begin, stretch = turn(request.state, -direction, push)
    here = request.state if begin == 0.0 else State(stretch, 0.0)
    pushing, before = 0.0, -math.inf
    for _ in range(_MOST_STEPS):
        braking, stop = turn(here, direction, brake)
        beyond = direction * (stop - target)
        if beyond >= 0.0 or (pushing > 0.0 and direction * here.rate <= 0.0):
            break
        before = beyond
        stretch, rate, *_ = sampled(
            pushed, here, np.array([stride]), material, rtol=_RTOL)[:, 0].tolist()
        here, pushing = State(stretch, rate), pushing + stride
    if beyond < 0.0:
        raise RefusedError(
            Code.FLUX_LIMIT,
            f'{request.named_target} is not reached under {request.units.load_text(push)}: '
            'expected wider flux density limits')
    # Interpolate in the last stride.
    return begin + pushing - stride * beyond / (beyond - before), braking
