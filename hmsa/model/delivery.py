"""
Delivery of commands to the coil: their stream, and how hardware applies them.

A command contains a level that applies from its timestamp on, and replaces all earlier commands
with a timestamp at or after this time: planner and plant share these rules. Ideal hardware applies
a level at once, at any time. Sampled hardware applies commands only at multiples of a period; an
amplifier with a slew limit ramps to the level; the field of a coil follows its amplifier with a
first-order lag.
"""

from bisect import bisect_left, bisect_right
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
import math
from typing import Generic, TypeVar

from hmsa.errors import check_number
from hmsa.model.moves import Level

T = TypeVar('T')


def is_axial_field(x: float, y: float, z: float) -> bool:
    """Return whether a field in T is a valid command: finite, and along z."""
    return math.isfinite(z) and x == 0.0 == y


class Superseding(Generic[T]):
    """Items with timestamps in ns; a new item drops all with a timestamp at or after its own."""

    def __init__(self) -> None:
        """Begin without items."""
        self._stamps: deque[int] = deque()
        self._things: deque[T] = deque()

    def __len__(self) -> int:
        """Return the number of items."""
        return len(self._stamps)

    def __iter__(self) -> Iterator[T]:
        """Yield the items by timestamp."""
        return iter(self._things)

    def put(self, stamp: int, thing: T) -> None:
        """Add an item, and drop those that it replaces."""
        self._drop(stamp)
        self._stamps.append(stamp)
        self._things.append(thing)

    def shift(self, span: int) -> None:
        """Shift all timestamps by some ns."""
        self._stamps = deque(x + span for x in self._stamps)

    def _drop(self, stamp: int) -> int:
        """Drop items at or after a time; return their number."""
        dropped = len(self._stamps) - bisect_left(self._stamps, stamp)
        for _ in range(dropped):
            self._stamps.pop()
            self._things.pop()
        return dropped


class CommandSchedule(Superseding[float]):
    """The present level in T (NaN before the first command), and future commands."""

    def __init__(self, current: float) -> None:
        """Start with one level and no future commands."""
        super().__init__()
        self.current = current

    def insert(self, stamp: int, value: float) -> bool:
        """
        Take a level in T from a timestamp in ns on; return whether this changes anything.

        Commands at or after the timestamp are dropped. A command that repeats the level at its
        time, such as a heartbeat, adds nothing.
        """
        if self._stamps and self._stamps[-1] == stamp and self._things[-1] == value:
            return False
        dropped = self._drop(stamp)
        if value == (self._things[-1] if self._things else self.current):
            return dropped > 0
        self.put(stamp, value)
        return True

    def at(self, stamp: int) -> float:
        """Return the level in T at a present or future time in ns, as far as known."""
        known = bisect_right(self._stamps, stamp)
        return self._things[known - 1] if known else self.current

    def ahead(self, since: int = 0) -> list[tuple[int, float]]:
        """Return timestamps in ns and levels in T of future commands, from a time on."""
        return [(x, y) for x, y in zip(self._stamps, self._things, strict=True) if x >= since]

    @property
    def next_stamp(self) -> int | None:
        """Timestamp in ns of the next command, None if there is none."""
        return self._stamps[0] if self._stamps else None

    def apply_next(self) -> None:
        """Apply the next command; there must be one."""
        self._stamps.popleft()
        self.current = self._things.popleft()

    def apply_until(self, time: float) -> float:
        """Apply the commands due by a time in ns; return the level in T."""
        while self._stamps and self._stamps[0] <= time:
            self.apply_next()
        return self.current


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
