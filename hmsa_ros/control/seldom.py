"""Reports that would come too often."""

from time import monotonic


class Seldom:
    """
    Says at most once a second that it is time to report something again.

    A logger's own throttle looks for the place in the code that it is called from before it
    decides, which takes up to a millisecond: too long for what may come a thousand times a
    second.
    """

    def __init__(self) -> None:
        self._next = 0.0

    def __call__(self) -> bool:
        """Return whether it is time."""
        now = monotonic()
        if now < self._next:
            return False
        self._next = now + 1.0
        return True
