"""The two-step command, on ideal and on real hardware."""

import contextlib
from dataclasses import replace
from itertools import product, starmap
import math

import numpy as np

from hmsa_ros import motion
from hmsa_ros.model.moves import Level, Limits, Move
from hmsa_ros.model.status import Code, RefusedError
from hmsa_ros.planning.shapers.creeping import free_levels, two_levels
from hmsa_ros.planning.shapers.lagged import at_rest, settle, three_levels
from hmsa_ros.planning.shapers.push_brake import push_brake
from hmsa_ros.planning.shapers.request import Request
from hmsa_ros.planning.shooting import approach, Attempt, first_kept, solve, Template
from hmsa_ros.planning.two_step import CODES, HOLD_TOLERANCE, plan_two_step, RTOL

# Where a search begins: shares of the way between the least and the largest level, and the longest
# hold in eighths of a period.
_HEIGHTS = (0.5, 0.3, 0.7, 0.1, 0.9)
_LONGEST_HOLD = 18
# Ramps slower than this are refused without a search, which would take seconds.
_MOST_HALF_PERIODS = 80
_SHORTEST_STRIDE = 0.05
# Codes of plans in whose place something else is done at once.
_WITHOUT = (Code.HOLD, Code.TOO_DAMPED, Code.INDISTINGUISHABLE)
# Ramps to begin the search for two swings with, in quarters of a period.
_SWINGS = (0.3, 0.1, 0.7, 0.03, 1.2)


def two_step(request: Request) -> Move:
    """
    Apply beta_p for tau_p, then beta_1 (Eq. 13): at rest at the target, nothing left to ring.

    On a grid, the second last period gets a level of its own and both levels are solved for;
    through ramps, beta_p and its duration are. From a moving start for which no single level
    leads to rest within the limits, two are used. Where the response is too damped to cross
    the target there is no such command; the unshaped step, which does not overshoot there, takes
    its place. Both say so in the move's reason.
    """
    delivery, creep = request.delivery, request.material.creep
    if delivery.lag > 0.0 or creep:
        # The rest is for what one search does not lead to.
        move = _at_once(request) if delivery.period == 0.0 and delivery.slew == math.inf else None
        return move or (_late if delivery.lag > 0.0 else _creeping)(request)
    holding = request.holding_load()
    state, material, target = request.state, request.material, request.target
    plan = plan_two_step(
        state.stretch, target, material, rate=state.rate,
        load_limits=(request.limits.minimum, request.limits.maximum))
    if plan.code in _WITHOUT:
        return _without(request, plan.code, holding)
    inside = request.limits.minimum <= plan.beta_p <= request.limits.maximum
    if plan.code is not Code.TWO_STEP or not inside:
        if state.rate == 0.0:
            request.check([Level(0.0, plan.beta_p)])
        return _two_levels(request, holding)
    ideal = (Level(0.0, plan.beta_p), Level(plan.tau_p, holding))
    if request.delivery.ideal:
        return Move(Code.TWO_STEP, ideal, plan.tau_p)
    if request.delivery.period > 0.0:
        return _sampled(request, *ideal)
    return _ramped(request, *ideal)


def _at_once(request: Request) -> Move | None:
    """Return the move with branches or behind a lag, at any time and in steps; None if none."""
    state, material, limits, lag = (
        request.state, request.material, request.limits, request.delivery.lag)
    least, most = limits.minimum, limits.maximum
    found, beta_p, tau_p, beta_1, push, until = motion.two_step_late(
        state.stretch, state.rate, request.target, least, most, RTOL, HOLD_TOLERANCE,
        material.packed, material.branches, state.followed, request.field, request.load, lag)
    if CODES[found] is not Code.TWO_STEP or not (
            least <= beta_p <= most and least <= beta_1 <= most and least <= push <= most):
        return None
    levels = Level(0.0, beta_p), Level(tau_p, beta_1)
    if lag == 0.0:
        return Move(Code.TWO_STEP, levels, tau_p)
    return Move(
        Code.TWO_STEP, (levels[0], Level(tau_p, push), Level(until, beta_1)), until)


def _without(request: Request, code: Code, holding: float) -> Move:
    """Return what takes the place of two levels where there are none."""
    zeta = request.material.zeta
    if code is Code.HOLD:
        return Move(code, (Level(0.0, holding),), 0.0)
    if code is Code.TOO_DAMPED:
        return request.plain(
            code,
            f'zeta {zeta:g} is too damped for the response to cross {request.named_target}: no '
            'two-step command exists, the unshaped step approaches without overshoot (shaper '
            'minimum_time can arrive in finite time)')
    return request.plain(
        code,
        f'zeta {zeta:g} is so close to critical damping at {request.named_target} that beta_p '
        'equals beta_1 to rounding: the unshaped step is used')


def _elastic(request: Request, holding: float) -> Move | None:
    """Return a move of ideal hardware without branches and limits, None if there is none."""
    state = request.state
    plan = plan_two_step(state.stretch, request.target, request.material.elastic, rate=state.rate)
    if plan.code in _WITHOUT:
        return _without(request, plan.code, holding)
    if plan.code is not Code.TWO_STEP:
        return None
    return Move(
        plan.code, (Level(0.0, plan.beta_p), Level(plan.tau_p, holding)), plan.tau_p)


def _creeping(request: Request) -> Move:
    """Have branches arrive wherever they do: what they hold then is followed afterwards."""
    holding = request.holding_load()
    move = _elastic(request, holding)
    if move is not None and (move.code is Code.HOLD or math.isinf(move.duration)):
        return move
    found = None if move is None else two_levels(request, move)
    if found is not None and request.delivery.ideal:
        if request.keeps(found[0]):
            return Move(Code.TWO_STEP, *found)
    elif found is not None:
        with contextlib.suppress(RefusedError):
            return (_sampled if request.delivery.period > 0.0 else _ramped)(request, *found[0])
    if found is not None and request.state.rate == 0.0:
        request.check(found[0])
    return free_levels(request)


def _late(request: Request) -> Move:
    """Have the field arrive with the stretch, by a level more."""
    holding = request.holding_load()
    if at_rest(request):
        return Move(Code.HOLD, (Level(0.0, holding),), 0.0)
    move = None
    if request.material.creep or request.delivery.slew < math.inf:
        with contextlib.suppress(RefusedError):
            move = two_step(replace(
                request, delivery=replace(request.delivery, lag=0.0, period=0.0),
                limits=Limits()))
    else:
        move = _elastic(request, holding)
    if move is not None and math.isinf(move.duration):
        return move
    if move is not None and move.code is Code.TWO_STEP:
        found = settle(request, move)
        if found is not None:
            return found
    return three_levels(request, Code.MINIMUM_TIME, (
        'no single intermediate flux density and a push that settles the field lead within the '
        f'limits to rest at {request.target:g}: three are used'))


def _sampled(request: Request, first: Level, last: Level) -> Move:
    """
    Place the command on the grid: one level, and another for its last period.

    The share of the last period that the ideal command spends at beta_1 gives the first guess.
    Where that is too far off, the solution is followed from the grid that the ideal command
    fits exactly.
    """
    period = request.delivery.period
    tau_p = last.time
    least = max(2, math.ceil(tau_p / period - 1e-9))
    # Ramps may need a longer move than steps.
    for count in range(least, least + 4):
        fitting = tau_p / count

        def stretched(
                levels: tuple[Level, ...], share: float, aim: float, *, count: int = count,
                fitting: float = fitting) -> Attempt:
            each = fitting + aim * (period - fitting)
            late = min(count - tau_p / each, 1.0)
            between = levels[1].load
            if share == 0.0:
                between = first.load + late * (last.load - first.load)
            guess = (levels[0], Level((count - 1) * each, between),
                     Level(count * each, last.load))
            return solve(
                Template.of(guess, [('load', 0), ('load', 1)]), request)

        exact = (first, Level((count - 1) * fitting, first.load), last)
        found = approach(exact, stretched, _SHORTEST_STRIDE)
        if found is not None and request.keeps(found[0]):
            return Move(Code.TWO_STEP, *found)
    raise RefusedError(
        Code.NO_TWO_STEP,
        f'no command on a grid of {request.units.time_text(period)} within the limits brings '
        f'{request.named_target} to rest, which takes {request.units.time_text(tau_p)} without')


def _ramped(request: Request, first: Level, last: Level) -> Move:
    """
    Solve for the level between two ramps and for how long it holds.

    A linear oscillator comes to rest where ramps and hold together span an odd number of half
    periods. The solution for the first that fits is followed from fast ramps to the real ones;
    where that fails, levels and holds in between are tried.
    """
    slew = request.delivery.slew
    start, change = request.load, last.load - request.load
    decay = 1.0
    if first.load != start:
        decay = min(1.0, abs((last.load - first.load) / (first.load - start)))
    half_periods = 1 + 2 * max(
        0, math.ceil(0.5 * (abs(change) / slew / (2.0 * last.time) - 1.0)))

    def slower(levels: tuple[Level, ...], share: float, aim: float) -> Attempt:
        # The ramps lengthen about their middles, so that the second one begins earlier.
        shift = 0.5 * (aim - share) / slew * (
            abs(levels[0].load - start) - abs(levels[1].load - levels[0].load))
        guess = (levels[0], Level(levels[1].time + shift, levels[1].load))
        return solve(
            Template.of(guess, [('load', 0), ('time', 1)]), request,
            replace(request.delivery, slew=slew / aim))

    between = first.load
    if half_periods > 1:
        between = start + change / (1.0 + decay ** half_periods)
    ideal = (Level(0.0, between), Level(half_periods * last.time, last.load))
    found = approach(ideal, slower, _SHORTEST_STRIDE)
    if found is not None and request.keeps(found[0]):
        return Move(Code.TWO_STEP, *found)
    if request.state.rate == 0.0:
        found = _searched(request, last.load)
        if found is not None:
            return Move(Code.TWO_STEP, *found)
    else:
        with contextlib.suppress(RefusedError):
            return _two_levels(request, last.load)
    raise RefusedError(
        Code.SLEW_LIMIT,
        f'no command through ramps of {request.units.slew_text(slew)} brings '
        f'{request.named_target} to rest')


def _searched(request: Request, holding: float) -> Attempt:
    """Solve for a level and its hold from many guesses, those that hold shortest first."""
    slew, start = request.delivery.slew, request.load
    eighth = 0.25 * math.pi / request.frequency
    if abs(holding - start) > _MOST_HALF_PERIODS * 4.0 * eighth * slew:
        return None
    reach = 8.0 * eighth * slew
    low = max(request.limits.minimum, min(start, holding) - reach)
    high = min(request.limits.maximum, max(start, holding) + reach)

    def guess(hold: int, height: float) -> Template:
        level = low + height * (high - low)
        return Template.of(
            (Level(0.0, level), Level(abs(level - start) / slew + hold * eighth, holding)),
            [('load', 0), ('time', 1)])

    return first_kept(starmap(guess, product(range(_LONGEST_HOLD), _HEIGHTS)), request)


def _no_single(request: Request) -> str:
    return ('no single intermediate flux density within the limits leads from '
            f'{request.named_state} to rest at {request.target:g}: two are used')


def _two_levels(request: Request, holding: float) -> Move:
    """Use two levels where one does not do, or one that is held for longer."""
    if request.material.creep:
        return free_levels(request)
    if request.delivery.period == 0.0 and math.isfinite(request.delivery.slew):
        # Sooner there than by waiting.
        found = _swings(request, holding)
        if found is not None:
            return Move(Code.MINIMUM_TIME, *found, _no_single(request))
        found = _searched(request, holding)
        if found is not None:
            return Move(Code.TWO_STEP, *found)
    return push_brake(request, _no_single(request))


def _swings(request: Request, holding: float) -> Attempt:
    """
    Solve for two levels that ramps only just reach, the fastest way where no level is held.

    Bounded in its rate of change, the fastest load ramps without a pause and turns twice.
    """
    slew, start = request.delivery.slew, request.load
    longest = 0.5 * math.pi / request.frequency
    for share, rest, sign in product(_SWINGS, _SWINGS, (1.0, -1.0)):
        high = start + sign * slew * share * longest
        low = holding - sign * slew * rest * longest
        if sign * (high - low) <= 0.0:
            continue
        turn = share * longest
        guess = Template(
            np.array([0.0, turn, turn + abs(high - low) / slew]), np.array([high, low, holding]),
            sign / slew * np.array([[0.0, 0.0], [1.0, 0.0], [2.0, -1.0]]),
            np.array([[1.0, 0.0], [0.0, 1.0], [0.0, 0.0]]))
        found = solve(guess, request)
        if found is not None and request.delivery.resolution > 0.0:
            # Once more for the heights, at times that commands can carry and ramps can keep.
            later = [Level(request.delivery.rounded(x.time) + i * request.delivery.resolution,
                           x.load) for i, x in enumerate(found[0])]
            found = solve(
                Template.of(later, [('load', 0), ('load', 1)]), request) or found
        if found is not None and request.keeps(found[0]):
            return found
    return None
