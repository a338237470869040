"""
Axes of a sweep: grids and lists as text, tables of cases, and samples.

Samples are scrambled Sobol points (`scipy.stats.qmc`), with one dimension per column, transformed
to normal distributions on request. They depend only on their number and the seed.
"""

from collections.abc import Collection, Mapping, Sequence
import csv
from dataclasses import dataclass
import math
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from hmsa.errors import BadInputError
from hmsa.model.equations import Array

if TYPE_CHECKING:
    from hmsa.identification.files import Belief

#: Maximum number of values of a column, or of cases, since they are kept in memory.
MOST_VALUES = 10_000_000

_GRID = (
    'VALUE, FIRST:LAST:POINTS, log:FIRST:LAST:POINTS, or several separated by commas; or '
    'sobol:LOW:HIGH or normal:MEAN:STD')
# Minimum distance of a sample from 0 and 1, so that no value is infinite.
_LEAST_SHARE = 2.0 ** -32
# Identified names that differ from those of the block's parameters.
_OTHERS = {'coil_time_constant': 'coil_time_constant', 'time_unit': 'actuator.density'}
# Negative variances below this fraction are rounding errors.
_ROUNDING = 1e-9


@dataclass(frozen=True)
class Spread:
    """Distribution of a column: normal by mean and standard deviation, or uniform by two ends."""

    normal: bool
    first: float
    second: float


@dataclass(frozen=True, eq=False)
class NormalColumns:
    """Columns with a joint normal distribution, with means (p,) and covariance (p, p)."""

    names: tuple[str, ...]
    mean: Array
    covariance: Array


NOTHING = NormalColumns((), np.zeros(0), np.zeros((0, 0)))


def _too_many(column: str, points: int) -> BadInputError:
    return BadInputError(
        f'{column} has {points:,} points: expected at most {MOST_VALUES:,} of one column')


def parse_values(text: str, column: str) -> Array | Spread:
    """Parse a grid, ``sobol:LOW:HIGH`` or ``normal:MEAN:STD``, or raise `BadInputError`."""
    kind, colon, rest = text.strip().partition(':')
    if not colon or kind not in {'sobol', 'normal'}:
        return parse_grid(text, column)
    try:
        first, second = map(float, rest.split(':'))
    except ValueError:
        raise BadInputError(f'{column} is {text!r}: expected {_GRID}') from None
    if not (math.isfinite(first) and (
            0.0 < second < math.inf if kind == 'normal' else first < second < math.inf)):
        raise BadInputError(
            f'{column} is {text!r}: expected finite numbers, LOW below HIGH, and STD above 0')
    return Spread(kind == 'normal', first, second)


def parse_grid(text: str, column: str) -> Array:
    """
    Parse a column's values and grids: ``0.2``, ``0:2:1000``, ``log:0.1:100:50``, with commas.

    Raises
    ------
    BadInputError
        If the text is no grid, or an end of a grid is not finite.

    """
    parts = [_part(part.strip(), text, column) for part in text.split(',')]
    if sum(x.size for x in parts) > MOST_VALUES:
        raise _too_many(column, sum(x.size for x in parts))
    values: Array = np.concatenate(parts)
    return values


def _part(part: str, text: str, column: str) -> Array:
    """Parse one value or one grid."""
    logarithmic = part.startswith('log:')
    try:
        if ':' not in part:
            return np.array([float(part)])
        low, high, count = part.removeprefix('log:').split(':')
        first, last, points = float(low), float(high), int(count)
    except ValueError:
        raise BadInputError(f'{column} is {text!r}: expected {_GRID}') from None
    if points < 2:
        raise BadInputError(f'{column} of {text!r} has {points} points: expected at least 2')
    if points > MOST_VALUES:
        raise _too_many(column, points)
    if not math.isfinite(first) or not math.isfinite(last):
        raise BadInputError(f'{column} is {text!r}: expected finite ends of the grid')
    if logarithmic and not (first > 0.0 and last > 0.0):
        raise BadInputError(
            f'{column} is {text!r}: expected ends greater than 0 for a logarithmic grid')
    with np.errstate(all='ignore'):
        spacing = np.geomspace if logarithmic else np.linspace
        return np.asarray(spacing(first, last, points), dtype=np.float64)


def read_cases(path: Path, columns: Collection[str]) -> dict[str, Array]:
    """Read a CSV file with some of the columns, or raise `BadInputError`."""
    expected = ', '.join(columns)
    rows: list[list[float]] = []
    try:
        with path.open(newline='', encoding='utf-8-sig') as file:
            reader = csv.reader(file, strict=True)
            names = [name.strip() for name in next(reader, [])]
            if not names:
                raise BadInputError(
                    f'{path} is empty: expected a header with some of {expected}, and cases')
            for name in names:
                if name not in columns:
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
    """Parse a row of a table of cases."""
    if len(cells) != len(names):
        raise BadInputError(f'{where}: {len(cells)} cells, expected {len(names)}')
    values = []
    for name, cell in zip(names, cells, strict=True):
        try:
            values.append(float(cell))
        except ValueError:
            raise BadInputError(f'{where}: {name} is {cell!r}, expected a number') from None
    return values


def belief_of(found: 'Belief', path: Path) -> NormalColumns:
    """Return the uncertainty of the block in a file; raise `BadInputError` if there is none."""
    numbers, known = found.actuator.numbers, found.known
    means, names, places = [], [], []
    slopes = np.eye(len(known.names))
    for place, name in enumerate(known.names):
        if name in numbers:
            column, mean = f'actuator.{name}', numbers[name]
        elif name in _OTHERS:
            column, mean = _OTHERS[name], found.others.get(name, 0.0)
        else:
            continue
        if name == 'time_unit':
            # rho = G (T/L)^2, to first order.
            mean = numbers['density']
            slopes[place, place] = 2.0 * mean / found.actuator.time_unit
            if 'shear_modulus' in known.names:
                slopes[place, known.names.index('shear_modulus')] = (
                    mean / numbers['shear_modulus'])
        names.append(column)
        means.append(mean)
        places.append(place)
    if not names:
        raise BadInputError(
            f'{path} has no covariance of the block: expected a file that hmsa identify --out '
            'wrote')
    covariance = slopes @ known.covariance @ slopes.T
    return NormalColumns(
        tuple(names), np.array(means, dtype=np.float64), covariance[np.ix_(places, places)])


def draw(
        spreads: Mapping[str, Spread], belief: NormalColumns, count: int, seed: int
) -> dict[str, Array]:
    """Draw samples by column, the same on every machine, or raise `BadInputError`."""
    from scipy.special import ndtri
    from scipy.stats import qmc

    size = len(spreads) + len(belief.names)
    if not 1 <= count <= MOST_VALUES // max(size, 1):
        raise BadInputError(
            f'{count:,} samples of {size} columns: expected 1 to {MOST_VALUES // max(size, 1):,}')
    if seed < 0:
        raise BadInputError(f'the seed of the samples is {seed}: expected at least 0')
    factor = _factor(belief)
    # A power of 2 keeps the sequence balanced.
    points = qmc.Sobol(size, seed=np.random.default_rng(seed)).random_base2(
        (count - 1).bit_length())[:count].T
    points = np.clip(points, _LEAST_SHARE, 1.0 - _LEAST_SHARE)
    found: dict[str, Array] = {}
    for (name, spread), share in zip(spreads.items(), points, strict=False):
        found[name] = spread.first + (
            spread.second * ndtri(share) if spread.normal
            else (spread.second - spread.first) * share)
    normal = [ndtri(x) for x in points[len(spreads):]]
    for i, name in enumerate(belief.names):
        # Sum terms one by one: the rounding of matrix libraries depends on the machine.
        values = np.full(count, belief.mean[i])
        for j in range(i + 1):
            values += factor[i][j] * normal[j]
        found[name] = values
    return found


def _factor(belief: NormalColumns) -> list[list[float]]:
    """Return the lower triangular Cholesky factor of the covariance."""
    rows: list[list[float]] = []
    for i, given in enumerate(belief.covariance.tolist()):
        row: list[float] = []
        for j in range(i):
            left = given[j] - math.fsum(x * y for x, y in zip(row, rows[j], strict=False))
            row.append(left / rows[j][j] if rows[j][j] > 0.0 else 0.0)
        left = given[i] - math.fsum(x * x for x in row)
        if not left >= -_ROUNDING * abs(given[i]):
            raise BadInputError(
                f'the covariance of {", ".join(belief.names)} is none, at {belief.names[i]}: '
                'expected a matrix that is positive semidefinite, as hmsa identify writes it')
        rows.append([*row, math.sqrt(max(left, 0.0))])
    return rows
