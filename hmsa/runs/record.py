"""
Record of a run: measurements, commands, plans, setpoints and parameters of one actuator.

Its levels of the field are commanded, superseded, repeated, and applied.
"""

from bisect import bisect_left
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
import math
from pathlib import Path
from typing import cast, TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from hmsa.columns import read_only, write_table
from hmsa.errors import BadInputError
from hmsa.interfaces.diagnostics import LEVELS, Outcome
from hmsa.interfaces.parameters import LATENESS_LIMIT, number_of
from hmsa.interfaces.topics import PLANT
from hmsa.judge.records import RequestedSetpoint, SensorModel
from hmsa.model.delivery import CommandSchedule, Superseding
from hmsa.model.equations import Array, equilibrium_stretch, natural_frequency, stretch_limits
from hmsa.model.law import critical_zeta
from hmsa.model.parameters import ActuatorParameters, paper_actuator
from hmsa.model.units import NANOSECONDS
from hmsa.runs.parameters import of_joint
from hmsa.runs.topics import APPLIED

if TYPE_CHECKING:
    from hmsa.bag.info import BagSummary

#: Maximum rounding error of a level by the hardware, relative to the largest.
ROUNDED = 1e-3
#: Maximum clock error of a device in reported timestamps, in ns.
ROUNDED_STAMP = 100_000
# Largest usual difference in ns between the recording of a command and its arrival at a device.
_RECORDED = 20_000_000

Times = NDArray[np.int64]
# Larger median delays of samples in ns mean that the recorder used another clock.
_SAME_CLOCK = 60 * NANOSECONDS
#: Smaller differences of stretch do not change a setpoint.
SAME = 1e-6


@dataclass(frozen=True)
class RecordedLevel:
    """A command, or a change of level in a plan."""

    stamp: int  # start time in ns
    flux_density: float  # in T
    sent: int  # recording time in ns
    stretch: float = math.nan  # predicted at the timestamp; NaN for a command
    rate: float = math.nan  # predicted at the timestamp, in 1/s


def in_force(messages: Iterable[Sequence[RecordedLevel]]) -> tuple[RecordedLevel, ...]:
    """Return the remaining levels; each message replaces all at or after its first timestamp."""
    levels: Superseding[RecordedLevel] = Superseding()
    for message in messages:
        for level in sorted(message, key=lambda x: x.stamp):
            levels.put(level.stamp, level)
    return tuple(levels)


def held_at(levels: Sequence[RecordedLevel], stamps: NDArray[np.int64]) -> Array:
    """Return the level in T at timestamps in ns, for levels by time; NaN before the first."""
    place = np.searchsorted([x.stamp for x in levels], stamps, side='right')
    return np.array([math.nan, *(x.flux_density for x in levels)])[place]


def without_repeats(commands: Sequence[RecordedLevel]) -> tuple[tuple[RecordedLevel, ...], int]:
    """Return the commands that change the level, and the number of those that do not."""
    schedule = CommandSchedule(math.nan)
    kept = tuple(x for x in commands if schedule.insert(x.stamp, x.flux_density))
    return kept, len(commands) - len(kept)


def came_too_late(
        commands: Sequence[RecordedLevel], applied: Sequence[RecordedLevel] | None,
        limit: float) -> list[bool]:
    """
    Return for each command whether it came later than a limit in s, and was rejected.

    ``applied`` contains the reported levels, None if there are no reports. A command that took
    effect was not rejected, although the recorder may have received it late.
    """
    if applied is None:
        return [x.sent - x.stamp > limit * NANOSECONDS for x in commands]
    known = _ByLevel(applied, _rounding(commands))
    return [
        x.sent - x.stamp > limit * NANOSECONDS - _RECORDED
        and known.first(x, x.stamp - ROUNDED_STAMP, x.sent + _RECORDED + 1) is None
        for x in commands]


def lateness_of(
        commands: Sequence[RecordedLevel], applied: Sequence[RecordedLevel],
        last: int) -> tuple[Array, int]:
    """
    Return the lateness of each command, and the number of commands that never took effect.

    The lateness is in s, for each command from `without_repeats`: NaN for one that never took
    effect, empty if changes were not reported. The number counts changes of level that were due
    before ``last`` (ns), were not replaced, and never took effect. One that came late, when the
    next one was due, too, was replaced by that; its lateness is infinite.
    """
    if not applied:
        return np.empty(0), 0
    result = np.full(len(commands), np.nan)
    unapplied = 0
    # Commands that were replaced before their time never took effect.
    standing = in_force((x,) for x in commands)
    places = {x: i for i, x in enumerate(commands)}
    rounding = _rounding(commands)
    taken, changes = _ByLevel(applied, rounding), _ByLevel(standing, rounding)
    # The level when the first command was due; reported levels may be older.
    begin = standing[0].stamp if standing else 0
    before: RecordedLevel | None = max(
        (x for x in applied if x.stamp <= begin), key=lambda x: x.stamp,
        default=min(applied, key=lambda x: x.stamp))
    for i, command in enumerate(standing):
        until = changes.first(command, command.stamp + 1)
        when = taken.first(
            command, command.stamp - ROUNDED_STAMP,
            math.inf if until is None else until - ROUNDED_STAMP)
        following = standing[i + 1] if i + 1 < len(standing) else None
        if when is not None:
            result[places[command]] = (when - command.stamp) / NANOSECONDS
        elif command.stamp < last and not (
                before and abs(before.flux_density - command.flux_density) <= rounding):
            if following and command.sent > following.stamp and (
                    taken.first(following, following.stamp) is not None):
                result[places[command]] = math.inf
            else:
                unapplied += 1
        before = command
    return result, unapplied


def _rounding(commands: Sequence[RecordedLevel]) -> float:
    """Return the difference in T by which the hardware may round a level."""
    return ROUNDED * max((abs(x.flux_density) for x in commands), default=0.0)


class _ByLevel:
    """Levels to be found by level, up to ``rounding`` in T, and time: a path has thousands."""

    def __init__(self, levels: Iterable[RecordedLevel], rounding: float) -> None:
        self._rounding = rounding
        self._cells: defaultdict[int, list[tuple[int, float]]] = defaultdict(list)
        for x in sorted(levels, key=lambda x: x.stamp):
            if math.isfinite(x.flux_density):
                self._cells[self._cell(x.flux_density)].append((x.stamp, x.flux_density))

    def _cell(self, level: float) -> int:
        return math.floor(level / self._rounding) if self._rounding else int(level != 0.0)

    def first(self, like: RecordedLevel, since: int, until: float = math.inf) -> int | None:
        """Return the first timestamp from ``since`` and before ``until`` of the same level."""
        cell, found = self._cell(like.flux_density), until
        for near in (cell - 1, cell, cell + 1):
            rows = self._cells.get(near, [])
            for place in range(bisect_left(rows, (since,)), len(rows)):
                stamp, level = rows[place]
                if stamp >= found:
                    break
                if abs(level - like.flux_density) <= self._rounding:
                    found = stamp
                    break
        return None if found == until else int(found)


@dataclass(frozen=True)
class RecordedVerdict:
    """The planner's verdict on a request."""

    sent: int  # recording time in ns
    level: str  # ``'ok'``, ``'warning'`` or ``'error'``
    code: str
    message: str


@dataclass(frozen=True)
class LearntSensor:
    """The planner's estimate of a sensor from a time on."""

    sent: int  # recording time in ns
    sensor: SensorModel


@dataclass(frozen=True, eq=False)
class Run:
    """Data of one actuator in one run; tuples are in recorded order."""

    label: str  # name for display
    joint: str  # name in the joint states; empty if unknown
    path: Path  # the bag or table
    time: Times  # shape (n,), n of at least 1: timestamps in ns, increasing
    logged: Times  # shape (n,): recording times of the samples in ns
    stretch: Array  # shape (n,)
    rate: Array  # shape (n,): in 1/s, computed from the stretch if not recorded
    flux_density: Array  # shape (n,): in T, NaN if not recorded
    commands: tuple[RecordedLevel, ...] = ()
    applied: tuple[RecordedLevel, ...] = ()  # changes of the field that took effect, as reported
    forces: tuple[tuple[int, int, float], ...] = ()  # recording time, timestamp (ns), newtons
    # Recording time, timestamp (ns), and temperature in degrees Celsius
    temperatures: tuple[tuple[int, int, float], ...] = ()
    plans: tuple[tuple[RecordedLevel, ...], ...] = ()
    verdicts: tuple[RecordedVerdict, ...] = ()  # each once
    # Of setpoints, by begin; of a simulated run as planned, without findings
    outcomes: tuple[Outcome, ...] = ()
    sensors: tuple[LearntSensor, ...] = ()  # by time; the given sensor applies before
    # Parameters of the nodes, by ``'node.name'``
    parameters: Mapping[str, object] = field(default_factory=dict)
    plant: ActuatorParameters = field(default_factory=paper_actuator)  # true parameters
    # Parameters used by the planner
    planner: ActuatorParameters = field(default_factory=paper_actuator)
    parameters_known: bool = False  # if False, those of the example block
    left_out: int = 0  # messages or rows that could not be used
    notes: tuple[str, ...] = ()  # information for the reader, one sentence each
    # Topic names by role (`hmsa.runs.topics`)
    topics: Mapping[str, str] = field(default_factory=dict)
    summary: 'BagSummary | None' = None  # None for a table
    # ``'recorded'``, or ``'simulated'`` for samples of the simulated plant
    origin: str = 'recorded'

    def __post_init__(self) -> None:
        """Check the arrays, and protect the record from changes."""
        for name in ('time', 'logged', 'stretch', 'rate', 'flux_density'):
            object.__setattr__(self, name, read_only(getattr(self, name)))
        shapes = {x.shape for x in (
            self.time, self.logged, self.stretch, self.rate, self.flux_density)}
        if len(shapes) != 1 or not len(self.time) or np.any(np.diff(self.time) <= 0):
            raise BadInputError(
                f'the samples of {self.label} have shapes {sorted(shapes)}: expected one shape, '
                'at least one sample, and increasing times')

    def lost(self, *names: str) -> list[str]:
        """Return the numbers of messages that the recorder lost, as ``'3 of /name'``."""
        counts = {} if self.summary is None else {x.name: x.lost for x in self.summary.topics}
        return [f'{count} of {name}' for x in names
                if (name := self.topics.get(x)) and (count := counts.get(name))]

    def number(self, name: str) -> float:
        """Return a number like ``'planner.slew_limit'``; 0 if unknown, negative or not finite."""
        value = number_of(of_joint(self.parameters, self.joint, name))
        return value if value is not None and 0.0 <= value < math.inf else 0.0

    @property
    def temperature(self) -> float:
        """Mean of the recorded temperatures in degrees Celsius; NaN if there are none."""
        values = [x for _, _, x in self.temperatures]
        return sum(values) / len(values) if values else math.nan

    def coil_time_constant(self, node: str) -> float:
        """Return the time constant in s that a node has for the coil, at the temperature."""
        own = self.plant if node == PLANT else self.planner
        value = self.number(f'{node}.coil_time_constant')
        if not (value and own.thermal.coil_resistance):
            return value
        given = number_of(of_joint(self.parameters, self.joint, f'{node}.thermal.reference'))
        # The values of the actuator hold at the temperature of the run.
        return value * (1.0 if given is None else own.thermal.factor('coil_resistance', given))

    @property
    def one_clock(self) -> bool:
        """Whether the recorder used the clock of the timestamps."""
        return abs(float(np.median(self.logged - self.time))) <= _SAME_CLOCK

    @cached_property
    def accepted(self) -> tuple[RecordedLevel, ...]:
        """Commands that did not come too late, as plant or driver show, or their parameters."""
        known = number_of(of_joint(self.parameters, self.joint, f'plant.{LATENESS_LIMIT.name}'))
        reports = self.applied if self.reported else None
        if not self.one_clock or known is None and reports is None:
            return self.commands
        late = came_too_late(
            self.commands, reports,
            cast(float, LATENESS_LIMIT.default) if known is None else known)
        return tuple(x for x, too in zip(self.commands, late, strict=True) if not too)

    @cached_property
    def rejected(self) -> int:
        """Number of changes of level that came too late."""
        kept = {id(x) for x in self.accepted}
        return sum(id(x) not in kept for x in without_repeats(self.commands)[0])

    @property
    def reported(self) -> tuple[RecordedLevel, ...]:
        """
        Levels that the plant reported as applied, by time.

        Empty if some reports were lost and there are commands to use instead.
        """
        if self.commands and self.lost(APPLIED):
            return ()
        return tuple(sorted(self.applied, key=lambda x: x.stamp))

    @property
    def levels(self) -> tuple[RecordedLevel, ...]:
        """
        Changes of the field, by time.

        These are the levels that the plant reported as applied; without complete reports the
        commands that were not replaced; else changes of the measured flux density, accurate to one
        sample.
        """
        if reported := self.reported:
            return reported
        if self.commands:
            return in_force((x,) for x in self.accepted)
        known = np.flatnonzero(np.isfinite(self.flux_density))
        values = self.flux_density[known]
        places = known[np.append(True, values[1:] != values[:-1])] if len(known) else known
        return tuple(
            RecordedLevel(int(self.time[i]), float(self.flux_density[i]), int(self.logged[i]))
            for i in places)


def setpoints_of(run: Run) -> list[Outcome]:
    """Return the setpoints of a run; of those that were replaced, the ones reached before."""
    asked = [x for x in run.outcomes if x.asked != LEVELS]
    if asked:
        return [x for x in asked if x.finding is not None or not x.ended]
    return _held(run, in_force((x,) for x in without_repeats(run.accepted)[0]))


def start_of(run: Run, stamp: int) -> float:
    """Return the stretch before a time: that which the field holds, or else the measured one."""
    field = _field_before(run, stamp)
    if field is not None:
        return float(_balance(run, [field])[0])
    return float(run.stretch[max(int(np.searchsorted(run.time, stamp, side='right')) - 1, 0)])


def _field_before(run: Run, stamp: int) -> float | None:
    """Return the flux density in T in force before a time, None if it is unknown."""
    reported = [x.flux_density for x in run.reported if x.stamp < stamp]
    place = int(np.searchsorted(run.time, stamp)) - 1
    measured = [float(run.flux_density[place])] if place >= 0 else []
    return next((x for x in (*reported[-1:], *measured) if math.isfinite(x)), None)


def _balance(run: Run, flux_densities: Sequence[float]) -> Array:
    """Return the equilibrium stretches of levels in T with the planner's parameters."""
    return equilibrium_stretch(
        [run.planner.units.of_level(x) for x in flux_densities], run.planner.nondimensional)


def _held(run: Run, levels: Sequence[RecordedLevel]) -> list[Outcome]:
    """Return the setpoints of levels that are held for a period."""
    found: list[RequestedSetpoint] = []
    begin, start = 0, start_of(run, levels[0].stamp if levels else 0)
    held = _balance(run, [x.flux_density for x in levels])
    for i, (level, target) in enumerate(zip(levels, held.tolist(), strict=True)):
        until = levels[i + 1].stamp if i + 1 < len(levels) else int(run.time[-1])
        setpoint = described(run.planner, target, start, levels[begin].stamp, until)
        if not (until - level.stamp) / NANOSECONDS * setpoint.frequency >= 2.0 * math.pi:
            continue
        if setpoint.step > SAME:
            found.append(replace(setpoint, arrival=None if i == begin else (
                level.stamp + _ramp(run, levels[i - 1], level))))
            start = target
        begin = i + 1
    joints = run.parameters.get('planner.joints')
    joint = run.joint if isinstance(joints, list) and len(joints) > 1 else ''
    return [Outcome(setpoint=replace(
        x, number=i, count=len(found), joint=joint, held=i == len(found)))
        for i, x in enumerate(found, 1)]


def described(
        actuator: ActuatorParameters, target: float, start: float, begins: int,
        end: int | None) -> RequestedSetpoint:
    """Return a setpoint with frequency, decay and range of an actuator; times in ns."""
    material, unit = actuator.nondimensional, actuator.time_unit
    low, high = stretch_limits(material)
    inside = min(max(target, low + SAME), high - SAME)
    omega = float(natural_frequency(inside, material)) / unit
    decay = material.zeta / critical_zeta(inside, material.packed) * omega
    return RequestedSetpoint(target, start, begins, None, end, omega, decay, possible=(low, high))


def _ramp(run: Run, before: RecordedLevel, level: RecordedLevel) -> int:
    """Return the duration in ns of the amplifier's ramp from one level to the next."""
    slew = run.number('plant.slew_limit') or run.number('planner.slew_limit')
    # A bag may contain any slew limit: bound the result.
    return 0 if not slew else round(
        min(abs(level.flux_density - before.flux_density) / slew, 1e6) * NANOSECONDS)


def samples_of(run: Run) -> dict[str, Array]:
    """
    Return the samples of a run by column name.

    The columns are ``time`` in s from the first sample, ``stretch``, ``stretch_rate`` in 1/s and
    ``flux_density`` in T: measured, else the present level, else NaN.
    """
    field = run.flux_density
    if not np.isfinite(field).any():
        field = held_at(run.levels, run.time)
    return {'time': _seconds(run, run.time), 'stretch': run.stretch, 'stretch_rate': run.rate,
            'flux_density': field}


def levels_of(run: Run) -> dict[str, Array]:
    """
    Return the levels that drove a run by column name.

    The columns are ``time`` in s from the first sample and ``flux_density`` in T from that time
    on: applied, else commanded, else measured.
    """
    stamps = np.array([x.stamp for x in run.levels], dtype=np.int64)
    return {'time': _seconds(run, stamps),
            'flux_density': np.array([x.flux_density for x in run.levels])}


def _seconds(run: Run, stamps: NDArray[np.int64]) -> Array:
    return np.asarray((stamps - run.time[0]) / NANOSECONDS, dtype=np.float64)


def write_run(path: Path, run: Run) -> list[Path]:
    """
    Write samples and levels; return the files.

    The levels go to a file whose name ends in _levels, or into the same Matlab file as
    ``level_time`` and ``level_flux_density``. Errors are those of `write_table`.
    """
    samples, levels = samples_of(run), levels_of(run)
    if path.suffix.lower() == '.mat':
        write_table(path, samples | {f'level_{x}': y for x, y in levels.items()})
        return [path]
    write_table(path, samples)
    if not run.levels:
        return [path]
    write_table(levels_beside(path), levels)
    return [path, levels_beside(path)]


def levels_beside(path: Path) -> Path:
    """Return the path of the table of levels that belongs to a file of samples."""
    return path.with_name(f'{path.stem}_levels{path.suffix}')
