"""A coil that a driver serves: levels ahead, handed over and in force, and its temperature."""

from bisect import bisect_right
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
import math

from hmsa_ros.device.hardware import Calls, Hardware, HardwareError, Instrument
from hmsa_ros.device.protocol import Change, Kind, Notice, StateLostError
from hmsa_ros.device.watchdog import Fallback, GuardedJoint
from hmsa_ros.errors import BadInputError
from hmsa_ros.model.schedule import CommandSchedule
from hmsa_ros.model.units import NANOSECONDS

# Of the levels that took effect last, which tell at what level an older sample was taken.
_REMEMBERED = 64
# In ns: between questions for the time and temperature of a device, and for what it has applied.
_ASK, _POLL = NANOSECONDS // 4, NANOSECONDS // 200
# By how many degrees a coil that was too warm must be below its limit.
_COOLER = 5.0
# A level is not written again where the next one is due within so many of the longest writes.
_ROOM = 2.0


@dataclass(frozen=True)
class HardwareJoint:
    """
    A real actuator.

    Raises
    ------
    BadInputError
        If the limit is out of range.

    """

    hardware: Hardware  #: what writes and reads
    limit: float  #: largest level in T, above 0; what exceeds it is refused
    #: what to do after a silence
    fallback: Fallback = field(default_factory=lambda: Fallback(safe_flux='zero'))
    name: str = 'actuator'  #: for sentences
    #: of the coil in degrees Celsius, above 0; it is off while it is warmer
    temperature_limit: float = math.inf

    def __post_init__(self) -> None:
        if not 0.0 < self.limit < math.inf:
            raise BadInputError(f'limit is {self.limit:g} T: expected a number above 0')
        if not self.temperature_limit > 0.0:
            raise BadInputError(
                f'temperature_limit is {self.temperature_limit:g}: expected a number above 0')


class Coil(GuardedJoint):
    """
    What is known of a coil; NaN where a level in T is not known.

    All times are in ns.

    Parameters
    ----------
    number : int
        Of its joint.
    joint : HardwareJoint
        What writes and reads; the limit of the hardware counts if it is smaller.
    calls : Calls
        Limits and times the calls of hardware.
    clock : callable
        Returns the time of this host in ns.
    notices, changes : deque
        What gets what there is to log, and the levels that took effect.

    Raises
    ------
    BadInputError
        If the hardware is not as `Hardware` says, or has no temperature to be limited.
    HardwareError
        If it does not answer what time it has.

    """

    def __init__(
            self, number: int, joint: HardwareJoint, calls: Calls, clock: Callable[[], int],
            notices: deque[Notice], changes: deque[Change]) -> None:
        super().__init__(number, joint.fallback, notices)
        self.name, self._hottest = joint.name, joint.temperature_limit
        self._calls, self._clock, self._changes = calls, clock, changes
        self.instrument = Instrument(joint.hardware, joint.name, calls)
        if self._hottest != math.inf and not self.instrument.has('temperature'):
            raise BadInputError(
                f'temperature_limit of joint {self.name} is {self._hottest:g}, and '
                f'{self.instrument.name} reports no temperature: expected 0 for no limit, or a '
                'class with temperature()')
        self.temperature = math.nan
        self.too_warm = ''  # why the coil is to be off
        self.limit = min(joint.limit, self.instrument.limit or math.inf)
        self.tolerance = self.instrument.tolerance(self.limit)
        self._heard = False  # whether there was a sign of life since the last look
        self._armed = False
        # The newest level that was asked for, and the one really in force.
        self.asked = self.level = math.nan
        self.saturated = self.lost = 0
        self._history: deque[tuple[int, float]] = deque(maxlen=_REMEMBERED)
        self._patience = round(calls.limit * NANOSECONDS)
        self._clear()
        self._next_question: int | None = None
        self._synchronise()

    def _clear(self) -> None:
        """Forget what is ahead: the level is to be 0."""
        self._schedule = CommandSchedule(0.0)
        self._wanted = False  # whether it was to be on since then
        self._repeat = False  # whether a sign of life is to be passed on
        # What the device keeps, and what of it is due and not yet said to be applied.
        self._handed: deque[tuple[int, float]] = deque()
        self._awaited: deque[tuple[int, float]] = deque()
        # From when on what it keeps is not what is ahead.
        self._changed: int | None = None

    def clock_set(self, by: int) -> None:
        """Take in that the clock of this host was set ahead by some ns."""
        self.pass_over(by)
        self._schedule.shift(by)
        self._history, self._handed, self._awaited = (
            deque(((x + by, level) for x, level in times), times.maxlen)
            for times in (self._history, self._handed, self._awaited))
        if self._changed is not None:
            self._changed += by
        if self._next_question is not None:
            self._next_question += by
        if self.instrument.clock_map is not None:
            self.instrument.clock_map.host_set(by)

    # -- commands ------------------------------------------------------------------------------

    def receive(self, stamp: int, level: float, now: int) -> None:
        """Take a level in T from a stamp on, unless it is one of before a cut-off."""
        if self.refuses(stamp, level, now, self._schedule.current):
            return
        self._heard = True
        self._wanted = self._wanted or abs(level) > self.tolerance
        if not self._insert(stamp, level):
            self._repeat = True
        elif stamp and now > stamp:
            self.note_late(now - stamp)

    def _insert(self, stamp: int, level: float) -> bool:
        """Take a level in T from a stamp on; return whether anything is different."""
        changed = self._schedule.insert(stamp, level)
        if changed and self.instrument.keeps_levels:
            self._changed = stamp if self._changed is None else min(stamp, self._changed)
        return changed

    def look(self, now: int) -> None:
        """Have the watchdog look at what has come."""
        if self._heard:
            self.feed(now)
            self._heard = False
        for stamp, level in self.watch(now, now, self._schedule.current):
            self._insert(stamp, level)

    # -- what is due ---------------------------------------------------------------------------

    @property
    def next_level(self) -> int | None:
        """When the next level is to be written; None if there is none."""
        return None if self.instrument.keeps_levels else self._schedule.next_stamp

    def due(self, now: int) -> int | None:
        """Return when to `advance` it next; None for not before a command comes."""
        times = [self.watch_due, self._schedule.next_stamp, self._next_question]
        if self.instrument.keeps_levels:
            times.append(now + _POLL if self._awaited else None)
            if self._changed is not None and len(self._handed) < (self.instrument.capacity or 0):
                times.append(now)
        return min((x for x in times if x is not None), default=None)

    def advance(self, now: int) -> None:
        """
        Write what is due, or have the device keep it.

        Raises
        ------
        HardwareError
            If a call fails, or the device does not say what it has applied.

        """
        self.look(now)
        try:
            self._obey(now)
        except StateLostError as error:
            self.lose(error, now)

    def _obey(self, now: int) -> None:
        if self._wanted and not self._armed:
            self.instrument.arm()
            self._armed = True
        self._schedule.apply_until(now)
        self._see_applied(now)
        level = self._schedule.current
        # Whether it is in force, or on its way.
        if level != (self._awaited[-1][1] if self._awaited else self.asked):
            self._write(level, now)
        self._hand_over(now)
        if self._repeat and self._has_room(now):
            if self.instrument.keeps_levels:
                self.instrument.schedule([])
                self._repeat = False
            else:
                self._write(level, now)
        if not self._ask(now):
            raise StateLostError('its clock is another one')
        if self.too_warm and self._wanted:
            raise StateLostError(self.too_warm)

    def _has_room(self, now: int) -> bool:
        """Return whether there is time to write before the next level, which will do as well."""
        ahead = self.next_level
        longest = max(self._calls.longest.values(), default=0.0)
        return ahead is None or ahead - now > _ROOM * longest * NANOSECONDS

    def read(self, now: int) -> list[tuple[int, float, float]]:
        """
        Return time, stretch and rate of what is new.

        Raises
        ------
        HardwareError
            If it fails.

        """
        try:
            return [(now if x.stamp is None else x.stamp, x.stretch, x.rate)
                    for x in self.instrument.read(now)]
        except StateLostError as error:
            self.lose(error, now)
            return []

    # -- levels ahead --------------------------------------------------------------------------

    def _hand_over(self, now: int) -> None:
        """Have the device keep what has changed of the levels ahead."""
        if self._changed is None or self._changed <= now and not self._schedule.next_stamp:
            self._changed = None
            return
        since = max(self._changed, now + 1)
        kept = [x for x in self._handed if x[0] < since]
        capacity = self.instrument.capacity
        levels = self._schedule.ahead(since)
        if not levels or levels[0][0] > since:
            # What it has from here on goes, too.
            levels.insert(0, (since, self._schedule.at(since)))
        room = len(levels) if capacity is None else max(capacity - len(kept), 0)
        if room or not self._handed or len(kept) < len(self._handed):
            given = levels[:max(room, 1)]
            self.instrument.schedule(given)
            self._handed = deque([*kept, *given])
            levels = levels[len(given):]
        self._changed = levels[0][0] if levels else None

    def _see_applied(self, now: int) -> None:
        """Take in what the device has applied by now."""
        due = []
        while self._handed and self._handed[0][0] <= now:
            due.append(self._handed.popleft())
        if not self.instrument.has('applied'):
            for stamp, level in due:
                self._took_effect(stamp, level, level)
            return
        self._awaited.extend(due)
        for when, level in self.instrument.applied(now) if self._awaited else ():
            # A device that is slow to answer has gone on meanwhile.
            queue = self._awaited or self._handed
            stamp, asked = queue.popleft() if queue else (when, level)
            self._schedule.apply_until(stamp)
            self._took_effect(when, asked, level)
        if self._awaited and now - self._awaited[0][0] > self._patience:
            stamp, level = self._awaited[0]
            raise HardwareError(
                f'{self.instrument.name}.applied does not say that {level:g} T took effect, '
                f'{(now - stamp) / NANOSECONDS:.3f} s after its time: expected that within '
                'hardware.timeout')

    # -- levels in force -----------------------------------------------------------------------

    def at(self, stamp: int) -> float:
        """Return the level that was in force at a time."""
        known = bisect_right(self._history, stamp, key=lambda x: x[0])
        return self._history[known - 1][1] if known else math.nan

    def put(self, level: float, now: int) -> None:
        """
        Write a level; what is ahead is forgotten.

        Raises
        ------
        HardwareError
            If it fails.

        """
        self._clear()
        try:
            self._write(level, now)
        except StateLostError as error:
            self.lose(error, now)

    def _write(self, level: float, now: int) -> None:
        """Write a level; raise StateLostError if that is lost."""
        try:
            when, really = self.instrument.write(level, now)
        except HardwareError:
            self.set(now, math.nan, math.nan)
            raise
        self._took_effect(when, level, really)
        # What the device kept is dropped.
        self._handed.clear()
        self._awaited.clear()
        if self.instrument.keeps_levels:
            self._changed = self._schedule.next_stamp
        self._repeat = False

    def _took_effect(self, when: int, asked: float, really: float) -> None:
        """Take in the level that hardware has set in place of the one asked for."""
        if abs(really - asked) > self.tolerance:
            self.saturated += 1
            if self.saturated == 1:
                self.note(
                    Kind.SATURATED, f'{self.instrument.name} was asked for {asked:g} T and set '
                    f'{really:g} T, and moves will not end where they should: lower '
                    'flux_density_max of the planner and flux_density_limit of the driver to '
                    'what the amplifier gives')
        self.set(when, asked, really)

    def set(self, when: int, asked: float, level: float) -> None:
        """Note the requested level, and the one in force from a time on; NaN if unknown."""
        known = not math.isnan(level)
        if asked != self.asked and (known or not math.isnan(self.level)) or (
                abs(level - self.level) > self.tolerance):
            self._history.append((when, level))
            self.level = level
            self._changes.append(Change(self.number, when, level))
        self.asked = asked

    def lose(self, error: StateLostError, now: int) -> None:
        """
        Take in that hardware has lost its state.

        Raises
        ------
        HardwareError
            If it does not obey again.

        """
        self.lost += 1
        why = f' ({error})' if str(error) else ''
        self.note(
            Kind.LOST, f'{self.instrument.name} has lost its state{why} and its coil is off: '
            'what was commanded is forgotten, send a new request')
        self.set(now, 0.0, 0.0)
        self._clear()
        self._armed = False
        self.cut_off(now)
        try:
            self._synchronise()
            when, level = self.instrument.write(0.0, now)
        except StateLostError as again:
            raise HardwareError(
                f'{self.instrument.name} lost its state twice in a row') from again
        self.set(when, 0.0, level)

    # -- the end -------------------------------------------------------------------------------

    def lock(self, now: int) -> None:
        """
        Switch off, or ramp down; then 0 T comes first.

        Raises
        ------
        HardwareError
            If a call fails.

        """
        left = self.level if self.ramps and math.isfinite(self.level) else 0.0
        self.stand_by()
        self.cut_off(now, zero_first=True)
        if left:
            self.ramp_down(now, left)
        # That drops what the device keeps, too.
        self.put(left, now)

    def disarm(self) -> None:
        """
        Have the device disarmed, if it is armed.

        Raises
        ------
        HardwareError
            If it fails.

        """
        armed, self._armed = self._armed, False
        if armed:
            self.instrument.disarm()

    def switch_off(self, now: int) -> str:
        """Switch off; return why it could not be, in words."""
        try:
            self.put(0.0, now)
            if self.instrument.off(self.level, self.limit):
                self.disarm()
                return ''
        except HardwareError as error:
            with suppress(HardwareError):
                self.disarm()
            return str(error)
        return f'{self.instrument.name}.write says that {self.level:g} T are left'

    # -- the device's clock and temperature ----------------------------------------------------

    def _synchronise(self) -> None:
        """Learn the time of the device anew, where it has a clock."""
        self.instrument.synchronise(self._clock)
        self._feel()
        if self.instrument.clock_map is not None or self.instrument.has('temperature'):
            self._next_question = self._clock() + _ASK

    def _feel(self) -> None:
        """See whether the coil is too warm, or was and is not yet cool enough."""
        self.temperature = self.instrument.temperature()
        limit = self._hottest - (_COOLER if self.too_warm else 0.0)
        # One that is not known is none to go on with.
        self.too_warm = '' if self._hottest == math.inf or self.temperature <= limit else (
            f'the coil is at {self.temperature:.1f} degrees Celsius: expected at most '
            f'{limit:g} (temperature_limit {self._hottest:g}); let it cool')

    def _ask(self, now: int) -> bool:
        """Ask for time and temperature if that is due; return whether the clock is the same."""
        # Sooner than planned where the clock of the host was set back.
        if self._next_question is None or now < self._next_question <= now + _ASK:
            return True
        self._next_question = now + _ASK
        self._feel()
        return self.instrument.ask_clock(self._clock)
