"""
Moves of a viscoelastic elastomer, and the tail of levels that keeps it at rest afterwards.

At arrival the branches still have an overstress. To stay at rest, the level must follow its decay,
psi'(l_d) + sum h_i exp(-t/tau_i) for Maxwell branches, in steps (zero-order hold).
"""

from collections.abc import Sequence
import math

import numpy as np

from hmsa import motion
from hmsa.model import law
from hmsa.model.delivery import ramps
from hmsa.model.equations import Array
from hmsa.model.moves import Level, Move, State
from hmsa.model.parameters import NondimensionalParameters
from hmsa.model.simulation import (
    branches_of,
    follow,
    followed_by,
    longest_motion,
    sampled,
    with_followed,
)
from hmsa.model.status import Code, RefusedError
from hmsa.planning.shapers.request import MoveRequest

# Minimum move, and safety factor on the computed vibration of a tail.
_LEAST_MOVE, _SURE = 1e-3, 1.25
# Maximum number of levels of a tail.
_MOST = 300
# Codes of moves that leave vibration even with an exact model.
_RINGING = (Code.LINEAR, Code.MINIMAX)
# Minimum time for which a target is held.
_SHORTEST = 1e-9


def carried(
        state: State, before: NondimensionalParameters, after: NondimensionalParameters,
        faster: float) -> tuple[float, ...]:
    """
    Return the states of branches and modes for another material, or nothing.

    ``faster`` is the factor on dimensionless rates.
    """
    # The branches remember a stretch: at rest, they are relaxed for any model.
    count = len(before.branches)
    if len(state.followed) != len(before.rows) or len(before.rows) != len(after.rows) or (
            count != len(after.branches)):
        return ()
    found = [
        float(law.elastic_force(law.equilibrium_stretch(x, before.packed), after.packed))
        for x in state.followed[:count]]
    found += [x * (faster if i % 2 else 1.0) for i, x in enumerate(state.followed[count:])]
    return tuple(found) if np.all(np.isfinite(found)) else ()


def arrival(request: MoveRequest, found: Move) -> State:
    """Return the state that a move reaches, at rest at the target."""
    end = request.start
    if found.duration > 0.0:
        # The last level counts only if a ramp to it starts before the arrival.
        end = follow(
            found.until(found.duration).levels, end, found.duration, request.material,
            request.delivery)
    return State(
        request.target, 0.0, end.load, end.amplifier, followed_by(end, request.material))


def held(request: MoveRequest, found: Move, span: float) -> Move:
    """
    Return a move with the tail of levels that keeps it at rest while branches relax.

    Times are rounded to those that commands can have; the target is held until ``span`` after the
    start. Without creep, or if the target is only approached, the move does not change.
    """
    material, delivery = request.material, request.delivery
    if not material.creeps or not found.duration < np.inf:
        return found
    end = arrival(request, found)
    holding = float(law.elastic_force(request.target, material.packed))
    behind = branches_of(end, material)
    step = max(abs(request.target - request.state.stretch), _LEAST_MOVE)
    out = np.empty((_MOST, 5))
    count, vibration = motion.staircase(
        holding - np.array(behind), material.branches, request.target,
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
    followed = np.empty((1 + count, len(behind)))
    motion.trail(
        np.append(0.0, times - late), np.full(1 + count, holding),
        with_followed(material, behind), followed)
    field, amplifiers = before, [None] * count
    if delivery.lag > 0.0:
        field = holding + fields + late * (holding + fields - before) / delivery.lag
        amplifiers = before.tolist()
    states = list(map(
        State, (request.target + deviation - late * rates).tolist(), rates.tolist(),
        field.tolist(), amplifiers, (
            (*x, *(request.target, 0.0) * len(material.modes.ratios))
            for x in followed[1:].tolist())))
    if found.code in _RINGING:
        rings = int(np.searchsorted(begins, begins[0] + longest_motion(holding, material)))
        states[:rings] = _passed(request, levels + tail[:rings], begins[:rings])
    return found._replace(
        levels=levels + tail, tail=tuple(states), vibration=_SURE * (vibration + more))


def _passed(
        request: MoveRequest, levels: Sequence[Level], times: Array) -> tuple[State, ...]:
    """Return the states at the start of levels during which the block is not at rest."""
    delivery = request.delivery
    rows, _ = ramps(levels, request.load, float(times[-1]), delivery.slew)
    switches, loads, _ = zip(*rows, strict=True)
    outputs = np.interp(times, switches, loads) if delivery.slew < math.inf else np.array(
        [request.load, *(x.load for x in levels)])[len(levels) - len(times):-1]
    found = sampled(levels, request.start, times, request.material, delivery)
    lags = delivery.lag > 0.0
    return tuple(
        State(stretch, rate, field if lags else output, output if lags else None, tuple(followed))
        for output, (stretch, rate, field, *followed) in zip(
            outputs.tolist(), found.T.tolist(), strict=True))


def _ramped(
        request: MoveRequest, times: Array, changes: Array, found: Move) -> tuple[Array, float]:
    """Return how much earlier to command ramped levels, and the vibration that ramps add."""
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
    # Centre the ramp on the ideal step: the remaining error is of second order.
    late = 0.5 * ramps
    late[0], left = _first(request, found, float(changes[0]))
    more = np.sum(np.abs(changes) * ramps ** 2) / 12.0 + np.abs(changes[0]) * left / frequency
    return late, float(more / inertia)


def _first(request: MoveRequest, found: Move, change: float) -> tuple[float, float]:
    """Return how much earlier to change the level at arrival, and the uncompensated ramp time."""
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
    # The last ramp reverses before its end: the part it lacks balances the part that follows.
    late = min(ramp / (2.0 + math.sqrt(2.0)), abs(last) / slew)
    return late, ((ramp - 2.0 * late) ** 2 - 2.0 * late * late) / ramp
