"""The two-step command, on ideal and on real hardware."""

from collections.abc import Iterator
from dataclasses import replace
from itertools import product, starmap
import math
from operator import itemgetter

import numpy as np

from hmsa import motion
from hmsa.model.moves import Level, Move
from hmsa.model.simulation import branches_of
from hmsa.model.status import Code, RefusedError
from hmsa.planning.shapers.push_brake import push_brake
from hmsa.planning.shapers.request import MoveRequest
from hmsa.planning.shapers.shooting import (
    at_rest,
    Attempt,
    continuation,
    first_kept,
    free_heights,
    free_levels,
    heights,
    no_single,
    solve,
    soonest_kept,
    Template,
    within_limits,
)
from hmsa.planning.two_step import CODES, HOLD_TOLERANCE, RTOL

# Duration of the push that settles a lagging field, in time constants: the push exceeds the
# holding level by as much as the previous level falls short of it; others on a grid are longer.
_PUSH = math.log(2.0)
# Extra grid periods; with a lag, also factors on the push.
_MORE = (0, 1, 2, 3)
_BEHIND_LAG = (*_MORE, 4, 6, 9), (1, 2, 3)
# Initial values of a search: fractions of the range of levels, and the longest hold in eighths of
# a period.
_HEIGHTS = (0.5, 0.3, 0.7, 0.1, 0.9)
_LONGEST_HOLD = 18
# Slower ramps are refused without a search, which would take seconds.
_MOST_HALF_PERIODS = 80
_SHORTEST_STRIDE = 0.05
# Duration, in half periods and lags, above which levels of free heights may be faster.
_SLOW = 3.0
# Codes of plans that are replaced at once.
_WITHOUT = (Code.HOLD, Code.TOO_DAMPED, Code.INDISTINGUISHABLE)


def two_step(request: MoveRequest) -> Move:
    """
    Apply beta_p for tau_p, then beta_1 (Eq. 13): rest at the target without residual vibration.

    With viscoelastic branches, a tail of levels then follows their overstress at arrival. If the
    field lags, an additional short push settles it. On a command grid there is one more level,
    and the loads are solved for; with ramps, beta_p and its duration. If no single level within
    the limits leads to rest, levels of free heights do. If the response is overdamped and does not
    cross the target, no such command exists; the unshaped step, which does not overshoot then,
    replaces it. The move's reason reports each of these cases.
    """
    delivery, creeps = request.delivery, request.material.creeps
    lags, at_once = delivery.lag > 0.0, delivery.period == 0.0 and delivery.slew == math.inf
    if not lags and not creeps:
        code, levels = _plain(request)
        # First, since the checks below take as long as a third of the search.
        if code is Code.TWO_STEP and at_once and request.keeps(levels):
            return Move(code, levels, levels[1].time)
    holding = request.holding_load()
    if lags and at_rest(request):
        return Move(Code.HOLD, (Level(0.0, holding),), 0.0)
    if lags or creeps:
        # On a command grid or with ramps, start without the lag, whose push needs another level.
        code, levels = _late(request, delivery.lag if at_once else 0.0)
    if code is Code.TWO_STEP:
        found = (levels, levels[-1].time) if at_once else _delivered(request, levels)
        if found is not None and request.keeps(found[0]):
            sooner = _sooner(request, found[1]) if lags or creeps else None
            return sooner or Move(Code.TWO_STEP, *found)
    elif code in _WITHOUT and not (lags and code is Code.HOLD):
        return _without(request, code, holding)
    if request.still and not lags and (code is Code.TWO_STEP or not creeps):
        request.check(levels)
    if at_once and not lags and not creeps:
        return push_brake(request)._replace(reason=no_single(request))
    try:
        return free_levels(request)
    except RefusedError:
        found = soonest_kept(_held(request), request)
        if found is None:
            raise
        return Move(Code.TWO_STEP, *found)


def _sooner(request: MoveRequest, duration: float) -> Move | None:
    """Return levels of free heights that are at rest before a slow command, else None."""
    if duration <= _SLOW * request.delivery.lag or duration <= _SLOW * (
            math.pi / request.frequency + request.delivery.lag):
        return None
    found = free_heights(request)
    return Move(Code.MINIMUM_TIME, *found, no_single(request)) \
        if found is not None and found[1] < duration else None


def _plain(request: MoveRequest) -> tuple[Code, tuple[Level, ...]]:
    """Return code and levels for ideal hardware without branches."""
    state, limits = request.state, request.limits
    status, beta_p, tau_p, beta_1, _ = motion.two_step(
        state.stretch, state.rate, request.target, request.material.packed, limits.minimum,
        limits.maximum, RTOL, HOLD_TOLERANCE)
    return CODES[status], (Level(0.0, beta_p), Level(tau_p, beta_1))


def _late(request: MoveRequest, lag: float) -> tuple[Code, tuple[Level, ...]]:
    """Return code and levels with branches or a lag, at any time and in steps."""
    state, material, limits = request.state, request.material, request.limits
    status, beta_p, tau_p, beta_1, push, until = motion.two_step_late(
        state.stretch, state.rate, request.target, limits.minimum, limits.maximum, RTOL,
        HOLD_TOLERANCE, material.packed, material.branches, branches_of(state, material),
        request.field, request.load, lag)
    code = CODES[status]
    if code is not Code.TWO_STEP:
        # The reason is that of the elastic motion.
        elastic = _plain(replace(request, material=material.elastic))[0]
        return elastic if elastic in _WITHOUT else Code.NO_TWO_STEP, ()
    levels = Level(0.0, beta_p), Level(tau_p, beta_1)
    return code, levels if lag == 0.0 else (
        levels[0], Level(tau_p, push), Level(until, beta_1))


def _without(request: MoveRequest, code: Code, holding: float) -> Move:
    """Return the move that replaces two levels where they do not exist."""
    if code is Code.HOLD:
        return Move(code, (Level(0.0, holding),), 0.0)
    return request.plain(code, f'zeta {request.material.zeta:g} ' + (
        f'is too damped for the response to cross {request.named_target}: no two-step command '
        'exists, the unshaped step approaches without overshoot (shaper minimum_time can arrive '
        'in finite time)' if code is Code.TOO_DAMPED else
        f'is so close to critical damping at {request.named_target} that beta_p equals beta_1 to '
        'rounding: the unshaped step is used'))


def _delivered(request: MoveRequest, levels: tuple[Level, ...]) -> Attempt:
    """Return the command on a grid or with ramps for one at any time and in steps, else None."""
    if request.delivery.period > 0.0:
        return first_kept(_on_grid(request, *levels), request)
    return _ramped(request, levels)


def _on_grid(request: MoveRequest, first: Level, last: Level) -> Iterator[Template]:
    """
    Yield guesses on the grid: one level, another for a period, and one that settles the field.

    The fraction of that period that the ideal command spends at the last level gives its height.
    The push is long enough not to exceed the limits by much.
    """
    delivery = request.delivery
    period, lag = delivery.period, delivery.lag
    shortest = math.ceil(_PUSH * lag / period)
    late = lag + delivery.ramp(last.load - request.load) if lag > 0.0 else 0.0
    for periods, longer in product(*(_BEHIND_LAG if lag > 0.0 else (_MORE, (1,)))):
        push = longer * shortest
        count = max(push + 2, math.ceil((last.time + late) / period - 1e-9)) + periods
        before = count - push
        share = min(max(before - last.time / period, 0.0), 1.0)
        levels = [first, Level((before - 1) * period, first.load + share * (
            last.load - first.load)), Level(before * period, last.load)]
        yield heights(levels + [Level(count * period, last.load)] * bool(push))


def _ramped(request: MoveRequest, ideal: tuple[Level, ...]) -> Attempt:
    """
    Solve for the level between two ramps and its duration, and the push that settles the field.

    A linear oscillator comes to rest if ramps and hold together last an odd number of half
    periods. The solution for the smallest feasible number is followed from fast ramps to the real
    ones. If that takes more than one half period, or exceeds the limits, the fastest of many
    guesses may be better. The solution is then followed from no lag to the lag.
    """
    first, last = ideal
    delivery, start = replace(request.delivery, lag=0.0), request.load
    slew, lag, change = delivery.slew, request.delivery.lag, last.load - start
    bare = replace(request, delivery=delivery)

    def slower(levels: tuple[Level, ...], share: float, aim: float) -> Attempt:
        # Ramps lengthen about their midpoints, so that the second one starts earlier.
        shift = 0.5 * (aim - share) / slew * (
            abs(levels[0].load - start) - abs(levels[1].load - levels[0].load))
        guess = (levels[0], Level(levels[1].time + shift, levels[1].load))
        return solve(
            Template.of(guess, [('load', 0), ('time', 1)]), request,
            replace(delivery, slew=slew / aim))

    def later(levels: tuple[Level, ...], share: float, aim: float) -> Attempt:
        # The push compensates for the unsettled part of the first level, as far as ramps reach.
        missing = levels[-1].load - levels[0].load
        push = math.copysign(
            min(abs(missing), slew * aim * lag * math.log1p(math.exp(-_PUSH))), missing)
        return solve(_pushed(levels[0], Level(
            levels[1].time + (aim - share) * _PUSH * lag, levels[-1].load + push),
            levels[-1].load, slew, aim * lag), request, replace(delivery, lag=aim * lag))

    decay = 1.0
    if first.load != start:
        decay = min(1.0, abs((last.load - first.load) / (first.load - start)))
    half_periods = 1 + 2 * max(
        0, math.ceil(0.5 * (abs(change) / slew / (2.0 * last.time) - 1.0)))
    if half_periods > 1:
        ideal = (Level(0.0, start + change / (1.0 + decay ** half_periods)),
                 Level(half_periods * last.time, last.load))
    tried = [continuation(ideal, slower, _SHORTEST_STRIDE)]
    if request.still and (half_periods > 1 or within_limits(tried[0], request) is None):
        tried.append(soonest_kept(_held(bare), bare))
    for found in sorted(filter(None, tried), key=itemgetter(1)):
        late = within_limits(
            continuation(found[0], later, _SHORTEST_STRIDE) if lag > 0.0 else found, request)
        if late is not None:
            return late
    return None


def _pushed(first: Level, push: Level, last: float, slew: float, lag: float) -> Template:
    """Return a level and a push before the last load, with both heights and the time free."""
    change = push.load - first.load
    template = Template.of(
        (first, push, Level(push.time + abs(change) / slew + _PUSH * lag, last)),
        [('load', 0), ('load', 1), ('time', 1)])
    d_times = template.d_times.copy()
    d_times[2, :2] = math.copysign(1.0 / slew, change) * np.array([-1.0, 1.0])
    return replace(template, d_times=d_times)


def _held(request: MoveRequest) -> Iterator[tuple[float, Template]]:
    """Return guesses of a level between ramps and its hold, with their durations."""
    delivery, start, holding = request.delivery, request.load, request.holding_load()
    slew, eighth = delivery.slew, 0.25 * math.pi / request.frequency
    if delivery.lag > 0.0 or delivery.period > 0.0 or math.isinf(slew) or abs(
            holding - start) > _MOST_HALF_PERIODS * 4.0 * eighth * slew:
        return iter(())
    reach = 8.0 * eighth * slew
    low = max(request.limits.minimum, min(start, holding) - reach)
    high = min(request.limits.maximum, max(start, holding) + reach)

    def guess(hold: int, height: float) -> tuple[float, Template]:
        level = low + height * (high - low)
        until = abs(level - start) / slew + hold * eighth
        return until + abs(holding - level) / slew, Template.of(
            (Level(0.0, level), Level(until, holding)), [('load', 0), ('time', 1)])

    return starmap(guess, product(range(_LONGEST_HOLD), _HEIGHTS))
