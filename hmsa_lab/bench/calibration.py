"""
Calibrations: of a coil by a field probe, and of actuator and sensor by a slow staircase of levels.

A coil has a constant, saturation, a table and hysteresis; an actuator has a static response.
Guided runs on a bench measure the delays of field and samples, and make the staircase.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
import math
from threading import Event, Thread
from time import time_ns
from typing import Any

import numpy as np
from scipy.optimize import curve_fit
from scipy.special import stdtrit

from hmsa.errors import BadInputError, HmsaError
from hmsa.identification.delays import Delays, delays, field_delays
from hmsa.identification.measurement import Measurement
from hmsa.model.equations import Array
from hmsa.model.parameters import ActuatorParameters
from hmsa.model.units import NANOSECONDS
from hmsa_lab.bench.assembly import SensorScale
from hmsa_lab.bench.bench import Bench, LEAD, matched, PhaseResults
from hmsa_ros.device.hardware import described, readings

# Minimum number of readings for a fit.
_FEWEST = 4
# Fraction of the range by which a model may deviate beyond the hysteresis; saturation, in units of
# the range, from which it is not significant.
_MISSES, _FAR = 0.005, 20.0
# Number of levels that demagnetise a core.
_DECAY = 12
# Currents closer than this fraction of their range count as equal.
_SAME = 1e-6
# Minimum number of rows of a table of the law.
_FEWEST_ROWS = 6
# Minimum number of different lengths for a straight line.
_LENGTHS = 3


@dataclass(frozen=True, eq=False)
class CoilCalibration:
    """
    A coil as measured with a field probe.

    Attributes
    ----------
    tesla_per_ampere, std : float
        Coil constant at small currents, and its standard deviation.
    interval : (float, float)
        95 % interval of the coil constant.
    saturation : float
        B_s in T of ``B_s tanh(tesla_per_ampere I / B_s)``; infinite if not significant.
    offset : float
        Reading in T without a current.
    misses : float
        Largest deviation of a mean reading from the model, as a fraction of the range.
    hysteresis : float
        Largest difference of the mean readings at one current between rising and falling current,
        as a fraction of the range; NaN if no current was approached from both sides.
    current, flux_density : ndarray, shape (m,)
        Distinct currents in ascending order, and the mean reading at each minus the offset.
    model : str
        Recommended model: ``number``, ``saturation`` or ``table``.

    """

    tesla_per_ampere: float
    std: float
    interval: tuple[float, float]
    saturation: float
    offset: float
    misses: float
    hysteresis: float
    current: Array
    flux_density: Array
    model: str

    def settings(self, table: str) -> dict[str, Any]:
        """Return a driver's settings ``hardware.coil.*``; ``table`` is the file of a table."""
        if self.model == 'table':
            return {'hardware.coil.file': table}
        return {'hardware.coil.tesla_per_ampere': self.tesla_per_ampere} | (
            {'hardware.coil.saturation': self.saturation} if self.model == 'saturation' else {})

    def curve(self, current: Array) -> Array:
        """Return the flux density in T of the model at currents in A, without offset."""
        return np.interp(current, self.current, self.flux_density) if self.model == 'table' else (
            _model(current, self.tesla_per_ampere, 0.0, self.saturation))


def calibrate_coil(current: Array, flux_density: Array) -> CoilCalibration:
    """
    Fit a coil to readings of a field probe.

    Parameters
    ----------
    current : ndarray, shape (n,)
        Current in A (or voltage in V) of the source at each reading, in chronological order.
    flux_density : ndarray, shape (n,)
        Reading in T, including any offset of the probe.

    Returns
    -------
    CoilCalibration
        With the simplest model that fits the readings.

    Raises
    ------
    BadInputError
        If there are too few currents, or the readings do not depend on them.

    """
    if not np.all(np.isfinite(current) & np.isfinite(flux_density)):
        raise BadInputError('readings are not all finite: expected numbers, in A and T')
    places = np.unique(np.round(current / max(float(np.ptp(current)), 1e-300) / _SAME))
    if len(current) < _FEWEST or len(places) < _FEWEST or not (
            np.min(current) <= 0.0 <= np.max(current)):
        raise BadInputError(
            f'{len(current)} readings at {len(places)} currents: expected at least {_FEWEST} '
            'currents with 0 A within their range')
    span = float(np.ptp(flux_density))
    if span == 0.0:
        raise BadInputError(
            f'all readings are {flux_density[0]:g} T: they do not follow the current; check the '
            'probe and its direction')
    straight = _fit(current, flux_density, saturating=False)
    bent = _fit(current, flux_density, saturating=True)
    at, mean, hysteresis = branch_means(current, flux_density)
    better = len(current) * math.log(
        max(float(np.sum(straight[2]**2)), 1e-300) / max(float(np.sum(bent[2]**2)), 1e-300))
    saturates = better > 10.0 and abs(bent[0][2]) < _FAR * span
    values, deviation, _ = bent if saturates else straight
    slope, offset = float(values[0]), float(values[1])
    saturation = abs(float(values[2])) if saturates else math.inf
    if slope == 0.0 or not deviation < 0.2 * abs(slope):
        raise BadInputError(
            f'the readings do not follow the current ({slope:.3g} T/A, standard deviation '
            f'{deviation:.3g}): expected a field that rises or falls with it; check the '
            'probe and its direction')
    misses = float(np.max(np.abs(mean - _model(at, *values)))) / span
    half = float(stdtrit(len(current) - len(values), 0.975)) * deviation
    # Both branches of a loop deviate from a middle curve by half of the hysteresis.
    allowed = _MISSES + 0.5 * (0.0 if math.isnan(hysteresis) else hysteresis)
    model = 'table' if misses > allowed else 'saturation' if saturates else 'number'
    return CoilCalibration(
        slope, deviation, (slope - half, slope + half), saturation, offset, misses, hysteresis,
        at, mean - float(np.interp(0.0, at, mean)), model)


def _model(current: Array, slope: float, offset: float, saturation: float = math.inf) -> Array:
    found: Array = offset + (
        slope * current if saturation == math.inf
        else saturation * np.tanh(slope * current / saturation))
    return found


def _fit(current: Array, flux_density: Array, *, saturating: bool) -> tuple[Array, float, Array]:
    """Return slope, offset and any B_s; standard deviation of the slope; and residuals."""
    slope, offset = np.polyfit(current, flux_density, 1)
    start = [slope, offset, 2.0 * np.max(np.abs(flux_density - offset))][:3 if saturating else 2]
    values, covariance = curve_fit(
        _model, current, flux_density, start, method='trf', x_scale='jac', xtol=1e-15, ftol=1e-15,
        gtol=1e-15)
    return values, math.sqrt(covariance[0, 0]), _model(current, *values) - flux_density


def branch_means(current: Array, flux_density: Array) -> tuple[Array, Array, float]:
    """Return currents, mean readings at each, and hysteresis as a fraction of the range."""
    size = float(np.ptp(current))
    places = np.round(current / size / _SAME).astype(np.int64)
    before = np.concatenate([[np.nan], current[:-1]])
    # The first of several readings at one current shows from which side it was approached.
    side = np.sign(current - before)
    for i in range(1, len(side)):
        if places[i] == places[i - 1]:
            side[i] = side[i - 1]
    at, mean, apart = [], [], [math.nan]
    for place in np.unique(places):
        here = places == place
        at.append(float(np.mean(current[here])))
        branches = [flux_density[here & (side == x)] for x in (1.0, -1.0)]
        if all(len(x) for x in branches):
            rising, falling = (float(np.mean(x)) for x in branches)
            apart.append(abs(rising - falling) / float(np.ptp(flux_density)))
            mean.append(0.5 * (rising + falling))
        else:
            mean.append(float(np.mean(flux_density[here])))
    return np.array(at), np.array(mean), float(np.nanmax(apart)) if len(apart) > 1 else math.nan


def loop(largest: float, steps: int) -> list[float]:
    """Return levels from 0 up to the largest one, down to its negative, and back to 0."""
    up = np.linspace(0.0, largest, steps + 1)
    return [float(x) for x in (*up, *up[-2::-1], *-up[1:], *-up[-2::-1])]


def decay(largest: float) -> list[float]:
    """Return levels that demagnetise a core: of alternating sign and decreasing size, then 0."""
    return [largest * (1.0 - i / _DECAY) * (-1.0)**i for i in range(_DECAY)] + [0.0]


@dataclass(frozen=True, eq=False)
class Statics:
    """
    An actuator at rest.

    Attributes
    ----------
    level, stretch : ndarray, shape (m,)
        Levels in T, and the stretch that they hold, in ascending order; 1 without a field.
    rest : float
        Stretch reported by the sensor without a field.
    apart : float
        Largest difference of the stretches at one level that was approached from both sides, as a
        fraction of the range; NaN if there was none.

    """

    level: Array
    stretch: Array
    rest: float
    apart: float


def statics(level: Array, stretch: Array) -> Statics:
    """
    Evaluate a staircase.

    Parameters
    ----------
    level, stretch : ndarray, shape (n,)
        Levels in T in chronological order, and the measured stretch at each.

    Returns
    -------
    Statics
        With increasing stretches.

    Raises
    ------
    BadInputError
        If there are too few levels, or the stretch does not increase with them.

    """
    if not np.all(np.isfinite(level) & np.isfinite(stretch)):
        raise BadInputError('levels and stretches are not all finite: expected numbers')
    if len(np.unique(level)) < _FEWEST_ROWS or not np.min(level) < 0.0 < np.max(level):
        raise BadInputError(
            f'{len(np.unique(level))} levels: expected at least {_FEWEST_ROWS}, of both signs')
    at, mean, apart = branch_means(level, stretch)
    rest = float(np.interp(0.0, at, mean))
    if not rest > 0.0:
        raise BadInputError(
            f'the sensor shows a stretch of {rest:g} without a field: expected one above 0; see '
            'its gain, offset and rest_length')
    if not np.all(np.diff(mean) > 0.0):
        place = int(np.argmin(np.diff(mean)))
        raise BadInputError(
            f'the stretch goes from {mean[place]:.6g} at {at[place]:.4g} T to '
            f'{mean[place + 1]:.6g} at {at[place + 1]:.4g} T: expected a rising one; swap the '
            'leads or the sign of the gain where it falls, else raise --settle or --limit, or '
            'lower --steps')
    return Statics(at, mean / rest, rest, apart)


def scale_at_rest(scale: SensorScale, rest: float) -> SensorScale:
    """Return a scale with stretch 1 at the reading where the given one shows ``rest``."""
    return SensorScale(scale.gain, scale.offset, scale.rest_length * rest, scale.latency)


def scale_by_gauge(
        scale: SensorScale, level: Array, stretch: Array, length: Array
) -> tuple[SensorScale, float]:
    """
    Calibrate a sensor with a gauge of the actuator's length.

    Parameters
    ----------
    scale : SensorScale
        Scale of the measured stretches.
    level : ndarray, shape (n,)
        Levels in T.
    stretch : ndarray, shape (n,)
        Measured stretches.
    length : ndarray, shape (n,)
        Lengths from the gauge, in the unit of the rest length.

    Returns
    -------
    (SensorScale, float)
        The scale, and the largest deviation of a length from it, as a fraction of their range.

    Raises
    ------
    BadInputError
        If the lengths do not depend on the sensor.

    """
    span = float(np.ptp(length)) if np.all(np.isfinite(length)) else math.nan
    if not span > 0.0 or len(np.unique(stretch)) < _LENGTHS:
        raise BadInputError(
            f'the gauge shows lengths over {span:g}: expected at least {_LENGTHS} different ones')
    reading = (stretch * scale.rest_length - scale.offset) / scale.gain
    gain, offset = (float(x) for x in np.polyfit(reading, length, 1))
    misses = float(np.max(np.abs(gain * reading + offset - length))) / span
    still = np.abs(level) <= 1e-9 * float(np.max(np.abs(level)))
    rest = float(np.mean(length[still])) if np.any(still) else math.nan
    if not rest > 0.0 or misses > 0.5:
        raise BadInputError(
            f'the gauge reads {rest:g} without a field, and deviates from a straight line by '
            f'{100.0 * misses:.3g} % of its range: expected the length of the actuator')
    return SensorScale(gain, offset, rest, scale.latency), misses


CalibrationProgress = Callable[[str, float], None]
# Duration of levels in periods of the actuator, and minimum in s.
_PERIODS, _SHORTEST = (0.8, 1.6), 0.12
# Ranges of levels as fractions of the limit, used alternately.
_HIGH, _LOW = (0.6, 1.0), (-0.4, 0.2)
# Time in s between readings of a non-blocking probe.
_PAUSE = 2e-4
# Number of further waits for samples at a level.
_PATIENCE = 10


class _Reader:
    """Read a probe continuously in a thread; times in ns, field in T."""

    def __init__(self, probe: Any) -> None:
        self._probe, self._over = probe, Event()
        self.seen: list[tuple[int, float]] = []
        self.failure = ''
        self._thread = Thread(target=self._work, name='probe', daemon=True)
        self._thread.start()

    def _work(self) -> None:
        while not self._over.wait(_PAUSE):
            begun = time_ns()
            try:
                answer = self._probe.read()
                middle = (begun + time_ns()) // 2
                self.seen += [(middle if x.stamp is None else x.stamp, x.stretch)
                              for x in readings(answer)]
            except BaseException as error:  # any error of the laboratory's class
                self.failure = f'{type(self._probe).__name__}.read raised {described(error)}'
                return

    def close(self) -> Array:
        """Stop; return the readings, shape (n, 2); raise `HmsaError` if the probe failed."""
        self._over.set()
        self._thread.join()
        if self.failure:
            raise HmsaError(self.failure)
        found: Array = np.array(self.seen, dtype=np.float64).reshape(-1, 2)
        return found


def steps_of(actuator: ActuatorParameters, limit: float, count: int) -> list[tuple[float, float]]:
    """Return levels in T with durations in s that cover all phases of the samples."""
    random, period = np.random.default_rng(0), actuator.period
    return [(limit * random.uniform(*(_LOW if i % 2 else _HIGH)),
             max(period * random.uniform(*_PERIODS), _SHORTEST * random.uniform(1.0, 1.5)))
            for i in range(count)]


def measure_delays(
        bench: Bench, steps: Sequence[tuple[float, float]], probe: Any,
        actuator: ActuatorParameters, lag: float | None, progress: CalibrationProgress) -> Delays:
    """
    Step through levels, and determine transport delay, lag and latency.

    Parameters
    ----------
    bench : Bench
        Bench with the hardware.
    steps : sequence of (float, float)
        Levels in T, and their durations in s.
    probe : object or None
        Has ``read``, which returns a field in T, or a list of (field in T, NaN, time in ns).
    actuator : ActuatorParameters
        Approximate parameters.
    lag : float or None
        Known lag of the field in s.
    progress : callable
        Called with the current activity and the completed fraction.

    Returns
    -------
    Delays
        The delays, as far as they can be separated.

    Raises
    ------
    HmsaError
        If hardware or probe fail, or the recording is insufficient.

    """
    seen = PhaseResults([], [], [])
    reader = None if probe is None else _Reader(probe)
    try:
        for i, (level, seconds) in enumerate(steps):
            progress(f'{level:.3g} T', i / len(steps))
            seen = seen.joined(bench.hold(seconds, [level]))
    finally:
        field_seen = np.zeros((0, 2)) if reader is None else reader.close()
    progress('evaluating', 1.0)
    pairs = matched(seen)
    samples = {x.time: float(x.stretch[0]) for x in seen.samples if math.isfinite(x.stretch[0])}
    if not samples or len(pairs) < len(steps):
        raise HmsaError(
            f'{bench.name} gave {len(samples)} samples and set {len(pairs)} of {len(steps)} '
            'levels: expected a sensor, and all levels; see hmsa check-driver')
    zero = min(*samples, *(x.stamp for x, _ in pairs)) - NANOSECONDS

    def seconds_of(times: Any) -> Array:
        found: Array = (np.asarray(times, dtype=np.int64) - zero) / NANOSECONDS
        return found

    begins, levels = seconds_of([x.stamp for x, _ in pairs]), np.array([x.level for x, _ in pairs])
    times = sorted(samples)
    return delays(
        Measurement(
            seconds_of(times), np.array([samples[x] for x in times]), np.append(0.0, begins),
            np.append(0.0, levels), label=bench.name),
        np.append(math.nan, seconds_of([stamp for _, (stamp, _) in pairs])),
        None if reader is None else field_delays(
            seconds_of(field_seen[:, 0]), field_seen[:, 1], begins, levels),
        actuator, lag=lag)


def hold_staircase(
        bench: Bench, limit: float, steps: int, settle: float,
        gauge: Callable[[float], float] | None, progress: CalibrationProgress
) -> tuple[Array, Array, Array, float]:
    """
    Apply a slow staircase of levels up, down and back.

    Parameters
    ----------
    bench : Bench
        Bench with the hardware.
    limit : float
        Largest level in T.
    steps : int
        Number of levels in each quarter.
    settle : float
        Duration in s of each level, of which the second half is evaluated.
    gauge : callable or None
        Called with a level in T; returns the length of the actuator.
    progress : callable
        Called with the current activity and the completed fraction.

    Returns
    -------
    (ndarray, ndarray, ndarray, float)
        Levels in T, stretches, lengths (NaN without a gauge), and the largest remaining drift of
        the stretch at the end of a level, as a fraction of the range.

    Raises
    ------
    HmsaError
        If the hardware fails or has no sensor.

    """
    levels, rows = loop(limit, steps), []
    for i, level in enumerate(levels):
        progress(f'{level:.3g} T', i / len(levels))
        seen = bench.hold(settle, [level])
        parts: list[list[float]] = [[], []]
        for _ in range(_PATIENCE):
            parts = [[float(x.stretch[0]) for x in seen.samples if math.isfinite(x.stretch[0])
                      and seen.asked[0][0] + y * settle * NANOSECONDS <= x.time]
                     for y in (0.5, 0.75)]
            if parts[1]:
                break
            # Samples are late on a busy machine.
            seen = seen.joined(bench.hold(LEAD, []))
        if not parts[1]:
            raise HmsaError(
                f'{bench.name} gave no sample at {level:.3g} T: expected a sensor, and a settle '
                f'time well above {LEAD:g} s')
        second, late = (float(np.mean(x)) for x in parts)
        rows.append((
            level, second, math.nan if gauge is None else gauge(level), late - second))
    found = np.array(rows)
    return found[:, 0], found[:, 1], found[:, 2], float(
        2.0 * np.max(np.abs(found[:, 3])) / max(float(np.ptp(found[:, 1])), 1e-300))
