"""
Axes of a sweep: grids and lists as text, tables of cases, and samples; settings of its rows.

A row has one of two systems of units. Dimensionless columns define a block directly. Those in SI
units are parameters of the nodes, which override those of a parameter file.

Samples are scrambled Sobol points (`scipy.stats.qmc`), with one dimension per column, transformed
to normal distributions on request. They depend only on their number and the seed.

In a figure, a column with several numbers is an axis; models, shapers, cases and columns with a
few values are curves or rows of panels; samples become quantiles.
"""

from collections.abc import Collection, Mapping, Sequence
import csv
from dataclasses import dataclass, field
from functools import cached_property
from itertools import product
import math
from pathlib import Path
import sys
from typing import Any, TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from hmsa.api.facts import USUAL_MOVE
from hmsa.errors import BadInputError, check_number
from hmsa.interfaces.actuator import completed, model_from
from hmsa.interfaces.parameters import LAW, LAW_NAME, ParameterSpec, PLANNED
from hmsa.model.delivery import Delivery
from hmsa.model.equations import Array
from hmsa.model.laws import LAWS
from hmsa.model.moves import Limits
from hmsa.model.parameters import Errors, NondimensionalParameters, Uncertainty
from hmsa.model.units import NANOSECONDS, Units
from hmsa.planning.shapers.request import ERRORS

if TYPE_CHECKING:
    from hmsa.identification.files import Belief

#: Minimum and maximum value of a column.
Range = tuple[float, float]

#: The largest finite number.
FINITE = sys.float_info.max

_INF = math.inf
_POSITIVE = (math.ulp(0.0), FINITE)
_MODULUS = 'actuator.shear_modulus'
#: Prefix of the columns of the actuator, instead of that of a block's parameters.
ACTUAL, BLOCK_OF = 'actual.', 'actuator.'
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

#: Maximum number of rows of a sweep to draw, as they are kept in memory.
MOST_ROWS = 4_000_000
# Maximum number of points of an axis, of curves in a panel, and of stacked maps.
_MOST_POINTS, _MOST_CURVES, _MOST_MAPS = 1000, 8, 4
# Maximum number of values of a column for curves instead of an axis, if there is another axis.
_FEW = 5


def _ranges(specs: tuple[ParameterSpec, ...]) -> dict[str, Range]:
    """Return the ranges of numeric parameters."""
    return {
        x.name: (
            -_INF if x.minimum is None else x.minimum, _INF if x.maximum is None else x.maximum)
        for x in specs if isinstance(x.default, float)}


@dataclass(frozen=True)
class Setting:
    """A block and its delivery, as in `hmsa.planning.timeline.JointModel`."""

    material: NondimensionalParameters
    limits: Limits = field(default_factory=Limits)
    delivery: Delivery = field(default_factory=Delivery)
    units: Units = field(default_factory=Units)
    errors: Uncertainty = ERRORS  #: that minimax must tolerate


@dataclass(frozen=True)
class Nondimensional:
    """Columns in the paper's units."""

    #: Columns of each row, with their defaults.
    columns = {'start': 1.0, 'target': 1.1, 'zeta': 0.2, 'j_lim': 5.0, 'c1': 2.0}
    #: Ranges of all possible columns.
    ranges = {
        'start': _POSITIVE, 'target': _POSITIVE, 'zeta': (0.0, FINITE),
        'j_lim': (_POSITIVE[0], _INF), 'c1': _POSITIVE, 'load_min': (-_INF, _INF),
        'load_max': (-_INF, _INF), 'period': (0.0, FINITE), 'slew': (_POSITIVE[0], _INF),
        'lag': (0.0, FINITE), **_ranges(LAW)}
    #: Ranges of the columns for differences of the actuator from the model.
    actual = {
        'error.shear_modulus': (-1.0, FINITE), 'error.zeta': (-1.0, FINITE),
        'error.j_lim': (-1.0, FINITE), 'error.remanence': (-1.0, FINITE)}
    #: Columns with which hardware is not ideal, and whether it is without them.
    delivery = frozenset({'period', 'slew', 'lag'})
    ideal = True
    #: Whether results are beta and b, else tesla.
    roots = True

    def setting(self, values: Mapping[str, Any]) -> Setting:
        """Return the setting of a row; only the ratios of a model's constants matter."""
        law, elastic = LAWS[values.get(LAW_NAME.name, 'gent')], None
        if law.scaled is not None:
            _, elastic = law.scaled(
                {'actuator.remanence': 1.0, **{x.name: x.default for x in LAW}, **values})
        return Setting(
            NondimensionalParameters(
                values['zeta'], _INF if law.endless else values['j_lim'], values['c1'], elastic),
            Limits(values.get('load_min', -_INF), values.get('load_max', _INF)),
            Delivery(values.get('period', 0.0), values.get('slew', _INF),
                     lag=values.get('lag', 0.0)))

    def carried(self, values: Mapping[str, Any]) -> Setting:
        """Return the actuator of a row, with its units relative to those of the model."""
        planned = self.setting(values)
        errors = Errors(**{x.removeprefix('error.'): values.get(x, 0.0) for x in self.actual})
        return Setting(
            errors.actual(planned.material), units=Units(1.0 / errors.faster, errors.stiffer),
            delivery=errors.delivery(planned.delivery))


@dataclass(frozen=True)
class InSI:
    """Columns in seconds, tesla and parameters of the nodes; otherwise as `Nondimensional`."""

    actual = {
        f'{ACTUAL}{x.removeprefix(BLOCK_OF)}': y for x, y in _ranges(PLANNED).items()
        if x not in ('flux_density_min', 'flux_density_max')}
    delivery = frozenset({'command_period', 'slew_limit', 'coil_time_constant'})
    roots = False

    known: Mapping[str, Any]  #: of PLANNED and of creep, and points of a model from a file
    errors: Uncertainty = ERRORS  #: that minimax must tolerate

    @classmethod
    def of(cls, values: Mapping[str, Any], errors: Uncertainty = ERRORS) -> 'InSI':
        """Return the system for parameters, with the points of a file that they name."""
        return cls({**values, **completed(values)}, errors)

    @cached_property
    def _rest(self) -> float:
        return model_from(self.known, None, 0).material.rest

    @property
    def columns(self) -> Mapping[str, float]:
        """Columns of each row: by default a move from rest."""
        return {'start': self._rest, 'target': self._rest + USUAL_MOVE}

    @property
    def ranges(self) -> Mapping[str, Range]:
        """Ranges of all possible columns; a beam bends to either side."""
        place = _POSITIVE if self._rest else (-FINITE, FINITE)
        return {'start': place, 'target': place, **_ranges(PLANNED), 'command_period': (0.0, 1e3)}

    @property
    def ideal(self) -> bool:
        """Whether commands apply at any time and at once, to a block without creep."""
        return not any(self.known.get(x) for x in (
            'slew_limit', 'coil_time_constant', 'viscoelastic.ratio'))

    def setting(self, values: Mapping[str, Any]) -> Setting:
        """Return the setting of a row; a modulus scales the constants of a model."""
        model = model_from(
            {**self.known, **values}, values.get(_MODULUS),
            round(values.get('command_period', 0.0) * NANOSECONDS))
        return Setting(
            model.material, model.limits, model.delivery, model.units, self.errors)

    def carried(self, values: Mapping[str, Any]) -> Setting:
        """Return the actuator of a row; values that are not given are those of the plan."""
        names = {x.removeprefix(BLOCK_OF): x for x in _ranges(PLANNED)}
        given = {names[x.removeprefix(ACTUAL)]: y for x, y in values.items()
                 if x.startswith(ACTUAL)}
        planned = {x: y for x, y in values.items() if not x.startswith(ACTUAL)}
        return self.setting({**planned, **given})


System = Nondimensional | InSI


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
    check_number('the seed of the samples', seed, least=0)
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
                f'the covariance of {", ".join(belief.names)} is impossible at {belief.names[i]}: '
                'expected a matrix that is positive semidefinite, as hmsa identify writes it')
        rows.append([*row, math.sqrt(max(left, 0.0))])
    return rows


@dataclass(frozen=True, eq=False)
class SweepAxis:
    """One axis of a sweep that has more than one value."""

    name: str  #: of its column, or of all columns of a table
    size: int
    values: Array | None = None  #: of a numeric column
    labels: tuple[str, ...] = ()  #: of a few unordered values that are no samples
    sampled: bool = False

    @classmethod
    def of(cls, table: Mapping[str, NDArray[Any]], *, samples: bool) -> 'SweepAxis':
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

    def as_labels(self) -> 'SweepAxis':
        """Return a column of a few values as curves."""
        values = [] if self.values is None else self.values.tolist()
        return SweepAxis(self.name, self.size, labels=tuple(f'{self.name} {x:g}' for x in values))


@dataclass(frozen=True, eq=False)
class View:
    """Layout of the rows of a sweep: a map over x and y, curves over x, or a distribution."""

    x: SweepAxis | None
    y: SweepAxis | None
    labels: tuple[str, ...]  #: of each curve or map
    samples: int  #: number at each point; 1 for none
    _sizes: tuple[int, ...]
    _order: tuple[int, ...]

    @classmethod
    def of(cls, axes: Sequence[SweepAxis]) -> 'View':
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
    def places(axis: SweepAxis) -> Array:
        """Return the values of an axis, thinned in the same way."""
        values: Array = np.zeros(0) if axis.values is None else axis.values
        return values[::_stride(axis.size)]


def _stride(size: int) -> int:
    return -(-size // _MOST_POINTS)
