"""Full push, full brake, hold: on ideal hardware the fastest command within load limits."""

from collections.abc import Callable
import contextlib
from dataclasses import replace
import math

import numpy as np

from hmsa_ros import motion
from hmsa_ros.model import law
from hmsa_ros.model.moves import Level, Move, State
from hmsa_ros.model.simulation import sampled
from hmsa_ros.model.status import Code, RefusedError
from hmsa_ros.planning.shapers.creeping import with_branches
from hmsa_ros.planning.shapers.lagged import (
    at_rest,
    fastest_on_grid,
    in_order,
    push_brake_push,
    three_levels,
)
from hmsa_ros.planning.shapers.request import Request
from hmsa_ros.planning.shooting import Attempt, on_time, solve, Template

_RTOL = 1e-12
_AT_REST = 1e-9
# Room that is left below the limits, as a share, for what rounded times ask of the levels.
_MARGIN = 1e-4
# Periods to add on the grid where the least number gives no solution.
_MORE_PERIODS = ((0, 0), (1, 0), (0, 1), (1, 1), (2, 2), (3, 3))
# Heights to try, as shares of what the limits allow.
_SHARES = (1.0, 0.5, 0.25, 0.1, 0.05)
_MOST_STEPS = 20_000
# Of the time of the switch, as a share.
_ZERO_TOLERANCE = 1e-13


def push_brake(request: Request, reason: str = '') -> Move:
    """
    Push with the load limit on one side, brake with the other, then hold.

    With bounded load the fastest transfer is bang-bang with one switch. It exists from any
    state, moving ones and those above critical damping included, as long as the limits leave
    room on both sides of the target's own load: `RefusedError` otherwise. Without limits, a push
    of twice the move's change of load is used. ``reason`` is why it takes the place of another.
    """
    holding = request.holding_load()
    state, target = request.state, request.target
    if request.delivery.lag > 0.0:
        return _late(request, holding, reason)
    if abs(target - state.stretch) <= _AT_REST and abs(state.rate) <= _AT_REST * request.frequency:
        return Move(Code.HOLD, (Level(0.0, holding),), 0.0)
    least, most = _bounds(request, holding)
    for share in _SHARES:
        # On a grid and through ramps full height may leave no time to switch.
        found = _attempt(
            request, holding, holding + share * (least - holding),
            holding + share * (most - holding))
        if found is not None and request.keeps(found[0]):
            return Move(Code.MINIMUM_TIME, *found, reason)
    raise RefusedError(
        Code.NOT_CONVERGED,
        f'no command of two levels within the limits was found from {request.named_state} to '
        f'rest at {target:g}')


def _late(request: Request, holding: float, reason: str) -> Move:
    """Push, brake and push again, so that the field arrives with the stretch."""
    if at_rest(request):
        return Move(Code.HOLD, (Level(0.0, holding),), 0.0)
    if request.delivery.period > 0.0:
        found = fastest_on_grid(request, _bounds(request, holding))
        if found is not None:
            return Move(Code.MINIMUM_TIME, *found, reason)
        return three_levels(request, Code.MINIMUM_TIME, reason)
    least, most = _bounds(request, holding)
    elastic = replace(request, material=request.material.elastic)
    for share in _SHARES:
        low, high = holding + share * (least - holding), holding + share * (most - holding)
        direction = _direction(request, low, high)
        push, brake = (high, low) if direction > 0.0 else (low, high)
        with contextlib.suppress(RefusedError):
            found = _attempt(replace(elastic, delivery=replace(
                request.delivery, lag=0.0, resolution=0.0)), holding, low, high)
            found = found and push_brake_push(elastic, found[0], push, brake)
            found = in_order(_carried(request, found, 3))
            if found is not None and request.keeps(found[0]):
                return Move(Code.MINIMUM_TIME, *found, reason)
    return three_levels(request, Code.MINIMUM_TIME, reason)


def _attempt(
        request: Request, holding: float, least: float,
        most: float) -> Attempt:
    """Push and brake with given loads; None if no command comes of it."""
    direction = _direction(request, least, most)
    push, brake = (most, least) if direction > 0.0 else (least, most)
    elastic = replace(request, material=request.material.elastic)
    pushing, braking = _durations(elastic, direction, push, brake)
    if request.delivery.period > 0.0:
        return _on_grid(request, holding, (push, pushing), (brake, braking))
    delivery = request.delivery
    up = delivery.ramp(push - request.load)
    down = delivery.ramp(push - brake)
    levels = (Level(0.0, push), Level(max(pushing, up), brake),
              Level(max(pushing, up) + max(braking, down), holding))
    return _carried(request, solve(
        Template.of(levels, [('time', 1), ('time', 2)]), elastic), 2)


def _carried(request: Request, found: Attempt, switches: int) -> Attempt:
    """Have the switches of levels be those with branches, at times that commands can carry."""
    if found is not None and request.material.creep:
        found = with_branches(
            request, found[0], [('time', 1 + i) for i in range(switches)])
    return on_time(found, switches, request)


def _on_grid(
        request: Request, holding: float, push: tuple[float, float],
        brake: tuple[float, float]) -> Attempt:
    """Place push and brake, (load, duration) each, on the grid; their heights are free then."""
    period = request.delivery.period
    for more_first, more_second in _MORE_PERIODS:
        first = max(1, math.ceil(push[1] / period)) + more_first
        second = max(1, math.ceil(brake[1] / period)) + more_second
        levels = (
            Level(0.0, holding + (push[0] - holding) * push[1] / (first * period)),
            Level(first * period,
                  holding + (brake[0] - holding) * brake[1] / (second * period)),
            Level((first + second) * period, holding))
        found = solve(
            Template.of(levels, [('load', 0), ('load', 1)]), request)
        if found is not None:
            return found
    return None


def _bounds(request: Request, holding: float) -> tuple[float, float]:
    """Return the loads to push and brake with: the limits, or twice the move's own change."""
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


def _direction(request: Request, least: float, most: float) -> float:
    """Return where to push: +1 if full braking would stop short of the target, seen upwards."""
    state = request.state
    stop = state.stretch
    if state.rate != 0.0:
        up = state.rate > 0.0
        status, _, stop, _, _ = motion.turning_point(
            state.stretch, state.rate, 1.0 if up else -1.0, least if up else most, 1.0,
            request.material.packed, _RTOL)
        if status != motion.DONE:
            stop = state.stretch
    return 1.0 if request.target > stop else -1.0


def _durations(
        request: Request, direction: float, push: float,
        brake: float) -> tuple[float, float]:
    """Find how long to push so that braking turns at the target, and how long that brakes."""
    state, material, target = request.state, request.material, request.target
    packed = material.packed
    begins, loads, slopes = np.array([[0.0], [push], [0.0]])

    def follow(start: State, time: float) -> State:
        stretch, rate, *_ = sampled(
            begins, loads, slopes, np.array([float(time)]), start, material, _RTOL)[:, 0].tolist()
        return State(stretch, rate)

    def turn(start: State) -> tuple[float, float]:
        if direction * start.rate <= 0.0:
            return 0.0, start.stretch
        status, time, stretch, _, _ = motion.turning_point(
            start.stretch, start.rate, direction, brake, 1.0, packed, _RTOL)
        if status != motion.DONE:
            # Too hard against a limiting stretch to be followed: far beyond the target.
            return 0.0, float(packed[law.UPPER if direction > 0.0 else law.LOWER])
        return time, stretch

    begin = 0.0
    here = state
    if direction * state.rate < 0.0:
        # Moving away: the push first has to bring it to a stop.
        status, begin, stretch, _, _ = motion.turning_point(
            state.stretch, state.rate, -direction, push, 1.0, packed, _RTOL)
        if status == motion.DONE:
            here = State(stretch, 0.0)
    stride = 0.02 / (request.frequency + material.zeta)
    low = 0.0
    high = stride
    ahead = follow(here, high)
    for _ in range(_MOST_STEPS):
        if direction * (ahead.stretch - target) >= 0.0:
            break
        low = high
        high += stride
        ahead = follow(ahead, stride)
        if direction * ahead.rate <= 0.0:
            break
    if direction * (ahead.stretch - target) < 0.0:
        raise RefusedError(
            Code.FLUX_LIMIT,
            f'{request.named_target} is not reached under {request.units.load_text(push)}: '
            'expected wider flux density limits')

    def excess(time: float) -> float:
        return direction * (turn(follow(here, time))[1] - target)

    if excess(0.0) >= 0.0:
        low = high = 0.0
    elif excess(low) > 0.0:
        low = 0.0
    pushing = high if low == high else _zero(excess, low, high)
    return begin + pushing, turn(follow(here, pushing))[0]


def _zero(function: Callable[[float], float], low: float, high: float) -> float:
    """
    Return where a function changes its sign (Anderson and Bjorck, BIT 13, 1973).

    SciPy's solvers are as fast, but loading them takes half of the time in which a planner starts.
    """
    other, value = function(low), function(high)
    for _ in range(_MOST_STEPS):
        step = value * (high - low) / (other - value)
        if abs(step) <= _ZERO_TOLERANCE * max(abs(high), 0.1):
            return high + step
        new = function(high + step)
        if (new > 0.0) == (value > 0.0):
            # The same end moves again: the other one has less weight from now on.
            share = 1.0 - new / value
            other *= share if share > 0.0 else 0.5
        else:
            low, other = high, value
        high, value = high + step, new
    return high
