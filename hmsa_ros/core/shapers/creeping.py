"""
Moves of an elastomer that creeps, and the levels that keep it at rest afterwards.

A branch adds stiffness to a fast motion: level and duration of a move are found from those
without branches, while their stiffness grows. At arrival the branches still hold something. To
stay at rest the level has to follow it: psi'(l_d) + sum h_i exp(-t/tau_i), as a staircase.
"""

from dataclasses import replace
import math

import numpy as np

from hmsa_ros.core import creep_plan_kernel as kernel
from hmsa_ros.core import law
from hmsa_ros.core.creep import Creep
from hmsa_ros.core.creep_kernel import RATIO, SPEED
from hmsa_ros.core.delivery import Delivery, IDEAL
from hmsa_ros.core.model import Array
from hmsa_ros.core.moves import Level, Move, State
from hmsa_ros.core.parameters import NondimensionalParameters
from hmsa_ros.core.shapers.lagged import free_heights
from hmsa_ros.core.shapers.request import Request
from hmsa_ros.core.shooting import approach, Attempt, solve, Template
from hmsa_ros.core.simulation import follow, followed_by
from hmsa_ros.core.status import Code, RefusedError
from hmsa_ros.errors import BadInputError

#: Shapers that know of creep, and those that know of it through ramps.
SHAPERS = ('two_step', 'robust', 'smooth', 'step')
RAMPED = ('smooth', 'step')
# The least move that counts, and how much more a staircase may leave than is worked out.
_LEAST_MOVE, _SURE = 1e-3, 1.25
# Levels of a staircase at the most, how its vibration grows until it has no more, and how often
# the way back is halved.
_MOST, _COARSER, _HALVINGS = 300, 3.0, 5
_SHORTEST_STRIDE = 0.03
# Time for which a target is held at the least.
_SHORTEST = 1e-9


def check(material: NondimensionalParameters, delivery: Delivery, shaper: str) -> None:
    """
    Refuse what creep is not planned for yet.

    Raises
    ------
    BadInputError
        If something creeps and the field lags, the shaper is another, or the amplifier ramps
        and it is not one of `RAMPED`.

    """
    if not material.creep:
        return
    if delivery.lag > 0.0:
        raise BadInputError(
            'viscoelastic.ratio is set and so is coil_time_constant: expected 0 for one of them, '
            'since creep is planned for a field that follows at once only')
    if delivery.slew < np.inf and shaper in SHAPERS and shaper not in RAMPED:
        raise BadInputError(
            'viscoelastic.ratio is set and so is slew_limit: expected 0 for one of them, or the '
            f'shaper smooth in place of {shaper}, which plans for creep and steps only')
    if shaper not in SHAPERS:
        raise BadInputError(
            f'shaper {shaper} does not know of viscoelastic.ratio: expected one of '
            + ', '.join(SHAPERS))


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


def two_levels(request: Request, plain: Move) -> Attempt:
    """Solve for level and duration with branches, given those without them."""
    material, state = request.material, request.state
    ratios, speeds = material.branches.T
    frequency = law.natural_frequency(request.target, material.packed)
    # How much of a branch a motion as fast as this feels.
    felt = 1.0 / (1.0 + (speeds / frequency) ** 2)
    force = float(law.elastic_force(state.stretch, material.packed))
    held = force - np.array(followed_by(state, material))

    def stiffer(levels: tuple[Level, ...], share: float, aim: float) -> Attempt:
        before, after = np.expm1(share * np.log1p(ratios)), np.expm1(aim * np.log1p(ratios))
        stiffness = (1.0 + felt @ after) / (1.0 + felt @ before)
        load = force + after @ held + stiffness * (levels[0].load - force - before @ held)
        guess = (Level(0.0, float(load)),
                 Level(levels[1].time / float(np.sqrt(stiffness)), levels[1].load))
        there = request if aim == 1.0 else replace(request, material=replace(
            material, creep=Creep(tuple(after.tolist()), tuple((1.0 / speeds).tolist()))))
        return solve(Template.of(guess, [('load', 0), ('time', 1)]), there, IDEAL)

    return approach(plain.levels, stiffer, _SHORTEST_STRIDE)


def free_levels(request: Request) -> Move:
    """
    Come to rest by two levels of free heights.

    Raises
    ------
    RefusedError
        If there are none within the limits.

    """
    found = free_heights(request, [('load', 0), ('load', 1)])
    if found is None:
        raise RefusedError(
            Code.NO_TWO_STEP,
            f'no two flux densities within the limits bring stretch {request.target:g} of this '
            'creeping elastomer to rest: expected wider limits, a smaller move or several '
            'setpoints')
    return Move(Code.MINIMUM_TIME, *found, (
        f'no single intermediate flux density within the limits leads to rest at '
        f'{request.target:g}: two are used'))


def arrival(request: Request, found: Move) -> State:
    """Return the state to which a move leads, at rest at the target."""
    end = replace(request.state, load=request.load)
    if found.duration > 0.0:
        end = follow(
            found.levels[:-1], end, found.duration, request.material, request.delivery)
    return State(
        request.target, 0.0, end.load,
        followed=followed_by(end, request.material))


def held(request: Request, found: Move, span: float) -> Move:
    """
    Return a move with the staircase that keeps it at rest while branches relax.

    Parameters
    ----------
    request : Request
        The move.
    found : Move
        As a shaper answers, with times as commands carry them.
    span : float
        Time from the start of the move until which it is held.

    Returns
    -------
    Move
        As it was where nothing creeps or the target is only approached.

    Raises
    ------
    RefusedError
        If a level is outside the limits.

    """
    material, delivery = request.material, request.delivery
    if not material.creep or not found.duration < np.inf:
        return found
    end = arrival(request, found)
    holding = float(law.elastic_force(request.target, material.packed))
    branches = material.branches
    excess = branches[:, RATIO] * (holding - np.array(end.followed))
    step = max(abs(request.target - request.state.stretch), _LEAST_MOVE)
    out, vibration = _staircase(
        request, excess, max(span - found.duration, _SHORTEST), delivery.ripple / _SURE * step)
    times, loads = out[:, kernel.TIME], holding + out[:, kernel.EXCESS]
    late, more = _ramped(request, times, np.diff(loads, prepend=end.load))
    vibration += more
    # Not before the last level of the move, nor before its start.
    before = found.levels[-2].time if len(found.levels) > 1 else found.duration
    late[0] = min(late[0], 0.5 * (found.duration - before))
    levels = tuple(
        Level(delivery.rounded(x), y)
        for x, y in zip((found.duration + times - late).tolist(), loads.tolist(), strict=True))
    request.check(levels)
    followed = holding - (holding - np.array(end.followed)) * np.exp(
        -np.outer(times - late, branches[:, SPEED]))
    deviation: Array = out[:, kernel.DEVIATION] - late * out[:, kernel.RATE]
    tail = tuple(
        State(x, v, load, None, tuple(by)) for x, v, load, by in zip(
            (request.target + deviation).tolist(), out[:, kernel.RATE].tolist(),
            [end.load, *loads[:-1].tolist()],
            followed.tolist(), strict=True))
    return replace(
        found, levels=found.levels[:-1] + levels, tail=tail, vibration=_SURE * vibration)


def _ramped(request: Request, times: Array, changes: Array) -> tuple[Array, float]:
    """Return how much sooner to command levels that are ramped to, and what ramps add."""
    delivery, packed = request.delivery, request.material.packed
    ramps: Array = np.abs(changes) / delivery.slew
    if np.any(ramps > np.diff(times, append=np.inf)):
        raise RefusedError(
            Code.SLEW_LIMIT,
            f'ramps of {request.units.slew_text(delivery.slew)} are too slow to follow creep at '
            f'stretch {request.target:g}: expected a larger slew limit')
    inertia = law.mass(request.target, packed)
    if delivery.period == 0.0:
        # In the middle of the ramp the step would have been: what is left is of second order.
        return 0.5 * ramps, float(np.sum(np.abs(changes) * ramps ** 2) / (12.0 * inertia))
    frequency = law.natural_frequency(request.target, packed)
    return 0.0 * ramps, float(np.sum(np.abs(changes) * ramps) / (inertia * frequency))


def _staircase(
        request: Request, excess: Array, span: float, ripple: float) -> tuple[Array, float]:
    """Return the levels that follow a tail, and their vibration: the wanted, or what they can."""
    out = np.empty((_MOST, 4))

    def levels(ripple: float) -> tuple[Array, float] | None:
        count, vibration = kernel.staircase(
            excess, request.material.branches, float(request.target), request.material.packed,
            float(request.delivery.period), span, ripple, out)
        return None if count < 0 else (out[:count].copy(), float(vibration))

    found, fine, coarse = levels(ripple), ripple, ripple
    while found is None:
        fine, coarse = coarse, _COARSER * coarse
        found = levels(coarse)
    for _ in range(_HALVINGS if coarse > fine else 0):
        middle = math.sqrt(fine * coarse)
        better = levels(middle)
        if better is None:
            fine = middle
        else:
            found, coarse = better, middle
    return found
