"""A steady clock, with it steps of the wall clock, time at another speed, and a limit of rates."""

from collections.abc import Callable
from functools import partial
import math
import time

from hmsa.model.units import NANOSECONDS

# Smaller differences may be due to the time between two readings.
_STEP_NS = 5_000_000
# Number of readings after each of which the process may be interrupted.
_ATTEMPTS = 5

#: Returns the time in ns of a clock that is never set, and that counts the time for which the
#: computer is suspended: that time is a stall, and no step of the wall clock.
steady_ns = partial(time.clock_gettime_ns, time.CLOCK_BOOTTIME) if hasattr(
    time, 'CLOCK_BOOTTIME') else time.monotonic_ns


class StepWatch:
    """
    Read a clock, and detect that it has been set.

    Parameters
    ----------
    clock, steady : callable
        Return the time of the clock, and of a steady one, in ns.

    """

    def __init__(
            self, clock: Callable[[], int] = time.time_ns,
            steady: Callable[[], int] = steady_ns) -> None:
        self._clock, self._steady = clock, steady
        self._offset: int | None = None

    def read(self) -> tuple[int, int]:
        """Return the time in ns, and by how many ns the clock was set ahead since the last one."""
        for _ in range(_ATTEMPTS):
            before, now, after = self._steady(), self._clock(), self._steady()
            # If the process was interrupted between the readings, they cannot be compared.
            if after - before <= _STEP_NS:
                break
        else:
            # A clock that was set is found next time. Until then, its time is the former one.
            return now if self._offset is None else after + self._offset, 0
        offset = now - after
        last, self._offset = self._offset, offset
        return now, 0 if last is None or abs(offset - last) < _STEP_NS else offset - last


def clock_set_words(by: int, what: str) -> str:
    """Return a message that a clock was set ahead by some ns, and what continues unchanged."""
    return (f'the clock of this host was set {"ahead" if by > 0 else "back"} by '
            f'{abs(by) / NANOSECONDS:.3f} s: {what} as long from now as before; let the time '
            'service slew the clock, not set it, while an experiment runs')


class RealTimeFactor:
    """
    Time that a simulation should have reached, in ns.

    ``factor`` is in simulated seconds per second; 0 means as fast as possible.
    """

    def __init__(self, start: int, factor: float, *, paused: bool = False) -> None:
        """Begin at a time that advances from the first call of `target` on."""
        self.factor = factor
        self._anchor = start
        self._steady: int | None = None
        self.paused = paused

    def target(self, steady: int) -> float:
        """Return the simulated time in ns due at a steady time; infinite for a factor of 0."""
        if self.factor == 0.0:
            return math.inf
        if self.paused or self._steady is None:
            self._steady = steady
            return self._anchor
        return self._anchor + round((steady - self._steady) * self.factor)

    def set_paused(self, paused: bool, time: int) -> None:
        """Pause or continue from a simulated time in ns that has been reached."""
        self._anchor = time
        self._steady = None
        self.paused = paused

    def set_factor(self, factor: float, time: int) -> None:
        """Continue from a simulated time in ns at another speed; 0 for as fast as possible."""
        self.factor = factor
        self.set_paused(self.paused, time)


class Throttle:
    """
    Permit a report at most once a second.

    The throttle of a logger first determines its calling location in the code, which takes up to a
    millisecond. This is too slow for events that may occur a thousand times a second.
    """

    def __init__(self) -> None:
        self._next = 0.0

    def __call__(self) -> bool:
        """Return whether a report is due."""
        now = time.monotonic()
        if now < self._next:
            return False
        self._next = now + 1.0
        return True
