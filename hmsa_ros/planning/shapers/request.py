"""What a shaper gets, and the checks that all shapers share."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
import math
from typing import Any

import numpy as np

from hmsa_ros.errors import BadInputError, excerpt
from hmsa_ros.model import law
from hmsa_ros.model.delivery import Delivery, IDEAL
from hmsa_ros.model.equations import Array
from hmsa_ros.model.mismatch import Ellipsoid, Uncertainty
from hmsa_ros.model.moves import Level, Limits, Move, State
from hmsa_ros.model.parameters import NondimensionalParameters
from hmsa_ros.model.simulation import check_stretch, followed_by
from hmsa_ros.model.status import Code, RefusedError
from hmsa_ros.model.units import Units
from hmsa_ros.planning.shapers.pace import PACE, Pace

#: How far off G, damping coefficient and J_lim are expected to be, as shares.
ERRORS = (0.1, 0.1, 0.1)
#: The largest of them.
LARGEST_ERROR = 0.9
#: Chained two-step commands of robust at the most.
MOST_ORDER = 16
#: What is as good as at rest: of stretch and load, and of the rate over the frequency.
AT_REST = 1e-9


def as_errors(values: Sequence[float] | Ellipsoid) -> Uncertainty:
    """
    Return errors of G, damping coefficient and J_lim; an ellipsoid is checked already.

    Others than three numbers of 0 to 0.9 are a `BadInputError`.
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
            f'shares of 0 to {LARGEST_ERROR:g}')
    return modulus, damping, limit


@dataclass
class Work:
    """
    What a request may still cost, counted in steps of the integration, times their numbers.

    Its searches share it: when nothing is left, they find nothing more. So what is found does not
    depend on how fast or how busy a machine is.
    """

    left: int = 700_000
    #: Of a search for advice, which has no more than this for all that it tries.
    advising: bool = False

    def more(self, left: int) -> 'Work':
        """Return work for one more way to the same target."""
        return self if self.advising else Work(left)


@dataclass(frozen=True)
class Request:
    """One move to be commanded, from a state of motion or rest to rest at a target."""

    state: State
    target: float
    material: NondimensionalParameters
    limits: Limits = field(default_factory=Limits)
    delivery: Delivery = IDEAL
    order: int = 2  #: chained two-step commands of robust; minimax takes as long
    units: Units = field(default_factory=Units)  #: for the messages
    #: Of G, damping coefficient and J_lim, as `as_errors` returns them, for minimax.
    errors: Uncertainty = ERRORS
    pace: Pace = PACE  #: of smooth; the rate per unit of nondimensional time
    work: Work = field(default_factory=Work, compare=False)

    @classmethod
    def of(
            cls, material: NondimensionalParameters, start: State | None = None,
            **more: Any) -> 'Request':
        """Return a request to stay, from rest without a field unless a start is given."""
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
        """Load in force before the move."""
        if math.isfinite(self.state.load):
            return self.state.load
        return float(law.elastic_force(self.state.stretch, self.material.packed))

    @property
    def start(self) -> State:
        """The state with the load in force, where that is the one that holds it."""
        return replace(self.state, load=self.field)

    @property
    def frequency(self) -> float:
        """Undamped angular frequency of small motion about the target."""
        return float(law.natural_frequency(self.target, self.material.packed))

    @property
    def still(self) -> bool:
        """Whether the actuator does not move, though nothing may hold it there."""
        return abs(self.state.rate) <= AT_REST * self.frequency

    @property
    def unknowns(self) -> int:
        """How many numbers of a command are free: for stretch, rate and a field that lags."""
        return 2 + (self.delivery.lag > 0.0)

    def keeps(self, levels: Sequence[Level]) -> bool:
        """Return whether levels are inside the load limits."""
        return all(self.limits.minimum <= x.load <= self.limits.maximum for x in levels)

    def holding_load(self) -> float:
        """Return the load that holds the target, beta_1; `RefusedError` outside the limits."""
        try:
            check_stretch(self.target, self.material, 'target stretch')
        except BadInputError as error:
            raise RefusedError(Code.OUT_OF_RANGE, str(error)) from error
        load = float(law.elastic_force(self.target, self.material.packed))
        self.limits.check(load, self.target, self.units)
        return load

    def behind(self, stretch: float) -> Array:
        """Return how far what branches follow at the start is from the force at a stretch."""
        force = float(law.elastic_force(stretch, self.material.packed))
        return np.array([force - x for x in followed_by(self.state, self.material)])

    def balance(self, followed: Sequence[float]) -> float:
        """Return the load that keeps the target at rest where branches have followed forces."""
        load = float(law.elastic_force(self.target, self.material.packed))
        return load + float(sum(
            ratio * (load - force) for (ratio, *_), force in zip(
                self.material.branches.tolist(), followed, strict=True)))

    def check(self, levels: Sequence[Level]) -> None:
        """Refuse levels outside the load limits with `Code.FLUX_LIMIT` and the value needed."""
        for level in levels:
            self.limits.check(level.load, self.target, self.units)

    def plain(self, code: Code, reason: str) -> Move:
        """Return the unshaped step instead, which approaches the target, with code and reason."""
        return Move(code, (Level(0.0, self.holding_load()),), math.inf, reason)


#: Answers a request with a move, or refuses with a reason.
Shaper = Callable[[Request], Move]
