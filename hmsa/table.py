"""Tables of results: text in a terminal, HTML in a notebook, columns for further use."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
import math
import sys
import textwrap
from typing import Any, overload, SupportsIndex

from hmsa.errors import BadInputError, check_choice

#: Heading of the standard deviation of the column before.
DEVIATION = '±'
_GAP = '  '
#: Smaller fractions of a step are not distinguished: no sensor resolves them.
RESOLVED = 1e-5


def percent(share: float, sign: str = '') -> str:
    """
    Format a fraction of a step in percent, without the unit; NaN gives a question mark.

    Values below `RESOLVED` are shown as ``<``; with ``sign`` ``'+'`` others have a sign.
    """
    if math.isnan(share):
        return '?'
    if abs(share) < RESOLVED:
        return f'<{100.0 * RESOLVED:g}'
    value, size = 100.0 * share, 100.0 * abs(share)
    return f'{value:{sign}.{1 if size >= 1.0 else 2 if size >= 0.1 else 3}f}'


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
        return f'{name} ({self.unit})' if self.unit and name != DEVIATION else name

    def shown(self, value: object) -> str:
        """Return a value as text, a dash for a missing one."""
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            return '–' if value is None else str(value)
        if math.isnan(value):
            return '–'
        if math.isinf(value):
            return '∞' if value > 0.0 else '-∞'
        if self.form.endswith('%'):
            return percent(0.01 * value, self.form[:-1])
        return f'{value:{self.form}}'


@dataclass(frozen=True)
class Table:
    """
    Rows of results.

    Printing aligns the columns, and a notebook shows HTML. ``table['verdict']`` returns a column
    by its name without the unit, ``table[0]`` a row by these names, and ``table[:2]`` a table of
    rows. Iteration yields the rows, and `to_pandas` returns a DataFrame.

    Examples
    --------
    >>> from hmsa import Actuator
    >>> table = Actuator().plan([(1.1, 0.5), (1.0, 0.5)]).report()
    >>> table['status']
    ['two_step', 'two_step']
    >>> [row['stretch'] for row in table]
    [1.1, 1.0]
    >>> table[-1]['last level'], len(table[:1])
    (0.0, 1)

    """

    columns: tuple[Column, ...]
    rows: tuple[tuple[Any, ...], ...]
    caption: str = ''
    notes: tuple[str, ...] = ()  #: one sentence each
    legend: tuple[tuple[str, str], ...] = ()  #: headings, and what they mean

    def __len__(self) -> int:
        return len(self.rows)

    def __iter__(self) -> Iterator[dict[str, Any]]:
        return iter(self.records())

    @overload
    def __getitem__(self, key: str) -> list[Any]: ...

    @overload
    def __getitem__(self, key: SupportsIndex) -> dict[str, Any]: ...

    @overload
    def __getitem__(self, key: slice) -> 'Table': ...

    def __getitem__(self, key: Any) -> Any:
        if isinstance(key, slice):
            return replace(self, rows=self.rows[key])
        if isinstance(key, SupportsIndex):
            return self.records()[key]
        names = [x.name for x in self.columns]
        check_choice('a column of the table', key, names)
        return [row[names.index(key)] for row in self.rows]

    def __repr__(self) -> str:
        return str(self)  # shown at a prompt

    def __str__(self) -> str:
        texts = list(self._texts())
        right = self._right()
        room = _room()
        heads = [[x.title] for x in self.columns]
        if _width(_widths(heads, texts)) > room:
            heads = [_stacked(x.title, y) for x, y in zip(
                self.columns, _widths([[''] for _ in heads], texts), strict=True)]
        lines: list[str] = []
        for block in _blocks(
                [x.title for x in self.columns], _widths(heads, texts), self._keys(), room):
            lines += [''] * bool(lines) + _aligned(
                [heads[i] for i in block], [[row[i] for i in block] for row in texts],
                [right[i] for i in block])
        room = max(_width_of_terminal(80), 60)
        wide = max((len(x) for x, _ in self.legend), default=0) + len(_GAP)
        for text, indent in (
                (self.caption, 0), *((f'{x:<{wide}}{y}', wide) for x, y in self.legend),
                *((f'note: {x}', 0) for x in self.notes)):
            lines += textwrap.wrap(
                text, room, subsequent_indent=' ' * indent, break_long_words=False,
                break_on_hyphens=False)
        return '\n'.join(lines)

    def _keys(self) -> int:
        """Return the number of leading columns that name a row."""
        named = [all(isinstance(row[i], (str, int)) for row in self.rows)
                 for i in range(len(self.columns))]
        return max(1, named.index(False) if False in named else 1)

    def _repr_html_(self) -> str:
        from html import escape  # slow to import

        # Words to the left, numbers to the right, as notebooks show a DataFrame.
        styles = ['' if x else ' style="text-align: left"' for x in self._right()]

        def row(cells: Sequence[str], tag: str) -> str:
            return '<tr>' + ''.join(
                f'<{tag}{y}>{escape(x)}</{tag}>'
                for x, y in zip(cells, styles, strict=True)) + '</tr>'

        caption = f'<caption>{escape(self.caption)}</caption>' if self.caption else ''
        return (
            f'<table class="dataframe">{caption}'
            f'<thead>{row([x.title for x in self.columns], "th")}</thead><tbody>'
            + ''.join(row(x, 'td') for x in self._texts()) + '</tbody></table>'
            + ''.join(f'<div><b>{escape(x)}</b>: {escape(y)}</div>' for x, y in self.legend)
            + ''.join(f'<p>{escape(x)}</p>' for x in self.notes))

    def _right(self) -> list[bool]:
        """Return whether a column contains numbers."""
        return [all(not isinstance(row[i], str) for row in self.rows)
                for i in range(len(self.columns))]

    def _texts(self) -> Iterator[list[str]]:
        for row in self.rows:
            yield [x.shown(value) for x, value in zip(self.columns, row, strict=True)]

    def records(self) -> list[dict[str, Any]]:
        """
        Return each row as a mapping from column names.

        Examples
        --------
        >>> from hmsa import Actuator
        >>> Actuator().plan([(1.1, 0.5)]).report().records()[0]['status']
        'two_step'

        """
        return [dict(zip((x.name for x in self.columns), row, strict=True)) for row in self.rows]

    def to_pandas(self) -> Any:
        """
        Return a DataFrame whose column names contain the units.

        Raises
        ------
        BadInputError
            If pandas is not installed.

        Examples
        --------
        >>> from hmsa import Actuator
        >>> Actuator().plan([(1.1, 0.5)]).report().to_pandas()[['stretch', 'duration (s)']]
           stretch  duration (s)
        0      1.1           0.5

        """
        return frame({
            f'{x.name} ({x.unit})' if x.unit else x.name: self[x.name] for x in self.columns})


# Characters in a line of a notebook, which has no width of its own.
_NOTEBOOK = 80


def _room() -> float:
    """
    Return the characters in a line of the output; infinite for files and pipes.

    A terminal and a notebook break longer lines anywhere.
    """
    if sys.stdout.isatty() or 'ipykernel' in sys.modules:
        return _width_of_terminal(_NOTEBOOK)
    return math.inf


def _width_of_terminal(otherwise: int) -> int:
    from shutil import get_terminal_size  # slow to import

    return get_terminal_size((otherwise, 24)).columns


def _stacked(title: str, width: int) -> list[str]:
    """Return a heading in several lines, as narrow as its words and the cells allow."""
    most = max([width, *map(len, title.split())])
    return textwrap.wrap(title, most, break_long_words=False, break_on_hyphens=False) or ['']


def _widths(heads: Sequence[Sequence[str]], texts: Sequence[Sequence[str]]) -> list[int]:
    """Return the width of each column."""
    return [max(map(len, (*head, *(row[i] for row in texts)))) for i, head in enumerate(heads)]


def _width(widths: Sequence[int]) -> int:
    """Return the length of a line with columns of these widths."""
    return sum(widths) + len(_GAP) * (len(widths) - 1)


def _blocks(
        titles: Sequence[str], widths: Sequence[int], keys: int, room: float) -> list[list[int]]:
    """Return the columns of each block that fits into a line; each starts with the keys."""
    first = list(range(keys))
    blocks = [first[:]]
    for i in range(keys, len(widths)):
        if titles[i] == DEVIATION and len(blocks[-1]) > keys:
            continue  # with the column before
        added = [i, i + 1] if titles[i + 1:i + 2] == [DEVIATION] else [i]
        if len(blocks[-1]) > keys and _width([widths[x] for x in (*blocks[-1], *added)]) > room:
            blocks.append(first[:])
        blocks[-1] += added
    return blocks


def _aligned(
        heads: Sequence[Sequence[str]], texts: Sequence[Sequence[str]],
        right: Sequence[bool]) -> list[str]:
    """Return the lines of a table."""
    widths, tall = _widths(heads, texts), max(map(len, heads))
    above = zip(*([*[''] * (tall - len(x)), *x] for x in heads), strict=True)
    lines = [_GAP.join(
        f'{x:>{n}}' if number else f'{x:<{n}}'
        for x, n, number in zip(row, widths, right, strict=True)).rstrip()
        for row in (*above, *texts)]
    lines.insert(tall, _GAP.join('─' * n for n in widths))
    return lines


def frame(columns: dict[str, Any]) -> Any:
    """Return columns as a DataFrame; raise `BadInputError` if pandas is not installed."""
    try:
        import pandas
    except ImportError as error:
        raise _missing('pandas') from error
    return pandas.DataFrame(columns)


def dataset(columns: dict[str, Any], units: dict[str, str]) -> Any:
    """
    Return columns as an xarray Dataset over the column ``time``, with units as attributes.

    Raise `BadInputError` if xarray is not installed.
    """
    try:
        import xarray
    except ImportError as error:
        raise _missing('xarray') from error
    return xarray.Dataset({x: ('time', y, {'units': units[x]}) for x, y in columns.items()})


def _missing(name: str) -> BadInputError:
    """Return the error for an optional package that is not installed."""
    return BadInputError(
        f'{name} is not installed: install it (pip install {name}, or the extra {name!r} of this '
        'package), or take the columns as arrays')
