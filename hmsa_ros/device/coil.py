"""What a driver knows of one coil: levels ahead, handed over, in force, and in the past."""

from bisect import bisect_right
from collections import deque
from collections.abc import Callable
import math

from hmsa_ros.device.clock_map import ENOUGH
from hmsa_ros.device.hardware import Calls, Hardware, HardwareError, Instrument
from hmsa_ros.errors import BadInputError
from hmsa_ros.model.schedule import CommandSchedule
from hmsa_ros.model.units import NANOSECONDS

# Of the levels that took effect last, which tell at what level an older sample was taken.
_REMEMBERED = 64
# In ns: between questions for the time and temperature of a device, and for what it has applied.
_ASK, _POLL = NANOSECONDS // 4, NANOSECONDS // 200
# By how many degrees a coil that was too warm must be below its limit.
_COOLER = 5.0


class Coil:
    """
    What is known of a coil; NaN where a level in T is not known.

    Parameters
    ----------
    hardware : Hardware
        What writes and reads.
    name : str
        Of its joint, for sentences.
    limit : float
        Largest level in T; that of the hardware counts if it is smaller.
    calls : Calls
        What is told of each call.
    clock : callable
        Returns the time of this host in ns.
    hottest : float
        Temperature in degrees Celsius above which the coil is to be off.

    Raises
    ------
    BadInputError
        If the hardware is not as `Hardware` says, or has no temperature to be limited.
    HardwareError
        If it does not answer what time it has.

    """

    def __init__(
            self, hardware: Hardware, name: str, limit: float, calls: Calls,
            clock: Callable[[], int], hottest: float = math.inf) -> None:
        self.name = name
        self.instrument = Instrument(hardware, name, calls)
        if hottest != math.inf and not self.instrument.has('temperature'):
            raise BadInputError(
                f'temperature_limit of joint {name} is {hottest:g}, and {self.instrument.name} '
                'reports no temperature: expected 0 for no limit, or a class with temperature()')
        self.temperature, self._hottest = math.nan, hottest
        self.too_warm = ''  # why the coil is to be off
        self.limit = min(limit, self.instrument.limit or math.inf)
        self.tolerance = self.instrument.tolerance(self.limit)
        self.heard: int | None = None  # when, in ns, since the watchdog was last looked at
        self.repeat = False  # whether a sign of life is to be passed on
        self.armed = False
        self.asked = self.level = math.nan
        self.saturated = self.lost = 0
        self._history: deque[tuple[int, float]] = deque(maxlen=_REMEMBERED)
        self._clock, self._patience = clock, round(calls.limit * NANOSECONDS)
        self.clear()
        self._next_question: int | None = None
        self.synchronise()

    def clear(self) -> None:
        """Forget what is ahead: the level is to be 0."""
        self.schedule = CommandSchedule(0.0)
        self.wanted = False  # whether it was to be on since then
        # What the device keeps, and what of it is due and not yet said to be applied.
        self._handed: deque[tuple[int, float]] = deque()
        self._awaited: deque[tuple[int, float]] = deque()
        # From when on what it keeps is not what is ahead.
        self._changed: int | None = None

    def clock_set(self, by: int) -> None:
        """Take in that the clock of this host was set ahead by some ns."""
        self.schedule.shift(by)
        self._history, self._handed, self._awaited = (
            deque(((x + by, level) for x, level in times), times.maxlen)
            for times in (self._history, self._handed, self._awaited))
        if self.heard is not None:
            self.heard += by
        if self._changed is not None:
            self._changed += by
        if self._next_question is not None:
            self._next_question += by
        if self.instrument.clock_map is not None:
            self.instrument.clock_map.host_set(by)

    # -- levels in force -----------------------------------------------------------------------

    def set(self, when: int, asked: float, level: float) -> bool:
        """
        Record the level in force from a time on, and the requested one.

        Parameters
        ----------
        when : int
            Time in ns.
        asked : float
            Requested level in T.
        level : float
            Level in force in T, NaN if unknown.

        Returns
        -------
        bool
            Whether that is news.

        """
        known = not math.isnan(level)
        news = asked != self.asked and (known or not math.isnan(self.level)) or (
            abs(level - self.level) > self.tolerance)
        if news:
            self._history.append((when, level))
            self.level = level
        self.asked = asked
        return news

    def at(self, stamp: int) -> float:
        """Return the level that was in force at a time in ns."""
        known = bisect_right(self._history, stamp, key=lambda x: x[0])
        return self._history[known - 1][1] if known else math.nan

    # -- levels ahead --------------------------------------------------------------------------

    def insert(self, stamp: int, level: float) -> bool:
        """Take a level in T from a stamp in ns on; return whether anything is different."""
        changed = self.schedule.insert(stamp, level)
        if changed and self.instrument.keeps_levels:
            self._changed = stamp if self._changed is None else min(stamp, self._changed)
        return changed

    @property
    def next_level(self) -> int | None:
        """Stamp in ns of the next level that is to be written; None if there is none."""
        return None if self.instrument.keeps_levels else self.schedule.next_stamp

    def due(self, now: int) -> int | None:
        """Return when there is something to do with what the device keeps, or its clock."""
        times = [self._next_question]
        if self.instrument.keeps_levels:
            times += [self.schedule.next_stamp, now + _POLL if self._awaited else None]
            if self._changed is not None and self._room:
                times.append(now)
        return min((x for x in times if x is not None), default=None)

    @property
    def _room(self) -> int | None:
        """How many levels the device still takes; None for any number."""
        capacity = self.instrument.capacity
        return None if capacity is None else max(capacity - len(self._handed), 0)

    def hand_over(self, now: int) -> None:
        """
        Have the device keep what has changed of the levels ahead.

        Raises
        ------
        HardwareError
            If it fails; StateLostError if it has lost its state.

        """
        if self._changed is None or self._changed <= now and not self.schedule.next_stamp:
            self._changed = None
            return
        since = max(self._changed, now + 1)
        kept = [x for x in self._handed if x[0] < since]
        capacity = self.instrument.capacity
        levels = self.schedule.ahead(since)
        if not levels or levels[0][0] > since:
            # What it has from here on goes, too.
            levels.insert(0, (since, self.schedule.at(since)))
        room = len(levels) if capacity is None else max(capacity - len(kept), 0)
        if room or not self._handed or len(kept) < len(self._handed):
            given = levels[:max(room, 1)]
            self.instrument.schedule(given)
            self._handed = deque([*kept, *given])
            levels = levels[len(given):]
        self._changed = levels[0][0] if levels else None

    def pass_to(self, now: int) -> list[tuple[int, float, float]]:
        """
        Return what the device has applied by a time in ns: when, the level asked and the one set.

        Raises
        ------
        HardwareError
            If it fails, or does not say what it has applied; StateLostError if it has lost its
            state.

        """
        due = []
        while self._handed and self._handed[0][0] <= now:
            due.append(self._handed.popleft())
        if not self.instrument.has('applied'):
            return [(stamp, level, level) for stamp, level in due]
        self._awaited.extend(due)
        if not self._awaited:
            return []
        found = []
        for when, level in self.instrument.applied(now):
            # A device that is slow to answer has gone on meanwhile.
            queue = self._awaited or self._handed
            stamp, asked = queue.popleft() if queue else (when, level)
            self.schedule.apply_until(stamp)
            found.append((when, asked, level))
        if self._awaited and now - self._awaited[0][0] > self._patience:
            stamp, level = self._awaited[0]
            raise HardwareError(
                f'{self.instrument.name}.applied does not say that {level:g} T took effect, '
                f'{(now - stamp) / NANOSECONDS:.3f} s after its time: expected that within '
                'hardware.timeout')
        return found

    @property
    def stands(self) -> bool:
        """Whether the level that is to be in force is so, or on its way."""
        return self.schedule.current == (self._awaited[-1][1] if self._awaited else self.asked)

    def superseded(self) -> None:
        """Take in that a write has dropped what the device kept."""
        self._handed.clear()
        self._awaited.clear()
        if self.instrument.keeps_levels:
            self._changed = self.schedule.next_stamp

    def disarm(self) -> None:
        """
        Have the device disarmed, if it is armed.

        Raises
        ------
        HardwareError
            If it fails.

        """
        armed, self.armed = self.armed, False
        if armed:
            self.instrument.disarm()

    # -- the device's clock --------------------------------------------------------------------

    def synchronise(self) -> None:
        """
        Learn the time of the device anew, where it has a clock.

        Raises
        ------
        HardwareError
            If it fails; StateLostError if it has lost its state.

        """
        if self.instrument.clock_map is not None:
            self.instrument.forget_clock()
            for _ in range(ENOUGH):
                self.instrument.ask_clock(self._clock)
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

    def ask(self, now: int) -> bool:
        """
        Ask for time and temperature if that is due; return whether the clock is the same.

        Raises
        ------
        HardwareError
            If it fails; StateLostError if it has lost its state.

        """
        if self._next_question is None:
            return True
        # Sooner than planned where the clock of the host was set back.
        if now < self._next_question <= now + _ASK:
            return True
        self._next_question = now + _ASK
        self._feel()
        return self.instrument.ask_clock(self._clock)
