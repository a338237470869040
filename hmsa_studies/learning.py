"""
Learning from trial to trial: the same move from rest, repeated with improved levels.

After each trial, the first level, its duration and the last level are changed by the errors of the
samples after the arrival, through the Jacobian of the nominal block.
"""

from collections.abc import Iterator

import numpy as np

from hmsa.model.equations import Array
from hmsa.model.parameters import ActuatorParameters
from hmsa.model.simulation import ActuatorSimulation
from hmsa.model.units import NANOSECONDS

# Duration of the samples after the arrival, in time scales, and increment of levels and durations
# for the Jacobian, relative to their units.
_SEEN, _SMALL = 2.0, 1e-3
# Minimum and maximum duration of the first level, relative to the nominal one.
_RANGE = (0.3, 2.0)


class Learner:
    """Learns two levels, in ns and T, of a nominal block from samples every `period` in ns."""

    def __init__(
            self, block: ActuatorParameters, levels: tuple[tuple[int, float], ...],
            largest: float, period: int) -> None:
        """Begin with the nominal move."""
        self._block, self._period, self._largest = block, period, largest
        (begin, first), (end, last) = levels
        self._begin = begin
        self._scale = np.array([
            block.flux_density_unit, block.time_unit * NANOSECONDS, block.flux_density_unit])
        self.unknowns = np.array([first, end - begin, last]) / self._scale
        self._least, self._most = (x * self.unknowns[1] for x in _RANGE)
        count = int(_SEEN * block.time_unit * NANOSECONDS / period)
        self.stamps = [end + i * period for i in range(count)]
        here = self._nominal(self.unknowns)
        slopes = np.column_stack([
            (self._nominal(self.unknowns + _SMALL * row) - here) / _SMALL for row in np.eye(3)])
        self._inverse: Array = np.linalg.pinv(slopes).astype(np.float64)

    def levels(self, unknowns: Array) -> tuple[tuple[int, float], ...]:
        """Return timestamps in ns and levels in T."""
        first, duration, last = unknowns * self._scale
        return ((self._begin, float(first)), (self._begin + round(duration), float(last)))

    def learn(self, off: Array) -> None:
        """Change the levels by the errors of the samples."""
        found = self.unknowns - self._inverse @ off
        bound = self._largest / self._scale[0]
        self.unknowns = np.clip(
            found, [-bound, self._least, -bound], [bound, self._most, bound])

    def _nominal(self, unknowns: Array) -> Array:
        return np.array(list(carried_out(
            ActuatorSimulation(self._block), self.levels(unknowns), self.stamps)))


def carried_out(
        plant: ActuatorSimulation, levels: tuple[tuple[int, float], ...],
        stamps: list[int]) -> Iterator[float]:
    """Command levels and yield the stretch at times in ns."""
    for stamp, level in levels:
        plant.command(stamp, level)
    for stamp in stamps:
        plant.advance(stamp)
        yield plant.stretch
