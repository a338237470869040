"""Columns of numbers from CSV files, with precise error messages."""

import csv
from dataclasses import dataclass
import io
import math
from pathlib import Path
import re

import numpy as np
from numpy.typing import NDArray

from hmsa_ros.errors import BadInputError, excerpt
from hmsa_ros.files import read_at_most

Array = NDArray[np.float64]

_SEPARATORS = (';', '\t', ',', '|')
_LARGEST_FILE = 512 * 1024 * 1024
# The first unit of each quantity is the default.
_UNITS = {
    'time': {'s': 1.0, 'sec': 1.0, 'seconds': 1.0, 'ms': 1e-3, 'us': 1e-6, 'µs': 1e-6,
             'ns': 1e-9},
    'current': {'a': 1.0, 'amperes': 1.0, 'ma': 1e-3, 'v': 1.0},
    'stretch': {'': 1.0, '1': 1.0, '-': 1.0},
    'flux_density': {'t': 1.0, 'tesla': 1.0, 'mt': 1e-3, 'g': 1e-4, 'gauss': 1e-4},
}
_ALIASES = {
    't': 'time', 'stamp': 'time', 'timestamp': 'time', 'lambda': 'stretch',
    'position': 'stretch', 'b': 'flux_density', 'flux': 'flux_density', 'field': 'flux_density',
    'effort': 'flux_density'}
_NO_TEXT = re.compile(rb'[\x00-\x08\x0e-\x1f]')
_HEADER = re.compile(r'\s*([A-Za-z_µ ]+?)\s*(?:[\[(/]\s*([^\])]*?)\s*[\])]?)?\s*')


@dataclass(frozen=True, eq=False)
class Table:
    """Columns of a CSV file by name."""

    columns: dict[str, Array]  # in SI; NaN for a missing value
    lines: Array  # line number of each row
    notes: tuple[str, ...]  # conversions

    def check_complete(self, path: Path, because: str = '') -> None:
        """Raise `BadInputError`, with a reason if given, unless all cells have finite numbers."""
        bad = ~np.all([np.isfinite(x) for x in self.columns.values()], axis=0)
        if np.any(bad):
            raise BadInputError(
                f'{path} line {self.lines[np.argmax(bad)]} has no number for '
                f'{" or ".join(self.columns)}: expected both in every line{because}')


def _text(path: Path, kind: str) -> str:
    try:
        return _decoded(read_at_most(path, _LARGEST_FILE, 'a smaller CSV'))
    except UnicodeDecodeError as error:
        raise BadInputError(
            f'{path} is no text: expected {kind}; save a spreadsheet as CSV') from error
    except OSError as error:
        raise BadInputError(
            f'{path} cannot be read ({error.strerror or error}): expected {kind}') from error


def _decoded(content: bytes) -> str:
    """Return decoded text, by its byte order mark, as UTF-8 or as code page 1252."""
    if content.startswith((b'\xff\xfe', b'\xfe\xff')):
        return content.decode('utf-16')
    try:
        return content.decode('utf-8-sig')
    except UnicodeDecodeError:
        if _NO_TEXT.search(content):
            raise
        return content.decode('cp1252')


def read_table(path: Path, wanted: tuple[str, ...], *, kind: str = 'a CSV') -> Table:
    """
    Read the wanted columns of a CSV file, in SI.

    Separators are detected, and so are units after a name, as in ``flux_density [mT]``. ``kind``
    is the expected kind of file in messages. Raises `BadInputError` if the file cannot be read or
    has no header, or if a column is missing.
    """
    rows = [(i, x) for i, x in enumerate(_text(path, kind).splitlines(), 1)
            if x.strip() and not x.lstrip().startswith('#')]
    if not rows:
        raise BadInputError(f'{path} is empty: expected a header and rows of numbers')
    head = rows[0][1]
    if '\0' in head:
        raise BadInputError(f'{path} has zero bytes in its header: expected {kind} in UTF-8')
    separator = next((x for x in _SEPARATORS if x in head), None)
    cells = _split(head, separator)
    if all(_number(x, separator) is not None for x in cells):
        raise BadInputError(
            f'{path} begins with numbers ({excerpt(head)}): expected a header with the columns '
            f'{", ".join(wanted)} in line {rows[0][0]}')
    places, notes = _places(path, cells, wanted)
    missing = [x for x in wanted if x not in places]
    if missing:
        raise BadInputError(
            f'{path} has no column {" and no column ".join(missing)}: expected '
            f'{", ".join(wanted)}; its columns are {excerpt(", ".join(cells))}'
            + ('; stretch is strain plus 1' if 'stretch' in missing
               and any('strain' in x.lower() for x in cells) else ''))
    columns: dict[str, Array] = {name: np.full(len(rows) - 1, np.nan) for name in wanted}
    for i, (line, text) in enumerate(rows[1:]):
        parts = _split(text, separator)
        if any(parts[len(cells):]):
            raise BadInputError(
                f'{path} line {line} has {len(parts)} cells in {len(cells)} columns '
                f'({excerpt(text)}): expected a number a column{_decimal_commas(separator)}')
        for name, (place, factor) in places.items():
            if place >= len(parts):
                continue
            value = _number(parts[place], separator)
            if value is None:
                raise BadInputError(
                    f'{path} line {line} has {excerpt(parts[place])} in column {name}: expected '
                    f'a number{_decimal_commas(separator) if "," in parts[place] else ""}')
            columns[name][i] = value * factor
    return Table(columns, np.array([x[0] for x in rows[1:]]), tuple(notes))


def _decimal_commas(separator: str | None) -> str:
    return ('; numbers with decimal commas need semicolons between the columns'
            if separator == ',' else '')


def _split(text: str, separator: str | None) -> list[str]:
    if separator is None:
        return text.split()
    try:
        return [x.strip() for x in next(csv.reader(io.StringIO(text), delimiter=separator))]
    except csv.Error:  # a NUL or an overlong cell, which is not a number
        return [text]


def _number(text: str, separator: str | None) -> float | None:
    """Return the number in a cell, NaN for a missing value, None for other text."""
    if text.lower() in ('', 'nan', 'na', 'n/a', 'null', 'none'):
        return math.nan
    try:
        return float(text.replace(',', '.') if separator != ',' else text)
    except ValueError:
        return None


def _places(
        path: Path, cells: list[str], names: tuple[str, ...]
) -> tuple[dict[str, tuple[int, float]], list[str]]:
    """Return place and factor of each known column, and notes about conversions."""
    places: dict[str, tuple[int, float]] = {}
    notes = []
    for place, cell in enumerate(cells):
        match = _HEADER.fullmatch(cell)
        if match is None:
            continue
        name = '_'.join(match[1].lower().split())
        # The prefix is the micro sign or the Greek letter.
        unit = (match[2] or '').strip().lower().replace('\u03bc', 'µ')
        for suffix in ('ms', 'us', 'mt', 'mm', 's', 't'):
            stem = name.removesuffix(f'_{suffix}')
            if not unit and stem != name and _ALIASES.get(stem, stem) in names:
                name, unit = stem, suffix
        name = _ALIASES.get(name, name)
        if name not in names:
            continue
        if cell in cells[:place]:
            raise BadInputError(f'{path} has two columns {excerpt(cell)}: expected one')
        if name in places:
            continue
        known = _UNITS[name]
        unit = unit or next(iter(known))
        if unit not in known:
            raise BadInputError(
                f'{path} gives {name} in {unit}: expected '
                + ('no unit: divide a length by the length at rest, percent by 100'
                   if name == 'stretch' else ', '.join(known)))
        factor = known[unit]
        if factor != 1.0:
            notes.append(f'column {cell} was converted to SI units')
        places[name] = place, factor
    return places, notes
