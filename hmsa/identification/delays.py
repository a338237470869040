"""Delays of a field after its command, and of a sensor after the motion."""

from collections.abc import Iterable
from dataclasses import dataclass
import math

import numpy as np
from scipy.optimize import least_squares
from scipy.special import stdtrit

from hmsa.errors import BadInputError
from hmsa.identification.identify import identify
from hmsa.identification.measurement import Measurement
from hmsa.identification.quantities import DEFAULT_FREE
from hmsa.identification.result import Identification
from hmsa.model.equations import Array
from hmsa.model.parameters import ActuatorParameters

# Minimum numbers of readings and levels for a fit.
_READINGS, _LEVELS = 50, 4
# Time after a level, in s, within which readings are used.
_LONGEST = 0.05
# In s: initial transports and lags of the search, and the smallest lag that differs from 0.
_TRANSPORTS = np.linspace(-2e-3, 2e-2, 45)
_LAGS = np.geomspace(5e-5, 2e-2, 9)
_LEAST_LAG = 1e-6
# Minimum number of readings within the first three lags of a step to determine its shape.
_RISE = 3
# Minimum change of the field, in standard deviations of its readings, to determine its time.
_SEEN = 10.0


@dataclass(frozen=True)
class Interval:
    """A value with the ends of its 95 % interval; NaN if unknown."""

    value: float
    low: float = math.nan
    high: float = math.nan

    def __add__(self, other: 'Interval') -> 'Interval':
        """Return the sum of two independent values."""
        half = 0.5 * math.hypot(self.high - self.low, other.high - other.low)
        value = self.value + other.value
        return Interval(value, value - half, value + half)


@dataclass(frozen=True, eq=False)
class FieldDelays:
    """Delays of a field from readings of a probe."""

    transport: Interval  #: from the time of a level to the start of its field, in s
    lag: Interval  #: time constant of a first-order lag, in s
    noise: float  #: standard deviation of a reading in T
    since: Array  #: shape (n,), time in s of readings since the last level was set ...
    share: Array  #: shape (n,), ... and the fraction of its step that the field had completed


def field_delays(
        time: Array, field: Array, level_times: Array, levels: Array) -> FieldDelays:
    """
    Fit transport and lag of a coil to readings of its field.

    Each step is normalised to its own height, so that gain and hysteresis of the coil do not
    matter.

    Parameters
    ----------
    time, field : ndarray, shape (n,)
        Time in s and reading in T of a probe; n of at least 50.
    level_times, levels : ndarray, shape (m,)
        Times in s at which levels in T were set, increasing; m of at least 4.

    Returns
    -------
    FieldDelays
        The delays with intervals.

    Raises
    ------
    BadInputError
        If there are too few readings or levels, or the field does not follow.

    """
    if not all(np.all(np.isfinite(x)) for x in (time, field, level_times, levels)):
        raise BadInputError('readings of the probe are not all finite: expected numbers')
    steps = np.append(True, np.diff(levels) != 0.0)
    begins = level_times[steps]
    if len(time) < _READINGS or len(begins) < _LEVELS:
        raise BadInputError(
            f'{len(time)} readings of the probe and {len(begins)} levels: expected at least '
            f'{_READINGS} and {_LEVELS}')

    since, share, weight = _folded(time, field, begins)

    def off(values: Array) -> Array:
        return weight * (response(since, 1e-3 * values[0], 1e-3 * values[1]) - share)

    def search(transports: Iterable[float], lags: Iterable[float]) -> tuple[float, float]:
        return min((float(np.sum(off(np.array((1e3 * x, 1e3 * y)))**2)), 1e3 * x, 1e3 * y)
                   for x in transports for y in lags)[1:]

    coarse = 1e-3 * search(_TRANSPORTS, _LAGS)[0]
    # The cost of a short lag is constant between two readings.
    spacing = float(np.ptp(since)) / len(since)
    step = max(spacing, 1e-5)
    most = math.ceil(5e-4 / step)
    best = search(
        coarse + step * np.arange(-most, most + 1), np.append(0.25 * spacing, _LAGS))
    found = least_squares(
        off, best, x_scale='jac', xtol=1e-12, ftol=1e-12, bounds=([-np.inf, 0.0], np.inf))
    freedom = len(since) - 2
    noise = math.sqrt(2.0 * found.cost / freedom)
    if float(np.max(np.abs(weight))) < _SEEN * noise:
        raise BadInputError(
            f'the readings of the probe differ by {noise:.3g} T from a lagged field with steps of '
            f'at most {np.max(np.abs(weight)):.3g} T: expected a field that follows the levels; '
            'check the probe, or raise --limit')
    half = float(stdtrit(freedom, 0.975)) * noise * np.sqrt(
        np.abs(np.diag(np.linalg.pinv(found.jac.T @ found.jac))))
    values, since_ms = found.x, 1e3 * since
    begin, end = values[0], values[0] + 3.0 * values[1]
    if np.count_nonzero((since_ms > begin) & (since_ms < end)) < _RISE:
        # The readings only show an interval in which the field starts and rises for three lags.
        earliest = 0.0 if begin > 0.0 else 1e3 * float(_TRANSPORTS[0])
        before = float(np.max(since_ms, where=since_ms <= begin, initial=earliest))
        after = float(np.min(since_ms, where=since_ms >= end, initial=1e3 * _LONGEST))
        half = (after - before) / np.array([2.0, 6.0])
        values = np.array([before, 0.0]) + half
    transport, lag = (
        Interval(1e-3 * float(x), 1e-3 * float(x - y), 1e-3 * float(x + y))
        for x, y in zip(values, half, strict=True))
    return FieldDelays(transport, lag, noise, since, share)


def response(since: Array, transport: float, lag: float) -> Array:
    """Return the completed fraction of a step at times in s after its level was set."""
    late = np.maximum(since - transport, 0.0)
    done: Array = 1.0 - np.exp(-np.minimum(late / max(lag, _LEAST_LAG), 700.0))
    return done


def _folded(time: Array, field: Array, begins: Array) -> tuple[Array, Array, Array]:
    """Return times since the last level, completed fractions of its step, and its height in T."""
    place = np.searchsorted(begins, time, 'right') - 1
    ends = np.append(begins[1:], time[-1])
    # The field has settled long after a step.
    late = time > 0.5 * (begins + ends)[place]
    rest = np.array([
        np.mean(field[late & (place == i)]) if np.any(late & (place == i)) else math.nan
        for i in range(len(begins))])
    height = np.append(math.nan, np.diff(rest))
    since = time - begins[place]
    used = (place > 0) & (since < min(_LONGEST, 0.5 * float(np.min(np.diff(begins))))) & (
        np.isfinite(height[place])) & (height[place] != 0.0)
    if np.count_nonzero(used) < _READINGS:
        raise BadInputError(
            f'{np.count_nonzero(used)} readings of the probe are close enough after a level: '
            f'expected at least {_READINGS}; read the probe more often, or set more levels')
    place = place[used]
    return since[used], (field[used] - rest[place - 1]) / height[place], height[place]


@dataclass(frozen=True, eq=False)
class Delays:
    """Components of the time between a command and a sample of its effect; in s."""

    transport: Interval  #: from the timestamp of a level to the start of its field
    jitter: float  #: standard deviation of the part that the device reports
    lag: Interval  #: time constant of the field
    latency: Interval  #: delay of the timestamps of samples after the motion
    #: correction of these timestamps: the latency, and the transport that is not reported
    setting: Interval
    field: FieldDelays | None  #: None without a probe
    motion: Identification  #: result from the samples
    notes: tuple[str, ...]  #: a sentence each


def delays(
        recording: Measurement, asked: Array, field: FieldDelays | None,
        actuator: ActuatorParameters, *, lag: float | None = None) -> Delays:
    """
    Separate transport, lag and latency.

    Parameters
    ----------
    recording : Recording
        Samples of the motion, and the levels at the times that the device reports.
    asked : ndarray, shape (m,)
        Commanded time of each of these levels, in s; NaN for one that was not commanded.
    field : FieldDelays or None
        Delays of the field measured by a probe, for these levels.
    actuator : ActuatorParameters
        Sizes, and start values of the other parameters.
    lag : float, optional
        Known time constant of the field in s, instead of a probe.

    Returns
    -------
    Delays
        The delays; without a probe, the latency includes transport that the device does not
        report.

    Raises
    ------
    BadInputError
        If the recording cannot be used.

    """
    late = recording.level_times - asked
    late = late[np.isfinite(late)]
    jitter = float(np.std(late, ddof=1)) if len(late) > 1 else math.nan
    half = 2.0 * jitter / math.sqrt(max(len(late), 1))
    transport = Interval(float(np.mean(late)), float(np.mean(late)) - half,
                         float(np.mean(late)) + half)
    unsaid, notes = Interval(0.0, 0.0, 0.0), []
    if field is not None:
        constant, unsaid = field.lag, field.transport
        transport += unsaid
    elif lag is not None:
        constant = Interval(lag, lag, lag)
        notes.append('no probe: the latency includes transport that the device does not report')
    else:
        constant = Interval(math.nan)
        notes.append('no probe, and no lag is given: the latency includes the lag, and transport '
                     'that the device does not report')
    motion = _motion(recording, actuator, 0.0 if math.isnan(constant.value) else constant.value)
    found = motion.parameters['sensor_latency']
    setting = Interval(found.value, found.low, found.high)
    if motion.verdict != 'identified':
        notes.append(f'the motion is {motion.verdict}: {motion.reason}')
    return Delays(
        transport, jitter, constant,
        setting + Interval(-unsaid.value, -unsaid.high, -unsaid.low), setting, field, motion,
        tuple(notes))


def _motion(recording: Measurement, actuator: ActuatorParameters, lag: float) -> Identification:
    """Identify the latency for a known lag, with parameters that residuals suggest."""
    free: tuple[str, ...] = (*DEFAULT_FREE, 'sensor_latency')
    known = {'coil_time_constant': lag}
    found = identify(recording, free=free, actuator=actuator, known=known)
    for named in found.signatures:
        more = tuple(x for x in named.remedy.split(',') if x.startswith('viscoelastic'))
        if found.verdict != 'identified' and named.found and more:
            return identify(recording, free=(*free, *more), actuator=actuator, known=known)
    return found
