"""
Levels that minimise the worst-case vibration over a box or ellipsoid of parameters.

A chain of two-step commands leaves no vibration with an exact model, and more with larger errors.
Here the nominal case is one of many: within the duration of the chain, levels of equal duration
are chosen that minimise the largest vibration of all cases (for linear oscillators:
extra-insensitive shapers, W. E. Singhose, W. P. Seering, N. C. Singer, J. Mech. Des. 116, 1994).
The vibration of a case is a vector, stretch and rate in units of its amplitude: the part of the
state in the oscillating mode about equilibrium, without the creep of the branches. Each iteration
linearises it in the levels, and minimises the largest length within the bounds of levels and
ramps.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import product
import math

import numpy as np

from hmsa import motion
from hmsa.model import law
from hmsa.model.delivery import late, ramps
from hmsa.model.equations import Array
from hmsa.model.moves import Level, Move, State
from hmsa.model.parameters import Ellipsoid, Errors
from hmsa.model.simulation import branches_of, flow_rates, with_followed
from hmsa.model.status import Code
from hmsa.planning.shapers.creeping import arrival
from hmsa.planning.shapers.linear import oscillation
from hmsa.planning.shapers.request import as_errors, AT_REST, LARGEST_ERROR, MoveRequest
from hmsa.planning.shapers.robust import robust

#: Minimum number of levels besides the holding level, with steps and with ramps, and number of
#: levels per half period.
LEVELS, RAMPED, OF_EACH = 8, 6, 2
_RTOL = 1e-9
# Relative to the range of the levels: the increment for differentiation, and the largest change in
# the first iteration.
_CHANGE, _STRIDE = 1e-5, 0.3
# Maximum number of iterations and their cost: each integrates all cases once per level and
# correction, in as many steps as there are levels, radians and fastest branch time constants.
_PASSES, _COST = 24, 400_000
# Margin of the levels, relative to their range.
_MARGIN = 1e-3
# Minimum distance from bounds, relative to the stride, so that the search starts inside of them.
_LEAST_ROOM = 1e-3
# Vibration that counts as rounding error.
_NOTHING = 1e-8
# An iteration with a smaller relative gain is the last one.
_GAIN = 0.002
# Growth and reduction of the stride; a step with less than a fraction of the expected gain is
# repeated a number of times, and then reduces the stride.
_GROWN, _SHRUNK, _POOR, _CORRECTED = 2.0, 0.4, 0.3, 3
# Interior point method: initial length, relative tolerance, Newton decrement below which steps are
# full, reduction of the path parameter, and maximum number of steps.
_BEGIN, _NEAR, _STEEP, _CLOSER, _NEWTON_PASSES = 1.5, 1e-3, 0.3, 0.05, 60
# Durations of the push that settles a lagging field, in time constants, and its tolerance.
_PUSHES = (0.7, 1.0, 1.5, 2.2, 3.2, 4.6, 7.0)
_SETTLED, _SECANTS = 1e-12, 8
# Iterations that match the last levels to the overstress at arrival, and their tolerance.
_CARRIED, _BALANCED = 6, 1e-8
# Minimum duration of the levels before the push, as a fraction of the chain.
_SHORTEST = 0.4
# Relative to the move: a start nearer to rest is planned as rest, so that the result is cached.
_AT_REST = 1e-5
_KEPT = 256


def minimax(request: MoveRequest) -> Move:
    """
    Command a move with minimum worst-case vibration for errors within ``request.errors``.

    The move takes as long as the chain of ``request.order`` two-step commands. Its levels are
    between those of the chain and the loads that hold start and target. Even with an exact model,
    some vibration remains at arrival, about as much as in the worst case. If no such command is
    better than the chain, the result is that of `robust`.
    """
    as_errors(request.errors)
    state, packed = request.state, request.material.packed
    span = abs(request.target - state.stretch)
    held = float(law.elastic_force(state.stretch, packed))
    frequency = float(law.natural_frequency(state.stretch, packed))
    stiffness = float(law.elastic_stiffness(state.stretch, packed))
    away = abs(state.rate) / frequency + (
        abs(request.field - held) + abs(request.load - held)) / stiffness
    if away < _AT_REST * span:
        # Makes equal moves compare equal: NaN for the holding load would not.
        start = round(state.stretch, 9)
        return _kept(replace(
            request, state=State(start, load=float(law.elastic_force(start, packed)))))
    return _designed(request)


@lru_cache(maxsize=_KEPT)
def _kept(request: MoveRequest) -> Move:
    return _designed(request)


@dataclass(frozen=True)
class _ErrorCase:
    """An actuator in the uncertainty set, and its initial state, in its own units."""

    packed: Array
    stiffer: float
    faster: float
    stretch: float
    rate: float
    branches: Array  #: (n, 6), with their initial states
    rest: float
    force: float  #: that holds the rest
    stiffness: float
    mode: Array  #: (2, 2 + n), maps a state about rest to vibration
    tail: Array  #: (2, n), vibration due to the tail of levels for the branches of the model


def _cases(request: MoveRequest, holding: float) -> list[_ErrorCase]:
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


def _case(request: MoveRequest, holding: float, errors: Errors) -> _ErrorCase | None:
    """Return an actuator with errors, None if it does not oscillate about its equilibrium."""
    state, nominal = request.state, request.material.packed
    stiffer, faster = errors.stiffer, errors.faster
    material = errors.actual(request.material)
    packed = material.packed
    rest = law.equilibrium_stretch(holding / stiffer, packed)
    # The equilibrium under the initial field has an error, by which the stretch is shifted.
    shift = law.equilibrium_stretch(request.field / stiffer, packed) - law.equilibrium_stretch(
        request.field, nominal)
    stretch = state.stretch + shift
    if not packed[law.LOWER] < stretch < packed[law.UPPER]:
        return None
    found = oscillation(material, rest, request.behind(request.target))
    if found is None:
        return None
    root, mode, tail = found
    move = max(abs(request.target - state.stretch), AT_REST)
    peaks = (1.0 + math.exp(math.pi * root.real / root.imag)) / move
    return _ErrorCase(
        packed, stiffer, faster, stretch, state.rate / faster, with_followed(
            material, np.array(branches_of(state, request.material)) / stiffer),
        rest, law.elastic_force(rest, packed), law.elastic_stiffness(rest, packed), peaks * mode,
        peaks / stiffer * tail)


def left(
        request: MoveRequest, cases: Sequence[_ErrorCase], levels: Sequence[Level],
        arrival: float) -> Array:
    """Return the vibration after a command, (n, 2); infinite if the integration fails."""
    delivery = request.delivery
    rows, _ = ramps(levels, request.load, arrival, delivery.slew)
    faster, stiffer = np.array([(x.faster, x.stiffer) for x in cases]).T[:, :, np.newaxis]
    switches, loads, slopes = np.array(rows).T
    found = np.empty((len(cases), 2))
    ratios = request.material.branches[:, motion.RATIO]
    out = np.empty((3 + len(ratios), 1))
    held: Array | float = 0.0
    for row, x, end, begins, heights, rises in zip(
            found, cases, arrival * faster, switches * faster, loads / stiffer,
            slopes / (stiffer * faster), strict=True):
        if not motion.sample(
                x.stretch, x.rate, request.field / x.stiffer, begins, heights, rises,
                delivery.lag * x.faster, end, x.packed, x.branches, _RTOL, out):
            row[:] = math.inf
            continue
        followed = out[3:, 0]
        if len(ratios) and x is cases[0]:
            # The tail of levels follows the branches of the nominal case, which is the first.
            held = ratios * (x.force - followed)
        row[:] = x.mode[:, 0] * (out[0, 0] - x.rest) + x.mode[:, 1] * out[1, 0]
        if len(ratios):
            row[:] += x.mode[:, 2:] @ ((followed - x.force) / x.stiffness) - x.tail @ held
    return found


def largest(vibration: Array) -> float:
    """Return the length of the longest vector of (n, 2): peak to peak, relative to the move."""
    return math.sqrt((vibration * vibration).sum(axis=1).max())


def _designed(request: MoveRequest) -> Move:
    chain = robust(request)
    if chain.code not in (Code.ROBUST, Code.TWO_STEP):
        return chain
    cases = _cases(request, request.holding_load())
    if not cases:
        return chain
    before = largest(left(request, cases, chain.levels, chain.duration))
    found: tuple[tuple[Level, ...], float] = ((), math.inf)
    for length in _PUSHES if request.delivery.lag > 0.0 else (0.0,):
        frame = _frame(request, chain, length)
        if frame is not None:
            found = _search(request, cases, chain, frame)
        if found[0]:
            break
    if not found[1] < before - _NOTHING:
        return chain._replace(reason=chain.reason or (
            f'no levels leave less than the cascade of order {request.order}, which is used'))
    return Move(Code.MINIMAX, found[0], chain.duration)


@dataclass(frozen=True)
class _Frame:
    """Times of the levels and their end, bounds, and the last levels."""

    times: list[float]  #: the last is the time of the push that settles a lagging field, if any
    last: float  #: time of the level that holds the target
    low: Array
    high: Array
    room: Array  #: maximum change from each level to the next, by ramps


def _frame(request: MoveRequest, chain: Move, length: float) -> _Frame | None:
    """Return the frame of a command as long as the chain, with a push of given lags, or None."""
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
        # The push that settles the field keeps the limits for any field in the bounds.
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
    # Intermediate levels must differ from those that hold start or target.
    margin = _MARGIN * (high - low)
    least, most = np.full(len(times) - 1, low + margin), np.full(len(times) - 1, high - margin)
    # Leave room for the increments of the differentiation.
    room = delivery.slew * np.diff(times) - 4.0 * _CHANGE * (high - low)
    if delivery.slew < math.inf:
        # Ensures that the last ramp ends in time.
        reach = delivery.slew * (chain.duration - times[-1]) + np.append(
            np.cumsum(room[:0:-1])[::-1], 0.0)
        least, most = np.maximum(least, holding - reach), np.minimum(most, holding + reach)
        if not np.all(room > 0.0):
            return None
    return _Frame(times, last, least, most, room)


def _slopes(vibration: Callable[[Array], Array], loads: Array, now: Array, change: float) -> Array:
    """Return the derivatives of the vibration, ``now`` at some loads, by each of them."""
    slopes = np.empty((*now.shape, len(loads)))
    for i in range(len(loads)):
        nudged = loads.copy()
        nudged[i] += change
        slopes[:, :, i] = (vibration(nudged) - now) / change
    return slopes


def _room(request: MoveRequest, frame: _Frame, loads: Array, stride: float) -> Array:
    """Return by how much loads, and their ramps if limited, may rise in a step, and fall."""
    up, down = (np.minimum(x, stride) for x in (frame.high - loads, loads - frame.low))
    if request.delivery.slew < math.inf:
        way = np.diff(loads, prepend=request.load)
        up, down = np.append(up, frame.room - way), np.append(down, frame.room + way)
    room: Array = np.maximum(np.append(up, down), _LEAST_ROOM * stride)
    return room


def _search(
        request: MoveRequest, cases: Sequence[_ErrorCase], chain: Move,
        frame: _Frame) -> tuple[tuple[Level, ...], float]:
    """Return levels, and the largest vibration over all cases."""
    span = float(np.max(frame.high - frame.low))
    command: tuple[Level, ...] = ()

    def vibration(loads: Array) -> Array:
        levels = _command(request, chain, frame, loads, command)
        return left(request, cases, levels, chain.duration) if levels else np.full(
            (len(cases), 2), math.inf)

    starts = [_reached(request, frame, x) for x in _starts(request, chain, frame)]
    now, loads = min(((vibration(x), x) for x in starts), key=lambda x: largest(x[0]))
    stride = _STRIDE * span
    slopes: Array = np.empty(0)
    rows = np.eye(len(loads))
    if request.delivery.slew < math.inf:
        rows = np.vstack([rows, rows - np.eye(len(loads), k=-1)])
    rows = np.vstack([rows, -rows])
    material = request.material
    speed = float(law.natural_frequency(request.target, material.packed)) + float(
        material.branches[:, motion.SPEED].max(initial=0.0))
    cost = len(cases) * (len(loads) + _CORRECTED) * (len(loads) + chain.duration * speed)
    renew = True
    for _ in range(min(_PASSES, math.ceil(_COST / cost))):
        if not _NOTHING < largest(now) < math.inf:
            break
        if renew:
            slopes = _slopes(vibration, loads, now, _CHANGE * span)
            if not np.all(np.isfinite(slopes)):
                break
        room = _room(request, frame, loads, stride)
        step = least_largest(now, slopes, rows, room)
        before = largest(now)
        expected = before - largest(now + slopes @ step)
        if not expected > _GAIN * before:
            break
        for _ in range(_CORRECTED):
            there = _reached(request, frame, loads + step)
            new = vibration(there)
            gain = before - largest(new)
            if gain > _POOR * expected or not largest(new) < math.inf:
                break
            # Correct for the nonlinearity found there: repeat the step from its result.
            step = least_largest(new - slopes @ (there - loads), slopes, rows, room)
        renew = gain > 0.0
        if renew:
            loads, now, command = there, new, _command(request, chain, frame, there, command)
        stride *= _GROWN if gain > _POOR * expected else _SHRUNK
    return command or _command(request, chain, frame, loads), largest(now)


def _reached(request: MoveRequest, frame: _Frame, loads: Array) -> Array:
    """Return the loads within the bounds that ramps can reach."""
    loads = np.clip(loads, frame.low, frame.high)
    if math.isinf(request.delivery.slew):
        return loads
    found, load = [], request.load
    for level, room in zip(loads.tolist(), frame.room.tolist(), strict=True):
        load = min(max(level, load - room), load + room)
        found.append(load)
    return np.array(found)


def _command(
        request: MoveRequest, chain: Move, frame: _Frame, loads: Array,
        like: Sequence[Level] = ()) -> tuple[Level, ...]:
    """
    Return levels, the push that settles a lagging field (if there is one), and the last level.

    The overstress at arrival is first estimated from the levels ``like``, by default the chain's.
    """
    levels = [Level(*x) for x in zip(frame.times, loads.tolist(), strict=False)]
    holding = chain.levels[-1].load
    if not request.material.creeps or (
            request.delivery.lag == 0.0 and frame.last == chain.duration):
        return _settled(request, chain, frame, levels, holding, holding)
    # Match field and amplifier to the overstress, which hardly depends on how they reach it.
    wanted, last = _balance(request, chain, like or chain.levels)
    for _ in range(_CARRIED):
        found = _settled(request, chain, frame, levels, wanted, last)
        if not found:
            break
        before = wanted
        wanted, last = _balance(request, chain, found)
        if abs(wanted - before) <= _BALANCED * (1.0 + abs(wanted)):
            break
    return found


def _balance(request: MoveRequest, chain: Move, levels: Sequence[Level]) -> tuple[float, float]:
    """Return field and amplifier output at arrival, from which they follow the branches."""
    material = request.material
    followed = branches_of(
        arrival(request, chain._replace(levels=tuple(levels))), request.material)
    holding = request.holding_load()
    above, ratios = holding - np.array(followed), material.branches[:, motion.RATIO]
    return holding + float(ratios @ above), holding + float(
        ratios @ (above - request.delivery.lag * flow_rates(material, above)))


def _settled(
        request: MoveRequest, chain: Move, frame: _Frame, levels: Sequence[Level], wanted: float,
        load: float) -> tuple[Level, ...]:
    """Return levels, the push after which the field has its final value, and the last level."""
    delivery = request.delivery
    last = Level(frame.last, load)
    if delivery.lag == 0.0:
        return (*levels, last)

    def off(push: float) -> float:
        rows, _ = ramps(
            [*levels, Level(frame.times[-1], push), last], request.load, chain.duration,
            delivery.slew)
        return late(rows, chain.duration, request.field, delivery.lag) - wanted

    push, now = load, off(load)
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
        push - load) <= chain.duration - last.time
    return (*levels, Level(frame.times[-1], push), last) if kept and abs(now) < _NOTHING else ()


def _starts(request: MoveRequest, chain: Move, frame: _Frame) -> list[Array]:
    """Return the mean levels of a chain between times, and the loads that its ramps reach."""
    times, ends = frame.times, [*(x.time for x in chain.levels[1:]), math.inf]
    found: list[Array] = [np.array([
        sum(level.load * max(0.0, min(end, until) - max(level.time, begin))
            for level, end in zip(chain.levels, ends, strict=True)) / (until - begin)
        for begin, until in zip(times, times[1:], strict=False)])]
    if request.delivery.slew < math.inf:
        rows, _ = ramps(chain.levels, request.load, chain.duration, request.delivery.slew)
        switches, loads, _ = zip(*rows, strict=True)
        found.append(np.interp(times[1:], switches, loads))
        found.append(0.5 * (frame.low + frame.high))
    return found


def least_largest(now: Array, slopes: Array, rows: Array, room: Array) -> Array:
    """
    Return the step that minimises the longest of some vectors, to about a thousandth.

    Vectors are ``now`` (n, 2) at 0, with derivatives ``slopes`` (n, 2, m). The result (m,) keeps
    ``rows @ x`` (k, m) below ``room`` (k,), whose elements are above 0.
    """
    # Interior point method: Newton's method on
    # length/path - sum ln(length^2 - |vector|^2) - sum ln(room left), with steps damped for
    # self-concordance (S. Boyd, L. Vandenberghe, Convex Optimization, 2004).
    count = slopes.shape[2]
    size = largest(now)
    x: Array = np.zeros(count)
    length, path = _BEGIN * size, size
    least = _NEAR * size / (2 * len(now) + len(room))
    flat = slopes.reshape(-1, count)
    hessian = np.empty((count + 1, count + 1))
    gradient = np.empty(count + 1)
    for _ in range(_NEWTON_PASSES):
        vectors = now + slopes @ x
        inside = 1.0 / (length * length - (vectors * vectors).sum(axis=1))
        along = (slopes * (vectors * inside[:, np.newaxis])[:, :, np.newaxis]).sum(axis=1)
        kept = 1.0 / (room - rows @ x)
        near = rows * kept[:, np.newaxis]
        gradient[:-1] = 2.0 * along.sum(axis=0) + near.sum(axis=0)
        gradient[-1] = 1.0 / path - 2.0 * length * inside.sum()
        hessian[:-1, :-1] = (
            2.0 * (flat.T * inside.repeat(2)) @ flat + 4.0 * along.T @ along + near.T @ near)
        hessian[-1, :-1] = hessian[:-1, -1] = -4.0 * length * (inside @ along)
        hessian[-1, -1] = (4.0 * length * length * inside * inside - 2.0 * inside).sum()
        try:
            step = -np.linalg.solve(hessian, gradient)
        except np.linalg.LinAlgError:
            # Some direction has no effect, as when fewer cases differ than there are levels.
            step = -np.linalg.lstsq(hessian, gradient, rcond=None)[0]
        steep = math.sqrt(max(-float(gradient @ step), 0.0))
        share = 1.0 if steep < _STEEP else 1.0 / (1.0 + steep)
        x = x + share * step[:-1]
        length += share * step[-1]
        if steep < _STEEP:
            if path <= least:
                break
            path = max(_CLOSER * path, least)
    return x
