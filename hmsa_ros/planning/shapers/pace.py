"""How fast the shaper smooth moves where nothing limits it."""

from dataclasses import dataclass
import math

from hmsa_ros.errors import BadInputError

#: Natural periods that a move may take.
LEAST_PERIODS, MOST_PERIODS = 0.2, 50.0


@dataclass(frozen=True)
class Pace:
    """How fast the shaper smooth moves."""

    #: Natural periods about the target that a move takes at the least, 0.2 to 50.
    periods: float = 1.0
    rate: float = math.inf  #: largest stretch rate, above 0; infinite for any

    def __post_init__(self) -> None:
        """Check the numbers."""
        if not LEAST_PERIODS <= self.periods <= MOST_PERIODS:
            raise BadInputError(
                f'smooth_periods is {self.periods:g}: expected {LEAST_PERIODS:g} to '
                f'{MOST_PERIODS:g} natural periods')
        if not self.rate > 0.0:
            raise BadInputError(f'stretch_rate_max is {self.rate:g}: expected a number above 0')


#: A natural period, at any rate.
PACE = Pace()
