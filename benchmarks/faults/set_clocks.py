"""Faults of clocks that are set: that of plant or planner, or of both, in mid-sequence."""

from collections.abc import Iterator
from contextlib import contextmanager
from mmap import mmap, PAGESIZE
from pathlib import Path
import struct
from time import monotonic

import numpy as np

from benchmarks.contenders import compile_c, compiler
from benchmarks.faults.common import LIMIT, move, PATIENT_LEAD, Register, share
from benchmarks.faults.rig import Rig
from benchmarks.faults.table import Seen
from hmsa.model.units import NANOSECONDS

FAULTS = Register(lambda: '' if compiler() else 'no C compiler')
_NODES = 'plant', 'planner'
# The watchdog's timeout, and the time in s in which its effect is seen on a busy machine.
_TIMEOUT, _MORE = 0.5, 0.2
# Times in s: from the request to the setting, with wrong clocks, and with right ones again.
_BEFORE, _WRONG, _RIGHT = 1.1, 3.0, 2.0
_SEQUENCE = tuple((x, 0.4) for x in (1.1, 1.2, 1.3) * 20)


class _Clock:
    """The clock of a process that is started `under` it."""

    def __init__(self, file: Path) -> None:
        file.write_bytes(bytes(PAGESIZE))
        self._file = file
        with file.open('r+b') as opened:
            self._page = mmap(opened.fileno(), PAGESIZE)

    @contextmanager
    def under(self, rig: Rig, library: Path) -> Iterator[None]:
        """Start processes with this clock."""
        before = rig.environment
        rig.environment = {
            **before, 'LD_PRELOAD': str(library), 'CLOCK_OFFSET': str(self._file)}
        yield
        rig.environment = before

    def set(self, seconds: float) -> None:
        """Set the clock to some seconds ahead of the computer's."""
        self._page[:8] = struct.pack('q', round(seconds * NANOSECONDS))


def _start(rig: Rig) -> dict[str, _Clock]:
    """Start plant and planner, each with a clock of its own."""
    library = compile_c(
        rig.folder, 'set_clock.so', ['-shared', '-fPIC'], 'faults/set_clock.c')
    clocks = {x: _Clock(rig.folder / f'{x}.offset') for x in _NODES}
    for name, parameters in (
            ('plant', {'command_timeout': _TIMEOUT, 'safe_flux': 'zero'}),
            ('planner', {'lead_time': PATIENT_LEAD})):
        with clocks[name].under(rig, library):
            rig.start(name, parameters)
    rig.ready(*_NODES)
    return clocks


def _one(rig: Rig, node: str, by: float) -> Seen:
    """Set the clock of one node, and later set it right."""
    clock = _start(rig)[node]
    rig.sequence(_SEQUENCE)
    rig.spin(_BEFORE)
    begin = monotonic()
    clock.set(by)
    rig.spin_until(lambda: rig.applied[-1][1] == 0.0, 'the watchdog')
    off = monotonic() - begin
    mark = len(rig.applied)
    rig.spin(_WRONG)
    codes = {x['code'] for x in rig.verdicts}
    clock.set(0.0)
    rig.spin(_RIGHT)
    again = max((abs(x) for _, x in rig.applied[mark:]), default=0.0)
    residual, error = move(rig, 1.2, start=1.0)
    return Seen(
        f'off after {off:.2f} s, then at most {again:g} T, status '
        f'{"clocks_differ" if "clocks_differ" in codes else "without the clocks"}',
        share(max(residual, error)),
        off < _TIMEOUT + PATIENT_LEAD + _MORE and again == 0.0 and 'clocks_differ' in codes
        and max(residual, error) < LIMIT)


def _both(rig: Rig, by: float) -> Seen:
    """Set the clocks of both nodes."""
    clocks = _start(rig)
    rig.sequence([*_SEQUENCE[:6], (1.25, 60.0)])
    rig.spin(_BEFORE)
    for clock in clocks.values():
        clock.set(by)
    rig.spin(2.0 + 0.4 * 6)
    mark = rig.count()
    rig.spin(0.5)
    rest = rig.samples(mark)[1][:, 0]
    residual = max(float(np.ptp(rest)), float(np.max(np.abs(rest - 1.25)))) / 0.25
    return Seen(
        'at the last target', share(residual), rest.size > 100 and residual < LIMIT)


for _node, _by in (
        ('plant', -5.0), ('plant', -3600.0), ('plant', 5.0), ('planner', -5.0),
        ('planner', 3600.0)):
    FAULTS.add(
        f'set_{_node}_{_by:g}',
        f'clock of the {_node} set {"back" if _by < 0.0 else "ahead"} by {abs(_by):g} s',
        f'in mid-sequence, set right {_WRONG:g} s later; command_timeout {_TIMEOUT:g} s, '
        'safe_flux zero',
        'off within command_timeout of the last command that applies, and until a request; status '
        '`clocks_differ`; next move as planned', _one, _node, _by)
for _by in (-5.0, 60.0):
    FAULTS.add(
        f'set_both_{_by:g}',
        f'both clocks set {"back" if _by < 0.0 else "ahead"} by {abs(_by):g} s',
        'at once, in mid-sequence', 'the sequence continues, and ends at rest at its target',
        _both, _by)
