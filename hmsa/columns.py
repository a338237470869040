"""Columns of numbers in files: read from CSV with precise error messages, and written."""

from collections.abc import Mapping
import csv
from dataclasses import dataclass
import io
import math
from pathlib import Path
import re
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hmsa.errors import assume, BadInputError, excerpt
from hmsa.files import read_at_most, replacing, require_arrow

Array = NDArray[np.float64]

#: Units of the columns of samples and levels.
UNITS = {'time': 's', 'stretch': '1', 'stretch_rate': '1/s', 'flux_density': 'T'}
# Formats in which columns are written.
_FORMATS = ('.csv', '.parquet', '.mat')

_SEPARATORS = (';', '\t', ',', '|')
_STRONGEST = 5.0  # maximum flux density of a coil in T
_UNUSUAL = 100.0  # current of a coil in A above which a column without a unit may be in mA
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
    'effort': 'flux_density', 'deflection': 'stretch'}
# Units whose case is not that of the tables, which are compared in lower case.
_WRITTEN = {'t': 'T', 'mt': 'mT', 'g': 'G', 'a': 'A', 'ma': 'mA', 'v': 'V'}
# Units of a column that needs the length at rest.
_LENGTHS = {'m': 1.0, 'cm': 1e-2, 'mm': 1e-3, 'um': 1e-6, 'µm': 1e-6}
_SUFFIXES = ('s', 'ms', 'us', 'ns', 't', 'mt', 'a', 'ma', 'm', 'cm', 'mm')
# A row of units may have these below a number without a unit.
_DIMENSIONLESS = ('', '1', '-')
#: Words of a note.
DIVIDED = 'divided by the length at rest'
_DIVIDE = 'divide it by the length at rest, or name that: hmsa identify --rest-length 20mm'
_MISSING = frozenset((
    '', 'nan', 'na', 'n/a', 'null', 'none', '-', '--', '\u2013', '\u2014',
    # Errors of a spreadsheet.
    '#n/a', '#na', '#num!', '#div/0!', '#value!', '#ref!', '#name?', '#null!'))
_NO_TEXT = re.compile(rb'[\x00-\x08\x0e-\x1f]')
_HEADER = re.compile(r'\s*([A-Za-z_µ ]+?)\s*(?:[\[(/]\s*([^\])]*?)\s*[\])]?)?\s*')
_SEPARATOR_LINE = re.compile(r'\s*"?sep=(.)"?\s*', re.IGNORECASE)


@dataclass(frozen=True, eq=False)
class CsvColumns:
    """Columns of a CSV file by name."""

    columns: dict[str, Array]  # in SI; NaN for a missing value
    lines: Array  # line number of each row
    with_unit: frozenset[str]  # names of the columns whose unit the file gives

    def check_complete(self, path: Path, because: str = '') -> None:
        """Raise `BadInputError`, with a reason if given, unless all cells have finite numbers."""
        bad = ~np.all([np.isfinite(x) for x in self.columns.values()], axis=0)
        if np.any(bad):
            raise BadInputError(
                f'{path} line {self.lines[np.argmax(bad)]} has no number for '
                f'{" or ".join(self.columns)}: expected both in every line{because}')


@dataclass(frozen=True)
class _Place:
    """A column of the file that may be a wanted one."""

    index: int
    cell: str  # of the header
    name: str  # of the wanted column
    unit: str  # lower case; empty for none
    alias: bool  # whether the header has another name

    @property
    def rank(self) -> int:
        """Lower for a header that is closer to the wanted name."""
        return 2 if self.alias else 1 if self.unit else 0


def remedy(column: str, unit: str, from_csv: bool) -> str:
    """Return how to give numbers in another unit: in the header of a CSV, or converted."""
    return (f'write "{column} [{unit}]" in the header of the CSV' if from_csv else
            f'convert them to {_WRITTEN.get(x := next(iter(_UNITS[column])), x)}')


def check_flux_densities(source: object, levels: Array, from_csv: bool = True) -> None:
    """Raise `BadInputError` for more T than any coil has, such as mT read as T."""
    most = float(np.nanmax(np.abs(levels), initial=0.0))
    if most > _STRONGEST:
        raise BadInputError(
            f'{source} has flux densities up to {most:.6g} T: expected at most {_STRONGEST:g} T; '
            f'if they are in mT, {remedy("flux_density", "mT", from_csv)}')


def read_currents(path: Path) -> tuple[Array, Array]:
    """
    Read the columns ``current`` in A and ``flux_density`` in T of a CSV file.

    Raise `BadInputError` if the file cannot be used, or has numbers that look like other units.
    """
    table = read_table(path, ('current', 'flux_density'))
    current, flux = (table.columns[x] for x in ('current', 'flux_density'))
    most = float(np.nanmax(np.abs(current), initial=0.0))
    if 'current' not in table.with_unit and most > _UNUSUAL:
        raise BadInputError(
            f'{path} has currents up to {most:.6g} without a unit: expected at most '
            f'{_UNUSUAL:g} A; write "current [mA]" in its header, or "current [A]" if they '
            'are in A')
    table.check_complete(path)
    check_flux_densities(path, flux)
    return current, flux


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


def read_table(
        path: Path, wanted: tuple[str, ...], *, kind: str = 'a CSV',
        rest_length: float | None = None, notes: list[str] | None = None) -> CsvColumns:
    """
    Read the wanted columns of a CSV file, in SI.

    Separators are detected, and so are units after a name, as in ``flux_density [mT]``, or in a
    row below the header. A column with the wanted name is preferred to one with another name for
    the same quantity, such as ``field``.

    Parameters
    ----------
    path : Path
        The file.
    wanted : tuple of str
        Names of the columns.
    kind : str
        Expected kind of file, for messages.
    rest_length : float, optional
        Length in m by which lengths are divided to obtain the stretch.
    notes : list of str, optional
        Receives which columns were taken for what, and converted; by default `assume` says which
        were taken for what by their names.

    Returns
    -------
    Table
        The columns.

    Raises
    ------
    BadInputError
        If the file cannot be read or has no header, or if a column is missing or one of several.

    """
    rows, separator = _rows(_text(path, kind))
    if not rows:
        raise BadInputError(f'{path} is empty: expected a header and rows of numbers')
    head = rows[0][1]
    if '\0' in head:
        raise BadInputError(f'{path} has zero bytes in its header: expected {kind} in UTF-8')
    separator = separator or next((x for x in _SEPARATORS if x in head), None)
    cells = _split(head, separator)
    if separator is None and any(x[0] in '[(' for x in cells):
        raise BadInputError(
            f'{path} has spaces between its columns and before units ({excerpt(head)}): expected '
            'commas, semicolons or tabs between the columns')
    if all(_number(x, separator) is not None for x in cells):
        raise BadInputError(
            f'{path} begins with numbers ({excerpt(head)}): expected a header with the columns '
            f'{", ".join(wanted)} in line {rows[0][0]}')
    other = _ALIASES if rest_length is None else {**_ALIASES, 'length': 'stretch'}
    places = _places(path, cells, wanted, other)
    missing = [x for x in wanted if x not in places]
    if missing:
        raise BadInputError(
            f'{path} has no column {" and no column ".join(missing)}: expected '
            f'{", ".join(wanted)}; its columns are {excerpt(", ".join(cells))}'
            + (_of_another(cells, rest_length) if 'stretch' in missing else ''))
    below = _units_below(path, rows, separator, places)
    factors = {name: _factor(path, x, below.get(name, ''), rest_length)
               for name, x in places.items()}
    columns: dict[str, Array] = {
        name: np.full(len(rows) - 1 - bool(below), np.nan) for name in wanted}
    for i, (line, text) in enumerate(rows[1 + bool(below):]):
        parts = _split(text, separator)
        if any(parts[len(cells):]):
            raise BadInputError(
                f'{path} line {line} has {len(parts)} cells in {len(cells)} columns '
                f'({excerpt(text)}): expected a number a column{_decimal_commas(separator)}')
        for name, place in places.items():
            if place.index >= len(parts):
                continue
            value = _number(parts[place.index], separator)
            if value is None:
                raise BadInputError(
                    f'{path} line {line} has {excerpt(parts[place.index])} in column {name}: '
                    'expected a number'
                    + (_decimal_commas(separator) if ',' in parts[place.index] else ''))
            columns[name][i] = value * factors[name]
    for text, stated in _taken(path, places, factors, rest_length):
        if notes is not None:
            notes.append(text)
        elif not stated:
            assume(text)
    return CsvColumns(
        columns, np.array([x[0] for x in rows[1 + bool(below):]]),
        frozenset(name for name, x in places.items() if x.unit or below.get(name)))


def _rows(text: str) -> tuple[list[tuple[int, str]], str | None]:
    """Return number and text of each line, and the separator if the first line sets it."""
    rows = [(i, x) for i, x in enumerate(text.splitlines(), 1)
            if x.strip() and (not x.lstrip().startswith('#') or _is_missing(x))]
    found = _SEPARATOR_LINE.fullmatch(rows[0][1]) if rows else None
    return (rows, None) if found is None else (rows[1:], found[1])


def _is_missing(line: str) -> bool:
    """Return whether a line begins with an error of a spreadsheet rather than as a comment."""
    return re.split(r'[;,|\s"]', line.strip().lower(), maxsplit=1)[0] in _MISSING


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
    try:
        return float(text)
    except ValueError:
        pass
    if text.lower() in _MISSING:
        return math.nan
    text = text.replace('\u2212', '-')  # the minus sign of typesetting
    try:
        return float(text.replace(',', '.') if separator != ',' else text)
    except ValueError:
        return None


def _places(
        path: Path, cells: list[str], names: tuple[str, ...], other: Mapping[str, str]
) -> dict[str, _Place]:
    """
    Return the column of each wanted name that the file has.

    ``other`` are further names, which count where no column has the wanted one. Raises
    `BadInputError` if several columns may be meant.
    """
    found: dict[str, list[_Place]] = {}
    for index, cell in enumerate(cells):
        match = _HEADER.fullmatch(cell)
        if match is None:
            continue
        name = '_'.join(match[1].lower().split())
        # The prefix is the micro sign or the Greek letter.
        unit = (match[2] or '').strip().lower().replace('\u03bc', 'µ')
        for suffix in _SUFFIXES:
            stem = name.removesuffix(f'_{suffix}')
            if not unit and stem != name and other.get(stem, stem) in names:
                name, unit = stem, suffix
        meant = other.get(name, name)
        if meant in names:
            found.setdefault(meant, []).append(_Place(index, cell, meant, unit, meant != name))
    places = {}
    for name, every in found.items():
        best = [x for x in every if x.rank == min(y.rank for y in every)]
        if len(best) > 1 and len({x.cell for x in best}) == 1:
            raise BadInputError(f'{path} has two columns {excerpt(best[0].cell)}: expected one')
        if len(best) > 1:
            raise BadInputError(
                f'{path} has the columns {" and ".join(excerpt(x.cell) for x in best)}, each of '
                f'which may be {name}: expected one of them, named {name}')
        places[name] = best[0]
    return places


def _units_below(
        path: Path, rows: list[tuple[int, str]], separator: str | None,
        places: dict[str, _Place]) -> dict[str, str]:
    """Return the unit of each column from a row of units below the header, if there is one."""
    if len(rows) < 2:
        return {}
    parts = [x.strip('[]() ').lower().replace('\u03bc', 'µ')
             for x in _split(rows[1][1], separator)]
    units = {name: parts[x.index] for name, x in places.items() if x.index < len(parts)}
    if not any(x not in _DIMENSIONLESS and x in {**_UNITS[name], **_LENGTHS}
               for name, x in units.items()):
        return {}
    for name, unit in units.items():
        own = places[name].unit
        if own and unit and unit != own:
            raise BadInputError(
                f'{path} line {rows[1][0]} gives {name} in {excerpt(unit)}, its header in '
                f'{excerpt(own)}: expected one unit')
    return units


def _factor(path: Path, place: _Place, below: str, rest_length: float | None) -> float:
    """Return the factor from a column to SI; raise `BadInputError` for another quantity."""
    known, unit = _UNITS[place.name], place.unit or below
    if place.name == 'stretch' and rest_length is not None:
        if unit not in _LENGTHS:
            raise BadInputError(
                f'a length at rest is given, and {path} has the column {excerpt(place.cell)}: '
                f'expected a unit of length in its header, as in length [mm], one of '
                f'{", ".join(_LENGTHS)}; a stretch needs no length at rest')
        return _LENGTHS[unit] / rest_length
    if unit in known or not unit:
        return known[unit or next(iter(known))]
    expected = ', '.join(_WRITTEN.get(x, x) for x in known if x)
    if place.name == 'stretch':
        expected = 'no unit: ' + (
            _DIVIDE if unit in _LENGTHS else 'divide percent by 100, and add 1 to a strain')
    raise BadInputError(f'{path} gives {place.name} in {unit}: expected {expected}')


def _of_another(cells: list[str], rest_length: float | None) -> str:
    """Return how to obtain a stretch from the columns of a file without one."""
    if rest_length is not None:
        return '; with a length at rest, call the column of lengths length [mm]'
    names = ' '.join(cells).lower()
    if 'strain' in names:
        return '; stretch is strain' + ' in percent over 100' * ('%' in names) + ' plus 1'
    if re.search('displacement|elongation|extension', names):
        return '; stretch is the change of length over the length at rest, plus 1'
    return f'; for a length, {_DIVIDE}' if re.search('length|mm', names) else ''


def _taken(
        path: Path, places: dict[str, _Place], factors: dict[str, float],
        rest_length: float | None) -> list[tuple[str, bool]]:
    """Return a sentence for each column with another name or unit, and whether it follows."""
    found = []
    for name, place in places.items():
        what = f'{path}: column {excerpt(place.cell)} was '
        if place.name == 'stretch' and rest_length is not None:
            found.append((f'{what}{DIVIDED}, {rest_length:g} m', True))
        elif place.alias or factors[name] != 1.0:
            text = what + ' and '.join(
                [f'taken for {name}'] * place.alias
                + ['converted to SI units'] * (factors[name] != 1.0))
            found.append((text, not place.alias))
    return found


def read_only(values: NDArray[Any]) -> NDArray[Any]:
    """Return a view of an array that cannot be written to."""
    view = values.view()
    view.flags.writeable = False
    return view


def write_table(path: Path, columns: Mapping[str, Array]) -> None:
    """
    Write columns as CSV, Parquet or Matlab file, by the suffix of the name, in full precision.

    NaN is left empty in CSV. Raise `BadInputError` if the suffix is unknown, pyarrow is missing,
    or the file cannot be written.
    """
    kind = path.suffix.lower()
    if kind not in _FORMATS:
        raise BadInputError(
            f'the format of {path} is unknown: expected a name that ends in '
            + ' or '.join(_FORMATS))
    if kind == '.parquet':
        arrow, parquet = require_arrow()
        with replacing(path) as beside:
            parquet.write_table(arrow.table(dict(columns)), beside)
        return
    if kind == '.mat':
        from scipy.io import savemat  # slow to import

        # Open the file here, since errors of savemat do not give the reason.
        with replacing(path) as beside, beside.open('wb') as matrix:
            savemat(matrix, dict(columns), oned_as='column')
        return
    with replacing(path) as beside, beside.open('w', newline='', encoding='utf-8') as file:
        writer = csv.writer(file)
        writer.writerow(columns)
        writer.writerows(
            ['' if math.isnan(value) else repr(value) for value in row]
            for row in zip(*(x.tolist() for x in columns.values()), strict=True))
