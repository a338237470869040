"""Measured data: samples of the stretch and levels of the field, as arrays."""

from dataclasses import dataclass
from functools import cached_property
import math

import numpy as np
from numpy.typing import NDArray

from hmsa.errors import BadInputError, check_number
from hmsa.interfaces.topics import PLANNER
from hmsa.model.delivery import ramps
from hmsa.model.equations import Array
from hmsa.model.laws.coordinate import Coordinate, STRETCH
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
# this fraction of the range.
_CLIPPED_SLOPE = 0.01
_CLIPPED_SAMPLES = 3
# Number of repeated values in motion, if more than half of all, above which samples were held.
_STAIRS = 4
# Fraction of samples on either side that may be invalid, and the maximum flux density of a coil
# in T.
_FEW, _STRONGEST = 0.02, 5.0


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
        if np.max(np.abs(self.levels)) > _STRONGEST:
            raise BadInputError(
                f'{self.label} has flux densities up to {np.max(np.abs(self.levels)):.6g} T: '
                f'expected at most {_STRONGEST:g} T; if they are in mT, write '
                '"flux_density [mT]" in the header of the CSV')
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
        raise BadInputError(
            f'{self.label} has {what.plural} from {low:.4g} to {high:.4g}'
            + (f', {rest:.4g} without field' if seen else '')
            + f': expected {what.meaning}; if it is ' + looks)

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
