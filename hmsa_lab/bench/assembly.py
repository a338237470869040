"""
Hardware assembled from a source of current or voltage, a coil with a core, and a sensor.

A source has the members of `Hardware`, with amperes (or volts) instead of tesla. A sensor has
``read``, in any unit of length or signal. The assembly converts units and passes other members
through.

The hysteresis of an iron core is that of Prandtl and Ishlinskii with generalised play operators,
whose envelope is the curve of the coil (Al Janaideh, Rakheja and Su 2011,
doi:10.1109/TMECH.2010.2052366). Its inverse, which compensates it, is exact (Kuhnen 2003,
doi:10.3166/ejc.9.407-418): for a given state of the plays, the field is an increasing, piecewise
linear function of the level.
"""

from bisect import bisect_right
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields
import math
from pathlib import Path
from time import monotonic
from typing import Any, NamedTuple

import numpy as np

from hmsa.columns import read_currents
from hmsa.errors import BadInputError, excerpt
from hmsa.model.equations import Array
from hmsa.model.units import NANOSECONDS
from hmsa_ros.device.hardware import is_number, readings
from hmsa_ros.device.watchdog import StateLostError

# Number of levels stored, so that later ones can replace some of them, and rounding in ns of their
# times by a device.
_REMEMBERED, _ROUNDED = 1024, 100_000
# Widths for each level of a quarter of a staircase, and fraction of the range below which levels
# are equal.
_FINE, _SAME = 2, 1e-6
# Negligible weight, as a fraction of the first one.
_LEAST = 1e-9
# Fraction of its limit to which a coil that was too warm must cool.
_COOL = 0.9
# Largest usable fraction of the saturation.
_SATURATED = 0.99
_MEMBERS = ('open', 'clock', 'capacity', 'description', 'arm', 'disarm', 'temperature')


@dataclass(frozen=True, eq=False)
class IronCore:
    """
    Play operators of an iron core.

    Parameters
    ----------
    widths : sequence of float
        Change of the level in T before a play follows; increasing from 0.
    weights : sequence of float
        Weights of the plays in the field; at least 0, the first one above 0.

    Raises
    ------
    BadInputError
        If they do not meet these conditions.

    """

    widths: Sequence[float]
    weights: Sequence[float]
    _arrays: tuple[Array, Array] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        try:
            widths, weights = (np.array(x, dtype=np.float64) for x in (self.widths, self.weights))
            fits = (widths.ndim == 1 and widths.shape == weights.shape and widths[0] == 0.0
                    and np.all(np.diff(widths) > 0.0) and weights[0] > 0.0
                    and np.all(weights >= 0.0) and np.all(np.isfinite([widths, weights])))
        except (TypeError, ValueError, IndexError):
            fits = False
        if not fits:
            raise BadInputError(
                f'coil.play_widths is {self.widths!r:.80} and coil.play_weights '
                f'{self.weights!r:.80}: expected as many numbers of both, rising from 0, and at '
                'least 0 with the first one above 0; hmsa calibrate coil --hysteresis writes them')
        object.__setattr__(self, '_arrays', (widths, weights))

    def moved(self, plays: Array, level: float) -> Array:
        """Return the state of plays, shape (n,), after a level in T."""
        widths, _ = self._arrays
        found: Array = np.clip(plays, level - widths, level + widths)
        return found

    def field(self, plays: Array) -> float:
        """Return the field in T for a state of the plays."""
        return float(self._arrays[1] @ plays)

    def needed(self, plays: Array, flux: float) -> float:
        """Return the level in T that gives a field in T."""
        widths, weights = self._arrays
        turns = np.sort(np.concatenate([plays - widths, plays + widths]))
        fields = np.array([self.field(self.moved(plays, x)) for x in turns])
        if fields[0] < flux < fields[-1]:
            return float(np.interp(flux, fields, turns))
        # Outside, all plays follow.
        end = 0 if flux <= fields[0] else -1
        return float(turns[end] + (flux - fields[end]) / np.sum(weights))


class _Step(NamedTuple):
    stamp: int
    field: float
    level: float
    plays: Array


class Compensation:
    """
    State of a core after each of its levels, including pending ones; times in ns.

    The core is assumed demagnetised initially.
    """

    def __init__(self, core: IronCore) -> None:
        self._core = core
        self._steps = [_Step(-2**63, 0.0, 0.0, np.zeros(len(core.widths)))]

    def ask(self, stamp: int, field: float, *, off: bool = False) -> float:
        """Return the level in T for a field in T from a timestamp on; later levels are dropped."""
        keep = max(bisect_right(self._steps, stamp - 1, key=lambda x: x.stamp), 1)
        self._steps = self._steps[max(keep - _REMEMBERED, 0):keep]
        plays = self._steps[-1].plays
        level = 0.0 if off else self._core.needed(plays, field)
        self._steps.append(_Step(stamp, field, level, self._core.moved(plays, level)))
        return level

    def field_of(self, stamp: int, level: float, tolerance: float) -> float:
        """Return the requested field in T for a level that took effect by a timestamp."""
        until = max(bisect_right(self._steps, stamp + _ROUNDED, key=lambda x: x.stamp), 1)
        # A late level may take effect after the time of the next one.
        past = self._steps[:until]
        step = next((x for x in reversed(past) if abs(x.level - level) <= tolerance), past[-1])
        return step.field + level - step.level


def fit_core(level: Array, field: Array) -> tuple[IronCore, float]:
    """
    Fit a core to a staircase of levels.

    Parameters
    ----------
    level, field : ndarray, shape (n,)
        Levels in T in chronological order, such as up to a maximum, down to its negative and back,
        and the reading of the field in T at each; readings before the maximum are ignored.

    Returns
    -------
    (IronCore, float)
        The core, and the largest deviation of a reading from it, as a fraction of the range.

    Raises
    ------
    BadInputError
        If the levels do not have both signs, or the field does not increase with them.

    """
    from scipy.optimize import nnls  # not needed by a driver

    largest = float(np.max(np.abs(level))) if len(level) else 0.0
    first = int(np.argmax(level)) if len(level) else 0
    steps = len(np.unique(np.round(level[level > _SAME * largest] / (_SAME * largest)))) if (
        largest > 0.0) else 0
    if steps < 2 or not np.min(level[first:]) < 0.0 or len(level) - first <= 2 * steps:
        raise BadInputError(
            f'{len(level)} readings up to {largest:g} T: expected a loop from the largest current '
            'to its negative and back, for the hysteresis')
    widths = np.linspace(0.0, largest, _FINE * steps, endpoint=False)
    plays, rows = np.clip(0.0, level[first] - widths, level[first] + widths), []
    for x in level[first:]:
        plays = np.clip(plays, x - widths, x + widths)
        rows.append(plays)
    seen = field[first:] - np.mean(field[first:])
    table = np.array(rows) - np.mean(rows, axis=0)
    weights, _ = nnls(table, seen)
    if not weights[0] > 0.0:
        raise BadInputError(
            'the field does not rise with the current after a reversal: expected one that does; '
            'raise --settle or --steps')
    used = weights > _LEAST * weights[0]
    left = float(np.max(np.abs(table @ weights - seen))) / float(np.ptp(seen))
    return IronCore(tuple(widths[used].tolist()), tuple(weights[used].tolist())), left


@dataclass(frozen=True)
class CoilModel:
    """
    Flux density of a coil as a function of the current (or voltage) of its source, with limits.

    Either ``tesla_per_ampere``, with or without ``saturation``, or a ``file`` is required.

    Raises
    ------
    BadInputError
        If a value is out of range, or the file does not describe a coil.

    """

    #: coil constant at small currents, in T/A or T/V; negative if the leads are swapped
    tesla_per_ampere: float = math.nan
    #: flux density B_s in T of ``B_s tanh(tesla_per_ampere I / B_s)``
    saturation: float = math.inf
    file: str = ''  #: CSV with increasing columns current (A) and flux_density (T), through 0
    limit: float = math.inf  #: largest current in A
    rms: float = math.inf  #: largest effective current in A ...
    rms_time: float = 10.0  #: ... over this time in s, the thermal time constant of the coil
    #: iron core whose hysteresis is compensated, see `IronCore`; empty for none
    play_widths: Sequence[float] = ()
    play_weights: Sequence[float] = ()
    _table: tuple[Array, Array] | None = field(default=None, init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        for name in ('saturation', 'limit', 'rms', 'rms_time'):
            require(f'coil.{name}', getattr(self, name), positive=True)
        self.compensation()
        if self.file:
            object.__setattr__(self, '_table', _table_in(Path(self.file)))
        elif not is_number(self.tesla_per_ampere) or self.tesla_per_ampere == 0.0:
            raise BadInputError(
                f'coil.tesla_per_ampere is {excerpt(self.tesla_per_ampere)}: expected the flux '
                'density in T at 1 A (1 V) of the source, or coil.file')

    def compensation(self) -> Compensation | None:
        """Return a new compensation of the core's hysteresis, if configured."""
        if not (len(self.play_widths) or len(self.play_weights)):
            return None
        return Compensation(IronCore(self.play_widths, self.play_weights))

    def flux_density(self, current: float) -> float:
        """Return the flux density in T at a current in A, without hysteresis."""
        if self._table is not None:
            return float(np.interp(current, *self._table))
        linear = self.tesla_per_ampere * current
        return linear if self.saturation == math.inf else (
            self.saturation * math.tanh(linear / self.saturation))

    def current(self, level: float) -> float:
        """Return the current in A for a flux density in T, limited to the reachable range."""
        if self._table is not None:
            current, flux = self._table
            way = 1 if flux[-1] > flux[0] else -1
            return float(np.interp(level, flux[::way], current[::way]))
        if self.saturation != math.inf:
            level = self.saturation * math.atanh(
                max(-_SATURATED, min(level / self.saturation, _SATURATED)))
        return level / self.tesla_per_ampere

    def within(self, limit: float) -> tuple[float | None, float, float]:
        """Return the largest level in T within a current limit, and the range of T/A there."""
        most = min(limit, self.limit)
        if self._table is not None:
            most = min(most, -self._table[0][0], self._table[0][-1])
        if most == math.inf:
            largest = None if self.saturation == math.inf else _SATURATED * self.saturation
            return largest, abs(self.tesla_per_ampere), abs(self.tesla_per_ampere)
        currents = np.linspace(-most, most, 201)
        slopes = np.abs(np.diff([self.flux_density(x) for x in currents]) / np.diff(currents))
        return (min(abs(self.flux_density(most)), abs(self.flux_density(-most))),
                float(slopes.min()), float(slopes.max()))


def _table_in(path: Path) -> tuple[Array, Array]:
    current, flux = read_currents(path)
    if not (len(current) > 2 and np.all(np.diff(current) > 0.0)
            and np.all(np.diff(flux) * (flux[-1] - flux[0]) > 0.0)):
        raise BadInputError(
            f'{path}: expected at least three rows of current and flux_density, both numbers that '
            'rise from row to row (or a flux density that falls)')
    if not (current[0] < 0.0 < current[-1] and abs(np.interp(0.0, current, flux)) < 1e-12):
        raise BadInputError(
            f'{path}: expected negative and positive currents, with 0 T at 0 A (subtract the '
            'flux density without a current)')
    return current, flux


@dataclass(frozen=True)
class SensorScale:
    """
    Scale of a sensor: ``stretch = (gain reading + offset) / rest_length``.

    Raises
    ------
    BadInputError
        If a value is out of range.

    """

    gain: float = 1.0  #: length per unit of the reading; negative if the reading decreases
    offset: float = 0.0  #: length at reading 0
    rest_length: float = 1.0  #: length of the actuator without a field, in the same unit
    latency: float = 0.0  #: lateness in s of the timestamps of the readings

    def __post_init__(self) -> None:
        for x in fields(self):
            require(f'sensor.{x.name}', getattr(self, x.name), positive=x.name == 'rest_length')
        if self.gain == 0.0:
            raise BadInputError('sensor.gain is 0: expected another number')

    def stretch(self, reading: float) -> float:
        """Return the stretch for a reading."""
        return (self.gain * reading + self.offset) / self.rest_length

    @property
    def latency_ns(self) -> int:
        """The latency in ns."""
        return round(self.latency * NANOSECONDS)


def require(name: str, value: Any, *, positive: bool = False) -> None:
    """
    Check that a setting is a number, and above 0 if required.

    Raises
    ------
    BadInputError
        If it is not.

    """
    if not is_number(value, finite=not positive) or (positive and not value > 0.0):
        raise BadInputError(
            f'{name} is {excerpt(value)}: expected a number{" above 0" if positive else ""}')


def parts(settings: Mapping[str, Any]) -> tuple[CoilModel, SensorScale]:
    """
    Return the coil and the scale described by the settings ``coil.*`` and ``sensor.*``.

    Raises
    ------
    BadInputError
        If a setting does not exist, or a value is out of range.

    """
    kinds: dict[str, Any] = {'coil': CoilModel, 'sensor': SensorScale}
    known = {f'{part}.{x.name}' for part, kind in kinds.items() for x in fields(kind) if x.init}
    if unknown := settings.keys() - known:
        raise BadInputError(
            f'{min(unknown)} is no setting: expected {", ".join(sorted(known))}')
    coil, scale = (kind(**{
        x.partition('.')[2]: value for x, value in settings.items() if x.startswith(f'{part}.')})
        for part, kind in kinds.items())
    return coil, scale


class _Heat:
    """Mean square of a current in A over the thermal time constant of a coil."""

    def __init__(self, coil: CoilModel) -> None:
        self._coil = coil
        self._square = self._current = 0.0
        self._hot = False
        self._since = monotonic()

    def set(self, current: float) -> None:
        """Record the present current."""
        self._pass()
        self._current = current

    def _pass(self) -> None:
        now = monotonic()
        kept = math.exp((self._since - now) / self._coil.rms_time)
        self._square = self._current**2 + (self._square - self._current**2) * kept
        self._since = now

    def check(self, current: float | None = None) -> None:
        """
        Refuse a current in A, by default the present one, if the coil is too warm for it.

        Raises
        ------
        StateLostError
            If the coil is too warm.

        """
        self._pass()
        limit = self._coil.rms * (_COOL if self._hot else 1.0)
        self._hot = self._square > limit**2
        if self._hot and (self._current if current is None else current):
            wait = self._coil.rms_time * math.log(self._square / (_COOL * self._coil.rms)**2)
            raise StateLostError(
                f'the coil is too warm: {math.sqrt(self._square):.3g} A effective over '
                f'{self._coil.rms_time:g} s, expected at most coil.rms, {self._coil.rms:g} A; '
                f'wait {wait:.1f} s without a current')


class Assembly:
    """
    A source, a coil and a sensor as `Hardware`.

    Parameters
    ----------
    source : object
        Has the members of `Hardware` except ``read``, in A (V) instead of T.
    coil : CoilModel
        Conversion of the currents.
    scale : SensorScale
        Conversion of the readings.
    sensor : object, optional
        Has ``read``; by default the source, if it has that. Its times are on the source's clock.

    """

    def __init__(
            self, source: Any, coil: CoilModel, scale: SensorScale | None = None,
            sensor: Any = None) -> None:
        self.source, self.coil = source, coil
        self.scale = SensorScale() if scale is None else scale
        self.sensor = source if sensor is None else sensor
        self._heat, self._core = _Heat(coil), coil.compensation()
        most, least_slope, slope = coil.within(getattr(source, 'limit', None) or math.inf)
        self.limit = most
        self.resolution, self.slew = (
            None if x is None else x * y for x, y in (
                (getattr(source, 'resolution', None), slope),
                (getattr(source, 'slew', None), least_slope)))
        for name in _MEMBERS:
            if hasattr(source, name):
                setattr(self, name, getattr(source, name))
        if hasattr(source, 'schedule'):
            self.schedule: Callable[..., None] = self._schedule
        if hasattr(source, 'applied'):
            self.applied: Callable[..., Any] = self._applied

    def write(self, level: float, now: int) -> tuple[Any, Any]:
        """Set the coil to a level in T; return its time, and the actual level."""
        current = self._current(now, level, off=not level)
        self._heat.check(current)
        answer = self.source.write(current, now)
        when, really = answer if isinstance(answer, (tuple, list)) else (answer, current)
        self._heat.set(really)
        return when, self._level(now, really)

    def _current(self, stamp: int, level: float, *, off: bool = False) -> float:
        """Return the current in A for a level in T from a timestamp in ns on."""
        return self.coil.current(
            level if self._core is None else self._core.ask(stamp, level, off=off))

    def _level(self, stamp: int, current: float) -> float:
        """Return the requested level in T for a current in A that is set by a timestamp."""
        level = self.coil.flux_density(current)
        return level if self._core is None else self._core.field_of(
            stamp, level, 2.0 * (self.resolution or 1e-9 * abs(level)))

    def _schedule(self, levels: Sequence[tuple[int, float]]) -> None:
        currents = [(stamp, self._current(stamp, level)) for stamp, level in levels]
        most = max((abs(x) for _, x in currents), default=None)
        self._heat.check(most)
        self.source.schedule(currents)
        if most is not None and not hasattr(self, 'applied'):
            self._heat.set(most)

    def _applied(self) -> list[tuple[int, float]]:
        found = [*self.source.applied()]
        for _, current in found:
            self._heat.set(current)
        return [(stamp, self._level(stamp, current)) for stamp, current in found]

    def read(self, now: int) -> list[tuple[float, float, int]]:
        """Return stretch, rate in 1/s and timestamp in ns of each new reading."""
        self._heat.check()
        if not hasattr(self.sensor, 'read'):
            return []
        scale = self.scale
        return [
            (scale.stretch(x.stretch), scale.gain * x.rate / scale.rest_length,
             (now if x.stamp is None else x.stamp) - scale.latency_ns)
            for x in readings(self.sensor.read(now))]

    def close(self) -> None:
        """Close source and sensor."""
        for part in {id(x): x for x in (self.source, self.sensor)}.values():
            getattr(part, 'close', lambda: None)()
