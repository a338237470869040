"""Curves of a motion: between its samples, and thinned out to what can be seen."""

from dataclasses import dataclass
import math
from typing import Any

import numpy as np

from hmsa_ros.model.equations import Array

#: Intervals of a curve of which the least and the largest value are kept: more than a screen
#: has columns.
BUCKETS = 2000
# A motion is drawn with this many points a period of the actuator at least, up to so many.
_POINTS_A_PERIOD, _MOST_POINTS = 100, 2_000_000
# Between samples further apart than this share of a period, nobody knows what happened.
_GAP = 0.5
_DIGITS = 9


@dataclass(frozen=True, eq=False)
class Curve:
    """A motion at some times; NaN, of which curves are drawn without a line, where unknown."""

    time: Array  #: in s, shape (n,)
    stretch: Array  #: shape (n,)
    rate: Array  #: in 1/s, shape (n,)

    def between(self, begin: float, end: float) -> 'Curve':
        """Return the part between two times, both included."""
        inside = (self.time >= begin) & (self.time <= end)
        return Curve(self.time[inside], self.stretch[inside], self.rate[inside])

    def at(self, time: Array) -> 'Curve':
        """Return it at some of its own times."""
        places = np.searchsorted(self.time, time)
        return Curve(time, self.stretch[places], self.rate[places])


def fine(time: Array, period: float) -> Array:
    """Return times (n,) with more between them where they are too few for a period's motion."""
    if len(time) < 2:
        return time
    spacing = max(period / _POINTS_A_PERIOD, (time[-1] - time[0]) / _MOST_POINTS)
    if np.max(np.diff(time)) <= spacing:
        return time
    return np.union1d(time, np.arange(time[0], time[-1], spacing, dtype=np.float64))


def through(samples: Curve, period: float) -> Curve:
    """
    Return the curve through samples of stretch and rate: cubics, as Hermite's interpolation.

    It has a gap where samples are further apart than half a period (in s).
    """
    finite = np.isfinite(samples.stretch) & np.isfinite(samples.rate)
    time, stretch, rate = (
        x[finite] for x in (samples.time, samples.stretch, samples.rate))
    grid = fine(time, period)
    if len(time) < 2 or grid is time:
        return Curve(time, stretch, rate)
    places = np.searchsorted(time, grid)
    # SciPy's cubics take longer to import than all of a report.
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
    return Curve(grid, values, slopes)


def decimate(x: Array, y: Array, buckets: int = BUCKETS) -> tuple[Array, Array]:
    """
    Thin out a curve, keeping its ends and the extremes of intervals of many points.

    Where values are missing (NaN) inside, one of each gap stays, so that no line crosses it.
    """
    known, missing = np.flatnonzero(np.isfinite(y)), np.flatnonzero(~np.isfinite(y))
    kept = known[_extremes(y[known], buckets)] if len(known) else known
    gaps, firsts = np.unique(np.searchsorted(kept, missing), return_index=True)
    chosen = np.union1d(kept, missing[firsts[(gaps > 0) & (gaps < len(kept))]])
    return x[chosen], y[chosen]


def _extremes(y: Array, buckets: int) -> Any:
    """Return where the ends and the extremes of each interval are, or all of few places."""
    size = -(-len(y) // buckets)
    if size <= 2:
        return slice(None)
    begins = np.arange(0, len(y), size)
    rows = np.pad(y, (0, -len(y) % size), mode='edge').reshape(-1, size)
    return np.unique(np.concatenate([
        begins + rows.argmin(axis=1), begins + rows.argmax(axis=1), [0, len(y) - 1]]))


def numbers(values: Any) -> list[float | None]:
    """Return numbers for JSON, to nine digits; None for what is not finite."""
    return [float(f'{x:.{_DIGITS}g}') if math.isfinite(x) else None
            for x in np.asarray(values, dtype=np.float64).tolist()]
