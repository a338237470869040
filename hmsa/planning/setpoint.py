"""A setpoint of an actuator: a stretch and its duration."""

from dataclasses import dataclass
import math

from hmsa.errors import BadInputError
from hmsa.model.laws.coordinate import DEFLECTION, STRETCH


def impossible(stretch: float, rest: float) -> str:
    """Return why a stretch is impossible for an actuator with this rest; empty if possible."""
    if math.isfinite(stretch) and (stretch > 0.0 or rest == 0.0):
        return ''
    more = ' greater than 0' if rest else ''
    name = (STRETCH if rest else DEFLECTION).name
    return f'{name} is {stretch:g}: expected a finite number{more}'


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
