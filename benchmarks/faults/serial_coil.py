"""Example of a laboratory's hardware class for `benchmarks.faults.board`."""

import builtins
import ctypes
import os
import time

from hmsa_ros.device import StateLostError


class SerialCoil:
    """A coil and a sensor on a serial line."""

    resolution = 1e-6

    def __init__(self, joint: str, port: str, sleep: float = 0.0) -> None:
        """Open the port, which takes a while on some boards."""
        time.sleep(sleep)
        self._port = port
        self._line = -1
        self.open()

    def open(self) -> None:
        """Open the port (again)."""
        self.close()
        self._line = os.open(self._port, os.O_RDWR | os.O_NOCTTY)
        self._boots = ''

    def close(self) -> None:
        """Close the port."""
        if self._line >= 0:
            os.close(self._line)
        self._line = -1

    def _ask(self, line: str) -> list[str]:
        os.write(self._line, line.encode() + b'\n')
        answer = b''
        while not answer.endswith(b'\n'):
            part = os.read(self._line, 100)
            if not part:
                raise OSError('the line is closed')
            answer += part
        word, *values, boots = answer.decode().split()
        if word == 'RAISE':  # as the software of a vendor may
            raise getattr(builtins, boots)
        if word == 'HANG':  # holding the GIL, as a badly made extension does
            ctypes.PyDLL(None).sleep(60)
        before, self._boots = self._boots, boots
        if before not in ('', boots):
            raise StateLostError(f'boot {boots}')
        return values

    def write(self, level: float, now: int) -> tuple[int, float]:
        """Set a level in T; return the time and the actual level."""
        (really,) = self._ask(f'L {level!r} {self._boots or 0}')
        return time.time_ns(), float(really)

    def read(self, now: int) -> tuple[float, float]:
        """Return stretch and rate."""
        stretch, rate = self._ask('R')
        return float(stretch), float(rate)
