"""Readings of a sensor in chronological order, relative to those of a reference."""

from bisect import bisect_right, insort
import heapq

import numpy as np

from hmsa.model.equations import Array

# Number of reference readings stored for interpolation.
_KEPT = 1000


class Readings:
    """
    Sort readings by their timestamps, and subtract those of a reference.

    A reading is a number or a vector. The result for a vector, or a difference of vectors, is its
    length.

    Parameters
    ----------
    window : int
        Time to wait for an earlier reading, in ns; one that arrives later is discarded.
    reference : bool
        Whether there is a reference. It is interpolated between its readings; readings before the
        first one are discarded.

    """

    def __init__(self, window: int = 0, *, reference: bool = False) -> None:
        self._window, self._needs_reference = window, reference
        # By timestamp: waiting readings, each with the end of its wait and its number.
        self._waiting: list[tuple[int, int, int, Array]] = []
        self._reference: list[tuple[int, Array]] = []
        self._last = 0
        self.count = 0  # number of readings
        self.late = 0  # number discarded since a later one was returned before

    def take(self, stamp: int, reading: Array, now: int) -> None:
        """Add a reading with a timestamp in ns; ``now`` is a steady time in ns."""
        self.count += 1
        if stamp <= self._last:
            self.late += 1
        else:
            heapq.heappush(self._waiting, (stamp, now + self._window, self.count, reading))

    def take_reference(self, stamp: int, reading: Array) -> None:
        """Add a reading of the reference."""
        insort(self._reference, (stamp, reading), key=lambda x: x[0])
        del self._reference[:-_KEPT]

    def due(self, now: int) -> list[tuple[int, float]]:
        """Return timestamps and values of the readings whose wait is over."""
        until = max((x[0] for x in self._waiting if x[1] <= now), default=0)
        found = []
        while self._waiting and self._waiting[0][0] <= until:
            stamp, _, _, reading = heapq.heappop(self._waiting)
            if self._needs_reference:
                if not self._reference or self._reference[0][0] > stamp:
                    continue
                reading = reading - self._at(stamp)
            self._last = stamp
            number = reading[0] if len(reading) == 1 else np.linalg.norm(reading)
            found.append((stamp, float(number)))
        return found

    def _at(self, stamp: int) -> Array:
        """Interpolate the reference at a time; after its last reading, that reading applies."""
        place = bisect_right(self._reference, stamp, key=lambda x: x[0])
        before, reading = self._reference[place - 1]
        if place == len(self._reference):
            return reading
        after, next_reading = self._reference[place]
        return reading + (next_reading - reading) * ((stamp - before) / (after - before))
