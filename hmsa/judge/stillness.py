"""Whether a joint rests, by samples that contain no rate."""

from collections import deque
from collections.abc import Callable

import numpy as np

from hmsa.judge.fit import FEWEST, fit
from hmsa.model.units import NANOSECONDS

# Number of stored samples, and fraction of them that is new at each evaluation.
_STORED, _NEW = 300, 0.25
# Largest gap between successive samples in ns.
_GAP = 300_000_000
# Largest vibration of a joint at rest that the samples may conceal, peak to peak in stretch: a
# fiftieth of a usual step.
_REST = 5e-3


class Stillness:
    """Find rest in the samples of a joint since `clear`."""

    def __init__(self) -> None:
        self._samples: deque[tuple[int, float]] = deque(maxlen=_STORED)
        self.clear()

    def add(self, stamp: int, stretch: float) -> None:
        """Add a sample with a timestamp in ns, unless a newer one is known; a gap clears all."""
        step = stamp - self._samples[-1][0] if self._samples else 1
        if abs(step) > _GAP:
            self.clear()
        elif step <= 0:
            return
        self._samples.append((stamp, stretch))
        self._new += 1

    def clear(self) -> None:
        """Forget all samples."""
        self._samples.clear()
        self._new = 0  # number of samples since the last evaluation
        self._rest: float | None = None
        self._until = 0  # timestamp of the newest sample evaluated

    def rest(self, frequency: Callable[[float], float], since: int) -> float | None:
        """
        Return the stretch at which a joint rests by samples after a time in ns, else None.

        ``frequency`` returns the natural frequency in rad/s about a stretch.
        """
        if self._samples and self._samples[-1][0] <= since:
            self.clear()
        while self._samples and self._samples[0][0] <= since:
            self._samples.popleft()
        if self._rest is not None and self._until <= since and self._samples and (
                abs(self._samples[-1][1] - self._rest) > _REST):
            # It rested there before the time, and is elsewhere now.
            self._rest = None
        if len(self._samples) >= FEWEST and self._new >= _NEW * len(self._samples):
            self._new, self._until = 0, self._samples[-1][0]
            self._rest = self._evaluated(frequency)
        return self._rest

    def _evaluated(self, frequency: Callable[[float], float]) -> float | None:
        time, stretch = np.array(self._samples, dtype=np.float64).T
        middle = float(np.mean(stretch))
        found = fit(
            (time - time[0]) / NANOSECONDS, stretch - middle,
            frequency(middle), 0.0, lambda _: True)
        if found is None or not found.vibration.high <= _REST:
            return None
        return middle + found.offset.value
