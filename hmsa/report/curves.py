"""Curves of a motion: interpolated between samples, and decimated to screen resolution."""

from dataclasses import dataclass
import math
from typing import Any

import numpy as np

from hmsa.model.equations import Array

#: Intervals of which decimation keeps the minimum and the maximum: more than the columns of a
#: screen.
BUCKETS = 2000
# Minimum points per natural period of a drawn motion, and maximum of all points.
_POINTS_A_PERIOD, _MOST_POINTS = 100, 2_000_000
# Fraction of a natural period: a longer interval between samples is a gap.
_GAP = 0.5
_DIGITS = 9


@dataclass(frozen=True, eq=False)
class TimeCurve:
    """A motion over time; NaN where unknown, which leaves a gap in the drawn line."""

    time: Array  #: in s, shape (n,)
    stretch: Array  #: shape (n,)
    rate: Array  #: in 1/s, shape (n,)

    def between(self, begin: float, end: float) -> 'TimeCurve':
        """Return the part between two times, inclusive."""
        inside = (self.time >= begin) & (self.time <= end)
        return TimeCurve(self.time[inside], self.stretch[inside], self.rate[inside])

    def at(self, time: Array) -> 'TimeCurve':
        """Return the curve at a subset of its times."""
        places = np.searchsorted(self.time, time)
        return TimeCurve(time, self.stretch[places], self.rate[places])


def fine(time: Array, period: float) -> Array:
    """Return times (n,), with more in between if they are too coarse to draw a period."""
    if len(time) < 2:
        return time
    spacing = max(period / _POINTS_A_PERIOD, (time[-1] - time[0]) / _MOST_POINTS)
    if np.max(np.diff(time)) <= spacing:
        return time
    return np.union1d(time, np.arange(time[0], time[-1], spacing, dtype=np.float64))


def through(samples: TimeCurve, period: float) -> TimeCurve:
    """
    Return the cubic Hermite curve through samples of stretch and rate.

    The curve has a gap wherever samples are more than half a period (in s) apart.
    """
    finite = np.isfinite(samples.stretch) & np.isfinite(samples.rate)
    time, stretch, rate = (
        x[finite] for x in (samples.time, samples.stretch, samples.rate))
    grid = fine(time, period)
    if len(time) < 2 or grid is time:
        return TimeCurve(time, stretch, rate)
    places = np.searchsorted(time, grid)
    # Importing SciPy's interpolation takes longer than the whole report.
    after = np.clip(places, 1, None)
    width = np.diff(time)[after - 1]
    share = (grid - time[after - 1]) / width
    rest, step = 1.0 - share, np.diff(stretch)[after - 1]
    begin, end = rate[after - 1], rate[after]
    values = stretch[after - 1] + share * (
        share * (3.0 - 2.0 * share) * step + width * rest * (rest * begin - share * end))
    slopes = 6.0 * share * rest * step / width + rest * (1.0 - 3.0 * share) * begin \
        + share * (3.0 * share - 2.0) * end
    inside = time[np.minimum(places, len(time) - 1)] != grid
    gap = inside & (np.diff(time)[np.clip(places - 1, 0, None)] > _GAP * period)
    values[gap] = slopes[gap] = np.nan
    return TimeCurve(grid, values, slopes)


def decimate(x: Array, y: Array, buckets: int = BUCKETS) -> tuple[Array, Array]:
    """
    Decimate a curve, keeping its ends and the minimum and maximum of each interval.

    One NaN of each interior gap is kept, so that no line crosses the gap.
    """
    known, missing = np.flatnonzero(np.isfinite(y)), np.flatnonzero(~np.isfinite(y))
    kept = known[_extremes(y[known], buckets)] if len(known) else known
    gaps, firsts = np.unique(np.searchsorted(kept, missing), return_index=True)
    chosen = np.union1d(kept, missing[firsts[(gaps > 0) & (gaps < len(kept))]])
    return x[chosen], y[chosen]


def _extremes(y: Array, buckets: int) -> Any:
    """Return the indices of the ends and of each interval's extremes; of a short curve all."""
    size = -(-len(y) // buckets)
    if size <= 2:
        return slice(None)
    begins = np.arange(0, len(y), size)
    rows = np.pad(y, (0, -len(y) % size), mode='edge').reshape(-1, size)
    return np.unique(np.concatenate([
        begins + rows.argmin(axis=1), begins + rows.argmax(axis=1), [0, len(y) - 1]]))


def numbers(values: Any) -> list[float | None]:
    """Return numbers for JSON, rounded to nine digits; None if not finite."""
    return [float(f'{x:.{_DIGITS}g}') if math.isfinite(x) else None
            for x in np.asarray(values, dtype=np.float64).tolist()]
