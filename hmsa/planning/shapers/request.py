"""The input of a shaper, checks that all shapers share, and advice after a failed search."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import wraps
from itertools import combinations
import math
from typing import Any

import numpy as np

from hmsa.errors import BadInputError, check_number, excerpt
from hmsa.model import law
from hmsa.model.delivery import Delivery, IDEAL
from hmsa.model.equations import Array
from hmsa.model.moves import Level, Limits, Move, State
from hmsa.model.parameters import Ellipsoid, NondimensionalParameters, Uncertainty
from hmsa.model.simulation import branches_of
from hmsa.model.status import Code, RefusedError
from hmsa.model.units import Units

#: Range of the minimum duration of a move, in natural periods.
LEAST_PERIODS, MOST_PERIODS = 0.2, 50.0
#: Default relative errors of G, damping coefficient and J_lim.
ERRORS = (0.1, 0.1, 0.1)
#: Maximum relative error.
LARGEST_ERROR = 0.9
#: Maximum order of robust, its number of chained two-step commands.
MOST_ORDER = 16
#: Tolerance within which a state is at rest: of stretch and load, and of rate over frequency.
AT_REST = 1e-9
# Codes of refusals that may be due to a limit.
_SEARCHED = (Code.FLUX_LIMIT, Code.SLEW_LIMIT, Code.NO_TWO_STEP, Code.NOT_CONVERGED)
# Codes by the limiting quantity; those most often set wrongly come first.
_CODES = {'flux': Code.FLUX_LIMIT, 'slew': Code.SLEW_LIMIT, 'period': Code.NO_TWO_STEP,
          'lag': Code.NO_TWO_STEP}
# Work limit of the search for advice.
_ADVISING = 400_000
# Factors by which limits are relaxed.
_FACTORS = (1.5, 3.0, 10.0, 30.0, math.inf)


@dataclass(frozen=True)
class SmoothLimits:
    """Minimum duration and maximum rate of the shaper smooth."""

    #: Minimum duration of a move, in natural periods about the target, 0.2 to 50.
    periods: float = 1.0
    rate: float = math.inf  #: maximum stretch rate, above 0; infinite for no limit

    def __post_init__(self) -> None:
        """Check the ranges."""
        check_number(
            'smooth_periods', self.periods, 'natural periods', least=LEAST_PERIODS,
            most=MOST_PERIODS)
        check_number('stretch_rate_max', self.rate, above=0.0, endless=True)


#: One natural period, at any rate.
PACE = SmoothLimits()


def as_errors(values: Sequence[float] | Ellipsoid) -> Uncertainty:
    """
    Return errors of G, damping coefficient and J_lim; an ellipsoid has already been checked.

    Raise `BadInputError` for values other than three numbers of 0 to 0.9.
    """
    if isinstance(values, Ellipsoid):
        return values
    try:
        if np.iscomplexobj(values):
            raise TypeError
        modulus, damping, limit = (float(x) for x in values)
    except (TypeError, ValueError, OverflowError):
        modulus = damping = limit = math.nan
    if not all(0.0 <= x <= LARGEST_ERROR for x in (modulus, damping, limit)):
        raise BadInputError(
            f'errors of G, damping coefficient and J_lim are {excerpt(values)}: expected three '
            f'fractions of 0 to {LARGEST_ERROR:g}')
    return modulus, damping, limit


@dataclass
class StepBudget:
    """
    Remaining work of a request, in integration steps times the number of variables.

    Its searches share it and end when none is left. Results therefore do not depend on the speed
    or load of the machine.
    """

    left: int = 700_000
    #: Whether it is for a search for advice, which shares this limit among all its attempts.
    advising: bool = False

    def more(self, left: int) -> 'StepBudget':
        """Return the work limit of another method for the same target."""
        return self if self.advising else StepBudget(left)


@dataclass(frozen=True)
class MoveRequest:
    """One move to command, from a state in motion or at rest to rest at a target."""

    state: State
    target: float
    material: NondimensionalParameters
    limits: Limits = field(default_factory=Limits)
    delivery: Delivery = IDEAL
    order: int = 2  #: number of chained two-step commands of robust; minimax takes as long
    units: Units = field(default_factory=Units)  #: for the messages
    #: Relative errors of G, damping coefficient and J_lim from `as_errors`, for minimax.
    errors: Uncertainty = ERRORS
    pace: SmoothLimits = PACE  #: of smooth; dimensionless rate
    work: StepBudget = field(default_factory=StepBudget, compare=False)

    @classmethod
    def of(
            cls, material: NondimensionalParameters, start: State | None = None,
            **more: Any) -> 'MoveRequest':
        """Return a request to stay in a state, by default at rest without a field."""
        state = start or State(material.rest)
        return cls(state, state.stretch, material, **more)

    @property
    def named_target(self) -> str:
        """The target in a message, as in ``'stretch 1.4'``."""
        return f'{self.units.coordinate} {self.target:g}'

    @property
    def named_state(self) -> str:
        """The state in a message, as in ``'stretch 1.2 at rate 0.5'``."""
        return (f'{self.units.coordinate} {self.state.stretch:.6g} at rate '
                f'{self.state.rate / self.units.time:.4g}')

    @property
    def load(self) -> float:
        """Output of the amplifier before the move."""
        return self.field if self.state.amplifier is None else self.state.amplifier

    @property
    def field(self) -> float:
        """Load before the move."""
        if math.isfinite(self.state.load):
            return self.state.load
        return float(law.elastic_force(self.state.stretch, self.material.packed))

    @property
    def start(self) -> State:
        """The state, with the holding load if the load is not given."""
        known = math.isfinite(self.state.load)
        return self.state if known else replace(self.state, load=self.field)

    @property
    def frequency(self) -> float:
        """Undamped angular frequency of small motion about the target."""
        return float(law.natural_frequency(self.target, self.material.packed))

    @property
    def still(self) -> bool:
        """Whether the actuator does not move, even if it is not in equilibrium."""
        return abs(self.state.rate) <= AT_REST * self.frequency

    @property
    def unknowns(self) -> int:
        """Number of free values of a command: for stretch, rate and a field that lags."""
        return 2 + (self.delivery.lag > 0.0)

    def keeps(self, levels: Sequence[Level]) -> bool:
        """Return whether levels are inside the load limits."""
        least, most = self.limits.minimum, self.limits.maximum
        for _, load in levels:  # noqa: SIM110 - half the time of all()
            if not least <= load <= most:
                return False
        return True

    def holding_load(self) -> float:
        """Return the load that holds the target, beta_1; `RefusedError` outside the limits."""
        if reason := self.material.beyond(self.target, 'target stretch'):
            raise RefusedError(Code.OUT_OF_RANGE, reason)
        load = float(law.elastic_force(self.target, self.material.packed))
        self.limits.check(load, self.target, self.units)
        return load

    def behind(self, stretch: float) -> Array:
        """Return the force at a stretch minus the initial branch states."""
        force = float(law.elastic_force(stretch, self.material.packed))
        return np.array([force - x for x in branches_of(self.state, self.material)])

    def balance(self, followed: Sequence[float]) -> float:
        """Return the load that keeps the target at rest for given branch states."""
        load = float(law.elastic_force(self.target, self.material.packed))
        return load + float(sum(
            ratio * (load - force) for (ratio, *_), force in zip(
                self.material.branches.tolist(), followed, strict=True)))

    def check(self, levels: Sequence[Level]) -> None:
        """Raise `RefusedError` with `Code.FLUX_LIMIT` for levels outside the load limits."""
        for level in levels:
            self.limits.check(level.load, self.target, self.units)

    def plain(self, code: Code, reason: str) -> Move:
        """Return the unshaped step, which approaches the target, with code and reason."""
        return Move(code, (Level(0.0, self.holding_load()),), math.inf, reason)


#: Returns a move for a request, or raises `RefusedError` with a reason.
Shaper = Callable[[MoveRequest], Move]


def advised(
        shaper: Shaper, factors: Sequence[float] = _FACTORS,
        sooner: Shaper | None = None) -> Shaper:
    """
    Return a shaper whose refusals name the relaxed limits for which it finds a command.

    ``sooner`` is a faster shaper for this search that succeeds for the same requests.
    """
    asked = sooner or shaper

    @wraps(shaper)
    def shape(request: MoveRequest) -> Move:
        try:
            return shaper(request)
        except RefusedError as error:
            there = replace(request, work=StepBudget(_ADVISING, advising=True))
            ways = _ways(asked, there) if error.code in _SEARCHED else []
            what, _, advice = str(error).partition(': expected ')
            if not ways or (advice and ways == [('flux',)] and error.code is Code.FLUX_LIMIT):
                raise
            raise RefusedError(
                _CODES[ways[0][0]],
                f'{what}: expected ' + ', or '.join(
                    _advice(asked, there, x, factors) for x in ways)) from error
    return shape


def _ways(shaper: Shaper, request: MoveRequest) -> list[tuple[str, ...]]:
    """Return the smallest sets of limits whose removal makes a command possible."""
    delivery, limits = request.delivery, request.limits
    there = [name for name, limited in (
        ('flux', limits != Limits()), ('slew', delivery.slew < math.inf),
        ('period', delivery.period > 0.0), ('lag', delivery.lag > 0.0)) if limited]
    for count in range(1, len(there) + 1):
        ways = [x for x in combinations(there, count)
                if _succeeds(shaper, eased(request, x, math.inf))]
        if ways:
            return ways
    return []


def _advice(
        shaper: Shaper, request: MoveRequest, names: Sequence[str],
        factors: Sequence[float]) -> str:
    """Return relaxed values of some limits for which a command exists, as text."""
    factor = next(x for x in factors if x == math.inf or _succeeds(
        shaper, eased(request, names, x)))
    there, units = eased(request, names, factor), request.units
    limits, delivery = there.limits, there.delivery
    words = {
        'flux': 'flux density limits of ' + ' to '.join(
            map(units.load_text, (limits.minimum, limits.maximum))),
        'slew': f'a slew limit of {units.slew_text(delivery.slew)}',
        'period': f'a command period of {units.time_text(delivery.period)}',
        'lag': f'a coil time constant of {units.time_text(delivery.lag)}'}
    if factor == math.inf:
        words |= {'flux': 'no flux density limits', 'slew': 'no slew limit'}
    return ' and '.join(words[x] for x in names)


def eased(request: MoveRequest, names: Sequence[str], factor: float) -> MoveRequest:
    """Return a request with limits (flux, slew, period, lag) relaxed by a factor, or removed."""
    delivery, limits = request.delivery, request.limits
    if 'flux' in names:
        width = limits.maximum - limits.minimum
        more = (factor - 1.0) * (width if width < math.inf else max(
            abs(x) for x in (limits.minimum, limits.maximum) if math.isfinite(x)))
        limits = Limits(limits.minimum - more, limits.maximum + more)
    return replace(request, limits=limits, delivery=replace(
        delivery, slew=delivery.slew * (factor if 'slew' in names else 1.0),
        period=delivery.period / (factor if 'period' in names else 1.0),
        lag=delivery.lag / (factor if 'lag' in names else 1.0)))


def _succeeds(shaper: Shaper, request: MoveRequest) -> bool:
    try:
        shaper(request)
    except RefusedError:
        return False
    return True
