"""Real hardware as a device: levels written at their stamps, a watchdog, and samples."""

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
import math
from time import time_ns

import numpy as np

from hmsa_ros.device.coil import Coil
from hmsa_ros.device.hardware import Calls, Hardware, HardwareError, Instrument
from hmsa_ros.device.protocol import Change, Kind, Notice, Sample, StateLostError
from hmsa_ros.device.watchdog import Device, Fallback
from hmsa_ros.errors import BadInputError
from hmsa_ros.timekeeping import clock_set_words

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


class HardwareDevice(Device):
    """
    Real actuators; their coils are not known to be off before `switch_off`.

    Parameters
    ----------
    joints : sequence of HardwareJoint
        At least one.
    time : int
        Time at the start in ns.
    period : int
        Between samples, in ns; 0 for none.
    calls : Calls
        What is told of each call of hardware.
    clock : callable
        Returns the time in ns, as ``time`` is; for hardware with a clock of its own.

    Raises
    ------
    BadInputError
        If hardware is not as `Hardware` says.
    HardwareError
        If it does not answer what time it has.

    """

    def __init__(
            self, joints: Sequence[HardwareJoint], *, time: int, period: int = 0,
            calls: Calls | None = None, clock: Callable[[], int] = time_ns) -> None:
        super().__init__(x.fallback for x in joints)
        self.calls = Calls(1.0) if calls is None else calls
        self._time = time
        self._period = period
        self._next_sample = time
        self._coils = [
            Coil(x.hardware, x.name, x.limit, self.calls, clock, x.temperature_limit)
            for x in joints]

    @property
    def time(self) -> int:
        """Time in ns that it has been advanced to."""
        return self._time

    @property
    def next_level(self) -> int | None:
        """Stamp of the next level, in ns; None if there is none ahead."""
        return min((x.next_level for x in self._coils if x.next_level is not None), default=None)

    @property
    def due(self) -> int | None:
        """When to advance it next, in ns; None for not before a command comes."""
        times = [self.next_level, *(x.due for x in self._watchdogs),
                 *(x.due(self._time) for x in self._coils)]
        if self._period:
            times.append(self._next_sample)
        return min((x for x in times if x is not None), default=None)

    @property
    def instruments(self) -> list[Instrument]:
        """The hardware of each joint."""
        return [x.instrument for x in self._coils]

    @property
    def limits(self) -> list[float]:
        """Largest level in T of each joint, as given or as the hardware says."""
        return [x.limit for x in self._coils]

    @property
    def levels(self) -> list[float]:
        """Level in T that is in force on each joint; NaN where it is not known."""
        return [x.level for x in self._coils]

    @property
    def counts(self) -> dict[str, int]:
        """How often a level was not reached, and hardware lost its state."""
        return {'saturated': sum(x.saturated for x in self._coils),
                'state_lost': sum(x.lost for x in self._coils)}

    @property
    def clocks(self) -> dict[str, str]:
        """What is known of the clocks of hardware, in words by name."""
        found: dict[str, str] = {}
        for x in self._coils:
            if (known := x.instrument.clock_map) is not None:
                found |= {f'clock of {x.name}: error in us': f'{known.error * 1e6:.1f}',
                          f'clock of {x.name}: drift in ppm': f'{known.drift * 1e6:.2f}'}
        return found

    @property
    def temperatures(self) -> dict[str, float]:
        """Temperatures of coils in degrees Celsius by joint, where they are known."""
        return {x.name: x.temperature for x in self._coils if not math.isnan(x.temperature)}

    @property
    def too_warm(self) -> str:
        """Which coils are too warm, in words; empty if none is."""
        return '; '.join(f'joint {x.name}: {x.too_warm}' for x in self._coils if x.too_warm)

    # -- commands ------------------------------------------------------------------------------

    def check(self, joint: int, stamp: int, level: float) -> None:
        """
        Refuse a level in T beyond the limit, a stamp in ns of another clock, and any while locked.

        A coil that is too warm takes 0 T only.

        Raises
        ------
        BadInputError
            If it is.

        """
        limit = self._coils[joint].limit
        if not abs(level) <= limit:  # not a number is refused, too
            raise BadInputError(f'flux density is {level:g} T: expected at most {limit:g} T')
        if self.locked:
            raise BadInputError(
                f'the interlock is open ({self.locked}): close it, then send a new request')
        if level and (why := self._coils[joint].too_warm):
            raise BadInputError(f'flux density is {level:g} T, and {why}')
        self._check_clock(stamp)

    def receive(self, joint: int, stamp: int, level: float) -> None:
        """
        Take a level in T that applies from a stamp in ns on; a past one, or 0, at once.

        Raises
        ------
        BadInputError
            If the level is beyond the limit, the stamp of another clock, or the interlock open.

        """
        self.check(joint, stamp, level)
        coil = self._coils[joint]
        if self._refuses(joint, stamp, level, coil.schedule.current):
            return
        coil.heard = self._time
        coil.wanted = coil.wanted or abs(level) > coil.tolerance
        changed = coil.insert(stamp, level)
        coil.repeat = coil.repeat or not changed
        late = self._time - stamp
        if changed and stamp and late > 0:
            self._note_late(joint, late)

    def hear(self, joint: int, stamp: int, level: float, now: int) -> None:
        """Take a level that came at a time in ns (see `receive`), after any silence before it."""
        self._pass_to(now)
        self._watch(joint)
        self.receive(joint, stamp, level)
        self._watch(joint)

    # -- time ----------------------------------------------------------------------------------

    def _pass_to(self, time: int) -> None:
        if time < self._time:
            # The clock was set back.
            self._next_sample = min(self._next_sample, time)
        self._time = time

    def clock_set(self, by: int) -> None:
        """Take in that the clock was set ahead by some ns: all that is ahead stays as far away."""
        self._time += by
        self._next_sample += by
        for watchdog, cut_off, coil in zip(
                self._watchdogs, self._cut_offs, self._coils, strict=True):
            watchdog.pass_over(by)
            cut_off.clock_set(by)
            coil.clock_set(by)
        self._notices.append(Notice(Kind.CLOCK, 0, clock_set_words(by, 'levels ahead apply')))

    def advance(self, time: int) -> None:
        """
        Write what is due at a time in ns, which is now, and read if that is due.

        Raises
        ------
        HardwareError
            If a call fails.

        """
        self._pass_to(time)
        for i, coil in enumerate(self._coils):
            self._watch(i)
            try:
                self._obey(i, coil)
            except StateLostError as error:
                self._lose(i, error)
        if self._period and self._time >= self._next_sample:
            self._next_sample = (self._time // self._period + 1) * self._period
            self._read()

    def _obey(self, i: int, coil: Coil) -> None:
        """Write what is due, or have the device keep it; raise StateLostError if it has not."""
        if coil.wanted and not coil.armed:
            coil.instrument.arm()
            coil.armed = True
        coil.schedule.apply_until(self._time)
        for when, asked, really in coil.pass_to(self._time):
            self._took_effect(i, when, asked, really)
        level = coil.schedule.current
        if not coil.stands:
            self._write(i, level)
        if self.locked and coil.asked == 0.0:
            coil.disarm()
        coil.hand_over(self._time)
        if coil.repeat and self._has_room(coil):
            if coil.instrument.keeps_levels:
                coil.instrument.schedule([])
                coil.repeat = False
            else:
                self._write(i, level)
        if not coil.ask(self._time):
            raise StateLostError('its clock is another one')
        if coil.too_warm and coil.wanted:
            raise StateLostError(coil.too_warm)

    def _watch(self, i: int) -> None:
        coil = self._coils[i]
        if coil.heard is not None:
            self._feed(i, self._time)
            coil.heard = None
        for stamp, level in self._safe_levels(i, self._time, self._time, coil.schedule.current):
            coil.insert(stamp, level)

    def _has_room(self, coil: Coil) -> bool:
        """Return whether there is time to write before the next level, which will do as well."""
        ahead = coil.next_level
        longest = max(self.calls.longest.values(), default=0.0)
        return ahead is None or ahead - self._time > _ROOM * longest * 1e9

    # -- calls of the hardware -----------------------------------------------------------------

    def _write(self, i: int, level: float) -> None:
        """Write a level in T; raise StateLostError if that is lost."""
        coil = self._coils[i]
        try:
            when, really = coil.instrument.write(level, self._time)
        except HardwareError:
            self._set(i, self._time, math.nan, math.nan)
            raise
        self._took_effect(i, when, level, really)
        coil.superseded()
        coil.repeat = False

    def _took_effect(self, i: int, when: int, asked: float, really: float) -> None:
        """Take in the level in T that hardware has set in place of the one asked for."""
        coil = self._coils[i]
        if abs(really - asked) > coil.tolerance:
            coil.saturated += 1
            if coil.saturated == 1:
                self._notices.append(Notice(
                    Kind.SATURATED, i, f'{coil.instrument.name} was asked for {asked:g} T '
                    f'and set {really:g} T, and moves will not end where they should: lower '
                    'flux_density_max of the planner and flux_density_limit of the driver to '
                    'what the amplifier gives'))
        self._set(i, when, asked, really)

    def _set(self, i: int, when: int, asked: float, level: float) -> None:
        """Note the level that is in force from a time in ns on; NaN if it is not known."""
        if self._coils[i].set(when, asked, level):
            self._changes.append(Change(i, when, level))

    def _lose(self, i: int, error: StateLostError) -> None:
        """Take in that hardware has lost its state; it must obey again, or has failed."""
        coil = self._coils[i]
        coil.lost += 1
        why = f' ({error})' if str(error) else ''
        self._notices.append(Notice(
            Kind.LOST, i, f'{coil.instrument.name} has lost its state{why} and its coil is off: '
            'what was commanded is forgotten, send a new request'))
        self._set(i, self._time, 0.0, 0.0)
        coil.clear()
        coil.repeat = coil.armed = False
        self.cut_off(i, self._time)
        try:
            coil.synchronise()
            when, level = coil.instrument.write(0.0, self._time)
        except StateLostError as again:
            raise HardwareError(
                f'{coil.instrument.name} lost its state twice in a row') from again
        self._set(i, when, 0.0, level)

    # -- the interlock -------------------------------------------------------------------------

    def lock(self, why: str, time: int) -> None:
        """
        Switch all coils off at a time in ns, or ramp them down, and refuse commands from then on.

        Afterwards a joint obeys 0 T first: what was under way does not go on. An empty reason
        ends it.

        Raises
        ------
        HardwareError
            If a call fails.

        """
        begins = bool(why) and not self.locked
        self.locked = why
        if not begins:
            return
        self._pass_to(time)
        for i, coil in enumerate(self._coils):
            left = coil.level if self._watchdogs[i].ramps and math.isfinite(coil.level) else 0.0
            coil.clear()
            coil.repeat = False
            self._watchdogs[i].disarm()
            self._cut_offs[i].begin(time, zero_first=True)
            if left:
                self._watchdogs[i].ramp_down(time, left)
            # That drops what the device keeps, too.
            try:
                self._write(i, left)
            except StateLostError as error:
                self._lose(i, error)

    def _read(self) -> None:
        """Take what is new; readings of several joints with one stamp are one sample."""
        found: dict[int, dict[int, tuple[float, float]]] = {}
        for i, coil in enumerate(self._coils):
            try:
                for x in coil.instrument.read(self._time):
                    stamp = self._time if x.stamp is None else x.stamp
                    found.setdefault(stamp, {})[i] = x.stretch, x.rate
            except StateLostError as error:
                self._lose(i, error)
        for stamp, values in sorted(found.items()):
            read = np.array([
                values.get(i, (math.nan, math.nan)) for i in range(len(self._coils))])
            self._samples.append(Sample(
                stamp, read[:, 0], read[:, 1], np.array([x.at(stamp) for x in self._coils])))

    # -- the end -------------------------------------------------------------------------------

    def switch_off(self, time: int) -> str:
        """Switch all coils off at a time in ns; return what could not be, in words."""
        self._pass_to(time)
        return '; '.join(filter(None, (
            self._switch_off(i) for i in range(len(self._coils)))))

    def _switch_off(self, i: int) -> str:
        coil = self._coils[i]
        coil.clear()
        try:
            try:
                self._write(i, 0.0)
            except StateLostError as error:
                self._lose(i, error)
            if coil.instrument.off(coil.level, coil.limit):
                coil.disarm()
                return ''
        except HardwareError as error:
            with suppress(HardwareError):
                coil.disarm()
            return str(error)
        return f'{coil.instrument.name}.write says that {coil.level:g} T are left'

    def open(self) -> None:
        """Have the hardware connect again, where it can."""
        for x in self._coils:
            x.instrument.open()

    def close(self) -> str:
        """Have the hardware end; return what has gone wrong, in words."""
        return '; '.join(filter(None, (_said(x.instrument.close) for x in self._coils)))

    def forget(self, joint: int, level: float) -> None:
        """Take a level in T, NaN for unknown, that somebody else has brought about."""
        self._set(joint, self._time, level, level)


def _said(act: Callable[[], None]) -> str:
    try:
        act()
    except HardwareError as error:
        return str(error)
    return ''
