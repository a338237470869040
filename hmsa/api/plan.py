"""A plan: levels for the coil and their times, the predicted motion, and amplifiers for it."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from inspect import signature
import math
from pathlib import Path
from typing import Any, NamedTuple, overload, SupportsIndex, TYPE_CHECKING

import numpy as np

from hmsa.api.actuator import Actuator
from hmsa.api.arguments import check_names, file_of, number, numbers, several, suggesting
from hmsa.columns import read_only, UNITS, write_table
from hmsa.errors import BadInputError, excerpt
from hmsa.model.equations import Array
from hmsa.model.simulation import response
from hmsa.model.status import Code, RefusedError
from hmsa.planning.sequence import Segment
from hmsa.table import Column, dataset, frame, Table

if TYPE_CHECKING:
    from hmsa.api.motion import Motion

_MOST_BETWEEN = 4


def table_of(
        segments: Sequence[Segment], columns: Sequence[Column], values: Iterable[Sequence[Any]],
        between: Column, time: float, shown: Callable[[float], float],
        caption: str = '') -> Table:
    """
    Return a table of moves: given values, further levels of moves with more than two, and status.

    ``time`` is the time scale in s; ``shown`` converts a load to the displayed value.
    """
    inside = [_between(x, time, shown) for x in segments]
    many = any(inside)
    return Table(
        (*columns, *[between] * many, Column('status')),
        tuple((*x, *[y] * many, str(z.move.code))
              for x, y, z in zip(values, inside, segments, strict=True)),
        caption, tuple(note for x in segments for note in x.notes()))


def _between(segment: Segment, time: float, shown: Callable[[float], float]) -> str:
    """Return the levels between the first and the last of a move with their times, as text."""
    inside = segment.move.levels[1:-1]
    return ', '.join(
        f'{shown(x.load):.6g} at {x.time * time:.6g}' for x in inside
    ) if len(inside) <= _MOST_BETWEEN else f'{len(inside)} levels'


class FieldLevel(NamedTuple):
    """A field level of a plan."""

    time: float  #: from which it is valid, in s
    flux_density: float  #: in T


@dataclass(frozen=True, eq=False)
class Plan:
    """
    A planned command: field levels, each valid from its time on.

    `Actuator.plan` makes plans. A plan is a sequence of its levels: it has a length, and
    iteration, indices and slices return times and flux densities. Equal plans have the same
    actuator, setpoints, levels and shaper. Their arrays are read-only.

    Examples
    --------
    >>> from hmsa import Actuator
    >>> plan = Actuator().plan([(1.1, 0.5), (1.0, 0.5)])
    >>> plan.levels.shape
    (4, 2)
    >>> plan.report()['status']
    ['two_step', 'two_step']
    >>> plan.simulate().report()['verdict']
    ['arrived', 'arrived']
    >>> len(plan), round(plan[-1].time, 6), plan[-1].flux_density
    (4, 0.505733, 0.0)
    >>> [f'{1e3 * flux_density:.1f} mT' for time, flux_density in plan[:2]]
    ['20.1 mT', '34.6 mT']

    """

    actuator: Actuator  #: the actuator that the plan was made for
    segments: tuple[Segment, ...]  #: one per setpoint, dimensionless
    shaper: str = 'two_step'

    @cached_property
    def levels(self) -> Array:
        """Times in s and flux densities in T, shape (m, 2)."""
        units = self.actuator.model.units
        rows: list[tuple[float, float]] = []
        for i, segment in enumerate(self.segments):
            last = i + 1 == len(self.segments)
            rows += [(segment.begin + x.time, x.load) for x in segment.move.levels
                     if last or x.time < segment.setpoint.span]
        times, loads = np.array(rows).T
        return read_only(np.column_stack([
            [units.duration(x) for x in times.tolist()], units.level(loads)]))

    @property
    def times(self) -> Array:
        """Times in s at which the levels start, shape (m,)."""
        return self.levels[:, 0]

    @property
    def flux_densities(self) -> Array:
        """Levels in T, shape (m,)."""
        return self.levels[:, 1]

    @property
    def flux_density_rate(self) -> float:
        """Largest difference of successive levels over the duration of the first one, in T/s."""
        steps = np.abs(np.diff(self.flux_densities)) / np.diff(self.times)
        return float(np.max(steps, initial=0.0))

    @property
    def setpoints(self) -> Array:
        """Stretches and durations in s, shape (n, 2)."""
        return read_only(np.array([
            (x.setpoint.stretch, self.actuator.model.units.duration(x.setpoint.span))
            for x in self.segments]))

    @property
    def move_times(self) -> Array:
        """Move times in s; infinite where a target is only approached, shape (n,)."""
        units = self.actuator.model.units
        return read_only(np.array([units.duration(x.move.duration) for x in self.segments]))

    def __len__(self) -> int:
        return len(self.levels)

    def __iter__(self) -> Iterator[FieldLevel]:
        return (FieldLevel(*x) for x in self.levels.tolist())

    @overload
    def __getitem__(self, key: SupportsIndex) -> FieldLevel: ...

    @overload
    def __getitem__(self, key: slice) -> tuple[FieldLevel, ...]: ...

    def __getitem__(self, key: Any) -> Any:
        return tuple(self)[key]

    def currents(self, tesla_per_ampere: float) -> Array:
        """
        Return the levels in A, for a coil constant in T/A, shape (m,).

        Raises
        ------
        BadInputError
            If the coil constant is not a number above 0.

        Examples
        --------
        >>> from hmsa import Actuator
        >>> Actuator().plan([(1.1, 0.5)]).currents(0.02).round(3).tolist()
        [1.006, 1.729]

        """
        return self.flux_densities / number(
            tesla_per_ampere, 'tesla_per_ampere', 'T/A', above=0.0)

    def report(self) -> Table:
        """
        Return a table of the levels, move time and status of each setpoint.

        The table of a path contains its duration, its largest flux density and how fast this
        changes.

        Examples
        --------
        >>> from hmsa import Actuator
        >>> print(Actuator().plan([(1.1, 0.5)]).report())
        stretch  duration (s)  first level (T)  move time (s)  last level (T)  status
        ───────  ────────────  ───────────────  ─────────────  ──────────────  ────────
            1.1           0.5         0.020118     0.00573522       0.0345706  two_step

        """
        units, name = self.actuator.model.units, self.actuator.block.coordinate.name
        unit, level = units.load_name.strip(), units.level
        if len(self.segments) == 1 and self.segments[0].move.code is Code.PATH:
            return Table(
                (Column(f'last {name}'), Column('duration', 's'), Column('levels'),
                 Column('peak field', unit), Column('peak field rate', f'{unit}/s')),
                ((self.segments[0].setpoint.stretch, float(self.move_times[0]), len(self.levels),
                  float(np.max(np.abs(self.flux_densities))), self.flux_density_rate),),
                notes=tuple(self.segments[0].notes()))
        return table_of(
            self.segments, (
                Column(name), Column('duration', 's'), Column('first level', unit),
                Column('move time', 's'), Column('last level', unit)),
            [(*setpoint, level(x.move.levels[0].load) if x.shaped else None,
              duration if x.shaped and math.isfinite(duration) else None, level(x.held))
             for x, setpoint, duration in zip(
                 self.segments, self.setpoints.tolist(), self.move_times.tolist(), strict=True)],
            Column('between', f'{unit} at s'), units.time, level)

    @suggesting
    def simulate(
            self, *, truth: Actuator | None = None, noise: float = 0.0,
            rate: float | None = None, until: float | None = None, seed: int = 0,
            label: str = 'simulated') -> 'Motion':
        """
        Simulate the plan, on the planned actuator or on another one.

        Parameters
        ----------
        truth : Actuator, optional
            True actuator and amplifier; default those of the plan.
        noise : float
            Standard deviation of the samples of the stretch.
        rate : float, optional
            Sampling rate in Hz; default 1000 Hz, or 40 samples per natural period if this is more.
        until : float, optional
            End in s; default that of the last setpoint.
        seed : int
            Seed of the noise.
        label : str
            Name in figures and comparisons.

        Returns
        -------
        Motion
            Samples, levels and setpoints.

        Raises
        ------
        BadInputError
            If an argument has the wrong type or is out of range.

        Examples
        --------
        >>> from hmsa import Actuator
        >>> block = Actuator()
        >>> plan = block.plan([(1.1, 0.5)])
        >>> plan.simulate(truth=block.scaled(shear_modulus=1.1)).report()['verdict']
        ['off target']

        """
        if truth is not None and not isinstance(truth, Actuator):
            raise BadInputError(
                f'truth is {excerpt(truth)}: expected an Actuator, such as '
                'block.scaled(shear_modulus=1.1)')
        from hmsa.api.motion import simulated  # slow to import

        return simulated(
            truth or self.actuator, self.times, self.flux_densities,
            self.segments[0].start.stretch, self, until=until, rate=rate, noise=noise, seed=seed,
            label=label)

    def plot(
            self, path: str | Path | Sequence[str | Path] | None = None, *, ax: Any = None,
            panel: str = 'response', **more: Any) -> Any:
        """
        Draw the motion that the plan predicts, as `Motion.plot` does.

        Examples
        --------
        >>> from matplotlib.figure import Figure
        >>> from hmsa import Actuator
        >>> ax = Actuator().plan([(1.1, 0.2)]).plot(ax=Figure().subplots(), panel='command')
        >>> ax.get_ylabel()
        'flux density $B$ (T)'

        """
        return self.simulate(label=self.shaper).plot(path, ax=ax, panel=panel, **more)

    def save(self, path: str | Path) -> None:
        """
        Write the levels as CSV, Parquet or Matlab file (``.csv``, ``.parquet``, ``.mat``).

        ``hmsa simulate`` and ``hmsa run --levels`` read the CSV file. Raise `BadInputError` if the
        file cannot be written.

        Examples
        --------
        >>> from pathlib import Path
        >>> from tempfile import TemporaryDirectory
        >>> from hmsa import Actuator
        >>> with TemporaryDirectory() as folder:
        ...     Actuator().plan([(1.1, 0.5)]).save(Path(folder, 'levels.csv'))
        ...     print(Path(folder, 'levels.csv').read_text().splitlines()[0])
        time,flux_density

        """
        write_table(file_of(path), self._columns())

    def to_pandas(self) -> Any:
        """
        Return the levels as a DataFrame.

        Raise `BadInputError` if pandas is not installed.

        Examples
        --------
        >>> from hmsa import Actuator
        >>> Actuator().plan([(1.1, 0.5)]).to_pandas().round(4)
             time  flux_density
        0  0.0000        0.0201
        1  0.0057        0.0346

        """
        return frame(self._columns())

    def to_xarray(self) -> Any:
        """
        Return the levels as an xarray Dataset over the time, with units as attributes.

        Raise `BadInputError` if xarray is not installed.

        Examples
        --------
        >>> from hmsa import Actuator
        >>> levels = Actuator().plan([(1.1, 0.5)]).to_xarray()
        >>> levels['flux_density'].round(4).values.tolist(), levels['flux_density'].units
        ([0.0201, 0.0346], 'T')

        """
        return dataset(self._columns(), UNITS)

    def _columns(self) -> dict[str, Array]:
        return {'time': self.times, 'flux_density': self.flux_densities}

    def _values(self) -> tuple[object, ...]:
        """Return what makes plans equal; adding 0 makes -0 and 0 the same bytes."""
        return (self.actuator, self.shaper, self.segments[0].start.stretch,
                *((x + 0.0).tobytes() for x in (self.setpoints, self.levels)))

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Plan) and self._values() == other._values()

    def __hash__(self) -> int:
        return hash(self._values())

    def __repr__(self) -> str:
        count = len(self.segments)
        return (f'<Plan {self.shaper}: {count} setpoint{"s" * (count != 1)}, {len(self.levels)} '
                f'levels in {self.times[-1]:.6g} s>')

    def _repr_html_(self) -> str:
        return self.report()._repr_html_()


# Range of the slew rates and bandwidths to try, relative to those at which the largest step of the
# ideal plan takes as long as its fastest move.
_SLOWEST, _FASTEST = 0.1, 15.0
_DECADE = (1.0, 2.0, 5.0)
# Optional coil data and their units.
_COIL = {'inductance': 'H', 'resistance': 'ohm', 'tesla_per_ampere': 'T/A'}
# Columns and their descriptions; the last four need data of the coil, the last two all of them.
_COLUMNS = (
    (Column('slew', 'T/s', '.4g'), 'slew rate of the ramps'),
    (Column('bandwidth', 'Hz', '.4g'), 'that of a first-order lag'),
    (Column('longest move', 'ms', '.4g'), ''),
    (Column('lost', 'ms', '.3g'), 'additional time of the longest move, relative to ideal steps'),
    (Column('field', 'mT', '.4g'), 'largest magnitude of a level'),
    (Column('current', 'A', '.3g'), 'current of this field'),
    (Column('change', 'A/s', '.3g'), 'largest rate of the current'),
    (Column('voltage', 'V', '.3g'), 'largest magnitude of L dI/dt + R I'),
    (Column('power', 'W', '.3g'), 'this voltage times the largest current'))


def amplifiers(
        actuator: 'Actuator', setpoints: Any, *, slew_limits: Sequence[float] | None = None,
        bandwidths: Sequence[float] | None = None, **more: Any) -> Table:
    """
    Plan a sequence for amplifiers from fast to slow; see `Actuator.amplifiers`.

    Raises
    ------
    BadInputError
        If an argument has the wrong type or is out of range.

    """
    check_names('Actuator.amplifiers', more, [
        'slew_limits', 'bandwidths', *_COIL,
        *(x for x in signature(actuator.plan).parameters if x != 'setpoints')])
    given = {x: more.pop(x, None) for x in _COIL}
    coil = {
        x: number(y, x, _COIL[x], above=0.0) for x, y in given.items() if y is not None}
    if coil and 'tesla_per_ampere' not in coil:
        raise BadInputError(
            'tesla_per_ampere is missing: expected it with inductance and resistance')
    ideal = actuator.replace(slew_limit=math.inf, coil_time_constant=0.0)
    best = ideal.plan(setpoints, **more)
    fastest = float(np.min(best.move_times))
    before = ideal.flux_density(best.segments[0].start.stretch)
    swing = float(np.max(np.abs(np.diff(np.append(before, best.flux_densities)))))
    if not 0.0 < fastest < math.inf or not swing:
        raise BadInputError(
            f'shaper {best.shaper} does not end this move in a finite time: expected one that '
            'does, such as two_step')
    if slew_limits is None:
        slew_limits = _series(swing / fastest)
    rows = [_row(best, best, math.inf, math.inf, coil)]
    notes = []
    if bandwidths is None:
        bandwidths = _series(1.0 / fastest)
        if len(coil) == len(_COIL):
            own = coil['resistance'] / (2.0 * math.pi * coil['inductance'])
            bandwidths = sorted({*bandwidths, own}, reverse=True)
            notes.append(
                f'{own:.4g} Hz is the bandwidth of the coil itself, R/(2 pi L), on an amplifier '
                'that sets voltages and not currents')
    slew_limits, bandwidths = (numbers(several(x), y, unit=z).ravel().tolist() for x, y, z in (
        (slew_limits, 'slew limits', 'T/s'), (bandwidths, 'bandwidths', 'Hz')))
    for slew, band in [*((x, math.inf) for x in slew_limits), *(
            (math.inf, x) for x in bandwidths)]:
        try:
            plan = ideal.replace(
                slew_limit=slew, coil_time_constant=0.0 if math.isinf(band) else 0.5 / (
                    math.pi * number(band, 'bandwidth', 'Hz', above=0.0))).plan(setpoints, **more)
        except RefusedError as error:
            rows.append((slew, band, *(None for _ in rows[0][2:])))
            named = f'{slew:g} T/s' if math.isinf(band) else f'{band:g} Hz'
            notes.append(f'{named}: {error}')
            continue
        rows.append(_row(plan, best, slew, band, coil))
    shown = _COLUMNS[:len(rows[0])]
    return Table(
        tuple(x for x, _ in shown), tuple(rows), '∞: no limit', tuple(notes),
        tuple((x.name, words) for x, words in shown if words))


def _series(middle: float) -> list[float]:
    """Return round numbers around the given one, the largest first."""
    decades = range(
        math.floor(math.log10(_SLOWEST * middle)), math.ceil(math.log10(_FASTEST * middle)) + 1)
    found = [x * 10.0 ** y for y in decades for x in _DECADE]
    return [float(f'{x:g}') for x in reversed(found)
            if _SLOWEST * middle <= x <= _FASTEST * middle]


def _row(
        plan: 'Plan', best: 'Plan', slew: float, band: float,
        coil: dict[str, float]) -> tuple[Any, ...]:
    """Return the demands of a plan on an amplifier: one row of the table."""
    longest, lost = (1e3 * float(np.max(x)) for x in (
        plan.move_times, plan.move_times - best.move_times))
    most = float(np.max(np.abs(plan.flux_densities)))
    row: tuple[Any, ...] = (slew, band, longest, lost, 1e3 * most)
    if 'tesla_per_ampere' not in coil:
        return row
    factor = coil['tesla_per_ampere']
    # The field at the start of each level, and at the start of the next one.
    fields = response(
        plan.actuator.block, plan.actuator.model.delivery, plan.times, plan.flux_densities,
        np.append(plan.times, plan.times[-1] + 1.0), plan.segments[0].start.stretch)[2]
    change: Array = np.full(2, slew / factor)
    current: Array = np.array([most, -most]) / factor
    if not math.isinf(band):
        at = np.concatenate([fields[:-1], fields[1:]])
        wanted = np.concatenate([plan.flux_densities] * 2)
        change = 2.0 * math.pi * band * (wanted - at) / factor
        current = at / factor
    row += (most / factor, float(np.max(np.abs(change))))
    if len(coil) == len(_COIL):
        volts = float(np.max(np.abs(
            coil['inductance'] * change + coil['resistance'] * current)))
        row += (volts, volts * most / factor)
    return row
