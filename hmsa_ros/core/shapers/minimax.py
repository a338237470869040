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

from hmsa_ros.core import kernels, law, response_kernel
from hmsa_ros.core.delivery import ramps
from hmsa_ros.core.mismatch import Ellipsoid, Errors
from hmsa_ros.core.model import Array
from hmsa_ros.core.moves import Level, Move, State
from hmsa_ros.core.shapers.creeping import check
from hmsa_ros.core.shapers.request import as_errors, LARGEST_ERROR, Request
from hmsa_ros.core.shapers.robust import robust
from hmsa_ros.core.status import Code

#: Least number of levels besides the one that holds the target, and how many a half period.
LEVELS, OF_EACH = 6, 2
_RTOL = 1e-9
# Of the range of the levels: the change by which the vibration is differentiated, and the widest
# change of a first pass.
_CHANGE, _STRIDE = 1e-5, 0.3
_PASSES = 6
# Of the range of the levels.
_MARGIN = 1e-3
# Vibration that is rounding.
_NOTHING = 1e-8
# A pass that gains a smaller share is the last one.
_GAIN = 0.003
_POWERS = (4, 32, 128)
_NEWTON_PASSES = 8
_LEAST_SHARE = 1e-3
# Of the last level's lag: what is left of it then is below what is asked of the vibration.
_LAGS = 7.0
# Shorter than this share of the chain there is no use in it.
_SHORTEST = 0.6
# As a share of the move: from nearer to rest it is planned as from rest, and kept.
_AT_REST = 1e-5
_KEPT = 256


def minimax(request: Request) -> Move:
    """
    Command a move that leaves the least vibration at the worst, within ``request.errors``.

    Parameters
    ----------
    request : Request
        The move. It takes as long as the chain of ``request.order`` two-step commands, and its
        levels are within those of the chain and the loads that hold start and target.

    Returns
    -------
    Move
        Some levels and the one that holds the target. At arrival some vibration is left even if
        the model is exact, about as much as at the worst. Where no such command is better than
        the chain, what `robust` answers.

    Raises
    ------
    RefusedError
        As `robust`.
    BadInputError
        If the order is below 1, an error is out of range, or the elastomer creeps.

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


def left(
        request: Request, cases: Sequence[_Case], levels: Sequence[Level],
        arrival: float) -> Array:
    """Return the vibration that is left of a command, (n, 2); infinite if it gets lost."""
    delivery = request.delivery
    rows, _ = ramps(levels, request.load, arrival, delivery.slew)
    switches, loads, slopes = (np.array(x) for x in zip(*rows, strict=True))
    found = np.empty((len(cases), 2))
    out = np.empty((3, 1))
    for row, x in zip(found, cases, strict=True):
        pieces = (
            switches * x.faster, loads / x.stiffer, slopes / (x.stiffer * x.faster))
        end = np.array([arrival * x.faster])
        if delivery.lag > 0.0:
            status = response_kernel.trajectory_late(
                x.stretch, x.rate, request.field / x.stiffer, *pieces, delivery.lag * x.faster,
                end, x.packed, np.empty((0, 3)), _RTOL, out)
        else:
            status = kernels.trajectory(
                x.stretch, x.rate, *pieces, end, x.packed, _RTOL, out[0], out[1])
        if status != kernels.DONE:
            row[:] = math.inf
            continue
        away = out[0, 0] - x.rest
        row[:] = x.scale * away, x.scale * (out[1, 0] + x.decay * away) / x.frequency
    return found


def largest(vibration: Array) -> float:
    """Return the length of the longest vector of (n, 2), as peak to peak in shares of a move."""
    return float(np.sqrt(np.max(np.sum(vibration * vibration, axis=1))))


def _designed(request: Request) -> Move:
    chain = robust(request)
    if chain.code not in (Code.ROBUST, Code.TWO_STEP):
        return chain
    holding = chain.levels[-1].load
    cases = _cases(request, holding)
    end = chain.duration - request.delivery.ramp(holding - request.field) \
        - _LAGS * request.delivery.lag
    times = _times(request, end)
    found = None
    before = largest(left(request, cases, chain.levels, chain.duration))
    if end >= _SHORTEST * chain.duration and len(times) > 2:
        found = _search(request, cases, chain, times)
    if found is None or not found[1] < before - _NOTHING:
        return replace(chain, reason=chain.reason or (
            f'no levels leave less than the chain of order {request.order}, which is used'))
    return Move(Code.MINIMAX, found[0], chain.duration)


def _times(request: Request, end: float) -> list[float]:
    """Return the times of levels up to the last one, on the grid if there is one."""
    period = request.delivery.period
    count = max(LEVELS, OF_EACH * request.order)
    times = [*(end * i / count for i in range(count)), end]
    if period > 0.0:
        return [x * period for x in dict.fromkeys(math.floor(x / period + 1e-9) for x in times)]
    return [request.delivery.rounded(x) for x in times]


def _search(
        request: Request, cases: Sequence[_Case], chain: Move,
        times: Sequence[float]) -> tuple[tuple[Level, ...], float]:
    """Return levels, and the largest vibration that they leave in any case."""
    holding = chain.levels[-1].load
    bounds = [request.field, *(x.load for x in chain.levels)]
    low = max(min(bounds), request.limits.minimum)
    high = min(max(bounds), request.limits.maximum)
    # A level in between must not look like one that holds start or target.
    low, high = low + _MARGIN * (high - low), high - _MARGIN * (high - low)

    def command(loads: Array) -> tuple[Level, ...]:
        return tuple(
            Level(t, x) for t, x in zip(times, [*loads.tolist(), holding], strict=True))

    def vibration(loads: Array) -> Array:
        return left(request, cases, command(loads), chain.duration)

    loads = np.clip(_means(chain, times), low, high)
    now = vibration(loads)
    stride = _STRIDE * (high - low)
    change = _CHANGE * (high - low)
    slopes = np.empty((*now.shape, len(loads)))
    renew = True
    for _ in range(_PASSES):
        if not _NOTHING < largest(now) < math.inf:
            break
        if renew:
            for i in range(len(loads)):
                nudged = loads.copy()
                nudged[i] += change
                slopes[:, :, i] = (vibration(nudged) - now) / change
            if not np.all(np.isfinite(slopes)):
                break
        step = least_largest(
            now, slopes, np.maximum(low - loads, -stride), np.minimum(high - loads, stride))
        new = vibration(loads + step)
        gain = 1.0 - largest(new) / largest(now)
        renew = gain > 0.0
        if renew:
            loads, now = loads + step, new
            if gain < _GAIN:
                break
        stride *= 1.5 if renew else 0.3
    return command(loads), largest(now)


def _means(chain: Move, times: Sequence[float]) -> Array:
    """Return the mean load of a chain between times."""
    ends = [*(x.time for x in chain.levels[1:]), math.inf]
    means: Array = np.array([
        sum(level.load * max(0.0, min(end, until) - max(level.time, begin))
            for level, end in zip(chain.levels, ends, strict=True)) / (until - begin)
        for begin, until in zip(times, times[1:], strict=False)])
    return means


def least_largest(now: Array, slopes: Array, low: Array, high: Array) -> Array:
    """
    Return what makes the longest of some vectors shortest, vectors being linear in it.

    Parameters
    ----------
    now : ndarray, shape (n, 2)
        The vectors at 0.
    slopes : ndarray, shape (n, 2, m)
        Their derivatives.
    low, high : ndarray, shape (m,)
        Bounds of the result, around 0.

    Returns
    -------
    ndarray, shape (m,)
        To a percent or so of the least.

    """
    x: Array = np.zeros(len(low))
    best, least = x, largest(now)
    for power in _POWERS:
        for _ in range(_NEWTON_PASSES):
            vectors = now + slopes @ x
            length = np.sqrt(np.sum(vectors * vectors, axis=1)) + 1e-300
            weight = (length / length.max()) ** (power - 2)
            along = np.einsum('nci,nc->ni', slopes, vectors / length[:, np.newaxis])
            gradient = (weight * length) @ along
            curvature = np.einsum('n,nci,ncj->ij', weight, slopes, slopes) + (
                power - 2) * (along.T * weight) @ along
            curvature += (1e-10 * np.trace(curvature) + 1e-30) * np.eye(len(x))
            step = _newton(gradient, curvature, low - x, high - x)
            taken = _line(now, slopes, x, step, power, length)
            if taken is None:
                break
            x = taken
        worst = largest(now + slopes @ x)
        if worst < least:
            best, least = x, worst
    return best


def _newton(gradient: Array, curvature: Array, low: Array, high: Array) -> Array:
    """Return the Newton step that keeps within bounds."""
    free = ~((low >= 0.0) & (gradient > 0.0) | (high <= 0.0) & (gradient < 0.0))
    step = np.zeros(len(gradient))
    while free.any():
        rest = gradient + curvature[:, ~free] @ step[~free]
        step[free] = -np.linalg.solve(curvature[np.ix_(free, free)], rest[free])
        beyond = free & ((step < low) | (step > high))
        if not beyond.any():
            break
        step[beyond] = np.clip(step, low, high)[beyond]
        free &= ~beyond
    return step


def _line(
        now: Array, slopes: Array, x: Array, step: Array, power: int,
        length: Array) -> Array | None:
    """Return a place on the way of a step where the norm is less."""
    top = length.max()
    before = np.sum((length / top) ** power)
    share = 1.0
    while share > _LEAST_SHARE:
        new: Array = x + share * step
        vectors = now + slopes @ new
        if np.sum((np.sum(vectors * vectors, axis=1) / top ** 2) ** (power // 2)) < (
                1.0 - 1e-4 * share) * before:
            return new
        share *= 0.5
    return None
