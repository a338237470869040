"""Records of a move: state, level, command and the limits it keeps."""

from dataclasses import dataclass, replace
import math

from hmsa_ros.core.status import Code, RefusedError
from hmsa_ros.core.units import Units
from hmsa_ros.errors import BadInputError


@dataclass(frozen=True)
class State:
    """
    Stretch, stretch rate, the load in force and the amplifier's output, nondimensional.

    Attributes
    ----------
    stretch : float
        Principal stretch.
    rate : float
        Per unit of nondimensional time.
    load : float
        Signed load beta in force; NaN for the one that holds the stretch. It matters where a
        slew limit makes the next level start from it, or where the field lags.
    amplifier : float or None
        Load that a field that lags is following; None where the two are the same.
    followed : tuple of float
        Elastic force that each Maxwell branch has followed; empty where they have relaxed.

    """

    stretch: float
    rate: float = 0.0
    load: float = math.nan
    amplifier: float | None = None
    followed: tuple[float, ...] = ()

    @property
    def ramps_from(self) -> float:
        """Load of the amplifier, from which it ramps to the next level."""
        return self.load if self.amplifier is None else self.amplifier


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
        Why it is not the requested command; empty if it is.
    tail : tuple of State
        Predicted at the last levels, which hold the target while branches relax; empty where
        none do.
    vibration : float
        Bound of the vibration of the stretch that these levels leave, peak to peak.

    """

    code: Code
    levels: tuple[Level, ...]
    duration: float
    reason: str = ''
    tail: tuple[State, ...] = ()
    vibration: float = 0.0

    def until(self, time: float) -> 'Move':
        """Return the move without the levels from a time on."""
        # Times on a grid are rounded.
        levels = tuple(x for x in self.levels if x.time < (1.0 - 1e-12) * time)
        return replace(
            self, levels=levels,
            tail=self.tail[:max(len(self.tail) - len(self.levels) + len(levels), 0)])


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
        Refuse a load outside the limits; the message names the target in the units.

        Raises
        ------
        RefusedError
            With `Code.FLUX_LIMIT`.

        """
        if not self.minimum <= load <= self.maximum:
            raise RefusedError(
                Code.FLUX_LIMIT,
                f'{units.coordinate} {target:g} needs a flux density of '
                f'{units.load_text(load)}: expected {units.load_text(self.minimum)} to '
                f'{units.load_text(self.maximum)}')
