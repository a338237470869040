"""
Layout of a figure of a sweep: curves, maps, or distributions of samples, depending on its axes.

A column with several numbers is an axis of the figure; models, shapers, cases and columns with a
few values are curves or rows of panels; samples become quantiles.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hmsa.errors import BadInputError
from hmsa.model.equations import Array

#: Maximum number of rows of a sweep to draw, as they are kept in memory.
MOST_ROWS = 4_000_000
# Maximum number of points of an axis, of curves in a panel, and of stacked maps.
_MOST_POINTS, _MOST_CURVES, _MOST_MAPS = 1000, 8, 4
# Maximum number of values of a column for curves instead of an axis, if there is another axis.
_FEW = 5


@dataclass(frozen=True, eq=False)
class Axis:
    """One axis of a sweep that has more than one value."""

    name: str  #: of its column, or of all columns of a table
    size: int
    values: Array | None = None  #: of a numeric column
    labels: tuple[str, ...] = ()  #: of a few unordered values that are no samples
    sampled: bool = False

    @classmethod
    def of(cls, table: Mapping[str, NDArray[Any]], *, samples: bool) -> 'Axis':
        """Return the axis of columns that vary together."""
        name = ', '.join(table)
        size = len(next(iter(table.values())))
        if samples:
            return cls(name, size, sampled=True)
        columns = list(table.values())
        if len(columns) == 1 and columns[0].dtype.kind == 'f':
            return cls(name, size, np.asarray(columns[0], dtype=np.float64))
        if size > _MOST_CURVES:
            return cls(name, size)
        if len(columns) == 1:
            return cls(name, size, labels=tuple(str(x) for x in columns[0]))
        return cls(name, size, labels=tuple(
            ', '.join(f'{key} {x:g}' for key, x in zip(table, row, strict=True))
            for row in zip(*columns, strict=True)))

    def as_labels(self) -> 'Axis':
        """Return a column of a few values as curves."""
        values = [] if self.values is None else self.values.tolist()
        return Axis(self.name, self.size, labels=tuple(f'{self.name} {x:g}' for x in values))


@dataclass(frozen=True, eq=False)
class View:
    """Layout of the rows of a sweep: a map over x and y, curves over x, or a distribution."""

    x: Axis | None
    y: Axis | None
    labels: tuple[str, ...]  #: of each curve or map
    samples: int  #: number at each point; 1 for none
    _sizes: tuple[int, ...]
    _order: tuple[int, ...]

    @classmethod
    def of(cls, axes: Sequence[Axis]) -> 'View':
        """Choose a layout for axes with several values; raise `BadInputError` if there is none."""
        rows = math.prod(x.size for x in axes)
        if rows > MOST_ROWS:
            raise BadInputError(
                f'no picture of {rows:,} rows: expected at most {MOST_ROWS:,}')
        samples = next((x for x in axes if x.sampled), None)
        shown = [x for x in axes if x is not samples]
        numbers = sorted((x for x in shown if x.values is not None), key=lambda x: x.size)
        few = [x for x in numbers if x.size <= _FEW][:max(len(numbers) - 1, 0)]
        shown = [x.as_labels() if x in few else x for x in shown]
        numbers = [x for x in shown if x.values is not None]
        others = [x for x in shown if x.values is None]
        maps = len(numbers) == 2
        if len(numbers) > 2 or not all(x.labels for x in others) or not (numbers or samples):
            raise BadInputError(
                'no picture of a sweep over '
                f'{" x ".join(f"{x.name} ({x.size})" for x in axes) or "nothing"}: expected one '
                'or two columns of several numbers, or samples; others of at most '
                f'{_FEW} values, and at most {_MOST_CURVES} cases')
        labels = tuple(', '.join(x) for x in product(*(x.labels for x in others)))
        most = _MOST_MAPS if maps else _MOST_CURVES
        if len(labels) > most:
            raise BadInputError(
                f'no picture of {len(labels)} {"maps" if maps else "curves"}: expected at most '
                f'{most}; give fewer values')
        # The first axis varies slowest: it is vertical, the last one horizontal.
        order = [*others, *numbers, *([samples] if samples else [])]
        places = [x.name for x in axes]
        return cls(
            numbers[-1] if numbers else None, numbers[0] if maps else None, labels,
            samples.size if samples else 1, tuple(x.size for x in axes),
            tuple(places.index(x.name) for x in order))

    def arranged(self, values: Array) -> Array:
        """Return a column of all rows as (labels, y, x, samples), thinned to the resolution."""
        columns = 1 if self.x is None else self.x.size
        rows = 1 if self.y is None else self.y.size
        found: Array = values.reshape(self._sizes).transpose(self._order).reshape(
            len(self.labels), rows, columns, self.samples)
        return found[:, ::_stride(rows), ::_stride(columns)]

    @staticmethod
    def places(axis: Axis) -> Array:
        """Return the values of an axis, thinned in the same way."""
        values: Array = np.zeros(0) if axis.values is None else axis.values
        return values[::_stride(axis.size)]


def _stride(size: int) -> int:
    return -(-size // _MOST_POINTS)
