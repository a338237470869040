"""
Sweeps: two-step plans over grids of parameters or a table of cases, to CSV or Parquet.

A sweep is a product of axes. It is planned in blocks, so that its size is bounded by the disk
and not by the memory, and a row that cannot be planned says why in its status.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
import csv
from dataclasses import dataclass
import math
from pathlib import Path
import sys
from types import TracebackType
from typing import Any, TextIO

import numpy as np
from numpy.typing import NDArray

from hmsa_ros.core.model import Array, signed_root
from hmsa_ros.core.two_step import CODES, plan_two_step_batch
from hmsa_ros.errors import BadInputError
from hmsa_ros.files import replacing

#: What can be swept, with the value of what is not.
DEFAULTS = {'start': 1.0, 'target': 1.1, 'zeta': 0.2, 'j_lim': 5.0, 'c1': 2.0}
#: Columns of the numbers that a plan consists of, after the inputs and the status.
RESULTS = ('beta_p', 'b_p', 'tau_p', 'beta_1', 'b_1')
COLUMNS = (*DEFAULTS, 'status', *RESULTS)
#: More are refused: a slip of the keyboard, most likely.
MOST_POINTS = 10_000_000
#: Rows planned at a time.
BLOCK = 10_000

_GRID = 'VALUE, FIRST:LAST:POINTS, log:FIRST:LAST:POINTS, or several separated by commas'
_STATUS = np.array([str(CODES[number]) for number in sorted(CODES)])


def too_many(points: int) -> BadInputError:
    """Return the error for a sweep of so many points, which is too large."""
    return BadInputError(
        f'the sweep has {points:,} points: expected at most {MOST_POINTS:,}; take fewer, or '
        'split it')


def parse_grid(text: str, column: str) -> Array:
    """
    Read a column's values and grids: ``0.2``, ``0:2:1000``, ``log:0.1:100:50``, with commas.

    Raises
    ------
    BadInputError
        If the text is no grid, or a value is not finite or never has a plan.

    """
    parts = [_part(part.strip(), text, column) for part in text.split(',')]
    if sum(x.size for x in parts) > MOST_POINTS:
        raise too_many(sum(x.size for x in parts))
    values = np.concatenate(parts)
    least = 'at least 0' if column == 'zeta' else 'greater than 0'
    wrong = ~np.isfinite(values) | ((values < 0.0) if column == 'zeta' else (values <= 0.0))
    if np.any(wrong):
        raise BadInputError(
            f'{column} of {text!r} takes the value {float(values[wrong][0]):g}: expected '
            f'finite numbers {least}')
    return values


def _part(part: str, text: str, column: str) -> Array:
    """Read one value or one grid."""
    words = part.split(':')
    spacing = np.geomspace if words[0] == 'log' else np.linspace
    numbers = words[1:] if words[0] == 'log' else words
    try:
        if len(words) == 1:
            return np.array([float(words[0])])
        first, last = float(numbers[0]), float(numbers[1])
        points = int(numbers[2])
        if len(numbers) != 3:
            raise ValueError(part)
    except (ValueError, IndexError):
        raise BadInputError(f'{column} is {text!r}: expected {_GRID}') from None
    if points < 2:
        raise BadInputError(f'{column} of {text!r} has {points} points: expected at least 2')
    if points > MOST_POINTS:
        raise too_many(points)
    if not math.isfinite(first) or not math.isfinite(last):
        raise BadInputError(f'{column} is {text!r}: expected finite ends of the grid')
    if words[0] == 'log' and not (first > 0.0 and last > 0.0):
        raise BadInputError(
            f'{column} is {text!r}: expected ends greater than 0 for a logarithmic grid')
    with np.errstate(all='ignore'):
        return np.asarray(spacing(first, last, points), dtype=np.float64)


def read_cases(path: Path) -> dict[str, Array]:
    """
    Read a table of cases.

    Parameters
    ----------
    path : Path
        CSV file with a header; each column is one of `DEFAULTS`.

    Returns
    -------
    dict of str to ndarray, shape (n,)
        Columns by name. Numbers are taken as they are, those out of range and NaN too: the
        plan of such a row says so.

    Raises
    ------
    BadInputError
        If the file cannot be read, a column is unknown or repeated, a row has more or fewer
        cells than the header, or a cell is no number.

    """
    expected = ', '.join(DEFAULTS)
    rows: list[list[float]] = []
    try:
        with path.open(newline='', encoding='utf-8-sig') as file:
            reader = csv.reader(file, strict=True)
            names = [name.strip() for name in next(reader, [])]
            if not names:
                raise BadInputError(
                    f'{path} is empty: expected a header with some of {expected}, and cases')
            for name in names:
                if name not in DEFAULTS:
                    raise BadInputError(
                        f'{path} has a column {name!r}: expected some of {expected}')
                if names.count(name) > 1:
                    raise BadInputError(f'{path} has two columns {name!r}: expected one')
            for cells in reader:
                if cells:
                    rows.append(_case(cells, names, f'{path}, line {reader.line_num}'))
                if len(rows) > MOST_POINTS:
                    raise BadInputError(
                        f'{path} has more than {MOST_POINTS:,} cases: expected at most that '
                        'many; split it')
    except OSError as error:
        raise BadInputError(
            f'cannot read {path}: {error.strerror or error}; expected a CSV file of cases'
        ) from error
    except (UnicodeDecodeError, csv.Error) as error:
        raise BadInputError(f'{path} is no CSV file in UTF-8: {error}') from error
    if not rows:
        raise BadInputError(f'{path} has a header only: expected at least one case')
    return dict(zip(names, np.array(rows).T, strict=True))


def _case(cells: Sequence[str], names: Sequence[str], where: str) -> list[float]:
    """Read a row of a table of cases."""
    if len(cells) != len(names):
        raise BadInputError(f'{where}: {len(cells)} cells, expected {len(names)}')
    values = []
    for name, cell in zip(names, cells, strict=True):
        try:
            values.append(float(cell))
        except ValueError:
            raise BadInputError(f'{where}: {name} is {cell!r}, expected a number') from None
    return values


@dataclass(frozen=True)
class Rows:
    """
    Rows of a sweep, planned.

    Attributes
    ----------
    inputs : dict of str to ndarray, shape (n,)
        Columns of `DEFAULTS`, in that order.
    status : ndarray of str, shape (n,)
        Code of each row.
    results : dict of str to ndarray, shape (n,)
        Columns of `RESULTS`, in that order; NaN where there is no such number.

    """

    inputs: dict[str, Array]
    status: NDArray[np.str_]
    results: dict[str, Array]


class Sweep:
    """
    All combinations of the cases of a table and the values of other columns.

    Parameters
    ----------
    grids : mapping of str to ndarray, shape (n,)
        Values by column; a column that is named nowhere has its default.
    cases : mapping of str to ndarray, shape (m,), optional
        Columns of a table, taken row by row; none of them in ``grids``.

    Attributes
    ----------
    size : int
        Number of rows. The cases vary slowest, then the columns in the order of `DEFAULTS`.

    Raises
    ------
    BadInputError
        If a column is unknown, empty or in both, the cases differ in length, or there are too
        many points.

    """

    def __init__(
            self, grids: Mapping[str, Array],
            cases: Mapping[str, Array] | None = None) -> None:
        cases = cases or {}
        for name in (*grids, *cases):
            if name not in DEFAULTS:
                raise BadInputError(
                    f'column {name!r} is unknown: expected some of {", ".join(DEFAULTS)}')
            if name in grids and name in cases:
                raise BadInputError(
                    f'{name} is a column of the cases and has values of its own: expected one '
                    'of them')
        table = {name: np.asarray(x, dtype=np.float64) for name, x in cases.items()}
        if len({x.size for x in table.values()}) > 1:
            raise BadInputError('the columns of the cases differ in length: expected one length')
        axes = [table] if table else []
        axes += [
            {name: np.asarray(grids.get(name, [default]), dtype=np.float64)}
            for name, default in DEFAULTS.items() if name not in table]
        self._axes = axes
        self._shape = [next(iter(axis.values())).size for axis in axes]
        self.size = math.prod(self._shape)
        if self.size == 0:
            raise BadInputError('a column of the sweep is empty: expected at least one value')
        if self.size > MOST_POINTS:
            raise too_many(self.size)

    def blocks(self, rows: int = BLOCK) -> Iterator[Rows]:
        """Plan the sweep and yield its rows in order, in blocks of so many."""
        for begin in range(0, self.size, rows):
            places = np.unravel_index(
                np.arange(begin, min(begin + rows, self.size)), self._shape)
            values = {
                name: column[place]
                for axis, place in zip(self._axes, places, strict=True)
                for name, column in axis.items()}
            inputs = {name: values[name] for name in DEFAULTS}
            plans = plan_two_step_batch(
                inputs['start'], inputs['target'], zeta=inputs['zeta'], j_lim=inputs['j_lim'],
                c1=inputs['c1'])
            yield Rows(inputs, _STATUS[plans.status], {
                'beta_p': plans.beta_p, 'b_p': signed_root(plans.beta_p),
                'tau_p': plans.tau_p, 'beta_1': plans.beta_1,
                'b_1': signed_root(plans.beta_1)})


class CsvWriter:
    """Writes blocks as CSV, numbers in full double precision."""

    def __init__(self, file: TextIO) -> None:
        """Write the header."""
        self._writer = csv.writer(file, lineterminator='\n')
        self._writer.writerow(COLUMNS)

    def write(self, block: Rows) -> None:
        """Write a block of rows."""
        self._writer.writerows(zip(
            *(x.tolist() for x in block.inputs.values()), block.status.tolist(),
            *(x.tolist() for x in block.results.values()), strict=True))


class ParquetWriter:
    """Writes blocks as Parquet, a row group each, through pyarrow."""

    def __init__(self, path: Path) -> None:
        """Open the file."""
        self._arrow, parquet = _arrow()
        self._schema = self._arrow.schema([
            (name, self._arrow.string() if name == 'status' else self._arrow.float64())
            for name in COLUMNS])
        self._writer = parquet.ParquetWriter(path, self._schema)

    def __enter__(self) -> 'ParquetWriter':
        """Return the writer."""
        return self

    def __exit__(
            self, kind: type[BaseException] | None, error: BaseException | None,
            trace: TracebackType | None) -> None:
        """Write the footer."""
        self._writer.close()

    def write(self, block: Rows) -> None:
        """Write a block of rows."""
        self._writer.write_table(self._arrow.table(
            {**block.inputs, 'status': block.status.tolist(), **block.results},
            schema=self._schema))


def _arrow() -> tuple[Any, Any]:
    try:
        import pyarrow
        from pyarrow import parquet
    except ImportError as error:
        raise BadInputError(
            'pyarrow, which writes Parquet, is not installed: install it (pip install '
            '"hmsa_ros[studies]") or write to a file that ends in .csv') from error
    return pyarrow, parquet


@contextmanager
def open_writer(path: Path | None) -> Iterator[Callable[[Rows], None]]:
    """
    Open what the blocks of a sweep are written to.

    Parameters
    ----------
    path : Path or None
        A file that ends in .csv or .parquet, None for standard output. A file of that name is
        replaced when all is written, and left alone otherwise.

    Yields
    ------
    callable
        Writes a `Rows`.

    Raises
    ------
    BadInputError
        If the name ends otherwise, pyarrow is missing, or the file cannot be written.

    """
    if path is None:
        yield CsvWriter(sys.stdout).write
        sys.stdout.flush()
        return
    kind = path.suffix.lower()
    if kind not in {'.csv', '.parquet'}:
        raise BadInputError(
            f'the format of {path} is unknown: expected a name that ends in .csv or .parquet')
    if path.is_dir():
        raise BadInputError(f'{path} is a folder: expected the name of a file')
    if kind == '.parquet':
        _arrow()
    with replacing(path) as beside:
        if kind == '.csv':
            with beside.open('w', newline='', encoding='utf-8') as file:
                yield CsvWriter(file).write
        else:
            with ParquetWriter(beside) as writer:
                yield writer.write
