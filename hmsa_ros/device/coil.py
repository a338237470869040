"""A driver's coil: its pending, scheduled and applied levels, and its temperature."""

from bisect import bisect_right
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
import math

from hmsa.errors import BadInputError, check_number
from hmsa.model.delivery import CommandSchedule
from hmsa.model.units import NANOSECONDS
from hmsa_ros.device.hardware import Calls, Hardware, HardwareError, Instrument
from hmsa_ros.device.watchdog import Change, Fallback, GuardedJoint, Kind, Notice, StateLostError

# Number of recent levels stored to determine the level at the time of an older sample.
_REMEMBERED = 64
# In ns: intervals of queries for time and temperature of a device, and for applied levels.
_ASK, _POLL = NANOSECONDS // 4, NANOSECONDS // 200
# Degrees below the limit to which a coil that was too warm must cool.
_COOLER = 5.0
# A heartbeat is omitted if the next level is due within this multiple of the longest write.
_ROOM = 2.0


@dataclass(frozen=True)
class HardwareJoint:
    """
    A real actuator.

    Raises
    ------
    BadInputError
        If a limit is out of range.

    """

    hardware: Hardware  #: amplifier and sensor
    limit: float  #: largest level in T, above 0; larger ones are refused
    #: reaction to silence
    fallback: Fallback = field(default_factory=lambda: Fallback(safe_flux='zero'))
    name: str = 'actuator'  #: for messages
    #: limit of the coil in degrees Celsius, above 0; the coil is off while it is warmer
    temperature_limit: float = math.inf

    def __post_init__(self) -> None:
        check_number('limit', self.limit, 'T', above=0.0)
        check_number('temperature_limit', self.temperature_limit, above=0.0, endless=True)


class Coil(GuardedJoint):
    """
    State of a coil; an unknown level in T is NaN.

    All times are in ns.

    Parameters
    ----------
    number : int
        Number of its joint.
    joint : HardwareJoint
        Amplifier and sensor; a smaller limit of the hardware takes precedence.
    calls : Calls
        Limits and times the calls of hardware.
    clock : callable
        Returns the host time in ns.
    notices, changes : deque
        Receive the notices to log, and the levels that took effect.

    Raises
    ------
    BadInputError
        If the hardware does not conform to `Hardware`, or lacks a temperature to limit.
    HardwareError
        If its clock cannot be read.

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
        self.too_warm = ''  # why the coil must be off
        self.limit = min(joint.limit, self.instrument.limit or math.inf)
        self.tolerance = self.instrument.tolerance(self.limit)
        # Timestamps of the commands and heartbeats since the last look.
        self._heard: list[int] = []
        self._armed = False
        # The newest requested level, and the actual one.
        self.asked = self.level = math.nan
        self.saturated = self.lost = 0
        self._history: deque[tuple[int, float]] = deque(maxlen=_REMEMBERED)
        self._patience = round(calls.limit * NANOSECONDS)
        self._clear()
        self._next_question: int | None = None
        self._synchronise()

    def _clear(self) -> None:
        """Drop all pending levels and the ramp, with 0 as the present level."""
        self._ramp = None
        self._schedule = CommandSchedule(0.0)
        self._wanted = False  # whether a level other than 0 was commanded since then
        self._repeat = False  # whether to pass on a heartbeat
        # Levels stored by the device, and those due but not reported as applied.
        self._handed: deque[tuple[int, float]] = deque()
        self._awaited: deque[tuple[int, float]] = deque()
        # Time from which the stored levels differ from the pending ones.
        self._changed: int | None = None

    def clock_set(self, by: int) -> None:
        """Shift all times by the ns that the host's clock was set ahead."""
        super().clock_set(by)
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
        """Accept a level in T from a timestamp on, unless it is rejected after a cut-off."""
        if self.refuses(stamp, level, now, self._schedule.current):
            return
        self._heard.append(stamp)
        self._wanted = self._wanted or abs(level) > self.tolerance
        # A late one that is accepted applies at once.
        if not self._insert(max(stamp, now) if stamp else 0, level):
            self._repeat = True
        elif stamp and now > stamp:
            self.note_late(now - stamp)

    def _insert(self, stamp: int, level: float) -> bool:
        """Add a level in T from a timestamp on; return whether the schedule changes."""
        changed = self._schedule.insert(stamp, level)
        if changed and self.instrument.keeps_levels:
            self._changed = stamp if self._changed is None else min(stamp, self._changed)
        return changed

    def look(self, now: int) -> None:
        """Update the watchdog with the commands that have arrived."""
        for stamp in self._heard:
            self.feed(now, stamp)
        self._heard.clear()
        for stamp, level in self.watch(now, now, self._schedule.current):
            self._insert(stamp, level)

    # -- work that is due ----------------------------------------------------------------------

    @property
    def next_level(self) -> int | None:
        """Time of the next level to write; None if there is none."""
        return None if self.instrument.keeps_levels else self._schedule.next_stamp

    def due(self, now: int) -> int | None:
        """Return the time of the next `advance`; None if it is not needed before a command."""
        times = [self.watch_due, self._schedule.next_stamp, self._next_question]
        if self.instrument.keeps_levels:
            times.append(now + _POLL if self._awaited else None)
            if self._changed is not None and len(self._handed) < (self.instrument.capacity or 0):
                times.append(now)
        return min((x for x in times if x is not None), default=None)

    def advance(self, now: int) -> None:
        """
        Write levels that are due, or schedule them on the device.

        Raises
        ------
        HardwareError
            If a call fails, or the device does not report applied levels.

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
        self._drop_missed(now)
        self._schedule.apply_until(now)
        self._see_applied(now)
        level = self._schedule.current
        # Compared with the level in force or about to be.
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

    def _drop_missed(self, now: int) -> None:
        """Drop the pending levels if one is too late to be written, as after a stall."""
        due = self._changed if self.instrument.keeps_levels else self._schedule.next_stamp
        if not due or now - due <= self.lateness_limit or self.tripped or self.is_cut_off:
            # Nothing is pending, or for now, or it is the safe flux.
            return
        count = len(self._schedule)
        self._schedule = CommandSchedule(self._schedule.current)
        self.too_late = self._newest
        if self.instrument.keeps_levels:
            self._changed = now + 1
        self.note(
            Kind.REFUSED, f'{count} levels are dropped, the first of which is '
            f'{(now - due) / NANOSECONDS:.3f} s late: expected to write it within '
            f'{self.lateness_limit / NANOSECONDS:g} s (lateness_limit); the planner sends the '
            'rest anew; let nothing stop or starve the driver')

    def _has_room(self, now: int) -> bool:
        """Return whether a heartbeat fits in before the next level, which replaces it."""
        ahead = self.next_level
        longest = max(self._calls.longest.values(), default=0.0)
        return ahead is None or ahead - now > _ROOM * longest * NANOSECONDS

    def read(self, now: int) -> list[tuple[int, float, float]]:
        """
        Return time, stretch and rate of new readings.

        Raises
        ------
        HardwareError
            If a call fails.

        """
        try:
            return [(now if x.stamp is None else x.stamp, x.stretch, x.rate)
                    for x in self.instrument.read(now)]
        except StateLostError as error:
            self.lose(error, now)
            return []

    # -- levels ahead --------------------------------------------------------------------------

    def _hand_over(self, now: int) -> None:
        """Schedule changed levels on the device."""
        if self._changed is None or self._changed <= now and not self._schedule.next_stamp:
            if self._changed is not None and self._handed:
                # A level that came late, as the one in force, replaces those stored.
                self._write(self._schedule.current, now)
            self._changed = None
            return
        since = max(self._changed, now + 1)
        kept = [x for x in self._handed if x[0] < since]
        capacity = self.instrument.capacity
        levels = self._schedule.ahead(since)
        if not levels or levels[0][0] > since:
            # This also drops the device's levels from here on.
            levels.insert(0, (since, self._schedule.at(since)))
        room = len(levels) if capacity is None else max(capacity - len(kept), 0)
        if room or not self._handed or len(kept) < len(self._handed):
            given = levels[:max(room, 1)]
            self.instrument.schedule(given)
            self._handed = deque([*kept, *given])
            levels = levels[len(given):]
        self._changed = levels[0][0] if levels else None

    def _see_applied(self, now: int) -> None:
        """Process the levels that the device has applied by now."""
        due = []
        while self._handed and self._handed[0][0] <= now:
            due.append(self._handed.popleft())
        if not self.instrument.has('applied'):
            for stamp, level in due:
                self._took_effect(stamp, level, level)
            return
        self._awaited.extend(due)
        for when, level in self.instrument.applied(now) if self._awaited else ():
            # A slow device may have applied further levels meanwhile.
            queue = self._awaited or self._handed
            stamp, asked = queue.popleft() if queue else (when, level)
            self._schedule.apply_until(stamp)
            self._took_effect(when, asked, level)
        if self._awaited and now - self._awaited[0][0] > self._patience:
            stamp, level = self._awaited[0]
            raise HardwareError(
                f'{self.instrument.name}.applied does not report that {level:g} T took effect, '
                f'{(now - stamp) / NANOSECONDS:.3f} s after its time: expected that within '
                'hardware.timeout')

    # -- levels in force -----------------------------------------------------------------------

    def at(self, stamp: int) -> float:
        """Return the level that was in force at a time."""
        known = bisect_right(self._history, stamp, key=lambda x: x[0])
        return self._history[known - 1][1] if known else math.nan

    def put(self, level: float, now: int) -> None:
        """
        Write a level, and drop pending ones.

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
        """Write a level; raise StateLostError if the hardware has lost its state."""
        try:
            when, really = self.instrument.write(level, now)
        except HardwareError:
            self.set(now, math.nan, math.nan)
            raise
        self._took_effect(when, level, really)
        # This drops the levels stored by the device.
        self._handed.clear()
        self._awaited.clear()
        if self.instrument.keeps_levels:
            self._changed = self._schedule.next_stamp
        self._repeat = False

    def _took_effect(self, when: int, asked: float, really: float) -> None:
        """Record the actual level that hardware has set for a requested one."""
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
        """Record the requested level, and the actual one from a time on; NaN if unknown."""
        known = not math.isnan(level)
        if asked != self.asked and (known or not math.isnan(self.level)) or (
                abs(level - self.level) > self.tolerance):
            self._history.append((when, level))
            self.level = level
            self._changes.append(Change(self.number, when, level))
        self.asked = asked

    def lose(self, error: StateLostError, now: int) -> None:
        """
        Handle a loss of the hardware's state.

        Raises
        ------
        HardwareError
            If it does not obey again.

        """
        self.lost += 1
        why = f' ({error})' if str(error) else ''
        self.note(
            Kind.LOST, f'{self.instrument.name} has lost its state{why} and its coil is off: '
            'all commands are discarded; send a new request')
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
        Switch off, or ramp down; afterwards 0 T must be commanded first.

        Raises
        ------
        HardwareError
            If a call fails.

        """
        left = self.level if self.ramps and math.isfinite(self.level) else 0.0
        self.stand_by()
        self.cut_off(now, always=True)
        # This also drops the levels stored by the device.
        self.put(left, now)
        # No ramp if the hardware has lost its state meanwhile.
        if self.asked:
            self.ramp_down(now, left)

    def disarm(self) -> None:
        """
        Disarm the device, if it is armed.

        Raises
        ------
        HardwareError
            If it fails.

        """
        armed, self._armed = self._armed, False
        if armed:
            self.instrument.disarm()

    def switch_off(self, now: int) -> str:
        """Switch off, and reject levels commanded before; return any failure in words."""
        self.stand_by()
        self.cut_off(now)
        try:
            self.put(0.0, now)
            if self.instrument.off(self.level, self.limit):
                self.disarm()
                return ''
        except HardwareError as error:
            with suppress(HardwareError):
                self.disarm()
            return str(error)
        return f'{self.instrument.name}.write reports that {self.level:g} T are left'

    # -- the device's clock and temperature ----------------------------------------------------

    def _synchronise(self) -> None:
        """Compare clocks again, if the device has one, and read the temperature."""
        self.instrument.synchronise(self._clock)
        self._check_temperature()
        if self.instrument.clock_map is not None or self.instrument.has('temperature'):
            self._next_question = self._clock() + _ASK

    def _check_temperature(self) -> None:
        """Read the temperature, and decide whether the coil is too warm, with hysteresis."""
        self.temperature = self.instrument.temperature()
        limit = self._hottest - (_COOLER if self.too_warm else 0.0)
        # An unknown temperature counts as too warm.
        self.too_warm = '' if self._hottest == math.inf or self.temperature <= limit else (
            f'the coil is at {self.temperature:.1f} degrees Celsius: expected at most '
            f'{limit:g} (temperature_limit {self._hottest:g}); let it cool')

    def _ask(self, now: int) -> bool:
        """Query time and temperature if due; return whether the clock is the same."""
        # Also due if the host's clock was set back.
        if self._next_question is None or now < self._next_question <= now + _ASK:
            return True
        self._next_question = now + _ASK
        self._check_temperature()
        return self.instrument.ask_clock(self._clock)
