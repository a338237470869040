"""An interlock: who has opened it, and who has to keep it closed."""

from collections.abc import Callable, Collection

from hmsa_ros.model.units import NANOSECONDS

# Once open, it stays open so long, in ns: planners have heard of it then, or send nothing more.
_LEAST = NANOSECONDS


class Interlock:
    """
    Follows who says that a coil may be on; times in ns are of a clock that is never set.

    It is open while a publisher has said so last. Where it is ``required``, it is also open before
    one has closed it, and after one has been silent for longer than ``timeout``. A publisher that
    has left takes nothing back: one that closes it anew, and has not said so before, does.
    """

    def __init__(self, *, required: bool, timeout: int) -> None:
        self.required, self._timeout = required, timeout
        # Whether each publisher has closed it, and when it said so.
        self._said: dict[bytes, tuple[bool, int]] = {}
        self._until = 0
        self.why = ''  #: it is open; empty while it is closed
        self.openings = 0

    def hear(
            self, publisher: bytes, now: int, *, closed: bool,
            present: Callable[[], Collection[bytes]]) -> None:
        """Take in what a publisher says; ``present`` returns those that have not left."""
        anew = closed and not self._said.get(publisher, (False, 0))[0]
        self._said[publisher] = closed, now
        if anew and not all(x for x, _ in self._said.values()):
            here = present()
            self._said = {x: said for x, said in self._said.items() if said[0] or x in here}
        if not closed:
            # Also where it is taken back before anybody looks.
            self._open('a publisher has opened it', now)

    def look(self, now: int) -> str:
        """Return why it is open; empty if it is closed."""
        if self.required:
            for publisher, (closed, when) in self._said.items():
                if closed and now - when > self._timeout:
                    self._said[publisher] = False, when
                    self._open(
                        f'a publisher that closed it has been silent for more than '
                        f'{self._timeout / NANOSECONDS:g} s', now)
            if not self._said:
                self._open('no publisher has closed it', now)
        if all(x for x, _ in self._said.values()) and now >= self._until:
            self.why = ''
        return self.why

    def _open(self, why: str, now: int) -> None:
        if not self.why:
            self.openings += 1
        self.why, self._until = why, now + _LEAST
