"""
Rest of the first mode and of all secondary modes that ring, for actuators that are continua.

A move has more free levels than rest has conditions: two for each mode, and further ones on real
hardware as in `free`.

Those of a block have equal durations. A command that is as short as possible would excite the
modes that no model contains: by default it takes 2.3 times as long as the two-step command of the
paper. Of all levels that bring the modes to rest in linear motion, it has those that are expected
to leave least in weak modes, changed as little as rest demands. The secondary modes of a beam are
fast and weak: its command is the two-step command, convolved with an input shaper of zero
vibration (N. C. Singer, W. P. Seering, J. Dyn. Syst. Meas. Control 112, 76, 1990) for each of
them, and changed as little as rest demands.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
import math

import numpy as np

from hmsa import motion
from hmsa.model import law
from hmsa.model.equations import Array
from hmsa.model.modes import BROAD
from hmsa.model.moves import Level, Move, State
from hmsa.model.parameters import NondimensionalParameters
from hmsa.model.simulation import followed_by
from hmsa.model.status import Code, RefusedError
from hmsa.planning.shapers.request import AT_REST, MoveRequest
from hmsa.planning.shapers.shooting import (
    at_rest,
    Attempt,
    heights,
    solve,
    Template,
    within_limits,
)
from hmsa.planning.shapers.two_step import two_step

# Durations to try, in units of the wanted one: near solutions that swing back and forth there are
# others without (benchmarks continuum).
_LENGTHS = (1.0, 1.06, 0.94, 1.14, 1.25, 1.4, 1.6, 2.0)
# Duration of each order in half periods of a block that deforms uniformly, and of all less; levels
# at least, and at least for each order (benchmarks continuum).
_SPAN, _LESS, _LEVELS, _MORE_LEVELS = 1.195, 0.1, 16, 4
# For the expected vibration: relative error of all frequencies, weight of the bends by default and
# from order 3 on, multiples of the fastest ringing mode and of the mean of the weak ones between
# which these are, and where; mean in units of the fastest and share of those that nobody gave.
_ERROR, _BENT, _ABOVE, _BELOW, _WIDE = 0.025, (0.003, 0.012), 1.1, 0.5, 1.5
_BAND, _UNKNOWN = 12, (1.4, 0.05)
_PLACES: Array = np.linspace(0.0, 1.0, _BAND, dtype=np.float64)
# Largest load beyond those of start and end, in units of the largest change that the motion needs.
_BEYOND = 0.6
# Durations of levels in units of those of their ramps, at least.
_MORE = 1.25
# Motion below this fraction of the move is none for the guess.
_STILL = 1e-3
# Mean frequency ratio and share of the weak modes, if there are any.
_Weak = tuple[float, float] | None


def modal(request: MoveRequest) -> Move:
    """
    Come to rest with all modes that ring.

    A block takes 2.3 times as long as the two-step command of a block of uniform deformation, and
    1.2 times longer for each order beyond 2. A beam takes as long as the two-step command, half a
    period of each secondary mode, and half periods of the first beyond order 2.

    Without secondary modes, the two-step command does so, and is returned. Raise `RefusedError` if
    no such command keeps the limits.
    """
    modes = request.material.modes
    weak = next(((x, y) for i, (x, y) in enumerate(zip(
        modes.ratios, modes.shares, strict=True)) if i not in modes.ringing), None)
    whole = (_SPAN * request.order - _LESS) * 0.5 * sum(
        _half_period(request.material, x) for x in (request.state.stretch, request.target))
    request = _of_ringing(request)
    if not request.material.modes.ratios:
        return two_step(request)
    holding = request.holding_load()
    if at_rest(request) and _modes_rest(request):
        return Move(Code.HOLD, (Level(0.0, holding),), 0.0)
    reach = _BEYOND * _largest_change(request, holding)
    limits = min(request.load, holding) - reach, max(request.load, holding) + reach
    widest: Attempt = None
    for found in _solutions(request, holding, whole, weak):
        loads = [x.load for x in found[0]]
        if limits[0] <= min(loads) and max(loads) <= limits[1]:
            return Move(Code.MODAL, *found)
        widest = widest or found
    if widest is None:
        raise RefusedError(
            Code.NO_TWO_STEP if request.delivery.period > 0.0 else Code.FLUX_LIMIT,
            f'no levels within the limits bring all modes to rest at {request.named_target}: '
            'expected wider limits, a smaller move, or another shaper')
    return Move(Code.MODAL, *widest)


def _of_ringing(request: MoveRequest) -> MoveRequest:
    """Return the request without modes that are too damped to ring."""
    material = request.material
    if material.ringing is material:
        return request
    count, followed = len(material.branches), followed_by(request.state, material)
    return replace(
        request, material=material.ringing,
        state=replace(request.state, followed=(*followed[:count], *(
            followed[count + 2 * i + j] for i in material.modes.ringing for j in (0, 1)))))


def _modes_rest(request: MoveRequest) -> bool:
    """Return whether the secondary modes are at rest at the target."""
    material = request.material
    states = followed_by(request.state, material)[len(material.branches):]
    return all(abs(x - request.target) <= AT_REST for x in states[::2]) and all(
        abs(x) <= AT_REST * request.frequency for x in states[1::2])


def _largest_change(request: MoveRequest, holding: float) -> float:
    """Return the largest change of load of the move, or the amplitude of the present motion."""
    state, packed = request.state, request.material.packed
    force = float(law.elastic_force(state.stretch, packed))
    stiffness = float(law.elastic_stiffness(state.stretch, packed))
    return max(
        abs(holding - request.load), abs(holding - force), abs(request.load - force),
        abs(state.rate) * stiffness / request.frequency)


def _half_period(material: NondimensionalParameters, stretch: float) -> float:
    """
    Return half the period about a stretch of a block that can only deform as it does at rest.

    All modes contribute to its inertia (J. W. Strutt, Lord Rayleigh, The Theory of Sound, 1877),
    as to the paper's model.
    """
    modes = material.modes
    ratios = (1.0, *(x * stretch ** y for x, _, _, y, _ in modes.numbers))
    inertia = sum(x / y ** 2 for x, y in zip(modes.at(stretch), ratios, strict=True))
    return math.pi * math.sqrt(inertia) / float(law.natural_frequency(stretch, material.packed))


def _solutions(
        request: MoveRequest, holding: float, whole: float, weak: _Weak
) -> Iterator[tuple[tuple[Level, ...], float]]:
    """Yield commands that end at rest within the limits."""
    guesses = (_equal(request, holding, whole, weak) if request.material.rest != 0.0
               else _around_two_steps(request, holding))
    before: tuple[float, ...] = ()
    for template in guesses:
        times = tuple(template.times.tolist())
        if times != before:
            before = times
            found = within_limits(solve(template, request, modes=True), request)
            if found is not None:
                yield found


def _equal(
        request: MoveRequest, holding: float, whole: float, weak: _Weak) -> Iterator[Template]:
    """Yield levels of equal durations that rise smoothly from the present load to the last."""
    modes, delivery = request.material.modes, request.delivery
    count = max(_LEVELS, _MORE_LEVELS * request.order)
    whole += delivery.lag + delivery.ramp(holding - request.load)
    rise = holding - request.load
    for length in _LENGTHS:
        each, levels = length * whole / count, count
        if delivery.period > 0.0:
            each = max(math.floor(each / delivery.period), 1) * delivery.period
            levels = max(
                round(length * whole / each), request.unknowns + 2 * len(modes.ratios))
        each = delivery.rounded(each)
        found = _smooth(each, levels, request, weak)
        if found is None:
            continue
        # A field that lags is one more condition.
        free = np.concatenate([found[1:], np.eye(levels)[levels - request.unknowns + 2:]])
        d_loads = np.zeros((levels + 1, len(free)))
        d_loads[:-1] = free.T
        times = each * np.arange(levels + 1, dtype=np.float64)
        yield Template(
            times, np.append(request.load + rise * found[0], holding), np.zeros_like(d_loads),
            d_loads)


def _smooth(each: float, count: int, request: MoveRequest, weak: _Weak) -> Array | None:
    """
    Return a smooth rise from 0 to 1, in levels of a duration, after which all modes rest.

    This is in linear motion about the target. Of all such levels, they leave least on average if
    frequencies have errors, and weak modes any frequency near their mean. Each further row changes
    one position or rate at the end, and as little else as possible. None if rounding prevents it.
    """
    target, modes, damping = request.target, request.material.modes, _damping_ratio(request)
    shares = modes.at(target)
    rings = [(1.0, damping, _ERROR * shares[0]), *(
        (ratio * target ** exponent, own, _ERROR * share * ratio * target ** exponent)
        for (ratio, _, own, exponent, _), share in zip(modes.numbers, shares[1:], strict=True))]
    fastest = max(x for x, _, _ in rings)
    mean, share = weak or (_UNKNOWN[0] * fastest, _UNKNOWN[1])
    band = _band(fastest, mean)
    others = np.stack([band, damping * band, np.full(_BAND, share / math.sqrt(_BAND))], axis=1)
    found = np.empty((1 + 2 * len(rings), count))
    solved = motion.smooth(
        request.frequency * each, len(rings), np.concatenate([np.array(rings), others]),
        _BENT[request.order > 2], found)
    return found if solved else None


def _damping_ratio(request: MoveRequest) -> float:
    """Return the damping ratio of the first mode about the target."""
    packed, target = request.material.packed, request.target
    return float(law.damping(target, packed) / law.mass(target, packed)) / (
        2.0 * request.frequency)


def _band(fastest: float, mean: float) -> Array:
    """Return frequency ratios that weak modes may have, from the fastest one that rings."""
    least = min(_ABOVE * fastest, _BELOW * mean)
    band: Array = least * (_WIDE * mean / least) ** _PLACES
    return band


def weak_vibration(request: MoveRequest, move: Move) -> tuple[float, int]:
    """
    Return the expected vibration of weak modes after a move, and the index of most of it.

    A mode that does not ring stands for many at any frequency near its mean, which have the
    damping of a viscous material and keep more than it does. The vibration is from peak to peak,
    the root mean square over these frequencies, in linear motion about the target.
    """
    target, modes, damping = request.target, request.material.modes, _damping_ratio(request)
    fastest = max((1.0, *(
        modes.ratios[i] * target ** modes.numbers[i][3] for i in modes.ringing)))
    since = move.duration - np.array([x.time for x in move.levels])
    loads = np.array([request.load, *(x.load for x in move.levels)])
    changes = (loads[1:] - loads[:-1]) / float(
        law.elastic_stiffness(target, request.material.packed))
    shares, sizes = modes.at(target)[1:], [0.0] * len(modes.ratios)
    for i in set(range(len(sizes))) - set(modes.ringing):
        band = _band(fastest, modes.ratios[i])
        ratios = np.minimum(damping * band, BROAD)
        rates = request.frequency * band * (1j * np.sqrt(1.0 - ratios ** 2) - ratios)
        left = np.exp(rates[:, None] * since) @ changes
        sizes[i] = 2.0 * abs(shares[i]) * math.sqrt(float(np.vdot(left, left).real) / _BAND)
    return math.hypot(*sizes), int(np.argmax(sizes))


def _around_two_steps(request: MoveRequest, holding: float) -> Iterator[Template]:
    """Yield the levels of a two-step command that is shaped for all other modes."""
    half, delivery = math.pi / request.frequency, request.delivery
    try:
        move = two_step(replace(
            request, state=_seen(request), work=request.work.more(request.work.left)))
    except RefusedError:
        move = Move(Code.HOLD, (Level(0.0, 0.5 * (request.load + holding)),), math.inf)
    delays, impulses = [], [(0.0, 1.0)]
    for frequency, damping in sorted(_others(request), reverse=True):
        delay = math.pi / frequency
        # Of a vibration, this fraction is left a half period later.
        left = math.exp(-math.pi * damping / math.sqrt(1.0 - damping ** 2))
        impulses = [(x + shift, y * share / (1.0 + left))
                    for x, y in impulses for shift, share in ((0.0, 1.0), (delay, left))]
        delays.append(delay)
    more = sum(delays)
    first = move.duration if more < move.duration < math.inf else half
    levels = [x for x in move.levels if x.time < first]
    shortest = first + max(request.order - 2, 0) * half + more
    # The last levels act on modes that have forgotten the others.
    ends = [0.5 * x for x in reversed(delays) for _ in range(2)]
    for length in _LENGTHS:
        middle = (length * shortest - 2.0 * more) / request.unknowns
        if middle <= 0.0:
            continue
        durations, loads, begin = [], [], 0.0
        for duration in (*delays, *[middle] * request.unknowns, *ends):
            at = (first + more) / (length * shortest) * (begin + 0.5 * duration)
            loads.append(math.fsum(
                part * _load(levels, at - delay, request.load, holding, first)
                for delay, part in impulses))
            begin += duration
            ramp = delivery.ramp(loads[-1] - (loads[-2] if len(loads) > 1 else request.load))
            durations.append(max(duration, _MORE * ramp))
        durations = [_on_grid(x, request) for x in durations]
        begins = [math.fsum(durations[:i]) for i in range(len(durations) + 1)]
        yield heights([Level(*x) for x in zip(begins, (*loads, holding), strict=True)])


def _seen(request: MoveRequest) -> State:
    """Return the state, at rest if it hardly moves: from motion, two_step searches twice."""
    state = request.state
    moves = abs(state.rate) > _STILL * request.frequency * abs(request.target - state.stretch)
    return state if moves else replace(state, rate=0.0)


def _load(
        levels: Sequence[Level], time: float, before: float, after: float, end: float) -> float:
    """Return the load at a time of a command that ends at another one."""
    if time >= end:
        return after
    return next((x.load for x in reversed(levels) if x.time <= time), before)


def _others(request: MoveRequest) -> list[tuple[float, float]]:
    """Return frequencies and damping ratios of the secondary modes of a beam."""
    # They hardly change with the deflection.
    straight = float(law.natural_frequency(0.0, request.material.packed))
    modes = request.material.modes
    return [(x * straight, y) for x, y in zip(modes.ratios, modes.dampings, strict=True)]


def _on_grid(duration: float, request: MoveRequest) -> float:
    """Return a duration that the command can have."""
    period = request.delivery.period
    if period > 0.0:
        duration = math.ceil(duration / period - 1e-9) * period
    return request.delivery.rounded(duration)
