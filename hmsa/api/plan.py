"""A plan: levels for the coil and their times, and the predicted motion."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
import math
from pathlib import Path
from typing import Any, NamedTuple, overload, SupportsIndex

import numpy as np

from hmsa.api.actuator import Actuator
from hmsa.api.arguments import file_of, number, suggesting
from hmsa.api.motion import Motion, simulated
from hmsa.errors import BadInputError, excerpt
from hmsa.model.equations import Array
from hmsa.model.status import Code
from hmsa.planning.sequence import Segment
from hmsa.runs.record import read_only
from hmsa.runs.tables import UNITS, write_table
from hmsa.table import Column, dataset, frame, Table

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
            label: str = 'simulated') -> Motion:
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
