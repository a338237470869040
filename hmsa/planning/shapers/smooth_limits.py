"""Pace of the shaper smooth without other limits."""

from dataclasses import dataclass
import math

from hmsa.errors import BadInputError

#: Range of the minimum duration of a move, in natural periods.
LEAST_PERIODS, MOST_PERIODS = 0.2, 50.0


@dataclass(frozen=True)
class SmoothLimits:
    """Minimum duration and maximum rate of the shaper smooth."""

    #: Minimum duration of a move, in natural periods about the target, 0.2 to 50.
    periods: float = 1.0
    rate: float = math.inf  #: maximum stretch rate, above 0; infinite for no limit

    def __post_init__(self) -> None:
        """Check the ranges."""
        if not LEAST_PERIODS <= self.periods <= MOST_PERIODS:
            raise BadInputError(
                f'smooth_periods is {self.periods:g}: expected {LEAST_PERIODS:g} to '
                f'{MOST_PERIODS:g} natural periods')
        if not self.rate > 0.0:
            raise BadInputError(f'stretch_rate_max is {self.rate:g}: expected a number above 0')


#: One natural period, at any rate.
PACE = SmoothLimits()
