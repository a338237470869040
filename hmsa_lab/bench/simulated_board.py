"""A simulated serial board: its firmware with a simulated coil, actuator and laser."""

from collections.abc import Callable
import math
from pathlib import Path
from random import Random
from time import monotonic_ns
from typing import Any, TextIO

from hmsa.errors import BadInputError
from hmsa.model.parameters import paper_actuator
from hmsa.model.simulation import ActuatorSimulation
from hmsa_lab.bench import _board
from hmsa_lab.bench.line import SimulatedLine

#: Settings for its driver: T/A, and the length of the block in mm.
TESLA_PER_AMPERE, REST_LENGTH = 0.05, 20.0
# Limit and resolution in uA.
_LIMIT, _RESOLUTION = 10_000_000, 100
# Sampling period in us of its clock.
_PERIOD = 1000
_NOISE = 1e-3  # standard deviation in mm


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

    @staticmethod
    def _make_block() -> Any:
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
