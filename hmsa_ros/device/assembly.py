"""
Hardware out of three parts: a source of current or voltage, a coil, and a sensor.

A source has the members of `Hardware` in amperes (or volts) in place of tesla, and a sensor those
of ``read``, in any unit of length or signal. The assembly converts; all else is passed through.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields
import math
from pathlib import Path
from time import monotonic
from typing import Any

import numpy as np

from hmsa_ros.columns import read_table
from hmsa_ros.device.hardware import is_number, readings
from hmsa_ros.device.iron_core import Compensation, IronCore
from hmsa_ros.device.protocol import StateLostError
from hmsa_ros.errors import BadInputError, excerpt
from hmsa_ros.model.equations import Array
from hmsa_ros.model.units import NANOSECONDS

# A coil that was too warm must cool to this share of its limit before it is used again.
_COOL = 0.9
# The share of its saturation that a coil can reach.
_SATURATED = 0.99
_MEMBERS = ('open', 'clock', 'capacity', 'description', 'arm', 'disarm', 'temperature')


@dataclass(frozen=True)
class CoilModel:
    """
    Flux density of a coil over the current (or the voltage) of its source, and its limits.

    Either ``tesla_per_ampere``, with a ``saturation`` or without, or a ``file``.

    Raises
    ------
    BadInputError
        If a value is out of range, or the file does not describe a coil.

    """

    #: at small currents, in T/A or T/V; negative where the leads are swapped
    tesla_per_ampere: float = math.nan
    #: flux density B_s in T of ``B_s tanh(tesla_per_ampere I / B_s)``
    saturation: float = math.inf
    file: str = ''  #: CSV with the columns current (A) and flux_density (T), rising, through 0
    limit: float = math.inf  #: largest current in A
    rms: float = math.inf  #: largest effective current in A ...
    rms_time: float = 10.0  #: ... over this time in s, the thermal time constant of the coil
    #: of an iron core whose hysteresis is compensated: see `IronCore`; empty for none
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
        """Return what undoes the hysteresis of the core, if it is to be."""
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
        """Return the current in A for a flux density in T, or the largest one there is."""
        if self._table is not None:
            current, flux = self._table
            way = 1 if flux[-1] > flux[0] else -1
            return float(np.interp(level, flux[::way], current[::way]))
        if self.saturation != math.inf:
            level = self.saturation * math.atanh(
                max(-_SATURATED, min(level / self.saturation, _SATURATED)))
        return level / self.tesla_per_ampere

    def within(self, limit: float) -> tuple[float | None, float, float]:
        """Return the largest level in T within a current, and the least and largest T/A there."""
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
    found = read_table(path, ('current', 'flux_density')).columns
    current, flux = found['current'], found['flux_density']
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
    What a sensor's reading means: ``stretch = (gain reading + offset) / rest_length``.

    Raises
    ------
    BadInputError
        If a value is out of range.

    """

    gain: float = 1.0  #: length per unit of the reading; negative where the reading falls
    offset: float = 0.0  #: length at reading 0
    rest_length: float = 1.0  #: of the actuator without a field, in the unit of the above
    latency: float = 0.0  #: time in s by which the timestamps of the readings are too late

    def __post_init__(self) -> None:
        for x in fields(self):
            require(f'sensor.{x.name}', getattr(self, x.name), positive=x.name == 'rest_length')
        if self.gain == 0.0:
            raise BadInputError('sensor.gain is 0: expected another number')

    def stretch(self, reading: float) -> float:
        """Return the stretch at a reading."""
        return (self.gain * reading + self.offset) / self.rest_length

    @property
    def latency_ns(self) -> int:
        """The latency in ns."""
        return round(self.latency * NANOSECONDS)


def require(name: str, value: Any, *, positive: bool = False) -> None:
    """
    Refuse a setting that is no number, or not above 0.

    Raises
    ------
    BadInputError
        If it is refused.

    """
    if not is_number(value, finite=not positive) or (positive and not value > 0.0):
        raise BadInputError(
            f'{name} is {excerpt(value)}: expected a number{" above 0" if positive else ""}')


def parts(settings: Mapping[str, Any]) -> tuple[CoilModel, SensorScale]:
    """
    Return what the settings ``coil.*`` and ``sensor.*`` describe.

    Raises
    ------
    BadInputError
        If there is no such setting, or a value is out of range.

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
        """Take in that a current flows from now on."""
        self._pass()
        self._current = current

    def _pass(self) -> None:
        now = monotonic()
        kept = math.exp((self._since - now) / self._coil.rms_time)
        self._square = self._current**2 + (self._square - self._current**2) * kept
        self._since = now

    def check(self, current: float | None = None) -> None:
        """
        Refuse a current in A, or the present one, where the coil is too warm for it.

        Raises
        ------
        StateLostError
            If it is.

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
        Has the members of `Hardware` but ``read``, in A (V) in place of T.
    coil : CoilModel
        What the currents mean.
    scale : SensorScale
        What the readings mean.
    sensor : object, optional
        Has ``read``; by default the source, if it has that. Its times are of the source's clock.

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
        """Set the coil to a level in T; return when, and the level really set."""
        current = self._current(now, level, off=not level)
        self._heat.check(current)
        answer = self.source.write(current, now)
        when, really = answer if isinstance(answer, (tuple, list)) else (answer, current)
        self._heat.set(really)
        return when, self._level(now, really)

    def _current(self, stamp: int, level: float, *, off: bool = False) -> float:
        """Return the current in A for a level in T from a stamp in ns on."""
        return self.coil.current(
            level if self._core is None else self._core.ask(stamp, level, off=off))

    def _level(self, stamp: int, current: float) -> float:
        """Return the level in T that was asked for where a current in A is set by a stamp."""
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
        """End with both parts."""
        for part in {id(x): x for x in (self.source, self.sensor)}.values():
            getattr(part, 'close', lambda: None)()
