"""Watchdog: what the coil does when nobody commands it any more."""

from hmsa_ros.errors import BadInputError

#: What to do: keep the last level, go to zero at once, or ramp to zero.
SAFE_FLUX = ('hold', 'zero', 'ramp')


class Watchdog:
    """
    Notices that commands and heartbeats have ceased.

    Armed by the first command, so that an actuator nobody has moved yet raises no alarm.

    Parameters
    ----------
    timeout : int
        Longest silence in ns; 0 for any.

    Attributes
    ----------
    tripped : bool
        Whether the silence has lasted too long.
    trips : int
        How often it has.

    """

    def __init__(self, timeout: int) -> None:
        """Start unarmed."""
        if timeout < 0:
            raise BadInputError(f'timeout is {timeout} ns: expected at least 0')
        self._timeout = timeout
        self._last: int | None = None
        self.tripped = False
        self.trips = 0

    def feed(self, now: int) -> bool:
        """
        Take a sign of life.

        Parameters
        ----------
        now : int
            Time in ns.

        Returns
        -------
        bool
            Whether it ends an alarm.

        """
        recovered = self.tripped
        self.tripped = False
        self._last = now
        return recovered

    def check(self, now: int) -> bool:
        """
        Look at the time.

        Parameters
        ----------
        now : int
            Time in ns; one that has jumped back begins the silence anew.

        Returns
        -------
        bool
            Whether the alarm is raised now.

        """
        if self._last is None or self.tripped or self._timeout == 0:
            return False
        self._last = min(self._last, now)
        if now - self._last <= self._timeout:
            return False
        self.tripped = True
        self.trips += 1
        return True

    def pass_over(self, span: int) -> None:
        """
        Leave out a span of time, which was no silence.

        Parameters
        ----------
        span : int
            In ns.

        """
        if self._last is not None:
            self._last += span

    def disarm(self) -> None:
        """Wait for a first command again."""
        self._last = None
        self.tripped = False
