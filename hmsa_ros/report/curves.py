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

    @property
    def known(self) -> bool:
        """Whether any of it is known."""
        return bool(np.isfinite(self.stretch).any())

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
    known = np.isfinite(y)
    if not known.any():
        return x[known], y[known]
    first, last = (int(z) for z in np.flatnonzero(known)[[0, -1]])
    x, y, known = x[first:last + 1], y[first:last + 1], known[first:last + 1]
    if known.all():
        keep = _extremes(y, buckets)
        return (x, y) if keep is None else (x[keep], y[keep])
    gaps = np.flatnonzero(~known[1:] & known[:-1]) + 1
    places = np.flatnonzero(known)
    keep = _extremes(y[places], buckets)
    if keep is not None:
        places = places[keep]
        # Of many gaps most are narrower than what is seen.
        gaps = gaps[np.unique(np.searchsorted(places, gaps), return_index=True)[1]]
    chosen = np.union1d(places, gaps)
    return x[chosen], y[chosen]


def _extremes(y: Array, buckets: int) -> Any:
    """Return where the ends and the extremes of each interval are; None to keep all."""
    size = -(-len(y) // buckets)
    if size <= 2:
        return None
    whole = len(y) // size * size
    begins = np.arange(0, whole, size)
    rows = y[:whole].reshape(-1, size)
    keep: list[Any] = [
        begins + rows.argmin(axis=1), begins + rows.argmax(axis=1), [0, len(y) - 1]]
    if whole < len(y):
        rest = y[whole:]
        keep.append([whole + int(rest.argmin()), whole + int(rest.argmax())])
    return np.unique(np.concatenate(keep))


def numbers(values: Any) -> list[float | None]:
    """Return numbers for JSON, to nine digits; None for what is not finite."""
    return [float(f'{x:.{_DIGITS}g}') if math.isfinite(x) else None
            for x in np.asarray(values, dtype=np.float64).tolist()]
