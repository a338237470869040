"""A steady clock, and detection of wall clock steps with it."""

from functools import partial
import time

from hmsa.model.units import NANOSECONDS

# Smaller differences may be due to the time between two readings.
_STEP_NS = 5_000_000

#: Returns the time in ns of a clock that is never set, and that counts the time for which the
#: computer is suspended: that time is a stall, and no step of the wall clock.
steady_ns = partial(time.clock_gettime_ns, time.CLOCK_BOOTTIME) if hasattr(
    time, 'CLOCK_BOOTTIME') else time.monotonic_ns


class StepWatch:
    """Detect that a clock has been set."""

    def __init__(self) -> None:
        self._offset: int | None = None

    def step(self, before: int, now: int, after: int) -> int:
        """Return the ns by which the clock was set ahead since the last reading; 0 if not."""
        # ``before`` and ``after`` are steady times in ns around the reading ``now``.
        if after - before > _STEP_NS:
            # The process was interrupted between the readings, so they cannot be compared.
            return 0
        offset = now - after
        last, self._offset = self._offset, offset
        if last is None or abs(offset - last) < _STEP_NS:
            return 0
        return offset - last


def clock_set_words(by: int, what: str) -> str:
    """Return a message that a clock was set ahead by some ns, and what continues unchanged."""
    return (f'the clock of this host was set {"ahead" if by > 0 else "back"} by '
            f'{abs(by) / NANOSECONDS:.3f} s: {what} as long from now as before; have it slewed, '
            'not set, while an experiment runs')
