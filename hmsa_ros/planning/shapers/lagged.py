"""
Commands for a field that lags behind its amplifier: stretch, rate and field arrive together.

One more condition takes one more number: a level of a short push, which settles the field,
before the level that holds the target. On a grid the heights of three levels are solved for,
through ramps and at any time two heights and a time.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from itertools import pairwise, product
import math

from hmsa_ros.model import law
from hmsa_ros.model.delivery import Delivery
from hmsa_ros.model.moves import Level, Limits, Move
from hmsa_ros.model.simulation import followed_by
from hmsa_ros.model.status import Code, RefusedError
from hmsa_ros.planning.shapers.request import Request
from hmsa_ros.planning.shooting import approach, Attempt, first_kept, solve, Template

# Lengths of the settling push to try, in time constants of the lag. The first one passes the
# holding level by as much as the level before falls short of it; shorter ones would save at most
# 0.4 time constants and need far more field.
_PUSHES = (math.log(2.0), 1.0, 1.5, 2.2, 3.2, 4.6, 7.0)
# Shares of the way from no lag to the lag for which a command is followed in smaller strides.
_SHORTEST_STRIDE = 0.03
# Lengths of three levels of free heights, in half periods at the target.
_LENGTHS = (0.7, 0.85, 1.0, 1.2, 1.4, 1.7, 2.0, 2.5, 3.0, 4.0, 5.0, 7.0)
_FREE_LOADS = [('load', 0), ('load', 1), ('load', 2)]
# Periods of the grid beyond the least number, and the share of a command by which longer ones are.
_MORE_PERIODS = (0, 1, 2, 3, 4, 6, 9)
_STRIDES = 12
_AT_REST = 1e-9


def at_rest(request: Request) -> bool:
    """Return whether stretch, rate and field are those of the target."""
    state = request.state
    if abs(state.stretch - request.target) > _AT_REST:
        return False
    holding = request.balance(followed_by(state, request.material))
    packed = request.material.packed
    stiffness = float(law.elastic_stiffness(request.target, packed))
    return (abs(state.rate) <= _AT_REST * request.frequency
            and max(abs(request.field - holding), abs(request.load - holding) * (
                not math.isinf(request.delivery.slew))) <= _AT_REST * stiffness)


def settle(request: Request, plain: Move) -> Move | None:
    """Have the field arrive with the stretch, given the two levels without a lag; or None."""
    found = first_kept(_sampled(request, plain), request) if request.delivery.period > 0.0 \
        else _pushed(request, plain)
    return None if found is None else Move(plain.code, *found, plain.reason)


def _pushed(request: Request, plain: Move) -> Attempt:
    """Solve for two heights and a time, with the shortest push that the limits allow."""
    first, last = plain.levels
    delivery = request.delivery

    def slower(length: float) -> Callable[[tuple[Level, ...], float, float], Attempt]:
        def closer(before: tuple[Level, ...], share: float, aim: float) -> Attempt:
            lag = aim * delivery.lag
            # What the field has not settled of the first level, undone by the push.
            left = math.exp(-length)
            passed = (last.load - before[0].load) * left / (1.0 - left)
            if not math.isinf(delivery.slew):
                passed = math.copysign(min(
                    abs(passed), delivery.slew * lag * math.log1p(left)), passed)
            middle = Level(
                last.time + length * lag * left / (1.0 - left), last.load + passed)
            if share > 0.0:
                middle = Level(
                    before[1].time + (aim - share) * delivery.lag * length * left / (1.0 - left),
                    middle.load)
            return solve(
                _template((before[0], middle, last), length * lag, delivery), request,
                delivery if aim == 1.0 else replace(delivery, lag=lag))
        return closer

    for length in _PUSHES:
        found = approach((first, first, last), slower(length), _SHORTEST_STRIDE)
        if found is not None and request.keeps(found[0]):
            return found
    return None


def _template(
        levels: tuple[Level, Level, Level], held: float, delivery: Delivery) -> Template:
    """Return levels with the first two heights and the time of the second free."""
    first, second, last = levels
    change = second.load - first.load
    template = Template.of(
        (first, second, Level(second.time + delivery.ramp(change) + held, last.load)),
        [('load', 0), ('load', 1), ('time', 1)])
    if not math.isinf(delivery.slew):
        slope = math.copysign(1.0 / delivery.slew, change)
        d_times = template.d_times.copy()
        d_times[2, 0], d_times[2, 1] = -slope, slope
        template = replace(template, d_times=d_times)
    return template


def _sampled(request: Request, plain: Move) -> Iterator[Template]:
    """
    Yield guesses of three heights on the grid.

    The second of them lasts a period; the last one, which settles the field, long enough not to
    ask for much more than the limits.
    """
    first, last = plain.levels
    period, lag = request.delivery.period, request.delivery.lag
    slow = 0.0 if math.isinf(request.delivery.slew) else request.delivery.ramp(
        last.load - request.load)
    shortest = max(1, math.ceil(_PUSHES[0] * lag / period))
    for more, longer in product(_MORE_PERIODS, (0, 1, 2)):
        push = shortest * (1 + longer)
        count = max(push + 2, math.ceil((last.time + lag + slow) / period)) + more
        late = (count - push) * period - last.time
        between = first.load + (last.load - first.load) * min(max(late / period, 0.0), 1.0)
        levels = (first, Level((count - push - 1) * period, between),
                  Level((count - push) * period, last.load), Level(count * period, last.load))
        yield Template.of(levels, _FREE_LOADS)


def three_levels(request: Request, code: Code, reason: str) -> Move:
    """
    Come to rest by three levels of free heights: the shortest of those within the limits.

    Where there are none of up to seven half periods: `RefusedError`.
    """
    found = free_heights(request, _FREE_LOADS)
    if found is None:
        raise RefusedError(*_refusal(request))
    return Move(code, *found, reason)


def free_heights(request: Request, free: Sequence[tuple[str, int]]) -> Attempt:
    """Solve for levels of free heights, all as long: the shortest that keep the limits."""
    holding = request.holding_load()
    first = Level(0.0, 0.5 * (request.load + holding))
    return first_kept((
        Template.of([first, *(Level((1 + i) * x, holding) for i in range(len(free)))], free)
        for x in _lengths(request, holding, len(free))), request)


def _lengths(request: Request, holding: float, count: int) -> Iterator[float]:
    """Yield how long each of so many levels may last."""
    delivery = request.delivery
    half = math.pi / request.frequency
    ramp = delivery.ramp(holding - request.load)
    before = 0.0
    for share in _LENGTHS:
        each = (share * half + delivery.lag + ramp) / count
        if delivery.period > 0.0:
            each = math.ceil(each / delivery.period) * delivery.period
        each = delivery.rounded(each)
        if each > before:
            before = each
            yield each


def _refusal(request: Request) -> tuple[Code, str]:
    units, delivery, limits = request.units, request.delivery, request.limits
    text = (f'no command for a coil time constant of {units.time_text(delivery.lag)} brings '
            f'{request.named_target} and the field to rest together within ')
    if not math.isinf(delivery.slew):
        return Code.SLEW_LIMIT, text + (
            f'ramps of {units.slew_text(delivery.slew)} and flux densities of '
            f'{_limits_text(request, limits)}')
    return Code.FLUX_LIMIT, f'{text}flux densities of {_limits_text(request, limits)}'


def _limits_text(request: Request, limits: Limits) -> str:
    text = request.units.load_text
    return f'{text(limits.minimum)} to {text(limits.maximum)}'


def push_brake_push(
        request: Request, plain: tuple[Level, ...], push: float, brake: float) -> Attempt:
    """Solve for the times of push, brake and push between two loads; None if there are none."""
    delivery = request.delivery
    holding = request.holding_load()
    # The second push ends when the field, at the brake's level before, is at the holding load.
    length = math.log1p((holding - brake) / (push - holding))

    def closer(levels: tuple[Level, ...], share: float, aim: float) -> Attempt:
        lag = aim * delivery.lag
        second, third = levels[1].time, levels[2].time
        up = delivery.ramp(push - brake)
        end = third + up + lag * length + delivery.ramp(push - holding)
        guess = (Level(0.0, push), Level(second, brake), Level(third, push), Level(end, holding))
        return solve(
            Template.of(guess, [('time', 1), ('time', 2), ('time', 3)]), request,
            replace(delivery, lag=lag))

    return in_order(approach(plain, closer, _SHORTEST_STRIDE))


def in_order(found: Attempt) -> Attempt:
    """Return a command unless a level of it begins before the one before has."""
    ordered = found and all(x.time < y.time for x, y in pairwise(found[0]))
    return found if ordered else None


def fastest_on_grid(request: Request, loads: tuple[float, float]) -> Attempt:
    """Return the shortest three levels on the grid that keep the limits, if there are any."""
    half = math.pi / request.frequency
    most = math.ceil((2.0 * half + 3.0 * request.delivery.lag) / request.delivery.period) + 6
    # On a fine grid long ones in strides, and then what the last stride has left out.
    shortest = count = 3
    while count < most:
        found = first_kept([_on_grid(request, loads, count)], request)
        if found is not None:
            return first_kept(
                (_on_grid(request, loads, x) for x in range(shortest, count)), request) or found
        shortest, count = count + 1, count + max(1, count // _STRIDES)
    return None


def _on_grid(request: Request, loads: tuple[float, float], count: int) -> Template:
    """Return a guess of three levels that last so many periods."""
    period = request.delivery.period
    holding = request.holding_load()
    last = max(1, min(count // 3, math.ceil(_PUSHES[0] * request.delivery.lag / period)))
    first = max(1, (count - last) // 2)
    return Template.of(
        (Level(0.0, 0.5 * (loads[0] + holding)), Level(first * period, holding),
         Level((count - last) * period, holding), Level(count * period, holding)), _FREE_LOADS)
