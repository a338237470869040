"""What nodes measure against a clock that does not step: steps of the wall clock."""

# Less is the clock being slewed, or the two readings being apart.
_STEP_NS = 5_000_000


class StepWatch:
    """Detects that a clock has been set back."""

    def __init__(self) -> None:
        self._offset: int | None = None

    def set_back(self, before: int, now: int, after: int) -> int:
        """Return by how many ns the clock was set back since the last reading; 0 if it was not."""
        # Steady time just before and just after the reading, in ns.
        if after - before > _STEP_NS:
            # Interrupted between the readings: they do not belong together.
            return 0
        offset = now - after
        last, self._offset = self._offset, offset
        if last is None or last - offset < _STEP_NS:
            return 0
        return last - offset
