"""Steps of the wall clock, which nobody announces: held against a clock that does not step."""

# Less is the clock being slewed, or the two readings being apart.
_STEP_NS = 5_000_000


class StepWatch:
    """Tells when a clock has been set back."""

    def __init__(self) -> None:
        """Begin with the first readings."""
        self._offset: int | None = None

    def set_back(self, before: int, now: int, after: int) -> int:
        """
        Compare a reading with the last one.

        Parameters
        ----------
        before, after : int
            Steady time in ns just before and just after.
        now : int
            The reading in ns.

        Returns
        -------
        int
            By how many ns the clock was set back since; 0 if it was not.

        """
        if after - before > _STEP_NS:
            # Interrupted between the readings: they do not belong together.
            return 0
        offset = now - after
        last, self._offset = self._offset, offset
        if last is None or last - offset < _STEP_NS:
            return 0
        return last - offset
