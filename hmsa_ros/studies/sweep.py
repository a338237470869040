"""
Sweeps: two-step plans over grids of parameters or a table of cases.

A sweep is a product of axes. It is planned in blocks, so that its size is bounded by the disk
and not by the memory, and a row that cannot be planned says why in its status.
"""

from collections.abc import Iterator, Mapping, Sequence
import csv
from dataclasses import dataclass
from functools import cached_property
import hashlib
import math
from pathlib import Path
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from hmsa_ros.core.model import Array, signed_root
from hmsa_ros.core.two_step import CODES, plan_two_step_batch
from hmsa_ros.errors import BadInputError
from hmsa_ros.files import require_arrow

#: What can be swept, with the value of what is not.
DEFAULTS = {'start': 1.0, 'target': 1.1, 'zeta': 0.2, 'j_lim': 5.0, 'c1': 2.0}
#: Columns of the numbers that a plan consists of, after the inputs and the status.
RESULTS = ('beta_p', 'b_p', 'tau_p', 'beta_1', 'b_1')
COLUMNS = (*DEFAULTS, 'status', *RESULTS)
#: More values of one column, or cases, are refused: a sweep has no limit, but they are in memory.
MOST_VALUES = 10_000_000
#: Roughly: plans a second and core of an idle machine, and bytes of a row as Parquet.
RATE, ROW_BYTES = 150_000.0, 50

_GRID = 'VALUE, FIRST:LAST:POINTS, log:FIRST:LAST:POINTS, or several separated by commas'
_STATUS = np.array([str(CODES[number]) for number in sorted(CODES)])


def _too_many(column: str, points: int) -> BadInputError:
    return BadInputError(
        f'{column} has {points:,} points: expected at most {MOST_VALUES:,} of one column')


def parse_grid(text: str, column: str) -> Array:
    """
    Read a column's values and grids: ``0.2``, ``0:2:1000``, ``log:0.1:100:50``, with commas.

    Raises
    ------
    BadInputError
        If the text is no grid, or a value is not finite or never has a plan.

    """
    parts = [_part(part.strip(), text, column) for part in text.split(',')]
    if sum(x.size for x in parts) > MOST_VALUES:
        raise _too_many(column, sum(x.size for x in parts))
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
    if points > MOST_VALUES:
        raise _too_many(column, points)
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
                if len(rows) > MOST_VALUES:
                    raise BadInputError(
                        f'{path} has more than {MOST_VALUES:,} cases: expected at most that '
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
    codes : ndarray of int64, shape (n,)
        Keys of `CODES`.
    results : dict of str to ndarray, shape (n,)
        Columns of `RESULTS`, in that order; NaN where there is no such number.

    """

    inputs: dict[str, Array]
    codes: NDArray[np.int64]
    results: dict[str, Array]

    @property
    def status(self) -> NDArray[np.str_]:
        """Return the code of each row."""
        return _STATUS[self.codes]

    def lists(self) -> list[list[Any]]:
        """Return the columns as lists."""
        return [*(x.tolist() for x in self.inputs.values()), self.status.tolist(),
                *(x.tolist() for x in self.results.values())]

    def arrow(self) -> Any:
        """Return the columns as a table of pyarrow."""
        arrow, _ = require_arrow()
        status = arrow.DictionaryArray.from_arrays(self.codes, _STATUS.tolist())
        return arrow.table(
            {**self.inputs, 'status': status.cast(arrow.string()), **self.results})


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
        If a column is unknown, empty or in both, or the cases differ in length.

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

    @cached_property
    def digest(self) -> str:
        """Return a hash of all inputs."""
        made = hashlib.sha256(b'sweep of two-step plans, ' + ','.join(COLUMNS).encode())
        for axis in self._axes:
            for name, values in axis.items():
                made.update(f'{name} {values.size} {len(axis)} '.encode())
                made.update(np.ascontiguousarray(values, dtype='<f8').tobytes())
        return made.hexdigest()

    def rows(self, begin: int, end: int) -> Rows:
        """Plan rows from one number up to another, on the threads that Numba has."""
        places = np.unravel_index(np.arange(begin, end), self._shape)
        values = {
            name: column[place]
            for axis, place in zip(self._axes, places, strict=True)
            for name, column in axis.items()}
        inputs = {name: values[name] for name in DEFAULTS}
        plans = plan_two_step_batch(
            inputs['start'], inputs['target'], zeta=inputs['zeta'], j_lim=inputs['j_lim'],
            c1=inputs['c1'])
        return Rows(inputs, plans.status, {
            'beta_p': plans.beta_p, 'b_p': signed_root(plans.beta_p),
            'tau_p': plans.tau_p, 'beta_1': plans.beta_1,
            'b_1': signed_root(plans.beta_1)})

    def table(self, begin: int, end: int) -> Any:
        """Plan rows from one number up to another on one core; return a table of pyarrow."""
        threads = numba.get_num_threads()
        numba.set_num_threads(1)
        try:
            return self.rows(begin, end).arrow()
        finally:
            numba.set_num_threads(threads)

    def blocks(self, rows: int) -> Iterator[Rows]:
        """Plan the sweep and yield its rows in order, in blocks of so many."""
        for begin in range(0, self.size, rows):
            yield self.rows(begin, min(begin + rows, self.size))
