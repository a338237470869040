"""Lines to instruments: pyserial ports, and simulated ones."""

from collections.abc import Callable, Iterator
from contextlib import suppress
from importlib import import_module
import sys
from time import monotonic
from typing import Any

from hmsa.errors import BadInputError, HmsaError

#: Port of a simulated instrument, which receives the text after a colon.
SIMULATED = 'sim'


class OnLine:
    """
    Base of instruments on a line, which is opened on use and reopened after a loss.

    A subclass defines the ``error`` raised for a lost line, the time limits in s of an attempt and
    of a write as ``times``, and ``simulate``, which creates a simulated instrument from the text
    after the colon of `SIMULATED`.

    Parameters
    ----------
    port : str
        A device, a URL such as ``socket://host:port``, or `SIMULATED`.
    baud : int
        Bits per second.

    """

    error: type[HmsaError]
    times: tuple[float, float]
    simulate: Callable[[str], Any]
    _line: Any = None

    def __init__(self, port: Any, baud: int) -> None:
        self._port, self._baud = port, int(baud)

    def _open(self) -> Any:
        """Return an open port, as `serial.Serial`; raise `BadInputError` if there is none."""
        port = self._port
        if not isinstance(port, str) or not port:
            raise BadInputError(
                f'port is {port!r}: expected a serial port, as /dev/ttyACM0, or {SIMULATED} for a '
                'simulated instrument')
        kind, _, rest = port.partition(':')
        if kind == SIMULATED:
            return self.simulate(rest)
        try:
            serial = import_module('serial')
        except ImportError as error:
            raise BadInputError(
                'pyserial, which serial ports need, is not installed: install it (pip install '
                f'pyserial), or use the port {SIMULATED} for a simulated instrument') from error
        return serial.serial_for_url(
            port, self._baud, timeout=self.times[0], write_timeout=self.times[1], exclusive=True)

    def _use(self, act: Callable[[], Any]) -> Any:
        """Call a function with an open line; return None if a write times out."""
        try:
            if self._line is None:
                self._line = self._open()
            return act()
        except HmsaError:
            raise
        except Exception as error:  # a lost port may raise any error
            if isinstance(error, getattr(
                    sys.modules.get('serial'), 'SerialTimeoutException', ())):
                return None
            with suppress(Exception):
                OnLine.close(self)
            raise self.error(
                f'the line {self._port} failed ({error}): check hardware.port, its cable, and '
                'that no other program uses it') from error

    def _lines(self, request: bytes) -> Iterator[bytes]:
        """Send a request; yield the received lines, then the rest at the end of an attempt."""
        self._line.reset_input_buffer()
        self._line.write(request)
        text, until = b'', monotonic() + self.times[0]
        while monotonic() < until:
            text += self._line.read(max(self._line.in_waiting, 1))
            *lines, text = text.split(b'\n')
            yield from lines
        yield text

    def close(self, last_words: bytes = b'') -> None:
        """Close the line, after writing ``last_words``."""
        line, self._line = self._line, None
        if line is not None:
            try:
                if last_words:
                    line.write(last_words)
            finally:
                line.close()


class SimulatedLine:
    """
    The host side of a simulated instrument, with the required members of a pyserial port.

    A subclass defines ``write``, which may append to ``_answer``, and ``close``.
    """

    def __init__(self) -> None:
        self._answer = b''

    @property
    def in_waiting(self) -> int:
        """Number of bytes available."""
        return len(self._answer)

    def read(self, size: int) -> bytes:
        """Return bytes for the host."""
        found, self._answer = self._answer[:size], self._answer[size:]
        return found

    def reset_input_buffer(self) -> None:
        """Discard unread bytes."""
        self._answer = b''
