"""Steps of the wall clock, measured against a clock that does not step."""

from hmsa_ros.model.units import NANOSECONDS

# Less is two readings that are apart.
_STEP_NS = 5_000_000


class StepWatch:
    """Detects that a clock has been set."""

    def __init__(self) -> None:
        self._offset: int | None = None

    def step(self, before: int, now: int, after: int) -> int:
        """Return by how many ns the clock was set ahead since the last reading; 0 for not."""
        # Steady time just before and just after the reading, in ns.
        if after - before > _STEP_NS:
            # Interrupted between the readings: they do not belong together.
            return 0
        offset = now - after
        last, self._offset = self._offset, offset
        if last is None or abs(offset - last) < _STEP_NS:
            return 0
        return offset - last


def clock_set_words(by: int, what: str) -> str:
    """Return that a clock was set ahead by some ns, and what happens as if it was not."""
    return (f'the clock of this host was set {"ahead" if by > 0 else "back"} by '
            f'{abs(by) / NANOSECONDS:.3f} s: {what} as long from now as before; have it slewed, '
            'not set, while an experiment runs')
