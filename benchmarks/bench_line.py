"""
Inject faults between a driver and its coil, many times each.

    python -m benchmarks line [--runs N] [--page FILE] [--quick]

The shipped driver class, the board's firmware and the simulated time are those of the
laboratories. The actuator matches the planner's model, so only the fault is judged: by the
levels in the coil, the true motion, and the messages of driver and planner. After the fault
comes another move; where the driver has ended, a new one is started on the same board.
"""

from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
import math
import os
from typing import Any

import numpy as np

from benchmarks.bench_laboratory import (
    Board,
    drawn,
    Driver,
    FAILED,
    Laboratory,
    Left,
    planner_of,
    Trial,
)
from benchmarks.laboratory import Plant
from benchmarks.sheet import Sheet
from hmsa.errors import HmsaError
from hmsa.model.equations import elastic_force
from hmsa_lab.bench.assembly import CoilModel
from hmsa_lab.bench.serial_board import TESLA_PER_AMPERE
from hmsa_ros.device.watchdog import Kind

RUNS, SEED = 20, 33_000
#: Allowed error of the move after a fault, as a fraction of the step.
GOAL = 0.005
#: Time in ns without a request after which the board switches off, and an allowance for requests
#: in flight.
WATCHDOG, _FLIGHT = 500_000_000, 10_000_000
_MS = 1_000_000
# Range of the time in ns that a cable is out, and the longest wait for it.
_OUT, _PATIENCE = (600 * _MS, 2000 * _MS), 5000 * _MS
# Fraction of answers and requests preceded by garbage, and fraction of their bytes lost.
_GARBAGE, _LOST = 0.1, 1e-3

FAULTS = {
    'cable': 'cable out for 0.6 to 2 s', 'reboot': 'board restarts',
    'garbage': 'garbage and lost bytes', 'saturated': 'amplifier gives half the field',
    'sensor': 'sensor out: frozen, at 0, or silent'}


class _Amplifier(Plant):
    """An actuator behind an amplifier with a largest level in T."""

    largest = math.inf

    def command(self, stamp: int, level: float) -> None:
        """Set a level from a timestamp on, limited to the amplifier's range."""
        super().command(stamp, max(-self.largest, min(level, self.largest)))


class FaultyBoard(Board):
    """A board with a fault between two times of the host in ns."""

    def __init__(self, lab: Laboratory, fault: str) -> None:
        self._fault, self._fate = fault, np.random.default_rng((33, lab.bench.seed))
        self.span = (0, 0)
        self._restarted = False
        self._frozen: float | None = None
        self._looks = ('frozen', 'zero', 'silent')[lab.bench.seed % 3]
        super().__init__(lab)

    def _make_block(self) -> Any:
        return _Amplifier(self.lab.bench, 0)

    @property
    def flowed(self) -> list[tuple[int, float]]:
        """Times of the host in ns, and the level in T from each on."""
        found: list[tuple[int, float]] = self._block.applied
        return found

    def _wrong(self, fault: str) -> bool:
        return fault == self._fault and self.span[0] <= self.now < self.span[1]

    def advance(self) -> int:
        """Do what is due by now."""
        if self._wrong('reboot') and not self._restarted:
            self._restarted = True
            # All of its levels are lost.
            self._block.command(self.now, 0.0)
            self._level = 0
            self.restart()
        if self._fault == 'saturated':
            self._block.largest = 0.5 * self.most if self._wrong('saturated') else math.inf
        return super().advance()

    def _connected(self) -> None:
        if self._wrong('cable'):
            self.now += _MS
            self.advance()
            raise OSError('the device is gone')

    def _worn(self, text: bytes) -> bytes:
        if not self._wrong('garbage'):
            return text
        noise = self._fate.bytes(5) if self._fate.random() < _GARBAGE else b''
        return noise + bytes(x for x in text if self._fate.random() >= _LOST)

    def write(self, text: bytes) -> None:
        """Send a request if connected."""
        self._connected()
        super().write(self._worn(text))
        self._answer = self._worn(self._answer)

    def read(self, size: int) -> bytes:
        """Return bytes if connected."""
        self._connected()
        return super().read(size)

    def _shown(self, stretch: float) -> float | None:
        if not self._wrong('sensor'):
            self._frozen = None
            return stretch
        self._frozen = stretch if self._frozen is None else self._frozen
        return {'frozen': self._frozen, 'zero': 0.0, 'silent': None}[self._looks]

    @property
    def most(self) -> float:
        """The largest level in T that the moves need."""
        block = self.lab.bench.block
        return block.flux_density_unit * float(
            elastic_force(max(self.lab.bench.targets), block.nondimensional))


@dataclass(frozen=True)
class Outcome:
    """Result of a fault."""

    lab: Laboratory
    off: float  # time in s from the fault until the coil was off; NaN where it need not be
    reported: bool
    silent: int  # moves that failed with the verdict arrived
    next: Left  # the move after the fault
    words: str  # what was reported


def run_one(seed: int, *, fault: str) -> Outcome:
    """Inject a fault at a random time during four moves, and make another move after it."""
    lab = drawn(seed, iron=False)
    lab = replace(lab, constant=1.0, bench=replace(
        lab.bench, given=lab.bench.block, lag=0.0, late=0.0, ratio=0.0))
    random = np.random.default_rng((34, seed))
    hold = max(0.4, 12.0 * lab.period)
    board = FaultyBoard(lab, fault)
    trial = _trial(board)
    begin = board.now + round(1e9 * random.uniform(0.3, 3.5) * hold)
    whole = fault in ('garbage', 'saturated')
    last = round(random.uniform(*_OUT)) if fault == 'cable' else round(5e9 * hold)
    board.span = (board.now, board.now + 10 * last) if whole else (begin, begin + last)
    moves: Sequence[Left] = ()
    words = ''
    try:
        moves = trial.moves(hold)
    except HmsaError as error:
        words = str(error)
        left = words
        while left and board.now < begin + _PATIENCE:
            board.now += 50 * _MS
            board.advance()
            trial.driver.device.open()
            left = trial.driver.device.switch_off(board.now)
        words += f'; {left}' * bool(left)
    ended = bool(words)
    words = '; '.join([words] * ended + [
        x.text for x in trial.driver.device.notices() if x.kind == Kind.LOST])
    off = math.nan
    if fault in ('cable', 'reboot'):
        off = 1e-9 * (next((x for x, y in board.flowed if x >= begin and not y), math.inf) - begin)
    board.span = (0, 0)
    failed = [x for x in moves if x.size > FAILED]
    unseen = [x for x in moves if x.verdict != 'arrived']
    if ended:
        trial = _trial(board)
    after = trial.moves(hold)
    return Outcome(
        # A move completed in time in spite of garbage need not be reported.
        lab, off, bool(words or unseen) or fault == 'garbage' and not failed,
        # The driver reports a loss after the verdict.
        0 if words else sum(x.verdict == 'arrived' for x in failed),
        max(after, key=lambda x: x.size),
        words or ', '.join(x.verdict for x in moves))


def _trial(board: FaultyBoard) -> Trial:
    return Trial(Driver(board, CoilModel(TESLA_PER_AMPERE)), planner_of(board.lab.bench.block))


def compare(*, quick: bool, runs: int = RUNS) -> Sheet:
    """Inject all faults; passed if the coil was always safe and all was reported and recovered."""
    with ProcessPoolExecutor(os.cpu_count()) as pool:
        found = {fault: list(pool.map(partial(run_one, fault=fault), range(
            SEED, SEED + (1 if quick else runs)))) for fault in FAULTS}
    rows, passed = [], True
    for fault, outcomes in found.items():
        offs = [x.off for x in outcomes if not math.isnan(x.off)]
        arrived = sum(
            x.next.size <= GOAL and x.next.verdict in ('arrived', 'undecided') for x in outcomes)
        reported, silent = sum(x.reported for x in outcomes), sum(x.silent for x in outcomes)
        count = len(outcomes)
        rows.append([
            FAULTS[fault], str(count), f'{1e3 * max(offs):.0f} ms' if offs else '',
            f'{reported} of {count}', str(silent), f'{arrived} of {count}',
            f'{100.0 * max(x.next.size for x in outcomes):.2g} %'])
        passed &= arrived == reported == count and not silent and all(
            x <= 1e-9 * (WATCHDOG + _FLIGHT) for x in offs)
    return Sheet(
        'line', 'Faults between a driver and its coil, at random times of four moves', (
            'fault', 'times', 'coil off within', 'reported', 'silent', 'next moves arrived',
            'they left at most'), rows,
        {fault: [{'laboratory': x.lab.words, 'off': x.off, 'words': x.words,
                  'next': x.next.size} for x in outcomes] for fault, outcomes in found.items()},
        passed)
