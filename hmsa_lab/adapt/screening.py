"""Rejection of invalid samples: no number, a frozen sensor, a jump."""

from collections.abc import Sequence
import math

import numpy as np
from numpy.typing import NDArray

from hmsa.model.equations import Array
from hmsa.model.laws.record import Coordinate

# Number of rejected samples in a row that are no outliers: sensor or actuator has changed.
_LOST = 6
# Number of fitting samples in a row after which samples are used again.
_FOUND = 12
# Equal values in a row that show a frozen sensor, if more motion than this, in standard
# deviations, is expected.
_EQUAL, _MOTION = 4, 8.0
# The same at rest, after a number of samples there, a fraction of which reversed due to noise.
_STILL, _ENOUGH, _MOST = 8, 20, 0.5


class Screening:
    """
    Rejection of samples beyond some standard deviations of the innovation, with a reason.

    Attributes count values that were no number, had the timestamp of another one, were too late,
    had a future timestamp, did not fit, or did not change while the actuator moved.
    """

    def __init__(self, gate: float, coordinate: Coordinate) -> None:
        self._gate, self._conceivable = gate, coordinate.conceivable
        self.unreadable = self.repeated = self.late = self.rejected = self.frozen = 0
        self.ahead = 0
        self.lost = 0  # times that several in a row did not fit
        self.last_trouble = ''  # the reason
        self.restart()

    def restart(self) -> None:
        """Discard the history; counts stay."""
        self.trouble = ''  # reason why samples should not be used
        self._in_a_row = self._fitted = 0
        self._last: list[tuple[float, float]] = []
        # At rest: number of samples, of reversals, and of values equal to the previous one.
        self._resting = self._turns = self._same = 0

    @property
    def doubts(self) -> bool:
        """Whether the newest samples do not fit; a single one may be an outlier."""
        return self._in_a_row > 1

    def refuse_ahead(self, seconds: float) -> None:
        """Reject a sample whose timestamp is ahead of the clock by some seconds."""
        self.ahead += 1
        self._reject(
            f'timestamps of samples lie {seconds:.3g} s ahead of the clock of the planner')

    def readable(self, stretch: float) -> bool:
        """Return whether a value is possible for this kind of position."""
        if self._conceivable[0] < stretch < self._conceivable[1]:
            return True
        self.unreadable += 1
        return False

    def fitting(
            self, stretch: Array, residual: Array, by: Array, covariance: Array, noise: float
    ) -> NDArray[np.bool_]:
        """
        Return which samples fit the estimated motion, shape (n,).

        ``residual`` and its derivatives ``by`` are given for coordinates with a covariance.
        """
        spread = np.sqrt(np.sum(by @ covariance * by, axis=1) + noise ** 2)
        return np.array([
            self._judge(value, value - off, size, noise) for value, off, size in zip(
                stretch.tolist(), residual.tolist(), spread.tolist(), strict=True)], dtype=bool)

    def _judge(self, value: float, expected: float, spread: float, noise: float) -> bool:
        self._last = [*self._last, (value, expected)][-_EQUAL:]
        values, motion = zip(*self._last, strict=True)
        if len(values) == _EQUAL and len(set(values)) == 1 and (
                max(motion) - min(motion) > _MOTION * noise):
            self.frozen += 1
            self._reject('the sensor repeats the same value while the actuator should move')
            return False
        if max(motion) - min(motion) <= noise and self._stands_still(values):
            self.frozen += 1
            self._reject('the sensor repeats the same value, without its noise')
            return False
        off = value - expected
        if abs(off) > self._gate * spread:
            self.rejected += 1
            self._reject(
                f'samples lie {off:+.3g} off what is expected: a jump of the sensor, or a '
                'disturbance')
            return False
        self._in_a_row = 0
        self._fitted += 1
        if self._fitted >= _FOUND:
            self.trouble = ''
        return True

    def _stands_still(self, values: Sequence[float]) -> bool:
        """Record the last values at rest; return whether they no longer scatter."""
        before, last = values[-2:] if len(values) > 1 else (math.nan, values[0])
        self._same = self._same + 1 if last == before else 0
        if self._same:
            return self._same >= _STILL and self._resting >= _ENOUGH and (
                self._turns > _MOST * self._resting)
        self._resting += 1
        # Vibration does not reverse from sample to sample.
        self._turns += len(values) > 2 and (last - before) * (before - values[-3]) < 0.0
        return False

    def _reject(self, why: str) -> None:
        self._in_a_row += 1
        self._fitted = 0
        if self._in_a_row >= _LOST or 'repeats' in why:
            self.lost += not self.trouble
            self.trouble = self.last_trouble = why
