"""Tables of results: text in a terminal, HTML in a notebook, columns for further use."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from html import escape
import math
import shutil
import textwrap
from typing import Any

from hmsa_ros.errors import BadInputError


@dataclass(frozen=True)
class Column:
    """A column: its name, unit (or empty), and number format."""

    name: str
    unit: str = ''
    form: str = '.6g'  #: as for `format`; ``'%'``, optionally after a sign, for percent of a step
    head: str = ''  #: shorter heading that replaces the name

    @property
    def title(self) -> str:
        """The name with its unit."""
        name = self.head or self.name
        return f'{name} ({self.unit})' if self.unit and name != '±' else name

    def shown(self, value: object) -> str:
        """Return a value as text, a dash for a missing one."""
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            return '–' if value is None else str(value)
        if math.isnan(value):
            return '–'
        if math.isinf(value):
            return '∞' if value > 0.0 else '-∞'
        if self.form.endswith('%'):
            from hmsa_ros.model.residual import percent  # imports NumPy

            return percent(0.01 * value, self.form[:-1])
        return f'{value:{self.form}}'


@dataclass(frozen=True)
class Table:
    """
    Rows of results.

    Printing aligns the columns, and a notebook shows HTML. ``table['arrival']`` returns a column
    by its name without the unit, and `to_pandas` returns a DataFrame.
    """

    columns: tuple[Column, ...]
    rows: tuple[tuple[Any, ...], ...]
    caption: str = ''
    notes: tuple[str, ...] = ()  #: one sentence each

    def __len__(self) -> int:
        return len(self.rows)

    def __getitem__(self, name: str) -> list[Any]:
        names = [x.name for x in self.columns]
        if name not in names:
            raise BadInputError(
                f'the table has no column {name!r}: expected one of {", ".join(names)}')
        return [row[names.index(name)] for row in self.rows]

    def __repr__(self) -> str:
        return str(self)  # shown at a prompt

    def __str__(self) -> str:
        cells = [[x.title for x in self.columns], *self._texts()]
        widths = [max(map(len, x)) for x in zip(*cells, strict=True)]
        right = [all(not isinstance(row[i], str) for row in self.rows)
                 for i in range(len(self.columns))]
        lines = ['  '.join(
            f'{x:>{n}}' if number else f'{x:<{n}}'
            for x, n, number in zip(row, widths, right, strict=True)).rstrip() for row in cells]
        lines.insert(1, '  '.join('─' * n for n in widths))
        room = max(shutil.get_terminal_size().columns, 60)
        for text in (self.caption, *(f'note: {x}' for x in self.notes)):
            lines += textwrap.wrap(text, room, break_long_words=False, break_on_hyphens=False)
        return '\n'.join(lines)

    def _repr_html_(self) -> str:
        def row(cells: Sequence[str], tag: str) -> str:
            return f'<tr>{"".join(f"<{tag}>{escape(x)}</{tag}>" for x in cells)}</tr>'

        caption = f'<caption>{escape(self.caption)}</caption>' if self.caption else ''
        return (
            f'<table>{caption}<thead>{row([x.title for x in self.columns], "th")}</thead><tbody>'
            + ''.join(row(x, 'td') for x in self._texts()) + '</tbody></table>'
            + ''.join(f'<p>{escape(x)}</p>' for x in self.notes))

    def _texts(self) -> Iterator[list[str]]:
        for row in self.rows:
            yield [x.shown(value) for x, value in zip(self.columns, row, strict=True)]

    def records(self) -> list[dict[str, Any]]:
        """Return each row as a mapping from column names."""
        return [dict(zip((x.name for x in self.columns), row, strict=True)) for row in self.rows]

    def to_pandas(self) -> Any:
        """
        Return a DataFrame whose column names contain the units.

        Raises
        ------
        BadInputError
            If pandas is not installed.

        """
        return frame({
            f'{x.name} ({x.unit})' if x.unit else x.name: self[x.name] for x in self.columns})


def frame(columns: dict[str, Any]) -> Any:
    """Return columns as a DataFrame; raise `BadInputError` if pandas is not installed."""
    try:
        import pandas
    except ImportError as error:
        raise BadInputError(
            'pandas is not installed: install it (pip install pandas), or take the columns as '
            'arrays') from error
    return pandas.DataFrame(columns)
