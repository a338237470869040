"""Hardware classes of a laboratory: loading by name, checked calls, and their clocks."""

from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from functools import cache
from importlib import import_module
import inspect
from itertools import islice
import math
from numbers import Real
import os
import sys
from time import monotonic
from typing import Any, NamedTuple, Protocol, TypeVar

import numpy as np

from hmsa.ending import Deadline, encoded
from hmsa.errors import BadInputError, excerpt, HmsaError
from hmsa.model.units import NANOSECONDS
from hmsa.plugins import HARDWARE, registered
from hmsa_ros.device.watchdog import ANOTHER_CLOCK, StateLostError

# Number of answers stored, and number of initial queries.
_KEPT, ENOUGH = 64, 8
# Standard deviation of the rate of an unknown clock: 100 ppm.
_RATE_STD = 1e-4
# Answers that took longer than this multiple of the shortest are ignored; half durations below the
# second value, in ns, count alike, since a call after a pause takes the host that long.
_SLOW, _LEAST = 3.0, 20_000
# Number of successive answers inconsistent with the known clock until a new one is assumed.
_STRANGE = 3
T = TypeVar('T')

# Arguments of the methods; all methods except the first two are optional.
_TAKES: dict[str, tuple[str, ...]] = {
    'write': ('level', 'now'), 'read': ('now',), 'open': (), 'close': (),
    'schedule': ('levels',), 'applied': (), 'clock': (), 'arm': (), 'disarm': (),
    'temperature': ()}
OPTIONAL = tuple(_TAKES)[2:]
# Largest plausible difference in ns, beyond the longest call, between an event and now.
_ABSURD = 10 * NANOSECONDS
# Limit on the items of one answer that is an iterator, which may be endless.
_MOST_PIECES = 100_000
# Largest counted time in s between two checks of a call.
_UNSEEN = 0.1
# Grace time in s: a blocking call must release Python's global lock by then, or the process ends.
_GRACE = 1.5
# Fractions of the limit: rounding of hardware without a stated resolution, and the largest field
# of a coil that counts as off.
_ROUNDING, _OFF = 1e-6, 0.01


class _Comparison(NamedTuple):
    """Host and device times, and half the duration of a query, in ns since the first answer."""

    host: int
    device: int
    half: int


class ClockMap:
    """
    Conversion between times of a host and of a device whose clock differs in epoch and rate.

    The shorter a round trip, the more precise the comparison: the device answered at some time
    between both host times. Rate and offset are determined by regression, as in Klipper's
    ``clocksync``. A prior for the rate keeps the first seconds from following the noise of single
    answers.

    ``drift`` is the rate of the device's clock relative to the host's, minus 1.
    """

    def __init__(self) -> None:
        self._answers: deque[_Comparison] = deque(maxlen=_KEPT)
        self._origin = 0, 0
        self._strange = 0
        # Device time minus host time is offset + drift (host - centre), with times in ns.
        self._centre = self._offset = self.drift = 0.0
        self._offset_std = self._rate_std = math.inf

    def add(self, before: int, device: int, after: int) -> bool:
        """
        Add one comparison of the two clocks.

        Parameters
        ----------
        before, after : int
            Host times in ns before the query and after the answer.
        device : int
            Device time in the answer, in ns.

        Returns
        -------
        bool
            Whether it is still the same clock; False if it restarted, as after a reboot.

        """
        if not self._answers:
            self._origin = before, device
        host, clock = self._origin
        answer = _Comparison(
            (before + after) // 2 - host, device - clock, max((after - before) // 2, _LEAST))
        off = answer.device - answer.host - self._offset - self.drift * (
            answer.host - self._centre)
        if len(self._answers) >= ENOUGH and abs(off) > answer.half + self._error(answer.host):
            self._strange += 1
            return self._strange < _STRANGE
        self._strange = 0
        self._answers.append(answer)
        self._fit()
        return True

    def _error(self, host: float) -> float:
        """Return a bound of the error, two standard deviations, at a time since the origin."""
        return 2.0 * math.hypot(self._offset_std, self._rate_std * (host - self._centre))

    def _fit(self) -> None:
        """Fit rate and offset, with each answer weighted by its duration."""
        shortest = min(x.half for x in self._answers)
        used = np.array([x for x in self._answers if x.half <= _SLOW * shortest], dtype=float)
        host, device, half = used.T
        # The device time is uniformly distributed between the two host times.
        weights = 3.0 / half**2
        self._centre = float(np.average(host, weights=weights))
        # Delays of one line are correlated: averaging does not reduce their mean.
        self._offset_std = shortest / math.sqrt(3.0)
        since, apart = host - self._centre, device - host
        precision = float(weights @ since**2) + _RATE_STD**-2
        self.drift = float(weights @ (since * (apart - np.average(
            apart, weights=weights)))) / precision
        self._rate_std = precision**-0.5
        self._offset = float(np.average(apart, weights=weights))

    @property
    def error(self) -> float:
        """Bound of the error in s at the newest answer; infinite before the first one."""
        if not self._answers:
            return math.inf
        return self._error(self._answers[-1].host) / NANOSECONDS

    def host_set(self, by: int) -> None:
        """Shift host times by the ns that the host's clock was set ahead."""
        host, device = self._origin
        self._origin = host + by, device

    def to_device(self, host: int) -> int:
        """Return the device time in ns for a host time."""
        begin, clock = self._origin
        since = host - begin
        return clock + since + round(self._offset + self.drift * (since - self._centre))

    def to_host(self, device: int) -> int:
        """Return the host time in ns for a device time."""
        begin, clock = self._origin
        since = device - clock
        apart = (self._offset + self.drift * (since - self._centre)) / (1.0 + self.drift)
        return begin + since - round(apart)


class Hardware(Protocol):
    """A coil's amplifier and the sensor of its actuator; all calls must be short."""

    # Optional members are `limit` (T), `resolution` (T), `slew` (T/s), `description` for the log
    # at startup, `open()`, which reconnects, and `close()`. All calls, including that of the
    # class, come from one thread, unless a call blocks.
    #
    # Hardware that applies levels at their times has `schedule(levels)`. It accepts a list
    # [(stamp, level), ...] of future levels, at most `capacity` at a time, which replaces all
    # stored levels at or after the first timestamp; an empty list is a heartbeat. `write` drops
    # stored levels. With `applied()`, it returns the [(stamp, level), ...] that have taken effect
    # since the last call.
    #
    # `arm()` is called before the first level other than 0 T, and `disarm()` once the coil is off
    # at the end, on deactivation, and while an interlock is open.
    #
    # `temperature()` returns the coil temperature in degrees Celsius, NaN if unknown.
    #
    # With `clock()`, which returns its time in ns, all times passed and returned are on its clock.

    def write(self, level: float, now: int) -> int | tuple[int, float] | None:
        """
        Set the coil to a level in T at a time in ns.

        Return the time of effect, that time and the actual level, or None for ``now``.
        """

    def read(self, now: int) -> Any:
        """Return stretch, rate in 1/s and timestamp in ns, or a list of those; see `Reading`."""


class Reading(NamedTuple):
    """A reading of a sensor; NaN: not measured, timestamp None: time of the call."""

    stretch: float
    rate: float = math.nan
    stamp: int | None = None  #: in ns


class HardwareError(HmsaError):
    """Hardware that raised an error, or returned an invalid answer."""


def described(error: BaseException) -> str:
    """Return a description of an exception for a message."""
    name = type(error).__name__
    try:
        text = str(error)
    except BaseException as another:  # the text of an exception may fail too
        text = f'no text, since {type(another).__name__} was raised meanwhile'
    # Messages of this package are short enough.
    shown = text if isinstance(error, HmsaError) else excerpt(text)
    return f'{name}: {shown}' if text else name


def imported(text: str) -> Any:
    """Return the object named ``'MODULE:NAME'``; the module may be in the working directory."""
    if os.getcwd() not in sys.path:
        # For the script of a command, sys.path contains the folder of the script instead.
        sys.path.append(os.getcwd())
    module, _, name = text.partition(':')
    return getattr(import_module(module), name)


def load(text: str, joint: str, settings: Mapping[str, Any]) -> Hardware:
    """
    Create the hardware of a joint by its name, ``'MODULE:NAME'`` or registered.

    The settings are its keyword arguments.

    Raises
    ------
    BadInputError
        If it does not exist, or fails.

    """
    shipped = {} if ':' in text else registered(HARDWARE)
    path = shipped[text].value if text in shipped else text
    if not all(path.partition(':')[::2]):
        raise BadInputError(
            f'hardware is {text!r}: expected MODULE:NAME of what makes the hardware of a joint, '
            f'as in hardware:=my_lab:Coil, or {", ".join(registered(HARDWARE))}')
    try:
        make = imported(path)
    except BaseException as error:  # any error of the module, including sys.exit
        raise BadInputError(
            f'hardware {text!r} cannot be loaded ({described(error)}): expected a module that '
            'Python finds, or in the working directory, with that name in it') from error
    try:
        found: Hardware = make(joint, **settings)
    except HmsaError as error:
        raise BadInputError(
            f'hardware {text!r} of joint {joint} does not start: {error}') from error
    except BaseException as error:
        takes = ' and the settings ' + ', '.join(
            f'hardware.{x}' for x in settings) if settings else ''
        raise BadInputError(
            f'hardware {text!r} of joint {joint} does not start ({described(error)}): expected it '
            f'to take the name of a joint{takes}') from error
    if not all(callable(getattr(found, x, None)) for x in ('write', 'read')):
        raise BadInputError(
            f'hardware {text!r} made a {type(found).__name__}: expected something with the '
            'methods write and read')
    return found


@cache
def _last_words(name: str, seconds: float) -> bytes:
    return encoded(
        f'{name} lets nothing else run for {seconds:g} s: the driver ends, and whether the coil '
        'is off is not known; release the GIL in what it calls')


class Calls:
    """
    Call hardware, one call at a time, with limits; ``longest`` contains the longest times in s.

    Parameters
    ----------
    limit : float
        Time limit of a call in s.
    deadline : Deadline, optional
        Ends the process if a call blocks Python for that time and a grace time.

    """

    def __init__(self, limit: float, deadline: Deadline | None = None) -> None:
        self.limit = limit
        self.longest: dict[str, float] = {}
        self._deadline = deadline
        self._armed = False
        # Name of the call under way, in a new tuple for each call.
        self._begun: tuple[str] | None = None
        # The call under way at the last check by `overdue`, the time of that check, and the
        # counted duration of the call.
        self._seen: tuple[str] | None = None
        self._looked = self._waited = 0.0

    def make_ready(self) -> None:
        """Arm the deadline before a call, since that takes some microseconds."""
        if self._deadline is not None and not self._armed:
            self._deadline.set(self.limit + _GRACE)
            self._armed = True

    def __call__(self, name: str, act: Callable[[], Any]) -> Any:
        """Call a method of hardware; ``name`` is its name in messages."""
        self.make_ready()
        if self._deadline is not None:
            self._deadline.set_text(_last_words(name, self.limit + _GRACE))
        begun = monotonic()
        self._begun = (name,)
        try:
            return act()
        finally:
            self._begun = None
            self.relax()
            self.longest[name] = max(self.longest.get(name, 0.0), monotonic() - begun)

    def relax(self) -> None:
        """Disarm the deadline while no call is under way."""
        if self._deadline is not None and self._armed:
            self._deadline.set(0.0)
            self._armed = False

    def give_up(self, seconds: float) -> None:
        """End the process after some seconds, unless the blocked call returns."""
        if self._deadline is not None:
            self._deadline.set_text(encoded('the driver hangs while it ends'))
            self._deadline.set(seconds)

    @property
    def current(self) -> str:
        """Name of the call under way; empty if there is none."""
        begun = self._begun
        return '' if begun is None else begun[0]

    def overdue(self) -> str:
        """
        Return the name of a call that exceeds its limit; empty if there is none.

        It must be called often: time between two checks is only counted in part, since the process
        may have been stopped.
        """
        begun, now = self._begun, monotonic()
        passed, self._looked = min(now - self._looked, _UNSEEN), now
        self._waited = self._waited + passed if begun is self._seen else 0.0
        self._seen = begun
        return begun[0] if begun is not None and self._waited > self.limit else ''


class Instrument:
    """
    The hardware of a joint, with checked return values, and ``name`` for messages.

    Its calls raise `HardwareError` if they fail or return an invalid answer, and `StateLostError`
    if the hardware raises it.

    Raises
    ------
    BadInputError
        If the hardware does not conform to `Hardware`.

    """

    def __init__(self, hardware: Hardware, joint: str, calls: Calls) -> None:
        self.hardware, self._calls = hardware, calls
        self.name = type(hardware).__name__
        self._names = {x: f'{self.name}.{x} of joint {joint}' for x in _TAKES}
        self._methods = {x for x in _TAKES if callable(getattr(hardware, x, None))}
        for method, arguments in _TAKES.items():
            try:
                inspect.signature(getattr(hardware, method, lambda *_: 0)).bind(*arguments)
            except ValueError:  # not a Python function
                pass
            except TypeError as error:
                raise BadInputError(
                    f'{self.name}.{method} does not take what it is given ({error}): expected '
                    f'{method}({", ".join(arguments)})') from error
        self.limit, self.resolution, self.slew, capacity = (
            self._number(x) for x in ('limit', 'resolution', 'slew', 'capacity'))
        #: Number of levels that it can store; None for unlimited.
        self.capacity = None if capacity is None else int(capacity)
        #: Whether it stores future levels.
        self.keeps_levels = self.has('schedule')
        #: Description given by the hardware.
        self.description = str(getattr(hardware, 'description', '') or '')
        #: Mapping from the host's clock to the device's; None if both share one clock.
        self.clock_map = ClockMap() if self.has('clock') else None
        # Device times of scheduled host timestamps, by the mapping at the time of scheduling.
        self._handed: dict[int, int] = {}

    def _number(self, name: str) -> float | None:
        try:
            value = getattr(self.hardware, name, None)
        except BaseException as error:  # error of a property
            raise BadInputError(f'{self.name}.{name} raised {described(error)}') from error
        if value is not None and not (is_number(value) and value > 0.0):
            raise BadInputError(
                f'{self.name}.{name} is {excerpt(value)}: expected a number above 0, or None')
        return None if value is None else float(value)

    def has(self, method: str) -> bool:
        """Return whether the hardware has a method."""
        return method in self._methods

    def tolerance(self, limit: float) -> float:
        """Return the tolerated difference in T between requested and actual levels."""
        return max(self.resolution or 0.0, _ROUNDING * limit)

    def off(self, level: float, limit: float) -> bool:
        """Return whether a coil with a level in T counts as off."""
        return abs(level) <= max(self.resolution or 0.0, _OFF * limit)

    # -- calls ---------------------------------------------------------------------------------

    def _call(self, method: str, *arguments: object) -> Any:
        """Call a method, and return its answer; do nothing if an optional method is missing."""
        if not self.has(method):
            return None
        name = self._names[method]

        def act() -> Any:
            answer = getattr(self.hardware, method)(*arguments)
            # An iterator is consumed within the call, including its time limit and errors.
            return answer if not isinstance(answer, Iterator) else [
                *islice(answer, _MOST_PIECES + 1)]

        try:
            return self._calls(name, act)
        except StateLostError:
            raise
        except BaseException as error:  # any error of the laboratory's code, including sys.exit
            raise HardwareError(f'{name} raised {described(error)}') from error

    def _ask(
            self, method: str, *arguments: object, take: Callable[[Any], T], expected: str,
            now: int = 0) -> T:
        """Return an answer converted by `take`; its TypeError or ValueError means invalid."""
        answer = self._call(method, *arguments)
        try:
            return take(answer)
        except (TypeError, ValueError) as error:
            raise HardwareError(
                f'{self._names[method]} returned {excerpt(answer)}: expected '
                + expected.format(now=now)) from error

    def write(self, level: float, now: int) -> tuple[int, float]:
        """Set a level in T at a time in ns; return its time of effect, and the actual level."""
        return self._ask(
            'write', level, self._theirs(now), take=lambda x: self._written(x, level, now),
            expected='when the level took effect in ns, near now, {now}, that and the level '
            'really set in T, or None', now=now)

    def _theirs(self, time: int) -> int:
        """Return a host time in ns on the hardware's clock."""
        return time if self.clock_map is None else self.clock_map.to_device(time)

    def _ours(self, time: Any) -> int:
        """Return a hardware time in ns on the host's clock."""
        whole = int(_number(time))
        return whole if self.clock_map is None else self.clock_map.to_host(whole)

    def _happened(self, time: Any, now: int) -> int:
        """Return the host time in ns of an event; raise ValueError if implausible."""
        found = self._ours(time)
        if abs(found - now) > _ABSURD + self._calls.limit * NANOSECONDS:
            raise ValueError
        return found

    def _written(self, answer: Any, level: float, now: int) -> tuple[int, float]:
        pair = isinstance(answer, (tuple, list)) and len(answer) == 2
        when, really = answer if pair else (answer, level)
        return now if when is None else self._happened(when, now), float(_number(really))

    def read(self, now: int) -> list[Reading]:
        """Return the new readings at a time in ns."""
        return self._ask(
            'read', self._theirs(now), take=lambda x: [self._stamped(y, now) for y in readings(x)],
            expected='stretch, (stretch, rate), (stretch, rate, timestamp in ns, near now, {now}) '
            f'or a list of the latter, at most {_MOST_PIECES} and [] if there is none, with NaN '
            'for what is not measured', now=now)

    def _stamped(self, found: Reading, now: int) -> Reading:
        if found.stamp is None:
            return found
        stamp = self._ours(found.stamp)
        if abs(stamp - now) > ANOTHER_CLOCK:
            raise ValueError
        return found._replace(stamp=stamp)

    def schedule(self, levels: Sequence[tuple[int, float]]) -> None:
        """Schedule levels in T from timestamps in ns on, replacing all from the first one on."""
        begin = levels[0][0] if levels else math.inf
        known, self._handed = self._handed, {
            x: y for x, y in self._handed.items() if begin - _ABSURD < x < begin or not levels}
        for stamp, _ in levels:
            # A replaced level keeps its device time, even if the clock mapping has improved.
            self._handed[stamp] = known.get(stamp) or self._theirs(stamp)
        self._call('schedule', [(self._handed[x], y) for x, y in levels])

    def applied(self, now: int) -> list[tuple[int, float]]:
        """Return timestamps in ns and levels in T that have taken effect since the last call."""
        return self._ask(
            'applied',
            take=lambda answer: [(self._happened(x, now), float(_number(y))) for x, y in answer],
            expected='a list of (timestamp in ns, level in T)')

    def synchronise(self, clock: Callable[[], int]) -> None:
        """Compare clocks again, if the hardware has one; ``clock`` returns the host time in ns."""
        self._handed.clear()
        if self.clock_map is not None:
            self.clock_map = ClockMap()
            for _ in range(ENOUGH):
                self.ask_clock(clock)

    def ask_clock(self, clock: Callable[[], int]) -> bool:
        """Compare the clocks once; return whether the hardware's clock is still the same."""
        if self.clock_map is None:
            return True
        before = clock()
        answer = self._ask(
            'clock', take=lambda x: int(_number(x)), expected='its time in ns')
        return self.clock_map.add(before, answer, clock())

    def temperature(self) -> float:
        """Return the coil temperature in degrees Celsius; NaN if unknown."""
        return math.nan if not self.has('temperature') else self._ask(
            'temperature', take=lambda x: float(_number(x, finite=False)),
            expected='degrees Celsius, NaN if they are not known')

    def arm(self) -> None:
        """Prepare the hardware for levels, if it supports that."""
        self._call('arm')

    def disarm(self) -> None:
        """Undo `arm`, if supported."""
        with suppress(StateLostError):
            self._call('disarm')

    def open(self) -> None:
        """Reconnect, if supported; errors are ignored, since the next `write` shows them."""
        with suppress(HardwareError, StateLostError):
            self._call('open')

    def close(self) -> None:
        """Close the hardware, if supported."""
        with suppress(StateLostError):
            self._call('close')

    def cut(self, now: int) -> bool:
        """Write 0 at a time in ns, bypassing a blocked call; return whether that succeeded."""
        try:
            self._written(self.hardware.write(0.0, self._theirs(now)), 0.0, now)
        except BaseException:
            return False
        finally:
            with suppress(BaseException):
                getattr(self.hardware, 'disarm', lambda: None)()
        return True

    def drop(self) -> None:
        """Close the hardware, bypassing a blocked call."""
        with suppress(BaseException):
            getattr(self.hardware, 'close', lambda: None)()


def readings(answer: Any) -> list[Reading]:
    """
    Return the readings in an answer of ``read``.

    Raises
    ------
    TypeError, ValueError
        If it contains none.

    """
    if isinstance(answer, (str, bytes)):
        raise TypeError('read returned text')
    values = (answer,) if is_number(answer, finite=False) else (*answer,)
    if len(values) > _MOST_PIECES:
        raise ValueError(f'read returned more than {_MOST_PIECES} readings')
    if any(is_number(x, finite=False) for x in values):
        return [_reading(*values)]
    return [_reading(*x) for x in values]


def _reading(stretch: Any, rate: Any = None, stamp: Any = None) -> Reading:
    return Reading(
        float(_number(stretch, finite=False)),
        math.nan if rate is None else float(_number(rate, finite=False)),
        None if stamp is None else int(_number(stamp)))


def _number(value: Any, *, finite: bool = True) -> Any:
    """Return a real number; raise TypeError for any other value."""
    if not is_number(value, finite=finite):
        raise TypeError
    return value


def is_number(value: Any, *, finite: bool = True) -> bool:
    """Return whether a value is a real number, and finite if required."""
    if type(value) is bool or not isinstance(value, Real):
        return False
    try:
        return math.isfinite(value) or not finite
    except OverflowError:  # an integer beyond the range of floats
        return False
