"""
The stream of stamped commands, as the planner sends it and the plant obeys it.

A command applies from its stamp on and supersedes all earlier ones stamped at or after it.
"""

from bisect import bisect_left
from collections import deque


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

    def insert(self, stamp: int, value: float) -> None:
        """
        Take a command; those stamped at or after it are dropped.

        Parameters
        ----------
        stamp : int
            Time in ns from which the value applies.
        value : float
            Level in T.

        """
        for _ in range(len(self._stamps) - bisect_left(self._stamps, stamp)):
            self._stamps.pop()
            self._values.pop()
        self._stamps.append(stamp)
        self._values.append(value)

    @property
    def next_stamp(self) -> int | None:
        """Stamp in ns of the next command ahead, None if there is none."""
        return self._stamps[0] if self._stamps else None

    def apply_next(self) -> None:
        """Put the next command ahead in force; there must be one."""
        self._stamps.popleft()
        self.current = self._values.popleft()
