"""Records of a move: setpoint, state, level, command and the limits it keeps."""

from dataclasses import dataclass
import math
from typing import NamedTuple

from hmsa.errors import BadInputError
from hmsa.model.laws.record import DEFLECTION, STRETCH
from hmsa.model.status import Code, RefusedError
from hmsa.model.units import Units


def check_target(stretch: float, rest: float) -> None:
    """Raise `RefusedError` if a stretch is impossible for an actuator with this rest."""
    if not math.isfinite(stretch) or stretch <= 0.0 < rest:
        more = ' greater than 0' if rest else ''
        name = (STRETCH if rest else DEFLECTION).name
        raise RefusedError(
            Code.BAD_INPUT, f'{name} is {stretch:g}: expected a finite number{more}')


@dataclass(frozen=True)
class Setpoint:
    """A stretch and its duration, the paper's (lambda_d, span)."""

    stretch: float  #: target, or another position
    #: Time from the end of the previous setpoint to the end of this one, above 0; may be infinite.
    span: float

    def __post_init__(self) -> None:
        """Check stretch and duration."""
        if not math.isfinite(self.stretch):
            raise BadInputError(f'stretch is {self.stretch:g}: expected a finite number')
        if not self.span > 0.0:
            raise BadInputError(f'duration is {self.span:g}: expected a number greater than 0')


@dataclass(frozen=True)
class State:
    """Stretch, stretch rate, load and output of the amplifier, dimensionless."""

    stretch: float
    rate: float = 0.0
    #: Present load, from which ramps and lags start; NaN for the load that holds the stretch.
    load: float = math.nan
    #: Load that a lagging field approaches; None if equal to the load.
    amplifier: float | None = None
    #: Elastic force that each branch has followed; empty if relaxed.
    followed: tuple[float, ...] = ()

    @property
    def ramps_from(self) -> float:
        """Load of the amplifier, from which it ramps to the next level."""
        return self.load if self.amplifier is None else self.amplifier


# As tuples, a level and a move are made in half the time, which counts in a plan of 10 us.
class Level(NamedTuple):
    """A constant load beta from a time on, counted from the start of the move."""

    time: float
    load: float


class Move(NamedTuple):
    """The command for one target."""

    code: Code
    levels: tuple[Level, ...]  #: in order; the last one holds the target
    duration: float  #: time until rest at the target; infinite if only approached
    reason: str = ''  #: why the command is not the requested one; empty if it is
    #: Predicted states at the last levels, which hold the target while branches relax.
    tail: tuple[State, ...] = ()
    vibration: float = 0.0  #: upper bound of the vibration due to these levels, peak to peak

    def until(self, time: float) -> 'Move':
        """Return the move without the levels from a time on."""
        # Times on a grid are rounded.
        levels = tuple(x for x in self.levels if x.time < (1.0 - 1e-12) * time)
        return self._replace(
            levels=levels,
            tail=self.tail[:max(len(self.tail) - len(self.levels) + len(levels), 0)])


@dataclass(frozen=True)
class Limits:
    """Admissible signed loads beta, minimum below maximum."""

    minimum: float = -math.inf
    maximum: float = math.inf

    def __post_init__(self) -> None:
        """Check the order."""
        if not self.minimum < self.maximum:
            raise BadInputError(
                f'the minimum flux density {self.minimum:g} is not below the maximum '
                f'{self.maximum:g}')

    def check(self, load: float, target: float, units: Units) -> None:
        """Raise `RefusedError` for a load outside the limits; units format the message."""
        if not self.minimum <= load <= self.maximum:
            raise RefusedError(
                Code.FLUX_LIMIT,
                f'{units.coordinate} {target:g} needs a flux density of '
                f'{units.load_text(load)}: expected {units.load_text(self.minimum)} to '
                f'{units.load_text(self.maximum)}')
