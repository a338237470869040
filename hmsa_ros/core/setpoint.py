"""What is asked of an actuator: a stretch, and how long it lasts."""

from dataclasses import dataclass
import math

from hmsa_ros.core.laws.coordinate import DEFLECTION, STRETCH
from hmsa_ros.errors import BadInputError


def impossible(stretch: float, rest: float) -> str:
    """Return why no actuator with a rest there has a stretch; empty if one may have it."""
    if math.isfinite(stretch) and (stretch > 0.0 or rest == 0.0):
        return ''
    more = ' greater than 0' if rest else ''
    name = (STRETCH if rest else DEFLECTION).name
    return f'{name} is {stretch:g}: expected a finite number{more}'


@dataclass(frozen=True)
class Setpoint:
    """
    A stretch and how long it lasts, the paper's (lambda_d, span).

    Attributes
    ----------
    stretch : float
        Target; the deflection of a beam.
    span : float
        Time from leaving the previous setpoint to leaving this one, greater than 0; infinite
        for the last one of a sequence that is held.

    Raises
    ------
    BadInputError
        If a value is not in range.

    """

    stretch: float
    span: float

    def __post_init__(self) -> None:
        """Check both numbers."""
        if not math.isfinite(self.stretch):
            raise BadInputError(f'stretch is {self.stretch:g}: expected a finite number')
        if not self.span > 0.0:
            raise BadInputError(f'span is {self.span:g}: expected a number greater than 0')
