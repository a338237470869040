"""Hardware as a laboratory writes it: found by its name, and called with care."""

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

from hmsa_ros.device.clock_map import ClockMap, ENOUGH
from hmsa_ros.device.protocol import StateLostError
from hmsa_ros.device.watchdog import ANOTHER_CLOCK
from hmsa_ros.ending import Deadline, encoded
from hmsa_ros.errors import BadInputError, excerpt, HmsaError
from hmsa_ros.model.units import NANOSECONDS

T = TypeVar('T')

#: Hardware of this package, by the short names that `load` takes, too.
SHIPPED = {
    'serial_board': 'hmsa_ros.device.serial_board:SerialBoard',
    'scpi_supply': 'hmsa_ros.device.scpi_supply:ScpiSupply',
    'topic': 'hmsa_ros.nodes.topic_coil:TopicCoil'}
# What its methods take; all but the first two are optional.
_TAKES: dict[str, tuple[str, ...]] = {
    'write': ('level', 'now'), 'read': ('now',), 'open': (), 'close': (),
    'schedule': ('levels',), 'applied': (), 'clock': (), 'arm': (), 'disarm': (),
    'temperature': ()}
OPTIONAL = tuple(_TAKES)[2:]
# In ns from now, besides the longest call: what cannot be the time of anything that has happened.
_ABSURD = 10 * NANOSECONDS
# Of one call that yields its answer piece by piece, which may never end.
_MOST_PIECES = 100_000
# In s, the most that counts of the time between two looks at a call.
_UNSEEN = 0.1
# A call that blocks lets Python run, or the process ends so many s after its time.
_GRACE = 1.5
# Of the limit: less than this is rounding where the hardware names no resolution, and no field
# that a coil is left on with.
_ROUNDING, _OFF = 1e-6, 0.01


class Hardware(Protocol):
    """A coil's amplifier, and the sensor of its actuator; all calls must be quick."""

    # It may have `limit` (T), `resolution` (T), `slew` (T/s), `description`, for the log at the
    # start, `open()`, which connects again, and `close()` too. All calls come from one thread,
    # also that of the class, unless one blocks.
    #
    # What keeps time itself has `schedule(levels)`, which takes [(stamp, level), ...] ahead and
    # replaces all that it has at or after the first stamp (an empty list is a sign of life), at
    # most `capacity` of them at a time; `write` drops what is ahead. With `applied()`, it returns
    # [(stamp, level), ...] that have taken effect since it was last called.
    #
    # `arm()` comes before the first level but 0 T, and `disarm()` once the coil is off at the end,
    # on deactivation, and while an interlock is open.
    #
    # `temperature()` returns that of the coil in degrees Celsius, NaN if it is not known.
    #
    # With `clock()`, its own time in ns, all times that it takes and returns are of that clock.

    def write(self, level: float, now: int) -> int | tuple[int, float] | None:
        """
        Set the coil to a level in T at a time in ns.

        Return when that took effect, that and the level really set, or None for ``now``.
        """

    def read(self, now: int) -> Any:
        """Return stretch, rate in 1/s and stamp in ns, or a list of those; see `Reading`."""


class Reading(NamedTuple):
    """What a sensor saw; NaN is not measured, and None is the time of the call."""

    stretch: float
    rate: float = math.nan
    stamp: int | None = None  #: in ns


class HardwareError(HmsaError):
    """Hardware that raised an error, or answered what cannot be used."""


def told(error: BaseException) -> str:
    """Return an exception for a sentence."""
    name = type(error).__name__
    try:
        text = str(error)
    except BaseException as another:  # of an exception that cannot be written either
        text = f'no text, since {type(another).__name__} was raised meanwhile'
    # The sentences of this package are short enough.
    shown = text if isinstance(error, HmsaError) else excerpt(text)
    return f'{name}: {shown}' if text else name


def imported(text: str) -> Any:
    """Return what ``'MODULE:NAME'`` names; the module may be in the working directory."""
    if os.getcwd() not in sys.path:
        # The script of a command has its own folder there instead.
        sys.path.append(os.getcwd())
    module, _, name = text.partition(':')
    return getattr(import_module(module), name)


def load(text: str, joint: str, settings: Mapping[str, Any]) -> Hardware:
    """
    Return the hardware of a joint by its name, ``'MODULE:NAME'`` or one of `SHIPPED`.

    Settings are its keyword arguments.

    Raises
    ------
    BadInputError
        If there is no such thing, or it fails.

    """
    path = SHIPPED.get(text, text)
    if not all(path.partition(':')[::2]):
        raise BadInputError(
            f'hardware is {text!r}: expected MODULE:NAME of what makes the hardware of a joint, '
            f'as in hardware:=my_lab:Coil, or {", ".join(SHIPPED)}')
    try:
        make = imported(path)
    except BaseException as error:  # whatever a laboratory's module raises, sys.exit too
        raise BadInputError(
            f'hardware {text!r} cannot be loaded ({told(error)}): expected a module that Python '
            'finds, or in the working directory, with that name in it') from error
    try:
        found: Hardware = make(joint, **settings)
    except HmsaError as error:
        raise BadInputError(
            f'hardware {text!r} of joint {joint} does not start: {error}') from error
    except BaseException as error:
        takes = ' and the settings ' + ', '.join(
            f'hardware.{x}' for x in settings) if settings else ''
        raise BadInputError(
            f'hardware {text!r} of joint {joint} does not start ({told(error)}): expected it to '
            f'take the name of a joint{takes}') from error
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
    What is called, one at a time, and for how long; ``longest`` has the longest time in s.

    Parameters
    ----------
    limit : float
        Time in s that a call may take.
    deadline : Deadline, optional
        Ends the process if a call lets no Python run for that time and some more.

    """

    def __init__(self, limit: float, deadline: Deadline | None = None) -> None:
        self.limit = limit
        self.longest: dict[str, float] = {}
        self._deadline = deadline
        self._armed = False
        # Name of the call under way, in a tuple of its own for each.
        self._begun: tuple[str] | None = None
        # The call that was under way when `overdue` was last asked, when that was, and for how
        # long it has been since.
        self._seen: tuple[str] | None = None
        self._looked = self._waited = 0.0

    def make_ready(self) -> None:
        """Do what takes some microseconds before a call."""
        if self._deadline is not None and not self._armed:
            self._deadline.set(self.limit + _GRACE)
            self._armed = True

    def __call__(self, name: str, act: Callable[[], Any]) -> Any:
        """Call a method of hardware; ``name`` is its name for a sentence."""
        self.make_ready()
        if self._deadline is not None:
            self._deadline.say(_last_words(name, self.limit + _GRACE))
        begun = monotonic()
        self._begun = (name,)
        try:
            return act()
        finally:
            self._begun = None
            self.relax()
            self.longest[name] = max(self.longest.get(name, 0.0), monotonic() - begun)

    def relax(self) -> None:
        """Take back `make_ready`: no call is under way."""
        if self._deadline is not None and self._armed:
            self._deadline.set(0.0)
            self._armed = False

    def give_up(self, seconds: float) -> None:
        """End the process after some seconds, unless the call returns that hangs."""
        if self._deadline is not None:
            self._deadline.say(encoded('the driver hangs while it ends'))
            self._deadline.set(seconds)

    @property
    def current(self) -> str:
        """Name of the call that is under way; empty if none is."""
        begun = self._begun
        return '' if begun is None else begun[0]

    def overdue(self) -> str:
        """
        Return the name of the call that takes too long; empty if none does.

        To be asked often: time in which nobody asks counts little, as that of a stopped process.
        """
        begun, now = self._begun, monotonic()
        passed, self._looked = min(now - self._looked, _UNSEEN), now
        self._waited = self._waited + passed if begun is self._seen else 0.0
        self._seen = begun
        return begun[0] if begun is not None and self._waited > self.limit else ''


class Instrument:
    """
    The hardware of a joint, with what it returns checked, and ``name`` for sentences.

    Its calls raise `HardwareError` where they fail, or answer what cannot be used, and
    `StateLostError` where the hardware says so.

    Raises
    ------
    BadInputError
        If it is not as `Hardware` says.

    """

    def __init__(self, hardware: Hardware, joint: str, calls: Calls) -> None:
        self.hardware, self._calls = hardware, calls
        self.name = type(hardware).__name__
        self._names = {x: f'{self.name}.{x} of joint {joint}' for x in _TAKES}
        self._methods = {x for x in _TAKES if callable(getattr(hardware, x, None))}
        for method, arguments in _TAKES.items():
            try:
                inspect.signature(getattr(hardware, method, lambda *_: 0)).bind(*arguments)
            except ValueError:  # of something that is no Python
                pass
            except TypeError as error:
                raise BadInputError(
                    f'{self.name}.{method} does not take what it is given ({error}): expected '
                    f'{method}({", ".join(arguments)})') from error
        self.limit, self.resolution, self.slew, capacity = (
            self._number(x) for x in ('limit', 'resolution', 'slew', 'capacity'))
        #: How many levels it takes ahead; None for any number.
        self.capacity = None if capacity is None else int(capacity)
        #: Whether it takes levels ahead.
        self.keeps_levels = self.has('schedule')
        #: What was found, in its words.
        self.description = str(getattr(hardware, 'description', '') or '')
        #: The device's clock against that of this host; None where there is one clock.
        self.clock_map = ClockMap() if self.has('clock') else None
        # Stamps of ours, in the device's clock as it was known when they were handed over.
        self._handed: dict[int, int] = {}

    def _number(self, name: str) -> float | None:
        try:
            value = getattr(self.hardware, name, None)
        except BaseException as error:  # of a property
            raise BadInputError(f'{self.name}.{name} raised {told(error)}') from error
        if value is not None and not (is_number(value) and value > 0.0):
            raise BadInputError(
                f'{self.name}.{name} is {excerpt(value)}: expected a number above 0, or None')
        return None if value is None else float(value)

    def has(self, method: str) -> bool:
        """Return whether it has a method."""
        return method in self._methods

    def tolerance(self, limit: float) -> float:
        """Return which difference in T between levels asked and set is none."""
        return max(self.resolution or 0.0, _ROUNDING * limit)

    def off(self, level: float, limit: float) -> bool:
        """Return whether a coil with a level in T is off."""
        return abs(level) <= max(self.resolution or 0.0, _OFF * limit)

    # -- calls ---------------------------------------------------------------------------------

    def _call(self, method: str, *arguments: object) -> Any:
        """Call a method, and return its answer; do nothing without one that is optional."""
        if not self.has(method):
            return None
        name = self._names[method]

        def act() -> Any:
            answer = getattr(self.hardware, method)(*arguments)
            # What is yielded is waited for and fails as the call itself does.
            return answer if not isinstance(answer, Iterator) else [
                *islice(answer, _MOST_PIECES + 1)]

        try:
            return self._calls(name, act)
        except StateLostError:
            raise
        except BaseException as error:  # whatever a laboratory's code raises, sys.exit too
            raise HardwareError(f'{name} raised {told(error)}') from error

    def _ask(
            self, method: str, *arguments: object, take: Callable[[Any], T],
            wrong: Callable[[str], HardwareError]) -> T:
        """Return what `take` makes of an answer; it raises TypeError or ValueError for none."""
        answer = self._call(method, *arguments)
        try:
            return take(answer)
        except (TypeError, ValueError) as error:
            raise wrong(f'{self._names[method]} returned {excerpt(answer)}') from error

    def write(self, level: float, now: int) -> tuple[int, float]:
        """Set a level in T at a time in ns; return when it took effect, and the one really set."""
        return self._ask(
            'write', level, self._theirs(now), take=lambda x: self._written(x, level, now),
            wrong=lambda what: HardwareError(
                f'{what}: expected when the level took effect in ns, near now, {now}, that and '
                'the level really set in T, or None'))

    def _theirs(self, time: int) -> int:
        """Return a time in ns as the hardware counts it."""
        return time if self.clock_map is None else self.clock_map.to_device(time)

    def _ours(self, time: Any) -> int:
        """Return a time in ns of the hardware as one of this host."""
        whole = int(_number(time))
        return whole if self.clock_map is None else self.clock_map.to_host(whole)

    def _happened(self, time: Any, now: int) -> int:
        """Return when a level took effect, as a time in ns of this host."""
        found = self._ours(time)
        if abs(found - now) > _ABSURD + self._calls.limit * NANOSECONDS:
            raise ValueError
        return found

    def _written(self, answer: Any, level: float, now: int) -> tuple[int, float]:
        pair = isinstance(answer, (tuple, list)) and len(answer) == 2
        when, really = answer if pair else (answer, level)
        return now if when is None else self._happened(when, now), float(_number(really))

    def read(self, now: int) -> list[Reading]:
        """Return what is new at a time in ns."""
        return self._ask(
            'read', self._theirs(now), take=lambda x: [self._stamped(y, now) for y in readings(x)],
            wrong=lambda what: HardwareError(
                f'{what}: expected stretch, (stretch, rate), (stretch, rate, timestamp in ns, '
                f'near now, {now}) or a list of the latter, at most {_MOST_PIECES}, with NaN for '
                'what is not measured'))

    def _stamped(self, found: Reading, now: int) -> Reading:
        if found.stamp is None:
            return found
        stamp = self._ours(found.stamp)
        if abs(stamp - now) > ANOTHER_CLOCK:
            raise ValueError
        return found._replace(stamp=stamp)

    def schedule(self, levels: Sequence[tuple[int, float]]) -> None:
        """Have it keep levels in T from stamps in ns on; they replace all from the first on."""
        begin = levels[0][0] if levels else math.inf
        known, self._handed = self._handed, {
            x: y for x, y in self._handed.items() if begin - _ABSURD < x < begin or not levels}
        for stamp, _ in levels:
            # What replaces a level has its time, though the clock is known better by now.
            self._handed[stamp] = known.get(stamp) or self._theirs(stamp)
        self._call('schedule', [(self._handed[x], y) for x, y in levels])

    def applied(self, now: int) -> list[tuple[int, float]]:
        """Return stamps in ns and levels in T that have taken effect since the last call."""
        return self._ask(
            'applied',
            take=lambda answer: [(self._happened(x, now), float(_number(y))) for x, y in answer],
            wrong=lambda what: HardwareError(
                f'{what}: expected a list of (timestamp in ns, level in T)'))

    def synchronise(self, clock: Callable[[], int]) -> None:
        """Learn its time anew, where it has a clock, by that of this host in ns."""
        self._handed.clear()
        if self.clock_map is not None:
            self.clock_map = ClockMap()
            for _ in range(ENOUGH):
                self.ask_clock(clock)

    def ask_clock(self, clock: Callable[[], int]) -> bool:
        """Compare its clock with that of this host, in ns; return whether it is still the same."""
        if self.clock_map is None:
            return True
        before = clock()
        answer = self._ask(
            'clock', take=lambda x: int(_number(x)),
            wrong=lambda what: HardwareError(f'{what}: expected its time in ns'))
        return self.clock_map.add(before, answer, clock())

    def temperature(self) -> float:
        """Return the temperature of its coil in degrees Celsius; NaN if it is not known."""
        return math.nan if not self.has('temperature') else self._ask(
            'temperature', take=lambda x: float(_number(x, finite=False)),
            wrong=lambda what: HardwareError(
                f'{what}: expected degrees Celsius, NaN if they are not known'))

    def arm(self) -> None:
        """Have it made ready for levels, where it can."""
        self._call('arm')

    def disarm(self) -> None:
        """Undo `arm`, where it can."""
        with suppress(StateLostError):
            self._call('disarm')

    def open(self) -> None:
        """Connect again, where it can; an error is passed over, as the next `write` shows."""
        with suppress(HardwareError, StateLostError):
            self._call('open')

    def close(self) -> None:
        """End with it, where it can."""
        with suppress(StateLostError):
            self._call('close')

    def cut(self, now: int) -> bool:
        """Write 0 past the call that blocks, at a time in ns; return whether that is done."""
        try:
            self._written(self.hardware.write(0.0, self._theirs(now)), 0.0, now)
        except BaseException:
            return False
        finally:
            with suppress(BaseException):
                getattr(self.hardware, 'disarm', lambda: None)()
        return True

    def drop(self) -> None:
        """Close it past the call that blocks."""
        with suppress(BaseException):
            getattr(self.hardware, 'close', lambda: None)()


def readings(answer: Any) -> list[Reading]:
    """
    Return the readings in the answer of a ``read``.

    Raises
    ------
    TypeError, ValueError
        If there are none in it.

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
    """Return a real number; raise TypeError for anything else."""
    if not is_number(value, finite=finite):
        raise TypeError
    return value


def is_number(value: Any, *, finite: bool = True) -> bool:
    """Return whether a value is a real number, and finite where it must be."""
    if type(value) is bool or not isinstance(value, Real):
        return False
    try:
        return math.isfinite(value) or not finite
    except OverflowError:  # a whole number that no float can be
        return False
