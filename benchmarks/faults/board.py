"""A board on a serial line: holds the level of a coil, measures, and fails as boards do."""

from collections.abc import Callable
import os
from pathlib import Path
import select
import threading
from time import monotonic
import tty

_POLL = 0.005
# Time in s between two looks at the line from which on the host halted the board: ten polls.
_HALT = 0.05


class Board:
    """
    A thread on a pseudo-terminal that answers requests, one per line.

    ``L level boots`` sets a level in T unless ``boots`` is of another boot (0 for any); the answer
    is ``K level boots``. ``R`` is answered by ``S stretch rate boots``. Stretch is 1 + level here.

    Parameters
    ----------
    port : Path
        Path of the line; renewed by each `plug`.
    watchdog : float
        Time in s without a level after which the firmware switches off; 0 for never.

    Attributes
    ----------
    record : list of (float, float)
        The actual level: time in s of `time.monotonic`, and level in T from then on.
    largest : float
        Level in T at which the amplifier saturates.
    answer : callable
        Makes the answer from the correct one; an empty answer is not sent.

    """

    def __init__(self, port: Path, watchdog: float = 0.0) -> None:
        """Switch on and plug in."""
        self._port, self._watchdog = port, watchdog
        self.record: list[tuple[float, float]] = [(monotonic(), 0.0)]
        self.largest = 1.0
        self.answer: Callable[[str], str] = str
        self._boots = 1
        self._fed = monotonic()
        self._fds: tuple[int, int] | None = None
        self._turn = threading.RLock()
        self._ended = False
        self._halts: list[tuple[float, float]] = []
        self.plug()
        threading.Thread(target=self._work, daemon=True).start()

    @property
    def level(self) -> float:
        """Present level in T."""
        return self.record[-1][1]

    def off_since(self, time: float) -> float:
        """Return how long after a time the coil was off, in s; infinite if it is not."""
        if self.level:
            return float('inf')
        return max(next((x for x, level in self.record if x > time and not level), time) - time,
                   0.0)

    def largest_since(self, time: float) -> float:
        """Return the largest level set after a time."""
        return max((abs(level) for x, level in self.record if x > time), default=0.0)

    def off_within(self, time: float, limit: float) -> bool:
        """Return whether the coil was off in time, without that for which the host halted."""
        return self.off_since(time) < limit + self.halted_since(time)

    def halted_since(self, time: float) -> float:
        """Return for how long in s the host halted the board after a time."""
        return sum(length for x, length in self._halts if x > time)

    def plug(self) -> None:
        """Plug the cable in: a new line at the same path."""
        with self._turn:
            self.unplug()
            controller, line = os.openpty()
            tty.setraw(line)
            self._fds, self._waiting = (controller, line), b''
            self._port.unlink(missing_ok=True)
            self._port.symlink_to(os.ttyname(line))

    def unplug(self) -> None:
        """Pull the cable out; the level persists."""
        with self._turn:
            if self._fds is not None:
                self._port.unlink(missing_ok=True)
                for fd in self._fds:
                    os.close(fd)
                self._fds = None

    def reboot(self) -> None:
        """Lose the level and count the boot."""
        self._set(0.0)
        self._boots += 1

    def end(self) -> None:
        """Switch off."""
        self._ended = True
        self.unplug()

    def _set(self, level: float) -> None:
        if level != self.level:
            self.record.append((monotonic(), level))

    def _work(self) -> None:
        looked = monotonic()
        while not self._ended:
            now = monotonic()
            if now - looked > _HALT:
                self._halts.append((now, now - looked))
            looked = now
            with self._turn:
                fds = self._fds
                if fds is not None and select.select([fds[0]], [], [], 0.0)[0]:
                    read = self._waiting + os.read(fds[0], 1000)
                    *lines, self._waiting = read.split(b'\n')
                    for line in lines:
                        if answer := self.answer(self._obey(line.decode())):
                            os.write(fds[0], answer.encode() + b'\n')
                    continue
            if self._watchdog and monotonic() - self._fed > self._watchdog:
                self._set(0.0)
            select.select([], [], [], _POLL)

    def _obey(self, line: str) -> str:
        word, *values = line.split()
        if word != 'L':
            return f'S {1.0 + self.level!r} 0.0 {self._boots}'
        level, boots = values
        if boots in ('0', str(self._boots)):
            self._fed = monotonic()
            self._set(max(-self.largest, min(float(level), self.largest)))
        return f'K {self.level!r} {self._boots}'
