"""
A board on a serial line, also a simulated one, that applies levels and samples a sensor.

``hmsa_board/board.hpp`` is its firmware and describes the protocol. Every request may be repeated:
a lost or damaged line costs one attempt.
"""

from binascii import crc_hqx
from collections.abc import Callable, Sequence
from itertools import accumulate
import math
from pathlib import Path
from random import Random
from secrets import randbelow
from time import monotonic, monotonic_ns
from typing import Any, NamedTuple, TextIO

from hmsa.errors import BadInputError, HmsaError
from hmsa.model.parameters import paper_actuator
from hmsa.model.simulation import ActuatorSimulation
from hmsa_lab.bench import _board
from hmsa_lab.bench.assembly import Assembly, parts, require
from hmsa_lab.bench.line import OnLine, SimulatedLine
from hmsa_ros.device.watchdog import StateLostError

_VERSION = 1
# Levels, readings and times are integer multiples of 1e-6 of their unit.
_MILLION = 1e6
# In s: an attempt, a request, and the first request, since opening a port restarts some boards.
_ATTEMPT, _PATIENCE, _BOOT = 0.04, 0.4, 4.0
# Reserve in the board's queue of levels, since its clock differs from the host's.
_SPARE = 2
# Values in a full answer, and the limit on answers, above the capacity of the board.
_PER_ANSWER, _ANSWERS = 7, 20
#: Settings for its driver: T/A, and the length of the block in mm.
TESLA_PER_AMPERE, REST_LENGTH = 0.05, 20.0
# Limit and resolution in uA.
_LIMIT, _RESOLUTION = 10_000_000, 100
# Sampling period in us of its clock.
_PERIOD = 1000
_NOISE = 1e-3  # standard deviation in mm


class BoardError(HmsaError):
    """A board that does not answer, or answers incorrectly."""


class _BoardAnswer(NamedTuple):
    session: int
    verb: str
    values: list[int]


def framed(text: str) -> bytes:
    """Return a line with its checksum."""
    return f'{text}*{crc_hqx(text.encode(), 0xFFFF):04X}\n'.encode()


class Board(OnLine):
    """
    The board as a source of current (or voltage) in A, and as a sensor.

    When its line is closed, a board that is on switches off after its watchdog time.

    Parameters
    ----------
    port : str
        As in `OnLine`; ``sim:FILE`` writes the true motion of a simulated board.
    baud : int
        Bits per second; without effect on USB.
    watchdog : float
        Time in s without a request after which the board switches off.

    Raises
    ------
    BadInputError
        If a setting is out of range.
    BoardError
        If the board does not answer.

    """

    error, times = BoardError, (_ATTEMPT, _PATIENCE)

    @staticmethod
    def simulate(rest: str) -> Any:
        """Return a simulated board (see `OnLine`)."""
        return SimulatedBoard(rest)

    def __init__(self, port: Any, baud: int = 1_000_000, watchdog: float = 0.5) -> None:
        require('baud', baud, positive=True)
        require('watchdog', watchdog, positive=True)
        super().__init__(port, baud)
        self._watchdog = round(watchdog * _MILLION)
        self._number = self._session = 0
        self._lost = False
        self._begin(_BOOT)
        if self._ask('C'):
            self.temperature: Callable[[], float] = self._temperature

    def _temperature(self) -> float:
        """Return the temperature of the coil in degrees Celsius."""
        return self._ask('C', count=1)[0] / _MILLION

    def open(self) -> None:
        """Connect again, without waiting for a restart of the board."""
        self._begin(_PATIENCE)

    def _begin(self, patience: float) -> None:
        """Begin a session, and detect whether the previous one was lost."""
        known, self._session = self._session, 1 + randbelow(2**31 - 1)
        try:
            version, *values, before = self._ask(
                'H', self._session, self._watchdog, patience=patience, count=7)
        except BoardError:
            self._session = known
            raise
        self._lost = self._lost or known not in (0, before)
        if version != _VERSION:
            raise BoardError(
                f'the board on {self._port} speaks version {version} of the protocol: expected '
                f'{_VERSION}; load the firmware of this package')
        kept, limit, resolution, *self._seen = values
        self.capacity = kept - _SPARE
        self.description = (
            f'version {version} on {self._port}, {kept} levels ahead, watchdog '
            f'{self._watchdog / _MILLION:g} s')
        self.limit, self.resolution = limit / _MILLION, resolution / _MILLION

    # -- the line ------------------------------------------------------------------------------

    def _ask(
            self, verb: str, *values: int, patience: float | None = None,
            count: int = 0) -> list[int]:
        """Return at least ``count`` values of the board's answer; repeat the request if needed."""
        patience = _PATIENCE if patience is None else patience
        until = monotonic() + patience
        answer: _BoardAnswer | None = None
        while True:
            if self._lost and verb != 'H':
                self._lost = False
                raise StateLostError(
                    f'the board on {self._port} has restarted, or was out of reach for '
                    f'{self._watchdog / _MILLION:g} s (watchdog)')
            answer = self._use(lambda: self._attempt(verb, values)) or answer
            if answer is not None and answer.verb == verb and len(answer.values) >= count:
                return answer.values
            if answer is not None and answer.verb == 'L':
                self._begin(patience)
                answer = None
                continue
            if monotonic() > until:
                why = 'does not answer' if answer is None else 'is full' if (
                    answer.verb == 'F') else f'answers {answer.verb} {answer.values}'
                raise BoardError(
                    f'the board on {self._port} {why}, {patience:g} s after it was asked {verb}: '
                    'expected the firmware of this package, at the same baud, without echo')

    def _attempt(self, verb: str, values: Sequence[int]) -> _BoardAnswer | None:
        self._number = (self._number + 1) % 65536
        request = ' '.join(map(str, (self._number, self._session, verb, *values)))
        answers = (_read(x, self._number) for x in self._lines(b'\n' + framed(request)))
        return next((x for x in answers if x is not None), None)

    # -- members of hardware -------------------------------------------------------------------

    def clock(self) -> int:
        """Return the time of the board in ns."""
        return 1000 * self._ask('T', count=1)[0]

    def write(self, current: float, now: int) -> tuple[int, float]:
        """Output a current in A now; return its time in ns and the actual current."""
        when, level, events = self._ask('W', round(current * _MILLION), count=3)
        # Pending levels are dropped, and earlier events are skipped.
        self._seen[0] = events
        return 1000 * when, level / _MILLION

    def schedule(self, levels: Sequence[tuple[int, float]]) -> None:
        """Schedule currents in A at times in ns of the board."""
        for stamp, current in levels:
            self._ask('S', round(stamp / 1000), round(current * _MILLION))
        if not levels:
            self._ask('K')

    def applied(self) -> list[tuple[int, float]]:
        """Return times in ns and values of the currents in A that took effect."""
        return [(when, level) for level, when in self._new('A', 0)]

    def read(self, now: int) -> list[tuple[float, float, int]]:
        """Return new readings, without rate, and their times in ns."""
        return [(reading, math.nan, when) for reading, when in self._new('M', 1)]

    def _new(self, verb: str, series: int) -> list[tuple[float, int]]:
        """Return values and their times in ns since the last call."""
        found: list[tuple[float, int]] = []
        for _ in range(_ANSWERS):
            first, *values = self._ask(verb, self._seen[series] + 1, count=1)
            # Times are differences from the previous one.
            found += [(value / _MILLION, 1000 * when) for when, value in zip(
                accumulate(values[::2]), values[1::2], strict=True)]
            if values:
                self._seen[series] = first - 1 + len(values) // 2
            if len(values) < 2 * _PER_ANSWER:
                break
        return found


def _read(line: bytes, number: int) -> _BoardAnswer | None:
    """Return the answer to a request in a line; None if it is damaged or for another request."""
    try:
        text = line.decode('ascii').rpartition('*')[0]
        if framed(text) != line + b'\n':
            return None
        theirs, session, verb, *values = text.split(' ')
        answer = _BoardAnswer(int(session), verb, [int(x) for x in values])
        return answer if int(theirs) == number else None
    except ValueError:
        return None


class SerialBoard(Assembly):
    """A serial board with its coil and its sensor, for ``hardware:=serial_board``."""

    def __init__(
            self, joint: str, port: Any = '', baud: int = 1_000_000, watchdog: float = 0.5,
            **settings: Any) -> None:
        coil, scale = parts(settings)
        super().__init__(Board(port, baud, watchdog), coil, scale)


class SimulatedBoard(SimulatedLine):
    """
    A board and its serial line.

    It is simulated on access: the firmware applies each level exactly when it is due.

    Parameters
    ----------
    truth : str
        CSV file for the true motion; empty for none.
    clock : callable
        Returns the host time in ns.

    Raises
    ------
    BadInputError
        If the file cannot be written.

    """

    #: relative error of its clock, which is fast, and constant of the coil in T/A
    fast, tesla_per_ampere = 40e-6, TESLA_PER_AMPERE
    #: temperature of the coil in degrees Celsius; NaN if not measured
    temperature = math.nan

    def __init__(self, truth: str = '', clock: Callable[[], int] = monotonic_ns) -> None:
        super().__init__()
        self._clock = clock
        self._begun = clock()
        self._block = self._make_block()
        self._random = Random(1)
        self._level = 0
        self._truth: TextIO | None = None
        if truth:
            try:
                self._truth = Path(truth).open('w', encoding='utf-8')  # noqa: SIM115
            except OSError as error:
                raise BadInputError(
                    f'{truth}, for the true motion of a simulated board, cannot be written '
                    f'({error.strerror}): expected a file in a folder that exists') from error
            self._truth.write('time,stretch,rate,flux_density\n')
        self.restart()

    def _make_block(self) -> Any:
        return ActuatorSimulation(paper_actuator(), time=0)

    def restart(self) -> None:
        """Boot: the coil is off, and the clock starts at 0."""
        self._board = _board.make(_LIMIT, _RESOLUTION)
        self._booted = self._clock()
        self._next_sample = self._now = 0

    def _host(self, time: int) -> int:
        """Return the host time in ns since the start for a board time in us."""
        return self._booted - self._begun + round(1000 * time / (1.0 + self.fast))

    def advance(self) -> int:
        """Do the work due by now; return the board time in us."""
        now = math.floor((self._clock() - self._booted) * (1.0 + self.fast) / 1000)
        while True:
            due = _board.due(self._board)
            # A late level is applied on arrival.
            time = min(self._next_sample, now if due < 0 else max(due, self._now), now)
            self._now = time
            level = _board.advance(self._board, time)
            if level != self._level:
                self._level = level
                self._block.command(self._host(time), level * 1e-6 * self.tesla_per_ampere)
            if time == self._next_sample:
                self._sample(time)
            elif time == now:
                return now

    def _sample(self, time: int) -> None:
        block = self._block
        block.advance(max(self._host(time), block.time))
        _board.sample(self._board, time, round(1e6 * (
            REST_LENGTH * block.stretch + self._random.gauss(0.0, _NOISE))))
        self._next_sample += _PERIOD
        if self._truth is not None:
            self._truth.write(f'{block.time / 1e9:.6f},{block.stretch!r},{block.rate!r},'
                              f'{self._level * 1e-6 * self.tesla_per_ampere:g}\n')

    # -- the port ------------------------------------------------------------------------------

    def write(self, text: bytes) -> None:
        """Receive bytes from the host."""
        if not math.isnan(self.temperature):
            _board.warm(self._board, round(1e6 * self.temperature))
        self._answer += _board.receive(self._board, text, self.advance())

    def close(self) -> None:
        """Close the line, and complete the file."""
        self.advance()
        if self._truth is not None:
            self._truth.close()
            self._truth = None
