"""Tables of a page, which a button copies in full precision."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from html import escape
import math

from hmsa_ros.model.residual import percent

_LONG_TABLE = 25


@dataclass(frozen=True)
class Cell:
    """A cell of a table: the text, and the value that is copied in full precision instead."""

    shown: str
    value: float | None = None


Row = list[Cell | str]
Values = list[Cell | str | float]


def table(
        key: str, caption: str, header: Sequence[str],
        rows: Sequence[Row]) -> str:
    """Return a table with a button that copies it."""
    if header[0] in ('run', 'bag') and len({row[0] for row in rows}) <= 1:
        # A run on its own needs no name in every row.
        header, rows = header[1:], [row[1:] for row in rows]
    numeric = [any(
        isinstance(row[i], Cell) for row in rows) for i in range(len(header))]
    kinds = [' class="number"' if x else '' for x in numeric]
    long = ' long' if len(rows) > _LONG_TABLE else ''
    lines = [
        f'<p class="soft" id="{key}-caption">{escape(caption)}</p>',
        f'<div class="scroll{long}" tabindex="0" role="region" '
        f'aria-labelledby="{key}-caption">'
        f'<table id="{key}" aria-labelledby="{key}-caption"><thead><tr>',
        *(f'<th scope="col"{kind}>{escape(x)}</th>'
          for x, kind in zip(header, kinds, strict=True)), '</tr></thead><tbody>']
    for row in rows:
        lines.append('<tr>')
        for cell, kind in zip(row, kinds, strict=True):
            if isinstance(cell, str):
                lines.append(f'<td{kind}>{escape(cell)}</td>')
            else:
                value = '' if cell.value is None else f' data-value="{cell.value!r}"'
                lines.append(f'<td{kind}{value}>{escape(cell.shown)}</td>')
        lines.append('</tr>')
    return ''.join([
        *lines, '</tbody></table></div>',
        f'<button type="button" data-table="{key}">Copy table</button>'])


def formatted(
        key: str, caption: str, columns: Mapping[str, str],
        rows: Iterable[Values]) -> str:
    """Return a table of values, each in the format of its column; texts and cells as they are."""
    return table(key, caption, list(columns), [[
        x if isinstance(x, (str, Cell)) else cell(x, form)
        for x, form in zip(row, columns.values(), strict=True)] for row in rows])


def cell(value: float, form: str = '.6g') -> Cell:
    """Return a number as a cell; of a form that ends in % it is one, with what is resolved."""
    value = float(value)
    if form.endswith('%') and math.isfinite(value):
        return Cell(percent(0.01 * value, form[:-1]), value)
    return Cell(f'{value:{form}}', value) if math.isfinite(value) else Cell('–', math.nan)
