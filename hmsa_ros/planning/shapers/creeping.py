"""
Moves of an elastomer that creeps, and the levels that keep it at rest afterwards.

A branch adds stiffness to a fast motion: level and duration of a move are found from those
without branches, while their stiffness grows. At arrival the branches still hold something. To
stay at rest the level has to follow it, psi'(l_d) + sum h_i exp(-t/tau_i) for Maxwell branches,
as a staircase.
"""

from collections.abc import Sequence
from dataclasses import replace
import math

import numpy as np

from hmsa_ros import motion
from hmsa_ros.model import law
from hmsa_ros.model.delivery import Delivery, IDEAL, ramps
from hmsa_ros.model.equations import Array
from hmsa_ros.model.moves import Level, Move, State
from hmsa_ros.model.parameters import NondimensionalParameters
from hmsa_ros.model.simulation import (
    follow,
    followed_by,
    longest_motion,
    paces,
    RTOL,
    sampled,
    with_followed,
)
from hmsa_ros.model.status import Code, RefusedError
from hmsa_ros.planning.shapers.lagged import free_heights
from hmsa_ros.planning.shapers.request import Request
from hmsa_ros.planning.shooting import approach, Attempt, solve, Template

# The least move that counts, and how much more a staircase may leave than is worked out.
_LEAST_MOVE, _SURE = 1e-3, 1.25
# Levels of a staircase at the most.
_MOST = 300
_SHORTEST_STRIDE = 0.03
# Codes of moves that leave vibration, even if the model is exact.
_RINGING = (Code.LINEAR, Code.MINIMAX)
# Time for which a target is held at the least.
_SHORTEST = 1e-9


def carried(
        state: State, before: NondimensionalParameters,
        after: NondimensionalParameters) -> tuple[float, ...]:
    """Return what branches have followed of a state, for another material."""
    # What they remember is a stretch: at rest, they are relaxed under any law.
    if len(state.followed) != len(after.branches):
        return ()
    found = tuple(
        float(law.elastic_force(law.equilibrium_stretch(x, before.packed), after.packed))
        for x in state.followed)
    return found if np.all(np.isfinite(found)) else ()


def _product(one: Sequence[float], other: Sequence[float]) -> float:
    return sum(x * y for x, y in zip(one, other, strict=True))


def with_branches(
        request: Request, plain: Sequence[Level], free: Sequence[tuple[str, int]],
        delivery: Delivery | None = None) -> Attempt:
    """Solve for the free numbers of levels with branches, given those without them."""
    # A free first level pushes as much harder as the branches are stiff; times shrink with it.
    material, state = request.material, request.state
    creep = material.creep.held
    # How much of a branch a motion as fast as this feels.
    speeds = paces(material, request.behind(request.target)) / request.frequency
    felt = (1.0 / (1.0 + speeds ** 2)).tolist()
    force = float(law.elastic_force(state.stretch, material.packed))
    held = request.behind(state.stretch).tolist()
    loads = {i for kind, i in free if kind == 'load'}
    times = {i for kind, i in free if kind == 'time'}

    def grown(share: float) -> list[float]:
        return [(1.0 + ratio) ** share - 1.0 for ratio in creep.ratios]

    def stiffer(levels: tuple[Level, ...], share: float, aim: float) -> Attempt:
        before, after = grown(share), grown(aim)
        stiffness = (1.0 + _product(felt, after)) / (1.0 + _product(felt, before))
        # Ramps and grid stay as they are.
        faster = math.sqrt(stiffness) if times else 1.0
        guess = [Level(
            x.time / faster, x.load if i not in loads else
            force + _product(after, held) + stiffness * (x.load - force - _product(before, held)))
            for i, x in enumerate(levels)]
        there = request if aim == 1.0 else replace(request, material=replace(
            material, creep=replace(creep, ratios=tuple(after))))
        found = solve(Template.of(guess, free), there, delivery)
        return found and (found[0][:len(plain)], found[1]) if aim < 1.0 else found

    return approach(tuple(plain), stiffer, _SHORTEST_STRIDE)


def two_levels(request: Request, plain: Move) -> Attempt:
    """Solve for level and duration with branches, given those without them."""
    return with_branches(request, plain.levels, [('load', 0), ('time', 1)], IDEAL)


def free_levels(request: Request) -> Move:
    """Come to rest by two levels of free heights; `RefusedError` if the limits have none."""
    found = free_heights(request, [('load', 0), ('load', 1)])
    if found is None:
        raise RefusedError(
            Code.NO_TWO_STEP,
            f'no two flux densities within the limits bring {request.named_target} of this '
            'creeping elastomer to rest: expected wider limits, a smaller move or several '
            'setpoints')
    return Move(Code.MINIMUM_TIME, *found, (
        f'no single intermediate flux density within the limits leads to rest at '
        f'{request.target:g}: two are used'))


def arrival(request: Request, found: Move) -> State:
    """Return the state to which a move leads, at rest at the target."""
    end = replace(request.state, load=request.field)
    if found.duration > 0.0:
        # The last level counts where it is ramped to.
        end = follow(
            found.until(found.duration).levels, end, found.duration, request.material,
            request.delivery)
    return State(
        request.target, 0.0, end.load, end.amplifier, followed_by(end, request.material))


def held(request: Request, found: Move, span: float) -> Move:
    """
    Return a move with the staircase that keeps it at rest while branches relax.

    Its times are as commands carry them; it is held until ``span`` after its start. Where nothing
    creeps, or the target is only approached, it stays as it was.
    """
    material, delivery = request.material, request.delivery
    if not material.creep or not found.duration < np.inf:
        return found
    end = arrival(request, found)
    holding = float(law.elastic_force(request.target, material.packed))
    step = max(abs(request.target - request.state.stretch), _LEAST_MOVE)
    out = np.empty((_MOST, 5))
    count, vibration = motion.staircase(
        holding - np.array(end.followed), material.branches, request.target,
        material.packed, delivery.lag, delivery.period,
        max(span - found.duration, _SHORTEST), delivery.ripple / _SURE * step, out)
    times, excess, deviation, rates, fields = out[:count].T
    loads = holding + excess
    before = np.append(end.ramps_from, loads[:-1])
    levels = found.until(found.duration).levels
    late, more = _ramped(request, times, loads - before, found)
    begins: Array = found.duration + times - late
    if delivery.resolution > 0.0:
        begins = np.rint(begins / delivery.resolution) * delivery.resolution
    tail = tuple(map(Level, begins.tolist(), loads.tolist()))
    request.check(tail)
    followed = np.empty((1 + count, len(end.followed)))
    motion.trail(
        np.append(0.0, times - late), np.full(1 + count, holding),
        with_followed(material, end.followed), followed)
    field, amplifiers = before, [None] * count
    if delivery.lag > 0.0:
        field = holding + fields + late * (holding + fields - before) / delivery.lag
        amplifiers = before.tolist()
    states = list(map(
        State, (request.target + deviation - late * rates).tolist(), rates.tolist(),
        field.tolist(), amplifiers, map(tuple, followed[1:].tolist())))
    if found.code in _RINGING:
        rings = int(np.searchsorted(begins, begins[0] + longest_motion(holding, material)))
        states[:rings] = _passed(request, levels + tail[:rings], begins[:rings])
    return replace(
        found, levels=levels + tail, tail=tuple(states), vibration=_SURE * (vibration + more))


def _passed(
        request: Request, levels: Sequence[Level], times: Array) -> tuple[State, ...]:
    """Return the states at times at which levels begin, where the block is not at rest."""
    delivery = request.delivery
    rows, _ = ramps(levels, request.load, float(times[-1]), delivery.slew)
    switches, loads, slopes = np.array(rows).T.copy()
    outputs = np.interp(times, switches, loads) if delivery.slew < math.inf else np.array(
        [request.load, *(x.load for x in levels)])[len(levels) - len(times):-1]
    found = sampled(
        switches, loads, slopes, times, replace(request.state, load=request.field),
        request.material, RTOL, delivery.lag)
    lags = delivery.lag > 0.0
    return tuple(
        State(stretch, rate, field if lags else output, output if lags else None, tuple(followed))
        for output, (stretch, rate, field, *followed) in zip(
            outputs.tolist(), found.T.tolist(), strict=True))


def _ramped(
        request: Request, times: Array, changes: Array, found: Move) -> tuple[Array, float]:
    """Return how much sooner to command levels that are ramped to, and what ramps add."""
    delivery, packed = request.delivery, request.material.packed
    ramps: Array = np.abs(changes) / delivery.slew
    if np.any(ramps > np.diff(times, append=np.inf)):
        raise RefusedError(
            Code.SLEW_LIMIT,
            f'ramps of {request.units.slew_text(delivery.slew)} are too slow to follow creep at '
            f'{request.named_target}: expected a larger slew limit')
    inertia = law.mass(request.target, packed)
    frequency = request.frequency
    if delivery.period > 0.0:
        return 0.0 * ramps, float(np.sum(np.abs(changes) * ramps) / (inertia * frequency))
    # In the middle of the ramp the step would have been: what is left is of second order.
    late = 0.5 * ramps
    late[0], left = _first(request, found, float(changes[0]))
    more = np.sum(np.abs(changes) * ramps ** 2) / 12.0 + np.abs(changes[0]) * left / frequency
    return late, float(more / inertia)


def _first(request: Request, found: Move, change: float) -> tuple[float, float]:
    """Return how much sooner to change the level at arrival, and how much ramp is not made up."""
    slew, ramp = request.delivery.slew, abs(change) / request.delivery.slew
    levels = found.until(found.duration).levels
    if not levels or math.isinf(slew):
        return 0.0, ramp
    last = levels[-1].load - (levels[-2].load if len(levels) > 1 else request.load)
    still = found.duration - levels[-1].time - abs(last) / slew
    if still > _SHORTEST:
        late = min(0.5 * ramp, still)
        return late, ramp - 2.0 * late
    if last * change >= 0.0:
        return 0.0, ramp
    # The last ramp is turned round before its end: as much is missing of it as comes later.
    late = min(ramp / (2.0 + math.sqrt(2.0)), abs(last) / slew)
    return late, ((ramp - 2.0 * late) ** 2 - 2.0 * late * late) / ramp
