"""
Delivery of commands to the coil: at any time or on a command grid, in steps or in ramps.

A command contains a level. Ideal hardware applies it at once. Sampled hardware applies commands
only at multiples of a period; an amplifier with a slew limit ramps to the level; the field of a
coil follows its amplifier with a first-order lag.
"""

from collections.abc import Sequence
from dataclasses import dataclass
import math

from hmsa.errors import check_number
from hmsa.model.moves import Level

# Time constants after which a lag has settled.
_SETTLED = 40.0


@dataclass(frozen=True)
class Delivery:
    """Dimensionless properties of the hardware that applies commands."""

    period: float = 0.0  #: commands take effect at multiples of this; 0 for any time
    slew: float = math.inf  #: maximum rate of the load; infinite for steps
    resolution: float = 0.0  #: times of commands are rounded to multiples of this; 0 for none
    lag: float = 0.0  #: time constant of the field
    #: Vibration that levels of the creep tail may leave, as a fraction of the move.
    ripple: float = 1e-6

    def __post_init__(self) -> None:
        """Check the values."""
        for name, value in (('command period', self.period), ('coil time constant', self.lag)):
            check_number(name, value, least=0.0)
        check_number('slew limit', self.slew, above=0.0, endless=True)
        check_number('creep tolerance', self.ripple, above=0.0, most=1.0)

    @property
    def ideal(self) -> bool:
        """Whether levels apply at any time and at once."""
        return self.period == 0.0 and math.isinf(self.slew) and self.lag == 0.0

    def settling(self, change: float) -> float:
        """Return the time (ramp and lag) in which a signed change of the load settles."""
        return self.ramp(change) + self.lagging

    @property
    def lagging(self) -> float:
        """Time in which a lag settles."""
        return _SETTLED * self.lag

    def rounded(self, time: float) -> float:
        """Return a time, possibly infinite or huge, rounded to a multiple of the resolution."""
        if self.resolution == 0.0 or math.isinf(time / self.resolution):
            return time
        return round(time / self.resolution) * self.resolution

    def ramp(self, change: float) -> float:
        """Return the duration of a signed change of the load; 0 without a slew limit."""
        return 0.0 if math.isinf(self.slew) else abs(change) / self.slew


IDEAL = Delivery()

#: Start time, initial load and rate of the load.
Piece = tuple[float, float, float]


def late(pieces: Sequence[Piece], end: float, field: float, lag: float) -> float:
    """Return the lagging load at a time after the amplifier's pieces."""
    for i, (begin, load, slope) in enumerate(pieces):
        span = (pieces[i + 1][0] if i + 1 < len(pieces) else end) - begin
        line = load - slope * lag
        field = line + slope * span + (field - line) * math.exp(-span / lag)
    return field


def ramps(
        levels: Sequence[Level], load: float, end: float,
        slew: float) -> tuple[list[Piece], float]:
    """
    Return the pieces of the load for some levels, and the last load.

    Levels are ordered by time, the first at the start; ``load`` applies before. ``end`` is not
    before the last level.
    """
    rows: list[Piece] = []
    for number, level in enumerate(levels):
        until = levels[number + 1].time if number + 1 < len(levels) else end
        begin = level.time
        if not math.isinf(slew) and level.load != load:
            sign = math.copysign(1.0, level.load - load)
            reached = begin + abs(level.load - load) / slew
            rows.append((begin, load, sign * slew))
            if reached > until:
                load += sign * slew * (until - begin)
                continue
            begin = reached
        load = level.load
        rows.append((begin, load, 0.0))
    return rows, load
