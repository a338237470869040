"""
Shapers: ways to command one move, in a registry by name.

A shaper takes the state, the target and the limits, and answers with a `Move`, or refuses with
a reason. Everything is nondimensional; `Units` only words the messages.
"""

from collections.abc import Callable
from dataclasses import dataclass
import math

from hmsa_ros.core import kernels
from hmsa_ros.core.parameters import NondimensionalParameters
from hmsa_ros.core.simulation import check_stretch
from hmsa_ros.core.status import Code, RefusedError
from hmsa_ros.core.two_step import plan_two_step
from hmsa_ros.errors import BadInputError


@dataclass(frozen=True)
class Units:
    """
    Units in which messages give times and loads.

    Attributes
    ----------
    time, load : float
        Size of the nondimensional unit in the named unit.
    time_name, load_name : str
        With a leading space; empty for nondimensional values.

    """

    time: float = 1.0
    load: float = 1.0
    time_name: str = ''
    load_name: str = ''

    def time_text(self, value: float) -> str:
        """
        Word a time.

        Parameters
        ----------
        value : float
            Nondimensional time.

        Returns
        -------
        str
            With four significant digits.

        """
        return f'{value * self.time:.4g}{self.time_name}'

    def load_text(self, value: float) -> str:
        """
        Word a load.

        Parameters
        ----------
        value : float
            Nondimensional load beta.

        Returns
        -------
        str
            With four significant digits.

        """
        return f'{value * self.load:.4g}{self.load_name}'


@dataclass(frozen=True)
class State:
    """
    Stretch and stretch rate (nondimensional time).

    Attributes
    ----------
    stretch : float
        Principal stretch.
    rate : float
        Per unit of nondimensional time.

    """

    stretch: float
    rate: float = 0.0


@dataclass(frozen=True)
class Level:
    """
    A constant load from a time on.

    Attributes
    ----------
    time : float
        From the start of the move.
    load : float
        Signed load beta.

    """

    time: float
    load: float


@dataclass(frozen=True)
class Move:
    """
    How one target is reached.

    Attributes
    ----------
    code : Code
        Which command it is.
    levels : tuple of Level
        In order; the last one holds the target.
    duration : float
        Time until rest at the target; infinite where it is only approached.
    reason : str
        Why it is not the command that was asked for; empty if it is.

    """

    code: Code
    levels: tuple[Level, ...]
    duration: float
    reason: str = ''


@dataclass(frozen=True)
class Limits:
    """
    Admissible loads.

    Attributes
    ----------
    minimum, maximum : float
        Signed loads beta, minimum below maximum.

    Raises
    ------
    BadInputError
        If they are not in order.

    """

    minimum: float = -math.inf
    maximum: float = math.inf

    def __post_init__(self) -> None:
        """Check the order."""
        if not self.minimum < self.maximum:
            raise BadInputError(
                f'the least flux density {self.minimum:g} is not below the largest '
                f'{self.maximum:g}')

    def check(self, load: float, target: float, units: Units) -> None:
        """
        Refuse a load outside the limits.

        Parameters
        ----------
        load : float
            Load that is needed.
        target : float
            For which stretch, for the message.
        units : Units
            For the message.

        Raises
        ------
        RefusedError
            With `Code.FLUX_LIMIT`.

        """
        if not self.minimum <= load <= self.maximum:
            raise RefusedError(
                Code.FLUX_LIMIT,
                f'stretch {target:g} needs a flux density of {units.load_text(load)}: expected '
                f'{units.load_text(self.minimum)} to {units.load_text(self.maximum)}')


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
