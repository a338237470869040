"""
Sweeps: plans over grids, tables of cases and samples of parameters.

A sweep is a product of axes. It is planned in blocks, so that its size is limited by the disk and
not by the memory. The status of a row that cannot be planned contains the reason.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property
import hashlib
import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hmsa.errors import BadInputError, check_choice, HmsaError
from hmsa.files import require_arrow
from hmsa.interfaces.parameters import LAW_NAME, present_name
from hmsa.model.equations import Array, signed_root
from hmsa.model.law import elastic_force
from hmsa.model.laws import LAWS
from hmsa.model.laws.record import Elastic
from hmsa.model.moves import Move, Setpoint, State
from hmsa.model.status import Code, RefusedError
from hmsa.planning.sequence import plan_sequence
from hmsa.planning.shapers import get_shaper
from hmsa.planning.shapers.request import MoveRequest
from hmsa.planning.two_step import CODES, Groups, plan_two_step_batch
from hmsa_studies.axes import (
    FINITE,
    Nondimensional,
    parse_grid,
    Range,
    Setting,
    SweepAxis,
    System,
    View,
)
from hmsa_studies.robustness import Actual, arrival_of
from hmsa_studies.study_folder import LEAST_ROWS, MOST_ROWS

#: All codes; plans contain their indices.
STATUS = tuple(Code)
_PLACES = np.array([STATUS.index(CODES[x]) for x in sorted(CODES)])
_TWO_STEP, _LIMIT, _BAD = (
    STATUS.index(x) for x in (Code.TWO_STEP, Code.FLUX_LIMIT, Code.BAD_INPUT))
__all__ = ['parse_grid', 'ROW_BYTES', 'Rows', 'Sweep']

#: Approximate size of a row in Parquet, in bytes.
ROW_BYTES = 50
# Approximate rows per second and core of an idle machine, and minimum and maximum rows of a chunk:
# by the batch alone, by the batch with a block per row, and one by one.
_RATES = (400_000.0, 15_000.0, 3_000.0)
_CHUNKS = ((LEAST_ROWS, MOST_ROWS), (5_000, 50_000), (500, 5_000))
_LAW, _SHAPER = 'law', 'shaper'
#: Columns for results of the simulated plans.
_LEFT = ('residual', 'offset')
_STATUS = np.array([str(x) for x in STATUS])

Column = Array | NDArray[np.str_]
Places = tuple[NDArray[np.int64], ...]


@dataclass(frozen=True)
class Plans:
    """Plans of n rows, dimensionless; NaN for missing levels or durations."""

    codes: NDArray[np.int64]  #: (n,), indices in STATUS
    numbers: Array  #: (3, n): first level, duration and last level

    @classmethod
    def none(cls, size: int) -> 'Plans':
        """Return rows that cannot be planned."""
        return cls(np.full(size, _BAD), np.full((3, size), math.nan))

    def put(
            self, rows: NDArray[np.int64] | int, codes: NDArray[np.int64] | int,
            numbers: ArrayLike) -> None:
        """Store plans at their rows."""
        self.codes[rows] = codes
        self.numbers[:, rows] = numbers


def by_batch(
        start: Array, target: Array, zeta: Array, j_lim: Array, c1: Array,
        elastic: Elastic | None = None, *, workers: int = 0) -> Plans:
    """Return two-step plans from rest on ideal hardware without limits."""
    found = plan_two_step_batch(
        start, target, Groups(zeta=zeta, j_lim=j_lim, c1=c1, elastic=elastic), workers=workers)
    return Plans(_PLACES[found.status], np.array([found.beta_p, found.tau_p, found.beta_1]))


def by_settings(
        settings: Sequence[Setting | None], which: NDArray[np.int64], start: Array,
        target: Array, shapers: NDArray[np.str_], *, workers: int = 0) -> Plans:
    """Return plans from rest; each row has the setting at `which`, None if out of range."""
    plans = Plans.none(len(which))
    # Models by index: comparing tables would take longer than planning.
    laws: dict[Elastic | None, int] = {}
    groups = np.full(len(settings), -2)
    for i, setting in enumerate(settings):
        if setting is not None:
            alone = setting.material.creep or not setting.delivery.ideal
            groups[i] = -1 if alone else laws.setdefault(setting.material.law, len(laws))
    group = np.where((groups[which] >= 0) & (shapers != 'two_step'), -1, groups[which])
    for elastic, number in laws.items():
        rows = np.flatnonzero(group == number)
        if len(rows):
            found = _limited(
                [settings[x] for x in which[rows]], start[rows], target[rows], elastic,
                workers)
            plans.put(rows, found.codes, found.numbers)
    for row in np.flatnonzero(group == -1).tolist():
        setting = settings[which[row]]
        if setting is not None:
            planned = _planned(setting, float(start[row]), float(target[row]), str(shapers[row]))
            plans.put(row, STATUS.index(planned.code), planned.numbers)
    return plans


def _limited(
        settings: Sequence[Setting | None], start: Array, target: Array,
        elastic: Elastic | None, workers: int) -> Plans:
    """Return plans of the batch, without those beyond the limits of the load."""
    given = np.array([
        (x.material.zeta, x.material.j_lim, x.material.c1, x.limits.minimum, x.limits.maximum)
        for x in settings if x is not None]).T
    zeta, j_lim, c1, least, most = given
    plans = by_batch(start, target, zeta, j_lim, c1, elastic, workers=workers)
    first, _, last = plans.numbers
    outside = (last < least) | (last > most)
    outside |= (plans.codes == _TWO_STEP) & ((first < least) | (first > most))
    plans.codes[outside] = _LIMIT
    plans.numbers[:2, outside] = math.nan
    return plans


def carried_out(
        settings: Sequence[Setting | None], actuals: Sequence[Setting | None],
        which: NDArray[np.int64], start: Array, target: Array,
        shapers: NDArray[np.str_]) -> tuple[Plans, Array, Array]:
    """Return plans, and their vibration and steady-state error on `actuals`, per step."""
    plans = Plans.none(len(which))
    # NaN without a plan or a move, or if a motion cannot be simulated.
    left = np.full((2, len(which)), math.nan)
    # Rows that differ only in the actuator share a plan.
    made: dict[tuple[Setting, float, float, str], tuple[_Planned, float]] = {}
    rows = zip(which.tolist(), start.tolist(), target.tolist(), shapers.tolist(), strict=True)
    for row, (place, begin, end, shaper) in enumerate(rows):
        setting, actual = settings[place], actuals[place]
        if setting is None:
            continue
        key = setting, begin, end, shaper
        if key not in made:
            planned = _planned(*key)
            made[key] = planned, math.nan if planned.move is None else arrival_of(
                planned.move, begin, end, setting.material)
        planned, arrival = made[key]
        plans.put(row, STATUS.index(planned.code), planned.numbers)
        if planned.move is not None and actual is not None and begin != end:
            with suppress(HmsaError):
                plant = Actual.of(setting, actual)
                left[1, row] = plant.offset(planned.move, begin, end)
                left[0, row] = plant.residual(planned.move, begin, end, arrival)
    return plans, left[0], left[1]


@dataclass(frozen=True)
class _Planned:
    """A plan of one row: its code, its command if there is one, and the holding load."""

    code: Code
    move: Move | None
    load: float

    @property
    def numbers(self) -> tuple[float, float, float]:
        """Return first level, duration and last level."""
        move = self.move
        if move is None or (move.code is not Code.HOLD and len(move.levels) == 1):
            return math.nan, math.nan, self.load
        return move.levels[0].load, move.duration, move.levels[-1].load


def _planned(setting: Setting, start: float, target: float, shaper: str) -> _Planned:
    """Plan one row."""
    material = setting.material
    if not math.isfinite(start + target):
        return _Planned(Code.BAD_INPUT, None, math.nan)
    load = float(elastic_force(target, material.packed))
    try:
        move = plan_sequence(
            [Setpoint(target, math.inf)],
            MoveRequest.of(
                material, State(start), limits=setting.limits, delivery=setting.delivery,
                units=setting.units, errors=setting.errors),
            shaper)[0].move
    except RefusedError as error:
        return _Planned(error.code, None, load)
    except BadInputError:
        return _Planned(Code.OUT_OF_RANGE, None, load)
    except HmsaError:
        return _Planned(Code.NOT_CONVERGED, None, load)
    return _Planned(move.code, move, load)


@dataclass(frozen=True)
class Rows:
    """Planned rows of a sweep: columns of shape (n,) by name, in order."""

    inputs: dict[str, Column]
    codes: NDArray[np.int64]  #: indices in `hmsa_studies.sweep.STATUS`
    results: dict[str, Array]  #: NaN for missing values

    @property
    def status(self) -> NDArray[np.str_]:
        """Return the code of each row."""
        return _STATUS[self.codes]

    def to_pydict(self) -> dict[str, list[Any]]:
        """Return the columns as lists, as a pyarrow table does."""
        columns = {**self.inputs, 'status': self.status, **self.results}
        return {name: x.tolist() for name, x in columns.items()}

    def arrow(self) -> Any:
        """Return the columns as a pyarrow table."""
        arrow, _ = require_arrow()
        status = arrow.DictionaryArray.from_arrays(self.codes, _STATUS.tolist())
        return arrow.table(
            {**self.inputs, 'status': status.cast(arrow.string()), **self.results})


class Sweep:
    """
    All combinations of the cases of a table, samples, and the values of other columns.

    Parameters
    ----------
    grids : mapping of str to array_like, shape (n,)
        Values by column; a column of the system that is not given has its default.
    cases, samples : mapping of str to array_like, shape (m,), optional
        Columns of tables, used row by row. Their values may be out of range: the status of
        such a row contains the reason.
    laws, shapers : sequence of str
        Names to compare; they have columns if given.
    system : System, optional
        Units of the columns; default dimensionless.
    residual : bool
        Whether to simulate the plans and return the results; implied by columns of the actuator.

    Attributes
    ----------
    size : int
        Number of rows. The cases vary slowest, then the samples, then the columns in order.
    columns, results : tuple of str
        Names of all columns of the table, and of computed numbers.
    rate : float
        Approximate rows per second and core.
    chunk_rows : tuple of int
        Minimum and maximum rows of a chunk.

    Raises
    ------
    BadInputError
        If a column is unknown, empty, out of range or given twice, or columns of a table differ
        in length.

    """

    def __init__(
            self, grids: Mapping[str, ArrayLike],
            cases: Mapping[str, ArrayLike] | None = None, *,
            samples: Mapping[str, ArrayLike] | None = None, laws: Sequence[str] = (),
            shapers: Sequence[str] = (), system: System | None = None,
            residual: bool = False) -> None:
        self._system = system or Nondimensional()
        ranges: dict[str, Range] = {**self._system.ranges, **self._system.actual}
        defaults = self._system.columns
        self._axes: list[dict[str, Column]] = [
            _table(words, table) for words, table in (('cases', cases), ('samples', samples))
            if table]
        self._sampled = len(self._axes) - 1 if samples else None
        seen = [name for axis in self._axes for name in axis] + list(grids)
        for name in seen:
            check_choice('a column', name, ranges)
            if seen.count(name) > 1:
                raise BadInputError(
                    f'{name} is a column of the cases or samples and has other values: expected '
                    'one of them')
        self._axes += [
            {x: _checked(x, grids[x], ranges[x]) if x in grids else np.array([defaults[x]])}
            for x in ranges if x in grids or (x in defaults and x not in seen)]
        for law in laws:
            check_choice('law', law, LAWS)
            if not any(x.startswith('law.') for x in seen):
                # Report invalid constants here if no row can have them.
                self._system.setting({**defaults, LAW_NAME.name: law})
        for shaper in shapers:
            get_shaper(shaper)
        self._axes += [
            {name: np.array(words)} for name, words in ((_LAW, laws), (_SHAPER, shapers)) if words]
        self._shape = [next(iter(axis.values())).size for axis in self._axes]
        self.size = math.prod(self._shape)
        if self.size == 0:
            raise BadInputError('a column of the sweep is empty: expected at least one value')
        given = {name for axis in self._axes for name in axis}
        self._inputs = [x for x in (*ranges, _LAW, _SHAPER) if x in given]
        self._carried = residual or bool(given & set(self._system.actual))
        self.results = tuple(self._results(Plans.none(0), 1.0, 1.0))
        self.columns = (*self._inputs, 'status', *self.results)
        one_by_one = bool(set(shapers) - {'two_step'} or given & self._system.delivery
                          or self._carried or not self._system.ideal)
        self._plain = not one_by_one and given <= {*Nondimensional.columns, _SHAPER} \
            and isinstance(self._system, Nondimensional)
        kind = 0 if self._plain else 1 + one_by_one
        self.rate, self.chunk_rows = _RATES[kind], _CHUNKS[kind]

    @property
    def shown(self) -> tuple[str, ...]:
        """Return the columns to draw by default."""
        if self._carried:
            return _LEFT
        return ('tau_p', 'beta_p') if self._system.roots else ('time_p', 'flux_density_p')

    def view(self) -> View:
        """Return how to draw the sweep; raise `BadInputError` if there is no figure of it."""
        return View.of([
            SweepAxis.of(axis, samples=i == self._sampled) for i, axis in enumerate(self._axes)
            if self._shape[i] > 1])

    @property
    def fixed(self) -> dict[str, float]:
        """Return the numeric columns that are constant over all rows."""
        return {
            name: float(column[0]) for axis, size in zip(self._axes, self._shape, strict=True)
            for name, column in axis.items() if size == 1 and column.dtype.kind == 'f'}

    @cached_property
    def digest(self) -> str:
        """Return a hash of all inputs."""
        made = hashlib.sha256(f'{self._system!r} {self.columns}'.encode())
        for axis in self._axes:
            for name, values in axis.items():
                made.update(f'{name} {values.size} {len(axis)} '.encode())
                made.update(
                    '\n'.join(values.tolist()).encode() if values.dtype.kind == 'U'
                    else np.ascontiguousarray(values, dtype='<f8').tobytes())
        return made.hexdigest()

    def rows(self, begin: int, end: int, *, workers: int = 0) -> Rows:
        """Plan a range of rows on a number of threads; 0 for one per core."""
        places, values = self._values(begin, end)
        inputs: dict[str, Any] = {name: values[name] for name in self._inputs}
        if self._plain:
            plans = by_batch(
                *(inputs[name] for name in Nondimensional.columns), workers=workers)
            return Rows(inputs, plans.codes, self._results(plans, 1.0, 1.0))
        occurring, which = self._occurring(inputs, places)
        settings = [_setting(self._system.setting, {
            x: y for x, y in values.items() if x not in self._system.actual})
            for values in occurring]
        moves = which, inputs['start'], inputs['target'], inputs.get(
            _SHAPER, np.full(end - begin, 'two_step'))
        left: Sequence[Array] = ()
        if self._carried:
            plans, *left = carried_out(
                settings, [_setting(self._system.carried, x) for x in occurring], *moves)
        else:
            plans = by_settings(settings, *moves, workers=workers)
        units: Array = np.array([
            (1.0, 1.0) if x is None else (x.units.time, x.units.load) for x in settings])[which]
        return Rows(inputs, plans.codes, self._results(plans, units[:, 0], units[:, 1], *left))

    def _values(self, begin: int, end: int) -> tuple[Places, dict[str, Any]]:
        """Return the places of rows on the axes, and the values of all columns there."""
        places = np.unravel_index(np.arange(begin, end), self._shape)
        return places, {
            name: column[place]
            for axis, place in zip(self._axes, places, strict=True)
            for name, column in axis.items()}

    def _occurring(
            self, inputs: Mapping[str, Column],
            places: Places) -> tuple[list[dict[str, Any]], NDArray[np.int64]]:
        """Return all combinations of columns that define a block, and the index of each row's."""
        names = [x for x in self._inputs if x not in ('start', 'target', _SHAPER)]
        number = np.zeros(len(inputs['start']), np.int64)
        for axis, place, size in zip(self._axes, places, self._shape, strict=True):
            if set(axis) & set(names):
                # Renumber within a block, since the product of all axes may be too large.
                _, number = np.unique(number * size + place, return_inverse=True)
        _, first, which = np.unique(number, return_index=True, return_inverse=True)
        columns = [inputs[name][first].tolist() for name in names]
        names = [present_name(x) for x in names]
        return [dict(zip(names, values, strict=True))
                for values in (zip(*columns, strict=True) if names else [()])], which

    def _results(
            self, plans: Plans, time: Array | float, load: Array | float,
            *left: Array) -> dict[str, Array]:
        """Return the numeric columns, for scales of time and load."""
        first, duration, last = plans.numbers
        more = dict(zip(_LEFT, left or (duration,) * 2, strict=True)) if self._carried else {}
        if self._system.roots:
            return {
                'beta_p': first, 'b_p': signed_root(first), 'tau_p': duration,
                'beta_1': last, 'b_1': signed_root(last), **more}
        return {
            'flux_density_p': first * load, 'time_p': duration * time,
            'flux_density_1': last * load, **more}

    def table(self, begin: int, end: int) -> Any:
        """Plan a range of rows on one core; return a pyarrow table."""
        return self.rows(begin, end, workers=1).arrow()

    def named(self, begin: int, end: int) -> str:
        """Return the range of each column in rows, for a message."""
        words = []
        for name, column in self._values(begin, end)[1].items():
            if column.dtype.kind == 'U':
                words.append(f'{name} {" or ".join(dict.fromkeys(column.tolist()))}')
            else:
                ends = dict.fromkeys((float(np.min(column)), float(np.max(column))))
                words.append(f'{name} {" to ".join(f"{x:g}" for x in ends)}')
        return ', '.join(words)

    def blocks(self, rows: int) -> Iterator[Rows]:
        """Plan the sweep and yield its rows in order, in blocks."""
        for begin in range(0, self.size, rows):
            yield self.rows(begin, min(begin + rows, self.size))


def _setting(
        make: Callable[[Mapping[str, Any]], Setting], values: Mapping[str, Any]) -> Setting | None:
    """Return a setting, None if values are out of range."""
    try:
        return make(values)
    except BadInputError:
        return None


def _table(words: str, table: Mapping[str, ArrayLike]) -> dict[str, Column]:
    """Return the columns of a table, which must have equal lengths."""
    found: dict[str, Column] = {
        name: np.asarray(x, dtype=np.float64) for name, x in table.items()}
    if len({x.size for x in found.values()}) > 1:
        raise BadInputError(f'the columns of the {words} differ in length: expected one length')
    return found


def _checked(name: str, values: ArrayLike, limits: tuple[float, float]) -> Array:
    """Return the values of a column; raise `BadInputError` for impossible ones."""
    found = np.asarray(values, dtype=np.float64)
    wrong = ~((found >= limits[0]) & (found <= limits[1]))
    if np.any(wrong):
        least = 'greater than 0' if 0.0 < limits[0] < 1e-300 else f'of at least {limits[0]:g}'
        most = f' and at most {limits[1]:g}' if limits[1] < FINITE else ''
        raise BadInputError(
            f'{name} takes the value {float(found[wrong][0]):g}: expected finite numbers '
            f'{least}{most}')
    return found
