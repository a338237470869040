"""
The stream of stamped commands, as the planner sends it and the plant obeys it.

A command applies from its stamp on and supersedes all earlier ones stamped at or after it.
"""

from bisect import bisect_left, bisect_right
from collections import deque
from collections.abc import Iterator
import math
from typing import Generic, TypeVar

T = TypeVar('T')


def obeyed(x: float, y: float, z: float) -> bool:
    """Return whether a field in T is one that an actuator obeys: finite, and along z."""
    return math.isfinite(z) and x == 0.0 == y


class Superseding(Generic[T]):
    """Things with stamps in ns, of which a later one drops all stamped at or after it."""

    def __init__(self) -> None:
        """Begin with none."""
        self._stamps: deque[int] = deque()
        self._things: deque[T] = deque()

    def __len__(self) -> int:
        """Return how many there are."""
        return len(self._stamps)

    def __iter__(self) -> Iterator[T]:
        """Yield them by stamp."""
        return iter(self._things)

    def put(self, stamp: int, thing: T) -> None:
        """Add one, and drop what it supersedes."""
        self._drop(stamp)
        self._stamps.append(stamp)
        self._things.append(thing)

    def shift(self, span: int) -> None:
        """Add a span in ns to all stamps."""
        self._stamps = deque(x + span for x in self._stamps)

    def _drop(self, stamp: int) -> int:
        """Drop what is stamped at or after a time; return how many there were."""
        dropped = len(self._stamps) - bisect_left(self._stamps, stamp)
        for _ in range(dropped):
            self._stamps.pop()
            self._things.pop()
        return dropped


class CommandSchedule(Superseding[float]):
    """The level in T in force (NaN before the first command), and the commands ahead."""

    def __init__(self, current: float) -> None:
        """Start with one level and nothing ahead."""
        super().__init__()
        self.current = current

    def insert(self, stamp: int, value: float) -> bool:
        """
        Take a level in T from a stamp in ns on; return whether anything is different from before.

        Commands stamped at or after it are dropped. One that repeats the level of its time, as a
        heartbeat does, adds nothing.
        """
        if self._stamps and self._stamps[-1] == stamp and self._things[-1] == value:
            return False
        dropped = self._drop(stamp)
        if value == (self._things[-1] if self._things else self.current):
            return dropped > 0
        self.put(stamp, value)
        return True

    def at(self, stamp: int) -> float:
        """Return the level in T that is in force at a time in ns, not past, as far as known."""
        known = bisect_right(self._stamps, stamp)
        return self._things[known - 1] if known else self.current

    def ahead(self, since: int = 0) -> list[tuple[int, float]]:
        """Return stamps in ns and levels in T of the commands ahead, from a time on."""
        return [(x, y) for x, y in zip(self._stamps, self._things, strict=True) if x >= since]

    @property
    def next_stamp(self) -> int | None:
        """Stamp in ns of the next command ahead, None if there is none."""
        return self._stamps[0] if self._stamps else None

    def apply_next(self) -> None:
        """Put the next command ahead in force; there must be one."""
        self._stamps.popleft()
        self.current = self._things.popleft()

    def apply_until(self, time: float) -> float:
        """Put what is due by a time in ns in force; return the level in T."""
        while self._stamps and self._stamps[0] <= time:
            self.apply_next()
        return self.current
