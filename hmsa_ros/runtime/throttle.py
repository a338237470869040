"""Limit the rate of reports."""

from time import monotonic


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
        now = monotonic()
        if now < self._next:
            return False
        self._next = now + 1.0
        return True
