"""A bench supply as a current source, with SCPI over a serial line or TCP, and its simulation."""

from collections import deque
import math
import re
from time import monotonic, monotonic_ns
from typing import Any

from hmsa.errors import HmsaError
from hmsa_lab.bench.assembly import Assembly, parts, require
from hmsa_lab.bench.line import OnLine, SimulatedLine
from hmsa_ros.device.watchdog import StateLostError


class SimulatedSupply(SimulatedLine):
    """A simulated bipolar supply of 10 A with its line."""

    limit, step = 10.0, 10.0 / 2**15

    def __init__(self, rest: str = '') -> None:
        super().__init__()
        self.restart()
        self._text = ''

    def restart(self) -> None:
        """Power up: as a voltage source, with its output off."""
        self.current, self.on, self.mode = 0.0, False, 'VOLT'
        self._errors: deque[str] = deque()

    def _obey(self, command: str) -> str | None:
        """Execute a command; return its answer, if any."""
        verb, _, value = command.strip().lstrip(':').upper().partition(' ')
        if verb == '*IDN?':
            return 'hmsa_ros, simulated supply, 0, 1'
        if verb == 'CURR?':
            return f'{self.limit if value == "MAX" else self.current:.6g}'
        if verb == 'OUTP?':
            return str(int(self.on))
        if verb == 'SYST:ERR?':
            return self._errors.popleft() if self._errors else '0,"No error"'
        if verb == '*CLS':
            self._errors.clear()
        elif verb == 'OUTP':
            self.on = value in ('ON', '1')
        elif verb == 'FUNC:MODE' and value in ('CURR', 'VOLT'):
            self.mode = value
        elif verb in ('CURR', 'VOLT'):
            self._set(verb, value)
        else:
            self._errors.append('-113,"Undefined header"')
        return None

    def _set(self, verb: str, value: str) -> None:
        try:
            number = float(value)
        except ValueError:
            self._errors.append('-104,"Data type error"')
            return
        if verb == 'CURR' and not abs(number) <= self.limit:
            self._errors.append('-222,"Data out of range"')
        elif verb == 'CURR':
            self.current = round(number / self.step) * self.step

    # -- the port ------------------------------------------------------------------------------

    def write(self, text: bytes) -> None:
        """Receive bytes from the host."""
        *lines, self._text = (self._text + text.decode('ascii', 'replace')).split('\n')
        for line in lines:
            answers = [x for x in map(self._obey, line.split(';')) if x is not None]
            if answers:
                self._answer += f'{";".join(answers)}\n'.encode()

    def close(self) -> None:
        """Close the line."""


# Time limits in s of an attempt and of a request.
_ATTEMPT, _PATIENCE = 0.2, 0.5
# Minimum number of output steps of a supply.
_STEPS = 4096
_NUMBER = r'([-+]?[\d.]+(?:[eE][-+]?\d+)?)'
# Current, state of the output, and oldest error.
_STATE = re.compile(rf'{_NUMBER};\s*(0|1|ON|OFF);\s*([-+]?\d+),?\s*(.*)')


class SupplyError(HmsaError):
    """A supply that does not answer, or reports an error."""


class Supply(OnLine):
    """
    The supply as a source of current in A.

    It must accept several commands in a line, as in IEEE 488.2. Each level is confirmed in one
    exchange by the set current, the state of the output and the error queue.

    Parameters
    ----------
    port : str
        As in `OnLine`; ``socket://host:port`` for TCP.
    baud : int
        Bits per second of a serial port.
    voltage : float
        Voltage limit in V; infinite for that of the supply.
    resolution : float, optional
        Step of the current in A; by default the largest current divided by 4096.

    Raises
    ------
    BadInputError
        If a setting is out of range.
    SupplyError
        If the supply does not answer, or reports an error.

    """

    error, times, simulate = SupplyError, (_ATTEMPT, _PATIENCE), SimulatedSupply

    def __init__(
            self, port: Any, baud: int = 9600, voltage: float = math.inf,
            resolution: float | None = None) -> None:
        require('baud', baud, positive=True)
        require('voltage', voltage, positive=True)
        require('resolution', 1.0 if resolution is None else resolution, positive=True)
        super().__init__(port, baud)
        self._voltage = voltage
        self.open()
        self.resolution = self.limit / _STEPS if resolution is None else resolution

    def open(self) -> None:
        """Connect or reconnect, and select the current-source mode at 0 A."""
        self.close()
        self.description = self._ask('*CLS;*IDN?', re.compile('(.+)'))[0].strip()
        limit = '' if self._voltage == math.inf else f'VOLT {self._voltage:g};:'
        self._set(f'FUNC:MODE CURR;:{limit}CURR 0;:OUTP ON')
        self.limit = float(self._ask('CURR? MAX', re.compile(_NUMBER))[0])

    def close(self, last_words: bytes = b'OUTP OFF\n') -> None:
        """Switch the output off, and close the line."""
        super().close(last_words)

    def write(self, current: float, now: int) -> tuple[int, float]:
        """
        Set a current in A; return its time, halfway through the exchange, and the actual one.

        Raises
        ------
        SupplyError
            If the supply does not answer, or refuses.
        StateLostError
            If its output was off; it is now on, at 0 A.

        """
        begun = monotonic_ns()
        level, on = self._set(f'CURR {current:.6g}')
        if not on:
            self._set('FUNC:MODE CURR;:CURR 0;:OUTP ON')
            raise StateLostError(f'the output of the supply on {self._port} was off')
        return now + (monotonic_ns() - begun) // 2, level

    def _set(self, text: str) -> tuple[float, bool]:
        """Execute a command; return the set current, and whether the output is on."""
        level, on, number, why = self._ask(f'{text};:CURR?;:OUTP?;:SYST:ERR?', _STATE)
        if int(number):
            raise SupplyError(
                f'the supply on {self._port} refuses {text} (error {number} {why}): expected one '
                'with the SCPI commands FUNC:MODE, CURR, VOLT and OUTP, and levels in its limits')
        return float(level), on in ('1', 'ON')

    def _ask(self, text: str, expected: 're.Pattern[str]') -> tuple[str, ...]:
        """Return the parts of an answer; repeat the request if the answer is unexpected."""
        until, answer, request = monotonic() + _PATIENCE, '', f'{text}\n'.encode()
        while True:
            found = self._use(lambda: next(self._lines(request)))
            answer = (found or b'').decode('ascii', 'replace').strip() or answer
            if parts := expected.fullmatch(answer):
                return parts.groups()
            if monotonic() > until:
                raise SupplyError(
                    f'the supply on {self._port} answers {answer!r} to {text}: expected a supply '
                    'that speaks SCPI, at the same baud')


class ScpiSupply(Assembly):
    """A bench supply and its coil, for ``hardware:=scpi_supply``."""

    def __init__(
            self, joint: str, port: Any = '', baud: int = 9600, voltage: float = math.inf,
            resolution: float | None = None, **settings: Any) -> None:
        coil, scale = parts(settings)
        super().__init__(Supply(port, baud, voltage, resolution), coil, scale)
