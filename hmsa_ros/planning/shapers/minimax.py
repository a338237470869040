"""
Levels that leave the least vibration at the worst, wherever in a box or ellipsoid parameters are.

A chain of two-step commands leaves none if the model is exact, and more the further it is off.
Here the nominal case is one of many: in the time of the chain, some levels of equal length are
chosen such that the largest vibration of all cases is as small as it can be (for linear
oscillators: extra-insensitive shapers, W. E. Singhose, W. P. Seering, N. C. Singer, J. Mech. Des.
116, 1994). The vibration that a case leaves is a vector, stretch and rate in units of its
amplitude. Each pass takes it linear in the levels, and finds the least of the largest length by
projected Newton steps on norms of growing power.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import product
import math

import numpy as np

from hmsa_ros import motion
from hmsa_ros.model import law
from hmsa_ros.model.delivery import late, ramps
from hmsa_ros.model.equations import Array
from hmsa_ros.model.mismatch import Ellipsoid, Errors
from hmsa_ros.model.moves import Level, Move, State
from hmsa_ros.model.status import Code
from hmsa_ros.planning.shapers.creeping import check
from hmsa_ros.planning.shapers.request import as_errors, LARGEST_ERROR, Request
from hmsa_ros.planning.shapers.robust import robust

#: Least number of levels besides the one that holds the target, of steps and of ramps, and how
#: many a half period.
LEVELS, RAMPED, OF_EACH = 8, 6, 2
_RTOL = 1e-9
# Of the range of the levels: the change by which the vibration is differentiated, and the widest
# change of a first pass.
_CHANGE, _STRIDE = 1e-5, 0.3
_PASSES = 12
# Of the range of the levels.
_MARGIN = 1e-3
# Vibration that is rounding.
_NOTHING = 1e-8
# A pass that gains a smaller share is the last one.
_GAIN = 0.003
_POWERS = (4, 32, 128)
_NEWTON_PASSES = 8
_LEAST_SHARE = 1e-3
# Lengths of the push that settles a lagging field, in time constants, and how well it does.
_PUSHES = (0.7, 1.0, 1.5, 2.2, 3.2, 4.6, 7.0)
_SETTLED, _SECANTS = 1e-12, 8
# Shorter than this share of the chain there is no use in it.
_SHORTEST = 0.4
# As a share of the move: from nearer to rest it is planned as from rest, and kept.
_AT_REST = 1e-5
_KEPT = 256


def minimax(request: Request) -> Move:
    """
    Command a move that leaves the least vibration at the worst, within ``request.errors``.

    It takes as long as the chain of ``request.order`` two-step commands, and its levels are within
    those of the chain and the loads that hold start and target. At arrival some vibration is left
    even if the model is exact, about as much as at the worst. Where no such command is better than
    the chain, it is what `robust` answers.
    """
    as_errors(request.errors)
    check(request.material, 'minimax')
    state, packed = request.state, request.material.packed
    span = abs(request.target - state.stretch)
    held = float(law.elastic_force(state.stretch, packed))
    frequency = float(law.natural_frequency(state.stretch, packed))
    stiffness = float(law.elastic_stiffness(state.stretch, packed))
    away = abs(state.rate) / frequency + (
        abs(request.field - held) + abs(request.load - held)) / stiffness
    if away < _AT_REST * span:
        # So that the same move is found again: NaN for the load that holds it would be none.
        start = round(state.stretch, 9)
        return _kept(replace(
            request, state=State(start, load=float(law.elastic_force(start, packed)))))
    return _designed(request)


@lru_cache(maxsize=_KEPT)
def _kept(request: Request) -> Move:
    return _designed(request)


@dataclass(frozen=True)
class _Case:
    """An actuator that the command may meet, and where it starts, in its own units."""

    packed: Array
    stiffer: float
    faster: float
    stretch: float
    rate: float
    rest: float
    decay: float
    frequency: float
    scale: float


def _cases(request: Request, holding: float) -> list[_Case]:
    """Return the nominal actuator, and others in and on the box or ellipsoid of errors."""
    errors = request.errors
    offs: list[tuple[float, ...]] = [(0.0, 0.0, 0.0, 0.0)]
    if isinstance(errors, Ellipsoid):
        offs += errors.offs(LARGEST_ERROR)
    else:
        g, zeta, j_lim = errors
        offs += [(-0.5 * g, 0.0, 0.0, 0.0), (0.5 * g, 0.0, 0.0, 0.0),
                 *product((-g, g), (-zeta, zeta), (-j_lim, j_lim), (0.0,))]
    if request.material.law is not None or math.isinf(request.material.j_lim):
        offs = [(x[0], x[1], 0.0, x[3]) for x in offs]
    found = [_case(request, holding, Errors(*x)) for x in dict.fromkeys(offs)]
    return [x for x in found if x is not None]


def _case(request: Request, holding: float, errors: Errors) -> _Case | None:
    """Return an actuator in error, None if it does not oscillate about where it would rest."""
    state, nominal = request.state, request.material.packed
    stiffer, faster = errors.stiffer, errors.faster
    packed = errors.actual(request.material).packed
    rest = law.equilibrium_stretch(holding / stiffer, packed)
    # What the field in force holds is off by as much as its stretch.
    shift = law.equilibrium_stretch(request.field / stiffer, packed) - law.equilibrium_stretch(
        request.field, nominal)
    ratio = packed[law.ZETA] / law.critical_zeta(rest, packed)
    stretch = state.stretch + shift
    if not (ratio < 1.0 and packed[law.LOWER] < stretch < packed[law.UPPER]):
        return None
    root = math.sqrt(1.0 - ratio * ratio)
    frequency = law.natural_frequency(rest, packed)
    peaks = 1.0 + math.exp(-math.pi * ratio / root)
    return _Case(
        packed, stiffer, faster, stretch, state.rate / faster, rest, ratio * frequency,
        root * frequency, peaks / abs(request.target - state.stretch))


_NO_BRANCHES = np.empty((0, 3))


def left(
        request: Request, cases: Sequence[_Case], levels: Sequence[Level],
        arrival: float) -> Array:
    """Return the vibration that is left of a command, (n, 2); infinite if it gets lost."""
    delivery = request.delivery
    rows, _ = ramps(levels, request.load, arrival, delivery.slew)
    faster, stiffer = np.array([(x.faster, x.stiffer) for x in cases]).T[:, :, np.newaxis]
    switches, loads, slopes = np.array(rows).T
    found = np.empty((len(cases), 2))
    out = np.empty((3, 1))
    for row, x, end, begins, heights, rises in zip(
            found, cases, arrival * faster, switches * faster, loads / stiffer,
            slopes / (stiffer * faster), strict=True):
        if not motion.sample(
                x.stretch, x.rate, request.field / x.stiffer, begins, heights, rises,
                delivery.lag * x.faster, end, x.packed, _NO_BRANCHES, _RTOL, out):
            row[:] = math.inf
            continue
        away = out[0, 0] - x.rest
        row[:] = x.scale * away, x.scale * (out[1, 0] + x.decay * away) / x.frequency
    return found


def largest(vibration: Array) -> float:
    """Return the length of the longest vector of (n, 2), as peak to peak in shares of a move."""
    return math.sqrt((vibration * vibration).sum(axis=1).max())


def _designed(request: Request) -> Move:
    chain = robust(request)
    if chain.code not in (Code.ROBUST, Code.TWO_STEP):
        return chain
    cases = _cases(request, chain.levels[-1].load)
    before = largest(left(request, cases, chain.levels, chain.duration))
    found: tuple[tuple[Level, ...], float] = ((), math.inf)
    for length in _PUSHES if request.delivery.lag > 0.0 else (0.0,):
        frame = _frame(request, chain, length)
        if frame is not None:
            found = _search(request, cases, chain, frame)
        if found[0]:
            break
    if not found[1] < before - _NOTHING:
        return replace(chain, reason=chain.reason or (
            f'no levels leave less than the chain of order {request.order}, which is used'))
    return Move(Code.MINIMAX, found[0], chain.duration)


@dataclass(frozen=True)
class _Frame:
    """Times of levels and of their end, what they may be, and the last levels."""

    times: list[float]  #: the last is that of the push that settles a lagging field, if it does
    last: float  #: time of the level that holds the target
    low: Array
    high: Array


def _frame(request: Request, chain: Move, length: float) -> _Frame | None:
    """Return the frame of a command as long as the chain, with a push of so many lags, or None."""
    delivery, limits, holding = request.delivery, request.limits, chain.levels[-1].load
    bounds = [request.field, *(x.load for x in chain.levels)]
    low, high = max(min(bounds), limits.minimum), min(max(bounds), limits.maximum)
    count = max(LEVELS if math.isinf(delivery.slew) else RAMPED, OF_EACH * request.order)
    last = chain.duration - min(delivery.ramp(high - low), chain.duration / (count + 1))
    grid = delivery.period
    if grid > 0.0:
        last = math.floor(last / grid + 1e-9) * grid
    end = last
    if delivery.lag > 0.0:
        end -= max(length * delivery.lag + delivery.ramp(0.5 * (high - low)), grid)
        if grid > 0.0:
            end = math.floor(end / grid + 1e-9) * grid
        # However far the field still is, the push that settles it keeps the limits.
        share = 1.0 / math.expm1(length)
        if not (limits.minimum <= holding - share * (high - holding)
                and holding + share * (holding - low) <= limits.maximum):
            return None
    times = [end * i / count for i in range(count + 1)]
    if grid > 0.0:
        times = [x * grid for x in dict.fromkeys(math.floor(x / grid + 1e-9) for x in times)]
    else:
        times, last = [delivery.rounded(x) for x in times], delivery.rounded(last)
    if end < _SHORTEST * chain.duration or len(times) < 3:
        return None
    # A level in between must not look like one that holds start or target.
    margin = _MARGIN * (high - low)
    least, most = np.full(len(times) - 1, low + margin), np.full(len(times) - 1, high - margin)
    if delivery.slew < math.inf:
        # So that the last ramp ends in time.
        reach = delivery.slew * (chain.duration - np.array(times[1:]))
        least, most = np.maximum(least, holding - reach), np.minimum(most, holding + reach)
    return _Frame(times, last, least, most)


def _search(
        request: Request, cases: Sequence[_Case], chain: Move,
        frame: _Frame) -> tuple[tuple[Level, ...], float]:
    """Return levels, and the largest vibration that they leave in any case."""
    low, high = frame.low, frame.high
    span = float(np.max(high - low))

    def vibration(loads: Array) -> Array:
        levels = _command(request, chain, frame, loads)
        return left(request, cases, levels, chain.duration) if levels else np.full(
            (len(cases), 2), math.inf)

    starts = [_reached(request, frame, np.clip(x, low, high)) for x in _starts(
        request, chain, frame.times)]
    now, loads = min(((vibration(x), x) for x in starts), key=lambda x: largest(x[0]))
    stride, change = _STRIDE * span, _CHANGE * span
    room = request.delivery.slew * np.diff(frame.times)
    slopes = np.empty((*now.shape, len(loads)))
    renew = True
    for _ in range(_PASSES):
        if not _NOTHING < largest(now) < math.inf:
            break
        if renew:
            # A level that a ramp just reaches has an effect to one side alone.
            way = loads - np.array([request.load, *loads[:-1]])
            for i in range(len(loads)):
                nudged, by = loads.copy(), math.copysign(change, -way[i])
                nudged[i] += by
                slopes[:, :, i] = (vibration(nudged) - now) / by
            if not np.all(np.isfinite(slopes)):
                break
            full = np.abs(way) >= (1.0 - 1e-9) * room
        step = least_largest(
            now, slopes, np.maximum(np.where(full & (way < 0.0), 0.0, low - loads), -stride),
            np.minimum(np.where(full & (way > 0.0), 0.0, high - loads), stride))
        if largest(now + slopes @ step) > (1.0 - _GAIN) * largest(now):
            break
        there = _reached(request, frame, loads + step)
        new = vibration(there)
        renew = largest(new) < largest(now)
        if renew:
            loads, now = there, new
        stride *= 1.5 if renew else 0.3
    return _command(request, chain, frame, loads), largest(now)


def _reached(request: Request, frame: _Frame, loads: Array) -> Array:
    """Return the loads that ramps reach, which make the same motion."""
    slew = request.delivery.slew
    if math.isinf(slew):
        return loads
    found, load = [], request.load
    for level, span in zip(loads.tolist(), np.diff(frame.times).tolist(), strict=True):
        load = min(max(level, load - slew * span), load + slew * span)
        found.append(load)
    return np.array(found)


def _command(request: Request, chain: Move, frame: _Frame, loads: Array) -> tuple[Level, ...]:
    """Return levels, the push that settles a lagging field, if one does, and the last level."""
    last = Level(frame.last, chain.levels[-1].load)
    levels = [Level(*x) for x in zip(frame.times, loads.tolist(), strict=False)]
    delivery = request.delivery
    if delivery.lag == 0.0:
        return (*levels, last)

    def off(push: float) -> float:
        rows, _ = ramps(
            [*levels, Level(frame.times[-1], push), last], request.load, chain.duration,
            delivery.slew)
        return late(rows, chain.duration, request.field, delivery.lag) - last.load

    push, now = last.load, off(last.load)
    slope = off(push + 1.0) - now
    for _ in range(_SECANTS):
        if not abs(now) > _SETTLED:
            break
        if slope == 0.0:
            return ()
        before, push = push, push - now / slope
        then, now = now, off(push)
        slope = (now - then) / (push - before)
    kept = request.limits.minimum <= push <= request.limits.maximum and delivery.ramp(
        push - last.load) <= chain.duration - last.time
    return (*levels, Level(frame.times[-1], push), last) if kept and abs(now) < _NOTHING else ()


def _starts(request: Request, chain: Move, times: Sequence[float]) -> list[Array]:
    """Return the mean levels of a chain between times, and what its ramps reach at their ends."""
    ends = [*(x.time for x in chain.levels[1:]), math.inf]
    found: list[Array] = [np.array([
        sum(level.load * max(0.0, min(end, until) - max(level.time, begin))
            for level, end in zip(chain.levels, ends, strict=True)) / (until - begin)
        for begin, until in zip(times, times[1:], strict=False)])]
    if request.delivery.slew < math.inf:
        rows, _ = ramps(chain.levels, request.load, chain.duration, request.delivery.slew)
        switches, loads, _ = zip(*rows, strict=True)
        found.append(np.interp(times[1:], switches, loads))
    return found


def least_largest(now: Array, slopes: Array, low: Array, high: Array) -> Array:
    """
    Return what makes the longest of some vectors shortest, to a percent or so of the least.

    Vectors are ``now`` (n, 2) at 0, with derivatives ``slopes`` (n, 2, m); the result (m,) is
    between the bounds ``low`` and ``high`` around 0.
    """
    x: Array = np.zeros(len(low))
    best, least, vectors = x, largest(now), now
    rows = slopes.reshape(-1, len(x))
    for power in _POWERS:
        for _ in range(_NEWTON_PASSES):
            length = np.sqrt((vectors * vectors).sum(axis=1)) + 1e-300
            weight = (length / length.max()) ** (power - 2)
            along = (slopes * (vectors / length[:, np.newaxis])[:, :, np.newaxis]).sum(axis=1)
            curvature = (rows.T * weight.repeat(2)) @ rows + (
                power - 2) * (along.T * weight) @ along
            curvature.flat[::len(x) + 1] += 1e-10 * curvature.trace() + 1e-30
            step = _newton((weight * length) @ along, curvature, low - x, high - x)
            share = _share(vectors, (rows @ step).reshape(now.shape), power, length)
            if share == 0.0:
                break
            x = x + share * step
            vectors = now + slopes @ x
        worst = largest(vectors)
        if worst < least:
            best, least = x, worst
    return best


def _newton(gradient: Array, curvature: Array, low: Array, high: Array) -> Array:
    """Return the Newton step that keeps within bounds."""
    free = ~((low >= 0.0) & (gradient > 0.0) | (high <= 0.0) & (gradient < 0.0))
    step = np.zeros(len(gradient))
    while free.any():
        step[free] = 0.0
        rest = gradient + curvature @ step
        step[free] = -np.linalg.solve(curvature[free][:, free], rest[free])
        beyond = free & ((step < low) | (step > high))
        if not beyond.any():
            break
        step[beyond] = np.clip(step, low, high)[beyond]
        free &= ~beyond
    return step


def _share(vectors: Array, change: Array, power: int, length: Array) -> float:
    """Return the share of a step with which the norm is less; 0 for none."""
    top = length.max()
    before = ((length / top) ** power).sum()
    share = 1.0
    while share > _LEAST_SHARE:
        new = vectors + share * change
        if (((new * new).sum(axis=1) / top ** 2) ** (power // 2)).sum() < (
                1.0 - 1e-4 * share) * before:
            return share
        share *= 0.5
    return 0.0
