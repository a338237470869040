"""Timing of a loop: CPU time per cycle and between cycles, and cycles that begin late."""

from time import monotonic_ns, thread_time_ns

import numpy as np
from numpy.typing import NDArray

from hmsa_ros.runtime.records import Clock, Severity

# Number of cycles whose CPU times are stored.
_REMEMBERED = 4096


class Cycles:
    """
    Measure the cycles of a loop, each run in this context manager; all times are in ns.

    ``late`` counts the cycles that began more than a period after they were due.
    """

    def __init__(
            self, period: int, *, steady: Clock = monotonic_ns,
            cpu: Clock = thread_time_ns) -> None:
        self.count = self.late = self.largest = 0
        self._period, self._steady, self._cpu = period, steady, cpu
        self._work = np.zeros(_REMEMBERED, dtype=np.int64)
        self._rest = np.zeros(_REMEMBERED, dtype=np.int64)
        self._due = self._begun = self._ended = 0
        self._reported = 0, 0

    def __enter__(self) -> None:
        now = self._steady()
        lateness = now - self._due if self.count else 0
        if lateness > self._period:
            self.late += 1
            self.largest = max(self.largest, lateness)
        # The grid is that of the first cycles; missed cycles are skipped.
        self._due = now + self._period - (
            lateness if 0 < lateness <= self._period else 0)
        self._begun = self._cpu()

    def __exit__(self, *_: object) -> None:
        self._ended = self._cpu()
        self._work[self.count % _REMEMBERED] = self._ended - self._begun
        self.count += 1

    @property
    def left(self) -> int:
        """Time until the next cycle is due; negative if it is late."""
        return self._due - self._steady()

    def note_rest(self) -> None:
        """Record the CPU time spent since the last cycle ended."""
        self._rest[(self.count - 1) % _REMEMBERED] = self._cpu() - self._ended

    def _figures(self, name: str, spent: NDArray[np.int64]) -> dict[str, object]:
        """Return median, 99 % quantile and maximum of recent CPU times in us."""
        seen = spent[:max(self.count, 1)]
        return {f'{name}_{key}_us': f'{float(np.quantile(seen, x)) / 1e3:.1f}'
                for key, x in (('p50', 0.5), ('p99', 0.99), ('largest', 1.0))}

    def report(self) -> tuple[Severity, str, dict[str, object]]:
        """Return severity and message for the cycles since the last call, and counters."""
        count, late = self.count - self._reported[0], self.late - self._reported[1]
        self._reported = self.count, self.late
        message = f'{late} of {count} cycles late' if late else 'cycles in time'
        return Severity.WARN if late else Severity.OK, message, {
            'cycles': self.count, 'late': self.late,
            'largest_lateness_ms': f'{self.largest / 1e6:.3f}',
            **self._figures('work', self._work), **self._figures('rest', self._rest)}
