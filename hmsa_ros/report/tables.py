"""Tables of a page, which a button copies in full precision."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
import math

from hmsa_ros.model.residual import percent


@dataclass(frozen=True)
class Cell:
    """A cell of a table: the text, and the value that is copied in full precision instead."""

    shown: str
    value: float | None = None


Row = list[Cell | str]
Values = list[Cell | str | float]


@dataclass(frozen=True)
class PageTable:
    """A table by its place: headings, each with whether its cells are numbers, and rows."""

    key: str
    columns: tuple[tuple[str, bool], ...]
    rows: Sequence[Row]


def table(key: str, header: Sequence[str], rows: Sequence[Row]) -> PageTable:
    """Return a table; a run on its own needs no name in every row."""
    if header[0] in ('run', 'bag') and len({row[0] for row in rows}) <= 1:
        header, rows = header[1:], [row[1:] for row in rows]
    return PageTable(key, tuple(
        (x, any(isinstance(row[i], Cell) for row in rows)) for i, x in enumerate(header)), rows)


def formatted(key: str, columns: Mapping[str, str], rows: Iterable[Values]) -> PageTable:
    """Return a table of values, each in the format of its column; texts and cells as they are."""
    return table(key, list(columns), [[
        x if isinstance(x, (str, Cell)) else cell(x, form)
        for x, form in zip(row, columns.values(), strict=True)] for row in rows])


def cell(value: float, form: str = '.6g') -> Cell:
    """Return a number as a cell; of a form that ends in % it is one, with what is resolved."""
    value = float(value)
    if form.endswith('%') and math.isfinite(value):
        return Cell(percent(0.01 * value, form[:-1]), value)
    return Cell(f'{value:{form}}', value) if math.isfinite(value) else Cell('–', math.nan)
