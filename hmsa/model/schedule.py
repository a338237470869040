"""
The stream of timestamped commands, with the rules that planner and plant share.

A command applies from its timestamp on and replaces all earlier ones with a timestamp at or after
this time.
"""

from bisect import bisect_left, bisect_right
from collections import deque
from collections.abc import Iterator
import math
from typing import Generic, TypeVar

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
