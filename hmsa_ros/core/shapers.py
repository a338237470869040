"""
Shapers: ways to command one move, in a registry by name.

A shaper takes the state, the target and the limits, and answers with a `Move`, or refuses with
a reason. Everything is nondimensional; `Units` only words the messages.
"""

from collections.abc import Callable
import math

from hmsa_ros.core import kernels
from hmsa_ros.core.moves import Level, Limits, Move, State
from hmsa_ros.core.parameters import NondimensionalParameters
from hmsa_ros.core.simulation import check_stretch
from hmsa_ros.core.status import Code, RefusedError
from hmsa_ros.core.two_step import plan_two_step
from hmsa_ros.core.units import Units
from hmsa_ros.errors import BadInputError

Shaper = Callable[[State, float, NondimensionalParameters, Limits, Units], Move]


def step(
        state: State, target: float, material: NondimensionalParameters, limits: Limits,
        units: Units) -> Move:
    """
    Apply the target's own load at once: the paper's unshaped input.

    Parameters
    ----------
    state : State
        At the start.
    target : float
        Stretch to settle at.
    material : NondimensionalParameters
        zeta, J_lim and c1.
    limits : Limits
        Admissible loads.
    units : Units
        For the messages.

    Returns
    -------
    Move
        One level.

    Raises
    ------
    RefusedError
        If the target lies outside the stretch limits or needs a load outside `limits`.

    """
    _check_target(target, material)
    load = float(kernels.elastic_force(target, 1.0 / material.j_lim))
    limits.check(load, target, units)
    return Move(Code.STEP, (Level(0.0, load),), math.inf)


def two_step(
        state: State, target: float, material: NondimensionalParameters, limits: Limits,
        units: Units) -> Move:
    """
    Apply beta_p for tau_p, then beta_1 (Eq. 13): at rest at the target, nothing left to ring.

    Where the response is too damped to cross the target there is no such command; the plain
    step, which does not overshoot there, takes its place and the move says so.

    Parameters
    ----------
    state : State
        At the start, moving or at rest.
    target : float
        Stretch to come to rest at.
    material : NondimensionalParameters
        zeta, J_lim and c1.
    limits : Limits
        Admissible loads.
    units : Units
        For the messages.

    Returns
    -------
    Move
        Two levels, or one.

    Raises
    ------
    RefusedError
        If the target lies outside the stretch limits, needs a load outside `limits`, or no
        single intermediate load leads there from a moving start.

    """
    _check_target(target, material)
    plan = plan_two_step(
        state.stretch, target, material, rate=state.rate,
        load_limits=(limits.minimum, limits.maximum))
    limits.check(plan.beta_1, target, units)
    hold = Level(0.0, plan.beta_1)
    if plan.code is Code.HOLD:
        return Move(Code.HOLD, (hold,), 0.0)
    if plan.code is Code.TOO_DAMPED:
        return Move(
            plan.code, (hold,), math.inf,
            f'zeta {material.zeta:g} is too damped for the response to cross stretch '
            f'{target:g}: no two-step command exists, the plain step approaches without '
            'overshoot')
    if plan.code is Code.INDISTINGUISHABLE:
        return Move(
            plan.code, (hold,), math.inf,
            f'zeta {material.zeta:g} is so close to critical damping at stretch {target:g} '
            'that beta_p equals beta_1 to rounding: the plain step is used')
    if plan.code is not Code.TWO_STEP:
        raise RefusedError(
            plan.code,
            f'no single intermediate flux density leads from stretch {state.stretch:g} at rate '
            f'{state.rate / units.time:g} to rest at {target:g}')
    limits.check(plan.beta_p, target, units)
    return Move(
        Code.TWO_STEP, (Level(0.0, plan.beta_p), Level(plan.tau_p, plan.beta_1)), plan.tau_p)


def _check_target(target: float, material: NondimensionalParameters) -> None:
    """Refuse a target outside the limiting stretches."""
    try:
        check_stretch(target, material.j_lim, 'target stretch')
    except BadInputError as error:
        raise RefusedError(Code.OUT_OF_RANGE, str(error)) from error


#: Shapers by name.
SHAPERS: dict[str, Shaper] = {'two_step': two_step, 'step': step}


def get_shaper(name: str) -> Shaper:
    """
    Return the shaper of a name.

    Parameters
    ----------
    name : str
        One of `SHAPERS`.

    Returns
    -------
    callable
        The shaper.

    Raises
    ------
    BadInputError
        If there is none of that name.

    """
    try:
        return SHAPERS[name]
    except KeyError:
        raise BadInputError(
            f'shaper {name!r} is unknown: expected one of {", ".join(SHAPERS)}') from None
