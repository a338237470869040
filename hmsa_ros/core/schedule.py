"""
The stream of stamped commands, as the planner sends it and the plant obeys it.

A command applies from its stamp on and supersedes all earlier ones stamped at or after it.
"""

from bisect import bisect_left, bisect_right
from collections import deque
import math


def obeyed(x: float, y: float, z: float) -> bool:
    """
    Return whether a field is one that an actuator obeys.

    Parameters
    ----------
    x, y, z : float
        Flux density in T; the actuator moves along z.

    Returns
    -------
    bool
        Whether it is finite, and along z.

    """
    return math.isfinite(z) and x == 0.0 == y


class CommandSchedule:
    """
    The level in force and the commands ahead.

    Parameters
    ----------
    current : float
        Level in force before the first command, in T.

    """

    def __init__(self, current: float) -> None:
        """Start with one level and nothing ahead."""
        self.current = current
        self._stamps: deque[int] = deque()
        self._values: deque[float] = deque()

    def __len__(self) -> int:
        """Return the number of commands ahead."""
        return len(self._stamps)

    def insert(self, stamp: int, value: float) -> bool:
        """
        Take a command; those stamped at or after it are dropped.

        One that repeats the level of its time, as a heartbeat does, adds nothing.

        Parameters
        ----------
        stamp : int
            Time in ns from which the value applies.
        value : float
            Level in T.

        Returns
        -------
        bool
            Whether anything is different from before.

        """
        dropped = len(self._stamps) - bisect_left(self._stamps, stamp)
        if dropped == 1 and self._stamps[-1] == stamp and self._values[-1] == value:
            return False
        for _ in range(dropped):
            self._stamps.pop()
            self._values.pop()
        if value == (self._values[-1] if self._values else self.current):
            return dropped > 0
        self._stamps.append(stamp)
        self._values.append(value)
        return True

    def at(self, stamp: int) -> float:
        """
        Return the level in force at a time, as far as is known.

        Parameters
        ----------
        stamp : int
            Time in ns, not past.

        Returns
        -------
        float
            In T.

        """
        known = bisect_right(self._stamps, stamp)
        return self._values[known - 1] if known else self.current

    @property
    def next_stamp(self) -> int | None:
        """Stamp in ns of the next command ahead, None if there is none."""
        return self._stamps[0] if self._stamps else None

    def apply_next(self) -> None:
        """Put the next command ahead in force; there must be one."""
        self._stamps.popleft()
        self.current = self._values.popleft()
