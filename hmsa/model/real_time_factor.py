"""Simulated time relative to a steady clock: real-time factor, pause and resume."""


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

    @property
    def unlimited(self) -> bool:
        """Whether the simulation runs as fast as possible."""
        return self.factor == 0.0

    def target(self, steady: int) -> int:
        """Return the simulated time in ns due at a steady time; meaningless if `unlimited`."""
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
