"""
Commands with free parameters, solved for rest at the target.

The two-step command on ideal hardware has its own search, `hmsa.motion.two_step`. All other
commands (on a command grid, with ramps, or with two intermediate levels of given loads) have two
unknowns as well. They meet the same two conditions when the last level applies: stretch at the
target, rate zero. If the field lags, it must also reach its final value, which needs a third
unknown. Newton's method solves them with derivatives from the integration.

Levels of free heights are for moves that a single intermediate level cannot bring to rest. Their
number equals the number of conditions. They have equal durations, the shortest first, with any
command grid and ramps. If only ramps limit the command, the fastest one ramps without a pause and
reverses twice.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import product
import math
from operator import itemgetter

import numpy as np

from hmsa import motion
from hmsa.model import law
from hmsa.model.delivery import Delivery
from hmsa.model.equations import Array
from hmsa.model.moves import Level, Move
from hmsa.model.simulation import branches_of, followed_by
from hmsa.model.status import Code, RefusedError
from hmsa.planning.shapers.request import AT_REST, MoveRequest

# Factor on the guessed duration of the last ramp, for the period that follows it.
_MORE = 1.25

#: A command and the time at which it is at rest; None if there is none.
Attempt = tuple[tuple[Level, ...], float] | None


@dataclass(frozen=True)
class Template:
    """Levels and their derivatives with respect to the two or, with a lag, three unknowns."""

    times: Array  #: (n,), the first is 0
    loads: Array  #: (n,), the last holds the target
    d_times: Array  #: (n, 2) or (n, 3)
    d_loads: Array  #: (n, 2) or (n, 3)

    @classmethod
    def of(cls, levels: Sequence[Level], unknowns: Sequence[tuple[str, int]]) -> 'Template':
        """Return the template of a guess, with unknowns ``('load', i)`` and ``('time', i)``."""
        return cls(
            np.array([x.time for x in levels]), np.array([x.load for x in levels]),
            *_derivatives(len(levels), tuple(unknowns)))


def heights(levels: Sequence[Level]) -> Template:
    """Return the template of a guess in which all loads except the last are free."""
    return Template.of(levels, [('load', i) for i in range(len(levels) - 1)])


@lru_cache(maxsize=256)
def _derivatives(count: int, unknowns: tuple[tuple[str, int], ...]) -> tuple[Array, Array]:
    """Return the derivatives of times and loads, which are cached and must not be changed."""
    d_times, d_loads = np.zeros((2, count, len(unknowns)))
    for column, (kind, index) in enumerate(unknowns):
        if kind == 'load':
            d_loads[index, column] = 1.0
        else:
            d_times[index:, column] = 1.0
    return d_times, d_loads


def solve(
        template: Template, request: 'MoveRequest', delivery: Delivery | None = None, *,
        wait: float = 0.0, modes: bool = False) -> Attempt:
    """
    Solve a template for rest at the target; the default delivery is that of the request.

    With creep and ramps, rest is at the end of the last ramp, or at least ``wait`` after the start
    of the last level; on a command grid, after whole periods. With ``modes``, the secondary modes
    are at rest, too.
    """
    delivery = delivery or request.delivery
    times, loads = template.times.copy(), template.loads.copy()
    d_times, d_loads = template.d_times, template.d_loads
    state, material = request.state, request.material
    if material.creeps and delivery.slew < math.inf:
        # The tail begins with the load at the end of the last ramp.
        d_times, d_loads = (np.pad(x, ((0, 0), (0, 1))) for x in (d_times, d_loads))
        d_loads[-1, -1] = 1.0
        if delivery.period > 0.0:
            ramp = _MORE * delivery.ramp(loads[-1] - loads[-2] if len(loads) > 1 else 0.0)
            wait = max(math.ceil(ramp / delivery.period), 1) * delivery.period
        if wait > 0.0:
            times, loads = np.append(times, times[-1] + wait), np.append(loads, loads[-1])
            d_times, d_loads = (np.concatenate([x, x[-1:]]) for x in (d_times, d_loads))
    rows = material.rows if modes else material.branches
    followed = followed_by(state, material)[:len(rows)]
    solved, duration, done = motion.solve(
        times, loads, np.ascontiguousarray(d_times), np.ascontiguousarray(d_loads), state.stretch,
        state.rate, request.field, request.load, request.target, delivery.slew, delivery.lag,
        material.packed, rows, np.array(followed, dtype=np.float64),
        request.work.left)
    request.work.left -= done
    if not solved:
        return None
    levels = tuple(Level(t, x) for t, x in zip(times.tolist(), loads.tolist(), strict=True))
    return levels, duration


def within_limits(found: Attempt, request: 'MoveRequest') -> Attempt:
    """Return a command if it keeps the load limits, else None."""
    return found if found is not None and request.keeps(found[0]) else None


def first_kept(guesses: Iterable[Template], request: 'MoveRequest') -> Attempt:
    """Return the first solution among the guesses that keeps the load limits, else None."""
    return next(filter(None, (within_limits(solve(x, request), request) for x in guesses)), None)


def soonest_kept(guesses: Iterable[tuple[float, Template]], request: 'MoveRequest') -> Attempt:
    """
    Return the solution with the earliest rest that keeps the load limits, else None.

    Guesses come with their durations; guesses longer than a solution are skipped.
    """
    best: Attempt = None
    for duration, guess in sorted(guesses, key=itemgetter(0)):
        if best is not None and duration >= best[1]:
            break
        found = within_limits(solve(guess, request), request)
        if found is not None and (best is None or found[1] < best[1]):
            best = found
    return best


def continuation(
        ideal: tuple[Level, ...],
        closer: Callable[[tuple[Level, ...], float, float], Attempt], shortest: float) -> Attempt:
    """Follow levels from ideal to real hardware, in strides down to a given fraction."""
    # closer(levels, share, aim) solves for hardware at the fraction aim, from levels that solve
    # it at the fraction share.
    found: Attempt = None
    levels, share, stride = ideal, 0.0, 1.0
    while share < 1.0:
        aim = min(1.0, share + stride)
        attempt = closer(levels, share, aim)
        if attempt is not None:
            found, levels, share = attempt, attempt[0], aim
        elif stride > shortest:
            stride *= 0.5
        else:
            return None
    return found


def on_time(found: Attempt, request: 'MoveRequest') -> Attempt:
    """Solve again for the first loads, with times rounded to those that commands can have."""
    if found is None or request.delivery.resolution == 0.0:
        return found
    # Delay later levels slightly more, so that ramps still fit.
    resolution = request.delivery.resolution
    rounded = [Level(request.delivery.rounded(x.time) + i * resolution, x.load)
               for i, x in enumerate(found[0])]
    return solve(Template.of(
        rounded, [('load', i) for i in range(request.unknowns)]), request) or found


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
