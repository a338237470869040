"""An interlock that publishers open and close, and the status of a device: commands, hardware."""

from collections.abc import Callable, Collection, Sequence

from hmsa.errors import listed
from hmsa.model.units import NANOSECONDS

# Minimum time open in ns, for planners to receive that state or to stop sending.
_LEAST = NANOSECONDS

_OK, _WARN, _ERROR = 0, 1, 2


class Interlock:
    """
    Combine the messages of publishers about an interlock; times in ns by a steady clock.

    It is open while the last message of any publisher opens it. If ``required``, it is also open
    until a publisher closes it, and after a publisher has been silent for longer than ``timeout``.
    An opening by a publisher that has left remains in force until another publisher newly closes
    the interlock.
    """

    def __init__(self, *, required: bool, timeout: int) -> None:
        self.required, self._timeout = required, timeout
        # State and time of the last message of each publisher.
        self._messages: dict[bytes, tuple[bool, int]] = {}
        self._until = 0
        self.why = ''  #: reason why it is open; empty while it is closed
        self.openings = 0

    def receive(
            self, publisher: bytes, now: int, *, closed: bool,
            present: Callable[[], Collection[bytes]]) -> None:
        """Process a message of a publisher; ``present`` returns those that have not left."""
        newly = closed and not self._messages.get(publisher, (False, 0))[0]
        self._messages[publisher] = closed, now
        if newly and not all(x for x, _ in self._messages.values()):
            here = present()
            self._messages = {x: y for x, y in self._messages.items() if y[0] or x in here}
        if not closed:
            # Also if it is closed again before the next look.
            self._open('a publisher has opened it', now)

    def look(self, now: int) -> str:
        """Return why it is open; empty if it is closed."""
        if self.required:
            for publisher, (closed, when) in self._messages.items():
                if closed and now - when > self._timeout:
                    self._messages[publisher] = False, when
                    self._open(
                        f'a publisher that closed it has been silent for more than '
                        f'{self._timeout / NANOSECONDS:g} s', now)
            if not self._messages:
                self._open('no publisher has closed it', now)
        if all(x for x, _ in self._messages.values()) and now >= self._until:
            self.why = ''
        return self.why

    def _open(self, why: str, now: int) -> None:
        if not self.why:
            self.openings += 1
        self.why, self._until = why, now + _LEAST


def judge_commands(
        *, late: int = 0, refused: int = 0, refused_source: int = 0, failed: int = 0,
        silent: Sequence[str] = (), crowded: Sequence[str] = (),
        rivals: str = '') -> tuple[int, str]:
    """
    Return the status for /diagnostics: level (0 OK, 1 WARN, 2 ERROR) and message.

    It depends on counts, on the joints without commands (``silent``) or with several publishers
    (``crowded``), and on other devices (``rivals``).
    """
    refused += refused_source
    return _verdict(
        'commands in time', (_ERROR, rivals),
        (_WARN, f'{late} commands late, {refused} refused' if late or refused else ''),
        (_WARN, f'several publishers command {listed(crowded)}' if crowded else ''),
        (_ERROR, f'{failed} times started again after a load too large to follow'
         if failed else ''),
        (_ERROR, f'no command and no heartbeat for {listed(silent)}' if silent else ''))


def judge_hardware(trouble: str, *, saturated: int, state_lost: int) -> tuple[int, str]:
    """Return the status of hardware from an error and counts."""
    return (_ERROR, trouble) if trouble else _verdict(
        'hardware obeys',
        (_WARN, f'{saturated} levels not reached: the amplifier is saturated'
         if saturated else ''),
        (_WARN, f'its state was lost, times: {state_lost}' if state_lost else ''))


def _verdict(fine: str, *notes: tuple[int, str]) -> tuple[int, str]:
    """Return the worst level of the notes, and all their messages."""
    present = [x for x in notes if x[1]]
    return max((x for x, _ in present), default=_OK), '; '.join(x for _, x in present) or fine


def judge_interlock(why: str) -> tuple[int, str]:
    """Return the status of an interlock from the reason why it is open."""
    return (_ERROR, f'open: {why}') if why else (_OK, 'closed')
