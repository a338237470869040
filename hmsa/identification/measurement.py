"""Measured data, also from CSV: samples of the stretch and levels of the field, as arrays."""

from dataclasses import dataclass
from functools import cached_property
import math
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hmsa.columns import check_flux_densities, CsvColumns, DIVIDED, read_table, remedy
from hmsa.errors import BadInputError, check_number
from hmsa.interfaces.topics import PLANNER
from hmsa.judge.judging import cut_off_at
from hmsa.model.delivery import ramps
from hmsa.model.equations import Array
from hmsa.model.laws.record import Coordinate, STRETCH
from hmsa.model.moves import Level
from hmsa.model.parameters import ActuatorParameters
from hmsa.model.units import NANOSECONDS
from hmsa.runs.record import in_force, Run, without_repeats

#: Minimum number of samples for a motion and five parameters.
FEWEST = 12
# Minimum motion, relative to the stretch, and to the scatter between samples.
_LEAST_MOTION = 1e-7
_TIMES_SCATTER = 6.0
# A crest is clipped if the value is constant at an extreme between samples that differ by at least
# this fraction of the range. If the sensor does not round, `cut_off_at` finds others; up to a
# fraction of samples is noted only, since a robust fit takes them for outliers (at 2.5 % without
# effect, at 20 % wrong).
_CLIPPED_SLOPE = 0.01
_CLIPPED_SAMPLES = 3
_MOST_CLIPPED = 0.05
# Number of repeated values in motion, if more than half of all, above which samples were held.
_STAIRS = 4
# Fraction of samples on either side that may be invalid.
_FEW = 0.02
# Maximum fraction of rows to leave out.
_MOST_LEFT_OUT = 0.2
# Interval, in median ones, above which a gap is noted.
_GAP = 20.0
# A clock was set back if this many rows are in order on either side of a jump back by this many
# intervals.
_RUN, _OVERTAKEN = 10, 3.0
# Number of levels, relative to samples and at least, above which the column is a measured field.
_MEASURED_FIELD = 0.3
_FEW_LEVELS = 8
# Maximum number of unknown switching times, for speed; of a field that changes at fewer samples
# than the fraction, those after it are left out: taken as measured, they come half an interval
# late, which a longer recording does not make up for.
_MOST_SWITCHES, _SWITCHED = 300, 0.02
# Difference of times, in s, above which clocks started at different times.
_ANOTHER_CLOCK = 1e8
# Median rate of a measured ramp, relative to the slew limit: jitter of the timestamps is less.
_SAME_RATE = 1.1
# Units of levels to test, and the improvement of the fit of the motion that shows another unit.
_OTHER_UNITS = {1e3: 'ms', 1e6: 'us', 1e9: 'ns'}
_BETTER = 0.5


@dataclass(frozen=True, eq=False)
class Measurement:
    """
    A measured motion.

    Attributes
    ----------
    time : ndarray, shape (n,)
        Times of the samples in s, increasing; n of at least 12.
    stretch : ndarray, shape (n,)
        Measured stretch, or deflection of a beam.
    level_times, levels : ndarray, shape (m,)
        Flux density in T from each time on, increasing in time; m of at least 1.
    slew_limit : float
        Rate in T/s at which the amplifier ramps; infinite for steps.
    earlier : float
        Maximum time in s by which the levels may have switched before their times, for instance
        if they were sampled; 0 if the times are exact.
    label : str
        Name of the recording.
    notes : tuple of str
        Information for the reader, one sentence each.
    coordinate : Coordinate
        Kind of position that the samples measure.
    temperature : float
        Temperature of the actuator in degrees Celsius; NaN if it was not measured.
    from_csv : bool
        Whether the numbers are those of a CSV, whose header states their units.
    at_rest : bool
        Whether the motion begins at rest, as determined by `identify`.

    Raises
    ------
    BadInputError
        If shapes differ, a value is not finite, times do not increase, the actuator never moved
        or the sensor was saturated.

    """

    time: Array
    stretch: Array
    level_times: Array
    levels: Array
    slew_limit: float = math.inf
    earlier: float = 0.0
    label: str = 'recording'
    notes: tuple[str, ...] = ()
    coordinate: Coordinate = STRETCH
    at_rest: bool = True
    temperature: float = math.nan
    from_csv: bool = False

    def __post_init__(self) -> None:
        """Check the arrays."""
        for name in ('time', 'stretch', 'level_times', 'levels'):
            values = np.ascontiguousarray(getattr(self, name), dtype=np.float64)
            if values.ndim != 1 or not np.all(np.isfinite(values)):
                raise BadInputError(
                    f'{name} of {self.label} is not one row of finite numbers: got shape '
                    f'{values.shape} with {np.count_nonzero(~np.isfinite(values))} that are not '
                    'finite')
            values.setflags(write=False)
            object.__setattr__(self, name, values)
        for one, other in (('time', 'stretch'), ('level_times', 'levels')):
            times, values = getattr(self, one), getattr(self, other)
            if len(times) != len(values):
                raise BadInputError(
                    f'{self.label} has {len(times)} {one} and {len(values)} {other}: expected '
                    'as many of both')
            if np.any(np.diff(times) <= 0.0):
                place = int(np.argmax(np.diff(times) <= 0.0)) + 1
                raise BadInputError(
                    f'{one} of {self.label} goes from {times[place - 1]:.9g} to '
                    f'{times[place]:.9g} s: expected increasing times')
        check_number('slew limit', self.slew_limit, 'T/s', above=0.0, endless=True)
        if not 0.0 <= self.earlier < math.inf:
            raise BadInputError(
                f'levels may have switched {self.earlier:g} s earlier: expected a finite time of '
                'at least 0')
        self._check_motion()

    def _check_motion(self) -> None:
        count = len(self.time)
        if count < FEWEST:
            raise BadInputError(
                f'{self.label} has {count} samples: expected {FEWEST} or more, and some ten for '
                'each parameter')
        if not len(self.levels):
            raise BadInputError(f'{self.label} has no level: expected the flux density in T')
        self._check_scale()
        check_flux_densities(self.label, self.levels, self.from_csv)
        spread = float(np.quantile(self.stretch, 0.99) - np.quantile(self.stretch, 0.01))
        # The range of white noise is 4.65 standard deviations, as is that of its increments.
        jitter = float(np.median(np.abs(np.diff(self.stretch)))) / 0.954
        first, last = self.place(self.time[[0, -1]])
        driven = np.ptp(self.levels[first:last + 1]) > 0.0
        still = spread < _LEAST_MOTION or (not driven and spread < _TIMES_SCATTER * jitter)
        if driven and not still:
            still = self._unmoved(jitter)
        if still:
            raise BadInputError(
                f'the {self.coordinate.name} of {self.label} stays within {spread:.3g}, scatter '
                f'{jitter:.2g}: expected a motion; was the coil on, is it the column of the '
                f'{self.coordinate.name}, and does it begin before the first change of level?')
        clipped, repeated = self._flat()
        if repeated:
            raise BadInputError(
                f'the {self.coordinate.name} of {self.label} is a staircase: during motion, '
                f'most values occur {repeated} times, as if the sensor were read more often than '
                'it measures; expected each measurement once, with its timestamp')
        if clipped:
            raise BadInputError(
                f'the {self.coordinate.name} of {self.label} is cut off {clipped} times at '
                f'{np.min(self.stretch):.6g} or {np.max(self.stretch):.6g}: expected a sensor '
                'within its range; the crests are lost, and a fit would be wrong without a sign')
        extremes = [] if self.quantum else cut_off_at(self.stretch)
        lost = [(x, int(np.count_nonzero(self.stretch == x))) for x in extremes]
        if sum(x for _, x in lost) > _MOST_CLIPPED * count:
            raise BadInputError(
                f'the {self.coordinate.name} of {self.label} is exactly '
                + ' and '.join(f'{x:.6g} in {times}' for x, times in lost)
                + f' of {count} samples, and never beyond: expected a sensor within its range; '
                'leave out the samples that it cuts off, or record less motion')
        for value, times in lost:
            object.__setattr__(self, 'notes', (
                *self.notes, f'{times} samples are exactly {value:.6g}, and none is beyond: the '
                'sensor seems to cut them off'))

    def _check_scale(self) -> None:
        """Raise `BadInputError` for samples that are impossible for this kind of position."""
        # A few samples may be invalid.
        low, middle, high = np.quantile(self.stretch, (_FEW, 0.5, 1.0 - _FEW)).tolist()
        without = self.stretch[self.levels[self.place(self.time)] == 0.0]
        seen = len(without) >= _CLIPPED_SAMPLES
        rest = float(np.median(without)) if seen else middle
        what = self.coordinate
        least, most = what.at_rest if seen else what.possible
        if least <= rest <= most and what.possible[0] <= low and high <= what.possible[1]:
            return
        lost = (self.stretch < what.possible[0]) | (self.stretch > what.possible[1])
        if least <= rest <= most and np.mean(lost) <= _MOST_LEFT_OUT:
            place = int(np.argmax(lost))
            raise BadInputError(
                f'{self.label} has {np.count_nonzero(lost)} of {len(lost)} samples that are no '
                f'{what.name}, such as {self.stretch[place]:.4g} at {self.time[place]:.6g} s: '
                f'expected {what.possible[0]:g} to {what.possible[1]:g}; if the sensor lost the '
                'actuator there, leave their cells empty')
        # A length in m is small too, but never near 0 compared with its rest value.
        strain = abs(rest) < 0.4 and not 0.0 < rest < 3.0 * low if seen else (
            low < what.possible[0])
        looks = what.looks or (
            'strain in percent, divide it by 100 and add 1' if strain and high > what.possible[1]
            else 'strain, add 1; if it is the deflection of a beam, give its parameter file'
            if strain
            else 'ten times the stretch, divide it by 10' if 6.0 < rest < 16.0
            else 'percent, divide it by 100' if 60.0 < rest < 160.0
            else 'a length, in mm or m perhaps, divide it by the length at rest')
        divided = [x for x in self.notes if DIVIDED in x]
        raise BadInputError(
            f'{self.label} has {what.plural} from {low:.4g} to {high:.4g}'
            + (f', {rest:.4g} without field' if seen else '') + f': expected {what.meaning}; '
            + (f'{divided[0]}: check their units' if divided else f'if it is {looks}'))

    def _unmoved(self, jitter: float) -> bool:
        """Return whether neither levels nor samples differ by more than noise."""
        edges = np.searchsorted(self.time, self.level_times)
        parts = [x for x in np.split(self.stretch, np.unique(edges)) if len(x) >= 4]
        if len(parts) < 2:
            return False
        means = np.array([np.mean(x) for x in parts])
        errors = np.array([jitter / math.sqrt(len(x)) for x in parts])
        same = bool(np.all(np.abs(means - np.mean(self.stretch)) < 5.0 * errors + 1e-12))
        quiet = float(np.std(self.stretch)) < 1.3 * jitter + 1e-12
        return same and quiet

    def _flat(self) -> tuple[int, int]:
        """
        Return the number of crests that are clipped at the end of the sensor's range.

        Also return the number of samples for which a value in motion is held, 0 unless most are.
        """
        y = self.stretch
        edges = np.flatnonzero(np.diff(y) != 0.0) + 1
        if len(edges) < _CLIPPED_SAMPLES:
            return 0, 0
        # Runs of one value, between steep changes on either side.
        lengths, values = np.diff(edges), y[edges[:-1]]
        steep = np.abs(np.diff(y)[edges - 1]) > _CLIPPED_SLOPE * float(np.ptp(y))
        moving = steep[:-1] & steep[1:]
        lengths, values = lengths[moving], values[moving]
        again = lengths > 1
        inside = (values != np.min(y)) & (values != np.max(y))
        if np.count_nonzero(again & inside) > max(0.5 * np.count_nonzero(inside), _STAIRS):
            return 0, round(float(np.median(lengths[again & inside])))
        clipped = int(np.count_nonzero(~inside & (lengths >= _CLIPPED_SAMPLES)))
        return (clipped if clipped > 1 else 0), 0

    def place(self, time: Array) -> NDArray[np.intp]:
        """Return the indices of the levels at some times; the first one before all."""
        return np.searchsorted(self.level_times, time, side='right').clip(1) - 1

    @cached_property
    def changes(self) -> Array:
        """Times in s of changes of level, after that of the first one."""
        found: Array = self.level_times[1:][np.diff(self.levels) != 0.0]
        return found

    @property
    def uncertain(self) -> NDArray[np.int64]:
        """Indices of the levels that switch at an uncertain time during sampling."""
        if self.earlier == 0.0:
            return np.zeros(0, np.int64)
        inside = (self.level_times > self.time[0]) & (self.level_times <= self.time[-1])
        return np.flatnonzero(inside)

    @cached_property
    def gap(self) -> float:
        """Median time between samples in s."""
        return float(np.median(np.diff(self.time)))

    @cached_property
    def quantum(self) -> float:
        """Quantisation step of the values; 0 if they are not quantised."""
        values = np.unique(self.stretch)
        if len(values) > 0.5 * len(self.stretch) or len(values) < 2:
            return 0.0
        steps = np.diff(values)
        least = float(np.min(steps))
        whole = steps / least
        return least if float(np.max(np.abs(whole - np.round(whole)))) < 0.01 else 0.0


@dataclass(frozen=True, eq=False)
class UncheckedMeasurement:
    """
    A recording to simulate, without checks, as a search creates thousands.

    The fields are those of a `Measurement`.
    """

    time: Array
    level_times: Array
    levels: Array
    slew_limit: float = math.inf
    earlier: float = 0.0
    at_rest: bool = True

    @property
    def uncertain(self) -> NDArray[np.int64]:
        """Indices of the levels that switch at an uncertain time: none."""
        return np.zeros(0, np.int64)


def pieces(
        times: Array, levels: Array, slew: float, begin: float
) -> tuple[Array, Array, Array]:
    """
    Return the amplifier's level in T as linear pieces: begins, values and slopes.

    From each begin on it is ``values + slopes (t - begins)``. At the given begin, in s, the level
    at that time has been reached; from then on the amplifier ramps at a slew rate in T/s, infinite
    for steps.
    """
    first = max(int(np.searchsorted(times, begin, side='right')) - 1, 0)
    level = float(levels[first])
    if math.isinf(slew):
        begins, heights = times[first:].copy(), levels[first:].copy()
        begins[0] = begin
        return begins, heights, np.zeros(len(begins))
    ahead = [Level(*x) for x in zip(
        times[first + 1:].tolist(), levels[first + 1:].tolist(), strict=True)]
    table = np.array([(begin, level, 0.0), *ramps(ahead, level, math.inf, slew)[0]])
    # Of pieces with the same begin the last one applies.
    keep = np.append(np.diff(table[:, 0]) > 0.0, True)
    return table[keep, 0].copy(), table[keep, 1].copy(), table[keep, 2].copy()


def recording_of(
        run: Run, actuator: ActuatorParameters | None = None
) -> tuple[Measurement, ActuatorParameters, dict[str, float]]:
    """
    Return the recording of a run, its actuator, and the planner's parameters of the coil.

    Times are from the first sample on; the actuator is the given one, or that of the planner.
    Raise `BadInputError` if the run has no level.
    """
    block = run.planner if actuator is None else actuator if math.isnan(run.temperature) else (
        actuator.at_temperature(run.temperature))
    # A recorder receives earlier latched changes after the first new one.
    levels = run.reported or in_force((x,) for x in without_repeats(run.accepted)[0])
    if not levels:
        raise BadInputError(
            f'{run.path} has no command that took effect: expected the levels of the field')
    zero = int(run.time[0])
    begin, end = levels[0].stamp, levels[-1].stamp
    if max(zero - end, begin - int(run.time[-1])) > _ANOTHER_CLOCK * NANOSECONDS:
        raise BadInputError(
            f'{run.path} has levels from {begin / NANOSECONDS:.9g} to {end / NANOSECONDS:.9g} s '
            f'and samples from {zero / NANOSECONDS:.9g} s on: expected timestamps of one clock')
    stamps = np.array([(x.stamp - zero) / NANOSECONDS for x in levels])
    fields = np.array([x.flux_density for x in levels])
    if stamps[0] > 0.0:
        # Before the first command use the field of the first sample, if known.
        field = float(run.flux_density[0])
        stamps = np.append(0.0, stamps)
        fields = np.append(field if math.isfinite(field) else 0.0, fields)
    slew = run.number('planner.slew_limit') or run.number('plant.slew_limit')
    # Of levels at the same time the last one applies.
    keep = np.append(np.diff(stamps) > 0.0, True)
    notes = () if actuator is not None else tuple(
        x.rstrip('.') for x in run.notes if 'unshaped steps' not in x)
    if actuator is None and not run.parameters_known:
        notes += (
            "the recording does not contain the actuator's parameters: what is not identified is "
            'that of the example block; name a parameter file (--params-file)',)
    return (
        Measurement(
            (run.time - zero) / NANOSECONDS, run.stretch, stamps[keep], fields[keep],
            slew or math.inf, 0.0, run.label, notes, block.coordinate,
            temperature=run.temperature),
        block,
        {'coil_time_constant': run.coil_time_constant(PLANNER)})


def read_levels(path: Path, notes: list[str] | None = None) -> tuple[Array, Array]:
    """
    Read the levels of the field from CSV: times in s and flux densities in T.

    The columns are ``time`` (s) and ``flux_density`` (T); each level applies from its time on.
    ``notes`` are those of `read_table`. Raise `BadInputError` if the file cannot be used.
    """
    table = read_table(path, ('time', 'flux_density'), notes=notes)
    if not len(table.lines):
        raise BadInputError(f'{path} has a header and no row: expected levels')
    times, levels = table.columns['time'], table.columns['flux_density']
    table.check_complete(path, '; a level that is left out would be a wrong one')
    back = np.flatnonzero(np.diff(times) < 0.0)
    if len(back):
        raise BadInputError(
            f'{path} line {table.lines[back[0] + 1]} goes back in time from '
            f'{times[back[0]]:.9g} to {times[back[0] + 1]:.9g} s: expected increasing times')
    # Of levels at the same time the last one applies.
    keep = np.append(np.diff(times) > 0.0, True)
    return times[keep], levels[keep]


def read_csv(
        path: Path, commands: Path | None = None, *, slew_limit: float = math.inf,
        coordinate: Coordinate = STRETCH, rest_length: float | None = None) -> Measurement:
    """
    Read a recording from CSV, with notes on rows that were left out.

    The columns are ``time`` (s) and ``stretch``, and ``flux_density`` (T) unless another file
    contains the levels as ``time`` and ``flux_density``, which apply from that time on. With a
    ``rest_length`` in m, a column of lengths replaces the stretch. Raise `BadInputError` if a file
    cannot be used.
    """
    own = () if commands is not None else ('flux_density',)
    notes: list[str] = []
    table = read_table(
        path, ('time', 'stretch', *own), kind='a CSV or the folder of a bag',
        rest_length=rest_length, notes=notes)
    if not len(table.lines):
        raise BadInputError(f'{path} has a header and no row: expected samples')
    keep = _kept(path, table, notes)
    time, stretch = table.columns['time'][keep], table.columns['stretch'][keep]
    if commands is not None:
        times, levels = read_levels(commands, notes)
        times, levels = joined(time, stretch, times, levels, notes, (path, commands))
        earlier = 0.0
    else:
        field = table.columns['flux_density'][keep]
        times, levels, earlier, used = _sampled_levels(path, time, field, notes)
        time, stretch = time[:used], stretch[:used]
        if slew_limit < math.inf and _ramps(time, field[:used], slew_limit):
            notes.append(
                f'the flux density already ramps at up to the slew limit of {slew_limit:g} T/s: '
                'taken as measured behind the amplifier, and not limited again')
            slew_limit = math.inf
    # Subtract the first time: seconds since an epoch leave few digits for differences.
    return Measurement(
        time - time[:1], stretch, times - time[:1], levels, slew_limit, earlier, str(path),
        tuple(dict.fromkeys(notes)), coordinate, from_csv=True)


def joined(
        time: Array, stretch: Array, times: Array, levels: Array, notes: list[str],
        sources: tuple[Path, Path] | None = None) -> tuple[Array, Array]:
    """
    Return times and levels from the first sample on, which begin with 0 T unless given.

    ``notes`` receives what is assumed; ``sources`` are the CSV files of samples and levels, None
    for arrays. Raise `BadInputError` if the times are not those of one clock in s.
    """
    path, commands = sources or ('the array of samples', 'the array of commands')
    check_flux_densities(commands, levels, sources is not None)
    if time[0] - times[-1] > _ANOTHER_CLOCK:
        raise BadInputError(
            f'{commands} ends at {times[-1]:.9g} s, and the first sample of {path} is at '
            f'{time[0]:.9g} s: expected times of one clock, not seconds since a start '
            'beside the time of day')
    # Those of arrays may be in any order, which `Measurement` refuses.
    if len(time) >= FEWEST and all(np.all(np.diff(x) > 0.0) for x in (time, times)):
        _check_units(str(path), time, stretch, str(commands), times, levels, sources is not None)
    if times[0] > time[-1]:
        raise BadInputError(
            f'{commands} begins at {times[0]:.9g} s, after the last sample of {path} at '
            f'{time[-1]:.9g} s: expected times of one clock')
    if times[0] > time[0]:
        # The field is zero before the first command.
        notes.append(f'before the first level at {times[0]:.6g} s the field is taken to be 0')
        times, levels = np.append(time[0], times), np.append(0.0, levels)
    return times, levels


def _kept(path: Path, table: CsvColumns, notes: list[str]) -> NDArray[np.int64]:
    """Return the usable rows by time, and note the others; raise `BadInputError` for too many."""
    time, stretch = table.columns['time'], table.columns['stretch']
    places: NDArray[np.int64] = np.flatnonzero(np.isfinite(time) & np.isfinite(stretch))
    lost = len(time) - len(places)
    if lost:
        notes.append(f'{lost} rows without a number were left out')
    places = _ordered(path, table, places, notes)
    steps = np.diff(time[places])
    double = int(np.count_nonzero(steps == 0.0))
    if double:
        places = places[np.append(True, steps > 0.0)]
        notes.append(f'{double} rows with the timestamp of the row before were left out')
    if lost + double > _MOST_LEFT_OUT * len(time):
        raise BadInputError(
            f'{path} has {lost + double} of {len(time)} rows that cannot be used ({lost} without '
            f'a number, {double} with the timestamp of the row before): expected at most '
            f'{100.0 * _MOST_LEFT_OUT:g} %, and a different timestamp for each sample')
    steps = steps[steps > 0.0]
    if len(steps) and float(np.max(steps)) > _GAP * float(np.median(steps)):
        notes.append(
            f'the timestamps have a gap of {np.max(steps):.3g} s, where the others are '
            f'{np.median(steps):.3g} s apart')
    return places


def _ordered(
        path: Path, table: CsvColumns, places: NDArray[np.int64], notes: list[str]
) -> NDArray[np.int64]:
    """Return rows sorted by time; raise `BadInputError` if a clock was set back."""
    time = table.columns['time'][places]
    steps = np.diff(time)
    back = np.flatnonzero(steps < 0.0)
    if not len(back):
        return places
    # Samples in order before and after, beyond frames that overtook each other.
    runs = np.diff(np.concatenate([[0], back + 1, [len(time)]]))
    usual = float(np.median(steps[steps > 0.0])) if np.any(steps > 0.0) else math.inf
    clock = back[(np.minimum(runs[:-1], runs[1:]) >= _RUN) & (-steps[back] > _OVERTAKEN * usual)]
    if len(clock):
        i, j = places[clock[0]], places[clock[0] + 1]
        raise BadInputError(
            f'{path} line {table.lines[j]} jumps back in time from '
            f'{table.columns["time"][i]:.9g} to {table.columns["time"][j]:.9g} s, between '
            'rows that are in order: expected increasing times of one clock; cut the '
            'file where the clock was set, or, if these are points in any order, sort the rows '
            'by time')
    notes.append(f'the rows were not in the order of time ({len(back)} jumps back): sorted')
    order: NDArray[np.int64] = np.argsort(time, kind='stable')
    return places[order]


def _check_units(
        path: str, time: Array, stretch: Array, commands: str, times: Array, levels: Array,
        from_csv: bool) -> None:
    """Raise `BadInputError` if times of samples and of levels have different units."""
    def unexplained(factor: float) -> float:
        # Variance that remains if each level has its own mean.
        place = np.searchsorted(factor * times, time, side='right') - 1
        _, group = np.unique(np.where(place < 0, 0.0, levels[place]), return_inverse=True)
        mean = np.bincount(group, stretch) / np.bincount(group)
        return float(np.sum((stretch - mean[group]) ** 2))

    least = _BETTER * unexplained(1.0)
    for factor, unit in _OTHER_UNITS.items():
        for finer, wrong in ((factor, path), (1.0 / factor, commands)):
            if unexplained(finer) < least:
                raise BadInputError(
                    f'{path} has samples from {time[0]:.6g} to {time[-1]:.6g} s and {commands} '
                    f'levels from {times[0]:.6g} to {times[-1]:.6g} s: expected both in s, but '
                    f'the motion follows the levels as if the times of {wrong} were in {unit}; '
                    f'if they are, {remedy("time", unit, from_csv)}')


def _ramps(time: Array, field: Array, slew: float) -> bool:
    """
    Return whether a sampled field ramps over several samples, at up to a slew rate in T/s.

    Commanded levels step by more, or so rarely that no two changes follow each other.
    """
    rates = np.abs(np.diff(field) / np.diff(time))
    moving = rates > 0.0
    return bool(np.any(moving[1:] & moving[:-1])) and (
        float(np.median(rates[moving])) <= _SAME_RATE * slew)


def _sampled_levels(
        path: Path, time: Array, field: Array, notes: list[str]
) -> tuple[Array, Array, float, int]:
    """
    Return the levels of a column of the samples, and the uncertainty of their times.

    Also return the number of samples to use.
    """
    good = np.isfinite(field)
    if not np.all(good):
        raise BadInputError(
            f'{path} has {np.count_nonzero(~good)} rows without a flux_density: expected the '
            'field in force at each sample, or its levels in a file of their own (--commands)')
    changed = np.append(True, np.diff(field) != 0.0)
    count, used = int(np.count_nonzero(changed)), len(time)
    if _MOST_SWITCHES < count < _SWITCHED * len(time):
        used = int(np.flatnonzero(changed)[_MOST_SWITCHES])
        notes.append(
            f'the flux density has {count - 1} switches: the first {_MOST_SWITCHES - 1}, up to '
            f'{time[used] - time[0]:.4g} s, are used, since their times are estimated too; give '
            'their true times with --commands to use all samples')
        time, field, changed, count = time[:used], field[:used], changed[:used], _MOST_SWITCHES
    if count > max(_MEASURED_FIELD * len(time), _FEW_LEVELS) or count > _MOST_SWITCHES:
        notes.append(
            f'the flux density changes at {count} of {len(time)} samples: taken as measured, '
            'and as constant from each sample to the next; give the levels with --commands if '
            'they are known')
        return time[changed], field[changed], 0.0, used
    interval = float(np.median(np.diff(time))) if len(time) > 1 else 0.0
    if count > 1:
        notes.append(
            f'each of {count - 1} switches lies somewhere in the {interval:.3g} s before the '
            'sample that shows it, and is estimated too: give their true times with --commands '
            'for the full accuracy')
    return time[changed], field[changed], interval, used
