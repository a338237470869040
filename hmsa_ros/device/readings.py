"""Readings of a sensor in the order in which they were taken, against those of a reference."""

from bisect import bisect_right, insort
import heapq

import numpy as np

from hmsa_ros.model.equations import Array

# Of the reference, how many readings are kept to interpolate between.
_KEPT = 1000


class Readings:
    """
    Sorts readings by their timestamps, and takes those of a reference off.

    A reading is a number or a vector; of a vector, or of the difference of two, the length counts.

    Parameters
    ----------
    window : int
        How long to wait for an earlier reading, in ns; one that comes later is left out.
    reference : bool
        Whether there is a reference. Between two of its readings it is interpolated; before the
        first one there is nothing to report.

    """

    def __init__(self, window: int = 0, *, reference: bool = False) -> None:
        self._window, self._needs_reference = window, reference
        # By timestamp: what is waiting, with the time until which it does and its number.
        self._waiting: list[tuple[int, int, int, Array]] = []
        self._reference: list[tuple[int, Array]] = []
        self._last = 0
        self.count = 0  # of the readings that were taken in
        self.late = 0  # of those left out since a later one was given out before

    def take(self, stamp: int, reading: Array, now: int) -> None:
        """Take a reading of a timestamp in ns; ``now`` is a time in ns that never goes back."""
        self.count += 1
        if stamp <= self._last:
            self.late += 1
        else:
            heapq.heappush(self._waiting, (stamp, now + self._window, self.count, reading))

    def take_reference(self, stamp: int, reading: Array) -> None:
        """Take a reading of the reference."""
        insort(self._reference, (stamp, reading), key=lambda x: x[0])
        del self._reference[:-_KEPT]

    def due(self, now: int) -> list[tuple[int, float]]:
        """Return timestamps and numbers of the readings for which nothing is waited any more."""
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
        """Return the reference at a time from its first reading on; the last one holds on."""
        place = bisect_right(self._reference, stamp, key=lambda x: x[0])
        before, reading = self._reference[place - 1]
        if place == len(self._reference):
            return reading
        after, next_reading = self._reference[place]
        return reading + (next_reading - reading) * ((stamp - before) / (after - before))
