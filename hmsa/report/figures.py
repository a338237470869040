"""
The description of a figure: panels, curves decimated to what a screen shows, axes and legend.

`hmsa.report.style` draws it on paper, and ``figure.js`` in the page of a report.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
import math
from typing import Any

import numpy as np

from hmsa.model.equations import Array
from hmsa.report.looks import LineStyle

#: Intervals of which decimation keeps the minimum and the maximum: more than the columns of a
#: screen.
BUCKETS = 2000
# Minimum points per natural period of a drawn motion, and maximum of all points.
_POINTS_A_PERIOD, _MOST_POINTS = 100, 2_000_000
# Fraction of a natural period: a longer interval between samples is a gap.
_GAP = 0.5
_DIGITS = 9
# Room around the curves, as a fraction of their extent.
_MARGIN = 0.05


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


@dataclass(frozen=True)
class Axis:
    """An axis: quantity, unit, scale, and limits when the figure is opened."""

    quantity: str
    symbol: str = ''
    unit: str = ''
    tex: str = ''  #: the symbol for TeX, if it differs
    limits: tuple[float, float] | None = None  #: by default, all curves
    #: ``'linear'``, ``'log'`` or ``'symlog'``: logarithmic on both sides, linear between -1 and 1
    scale: str = 'linear'
    ticks: tuple[tuple[float, str], ...] = ()  #: places and texts, by default numbers

    @property
    def label(self) -> str:
        """Quantity, symbol, and unit if given."""
        return ' '.join(x for x in (
            self.quantity, self.symbol, f'({self.unit})' if self.unit else '') if x)


@dataclass(frozen=True, eq=False)
class Curve:
    """
    A curve, band, or set of points.

    Curves of one name have one entry in the legend of a figure. Form and arrays are

    - ``'line'``, or ``'steps'`` that hold each value until the next, through points (x, y), with
      gaps where y is NaN;
    - ``'points'``: a marker at each point;
    - ``'bars'``: from zero to y, as wide as the distance of neighbours;
    - ``'band'``: between y and ``lower``;
    - ``'vertical'`` or ``'horizontal'``: a line across the panel at each x or y.
    """

    name: str
    look: LineStyle
    x: Array = field(default_factory=lambda: np.empty(0))
    y: Array = field(default_factory=lambda: np.empty(0))
    form: str = 'line'
    lower: Array | None = None
    #: in a page only, and there until it is chosen in the legend
    hidden: bool = False
    listed: bool = True  #: whether the legend has an entry

    def extent(self, axis: str, within: tuple[float, float] | None = None) -> list[float]:
        """Return minimum and maximum along ``'x'`` or ``'y'``; empty without a point in x."""
        values = np.asarray(getattr(self, axis), dtype=np.float64)
        if self.hidden or {'vertical': 'y', 'horizontal': 'x'}.get(self.form) == axis:
            return []
        if axis == 'y' and within is not None and self.form not in ('horizontal', 'band'):
            inside = (self.x >= within[0]) & (self.x <= within[1])
            if self.form == 'steps':
                # The value that is held when the range begins.
                inside[max(int(np.searchsorted(self.x, within[0])) - 1, 0)] = True
            values = values[inside]
        if axis == 'y' and self.lower is not None:
            values = np.append(values, self.lower)
        values = values[np.isfinite(values)]
        if axis == 'y' and self.form == 'bars':
            values = np.append(values, 0.0)
        if axis == 'x' and self.form == 'bars' and len(values) > 1:
            half = 0.5 * float(np.min(np.diff(values)))
            values = np.array([values[0] - half, values[-1] + half])
        return [float(np.min(values)), float(np.max(values))] if len(values) else []

    def to_dict(self) -> dict[str, Any]:
        """Return the curve for the page."""
        return {
            'name': self.name, 'form': self.form, 'x': numbers(self.x), 'y': numbers(self.y),
            'hidden': self.hidden, 'listed': self.listed, **self.look.to_dict(),
            **({} if self.lower is None else {'lower': numbers(self.lower)})}


@dataclass(frozen=True, eq=False)
class Panel:
    """Curves with common axes, on paper with a title; ``height`` is relative to others."""

    x: Axis
    y: Axis
    curves: Sequence[Curve]
    title: str = ''
    height: float = 1.0

    def limits(self, axis: str) -> tuple[float, float]:
        """Return the limits along ``'x'`` or ``'y'``, by default with all curves and some room."""
        own: Axis = getattr(self, axis)
        if own.limits is not None:
            return own.limits
        within = self.limits('x') if axis == 'y' else None
        ends = [x for curve in self.curves for x in curve.extent(axis, within)] or [0.0, 1.0]
        low, high = min(ends), max(ends)
        # A level curve lies in the middle.
        margin = _MARGIN * (high - low) or 0.5 * abs(high) or 0.5
        bars = any(x.form == 'bars' for x in self.curves)
        return low - margin * (not bars or low < 0.0), high + margin

    def to_dict(self) -> dict[str, Any]:
        """Return the panel for the page."""
        return {
            **{key: {
                'label': axis.label, 'scale': axis.scale, 'limits': numbers(self.limits(key)),
                'ticks': [[*numbers([x]), text] for x, text in axis.ticks]}
               for key, axis in (('x', self.x), ('y', self.y))},
            'height': self.height, 'curves': [x.to_dict() for x in self.curves]}


@dataclass(frozen=True, eq=False)
class Figure:
    """A figure of a page: panels above each other, which have the same x axis."""

    key: str
    alt: str  #: description for those who do not see it
    panels: Sequence[Panel]
    height: int = 300  #: in px
    legend: bool = True

    def to_dict(self) -> dict[str, Any]:
        """Return the figure for the page."""
        return {
            'key': self.key, 'legend': self.legend, 'panels': [x.to_dict() for x in self.panels]}
