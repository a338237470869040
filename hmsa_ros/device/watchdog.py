"""Devices, and their watchdogs: what a coil does when nobody commands it any more."""

from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
import math

from hmsa_ros.device.protocol import Change, Kind, Notice, Sample
from hmsa_ros.errors import BadInputError
from hmsa_ros.model.units import NANOSECONDS

#: What to do: keep the last level, go to zero at once, or ramp to zero.
SAFE_FLUX = ('hold', 'zero', 'ramp')
_REASONS = {
    'hold': 'what is commanded stays (safe_flux hold)', 'zero': 'the field goes to zero',
    'ramp': 'the field ramps to zero'}
_RAMP_STEP_NS = 1_000_000
# Levels of before a cut-off that are remembered.
_REMEMBERED = 8
#: Times that are further apart, in ns, are of clocks that began at different times.
ANOTHER_CLOCK = 100_000_000 * NANOSECONDS


@dataclass(frozen=True)
class Fallback:
    """
    What to do after a silence.

    Raises
    ------
    BadInputError
        If a value is out of range.

    """

    timeout: float = 1.0  #: longest silence in s; 0 for any
    safe_flux: str = 'hold'  #: one of `SAFE_FLUX`
    ramp_rate: float = 1.0  #: of a ramp to zero, in T/s, above 0

    def __post_init__(self) -> None:
        if not 0.0 <= self.timeout < math.inf:
            raise BadInputError(f'timeout is {self.timeout:g} s: expected at least 0')
        if self.safe_flux not in SAFE_FLUX:
            raise BadInputError(
                f'safe flux is {self.safe_flux!r}: expected one of {", ".join(SAFE_FLUX)}')
        if not 0.0 < self.ramp_rate < math.inf:
            raise BadInputError(f'ramp rate is {self.ramp_rate:g} T/s: expected above 0')


class Watchdog:
    """
    Notices that commands and heartbeats have ceased, and commands the safe flux then.

    Armed by the first command, so that an actuator nobody has moved yet raises no alarm. While
    the silence is too long it is ``tripped``; ``trips`` counts how often it was.
    """

    def __init__(self, fallback: Fallback) -> None:
        self._fallback = fallback
        self._timeout = round(fallback.timeout * NANOSECONDS)
        self._last: int | None = None
        # When it began, from which level, and how many of its levels were given.
        self._ramp: tuple[int, float] | None = None
        self._steps = 0
        self.tripped = False
        self.trips = 0

    @property
    def cuts_off(self) -> bool:
        """Whether the coil is off after an alarm."""
        return self._fallback.safe_flux != 'hold'

    @property
    def ramps(self) -> bool:
        """Whether the coil is to be ramped down rather than switched off."""
        return self._fallback.safe_flux == 'ramp'

    @property
    def alarm(self) -> str:
        """What to log when it trips."""
        return (f'no command and no heartbeat for {self._fallback.timeout:g} s: '
                f'{_REASONS[self._fallback.safe_flux]}; is the planner running?')

    def feed(self, now: int) -> bool:
        """Take a sign of life at a time in ns; return whether it ends an alarm."""
        recovered = self.tripped
        self.tripped = False
        self._ramp = None
        self._last = now
        return recovered

    def watch(self, now: int, until: int, level: float) -> Iterator[tuple[int, float]]:
        """Yield stamps (ns) and levels (T) of the safe flux once commands have ceased."""
        if self._trips(now):
            if self._fallback.safe_flux == 'zero':
                yield now, 0.0
            elif self.ramps:
                self.ramp_down(now, level)
        if self._ramp is None:
            return
        begin, level = self._ramp
        while (passed := self._steps * _RAMP_STEP_NS) <= until - begin:
            self._steps += 1
            left = abs(level) - self._fallback.ramp_rate * passed / NANOSECONDS
            yield begin + passed, math.copysign(max(left, 0.0), level)
            if left <= 0.0:
                self._ramp = None
                return

    def ramp_down(self, now: int, level: float) -> None:
        """Begin to ramp a level in T to zero at a time in ns."""
        self._ramp, self._steps = (now, level), 0

    def _trips(self, now: int) -> bool:
        if self._last is None or self.tripped or self._timeout == 0:
            return False
        self._last = min(self._last, now)
        if now - self._last <= self._timeout:
            return False
        self.tripped = True
        self.trips += 1
        return True

    @property
    def due(self) -> int | None:
        """When to `watch` next, in ns; None if there is nothing to watch."""
        if self._ramp is not None:
            return self._ramp[0] + self._steps * _RAMP_STEP_NS
        if self._last is None or self.tripped or self._timeout == 0:
            return None
        return self._last + self._timeout + 1

    def pass_over(self, span: int) -> None:
        """Leave out a span of time in ns, which was no silence."""
        if self._last is not None:
            self._last += span
        if self._ramp is not None:
            begin, level = self._ramp
            self._ramp = begin + span, level

    def disarm(self) -> None:
        """Wait for a first command again."""
        self._last = self._ramp = None
        self.tripped = False


class CutOff:
    """
    What a joint refuses after its coil was cut off: levels that were meant for before.

    Whoever was out of reach repeats its last level as soon as it is back, and what it sent in vain
    is sent again: either would put the field on in one step that nobody has asked for.
    """

    def __init__(self) -> None:
        self._before: deque[float] = deque(maxlen=_REMEMBERED)
        self._since: int | None = None
        self._zero_first = False

    @property
    def in_force(self) -> bool:
        """Whether levels are refused."""
        return self._since is not None

    def begin(self, now: int, *, zero_first: bool = False) -> None:
        """
        Refuse what was commanded before a time in ns, if anything was.

        If zero comes first, anything but 0 T is refused, whatever was commanded before.
        """
        if self._before or zero_first:
            self._since = now
            self._zero_first = self._zero_first or zero_first

    def clock_set(self, by: int) -> None:
        """Take in that the clock was set ahead by some ns."""
        if self._since is not None:
            self._since += by

    def end(self) -> None:
        """Forget it, and what was commanded."""
        self._since, self._zero_first = None, False
        self._before.clear()

    def refusal(self, stamp: int, level: float, now: int, current: float) -> str:
        """Return why a level in T from a stamp in ns on is refused now; empty if it is obeyed."""
        if self._since is None:
            self._remember(level)
            return ''
        if self._zero_first and (level or current):
            return (
                f'{level:g} T, and the interlock was opened '
                f'{(now - self._since) / NANOSECONDS:.3f} s ago: expected 0 T first, with the '
                'coil off')
        off = f'the coil was cut off {(now - self._since) / NANOSECONDS:.3f} s ago'
        if stamp and stamp < max(now, self._since):
            self._remember(level)
            return (f'{level:g} T applied {(now - stamp) / NANOSECONDS:.3f} s ago, and {off}: '
                    'expected a command for a time that has not passed')
        if level != current and level in self._before:
            return (f'{level:g} T was commanded before, and {off}: expected another level, or '
                    f'the one in force, {current:g} T, first')
        self.end()
        self._remember(level)
        return ''

    def _remember(self, level: float) -> None:
        if not self._before or level != self._before[-1]:
            self._before.append(level)


class Device(ABC):
    """
    Actuators with their amplifiers, sensors and watchdogs.

    Whoever drives it says what time it is, and collects what came of it: `changes`, `samples` and
    `notices` return what is new since they were last called, in the order in which it happened.
    """

    def __init__(self, fallbacks: Iterable[Fallback]) -> None:
        self._watchdogs = [Watchdog(x) for x in fallbacks]
        self._cut_offs = [CutOff() for _ in self._watchdogs]
        self._changes: list[Change] = []
        self._samples: list[Sample] = []
        self._notices: list[Notice] = []
        #: Why no command is obeyed; empty where they are.
        self.locked = ''

    @property
    @abstractmethod
    def time(self) -> int:
        """Time in ns that it has been advanced to."""

    @abstractmethod
    def receive(self, joint: int, stamp: int, level: float) -> None:
        """Take a level in T from a stamp in ns on (0: now), which supersedes all from then on."""

    @abstractmethod
    def advance(self, time: int) -> None:
        """Do what is due up to a time in ns."""

    def changes(self) -> list[Change]:
        """Return which levels took effect."""
        found, self._changes = self._changes, []
        return found

    def samples(self) -> list[Sample]:
        """Return what was measured."""
        found, self._samples = self._samples, []
        return found

    def notices(self) -> list[Notice]:
        """Return what there is to log."""
        found, self._notices = self._notices, []
        return found

    @property
    def silent(self) -> list[int]:
        """Joints that nobody commands any more."""
        return [i for i, x in enumerate(self._watchdogs) if x.tripped]

    @property
    def trips(self) -> int:
        """How often a joint fell silent."""
        return sum(x.trips for x in self._watchdogs)

    @property
    def cut_offs(self) -> list[int]:
        """Joints whose coil was cut off, and whose levels of before are refused."""
        return [i for i, x in enumerate(self._cut_offs) if x.in_force]

    def cut_off(self, joint: int, now: int) -> None:
        """From a time in ns on, refuse levels of before, since the coil is off or unknown."""
        self._cut_offs[joint].begin(now)

    def _refuses(self, joint: int, stamp: int, level: float, current: float) -> bool:
        """Return whether a level in T, other than the current one, is one of before a cut-off."""
        why = self._cut_offs[joint].refusal(stamp, level, self.time, current)
        if why:
            self._notices.append(Notice(Kind.REFUSED, joint, why))
        return bool(why)

    def _check_clock(self, stamp: int) -> None:
        """Refuse a stamp in ns of a clock that began at another time, before it is obeyed."""
        if stamp and self.time and abs(stamp - self.time) > ANOTHER_CLOCK:
            raise BadInputError(
                f'command has timestamp {stamp / NANOSECONDS:.3f} s, and the time is '
                f'{self.time / NANOSECONDS:.3f} s: expected one clock for both (use_sim_time the '
                'same on both sides, no time since a start beside the time of day)')

    def _feed(self, joint: int, now: int) -> None:
        """Take a sign of life at a time in ns."""
        if self._watchdogs[joint].feed(now):
            self._notices.append(Notice(Kind.HEARD, joint, 'commands have come back'))

    def _safe_levels(
            self, joint: int, now: int, until: int, level: float) -> Iterator[tuple[int, float]]:
        """Yield stamps (ns) and levels (T) of the safe flux, and note that a joint fell silent."""
        watchdog = self._watchdogs[joint]
        trips = watchdog.trips
        yield from watchdog.watch(now, until, level)
        if watchdog.trips > trips:
            if watchdog.cuts_off:
                self.cut_off(joint, now)
            self._notices.append(Notice(Kind.SILENT, joint, watchdog.alarm))

    def _note_late(self, joint: int, late: int) -> None:
        """Note that a command came some ns after its stamp."""
        self._notices.append(Notice(
            Kind.LATE, joint, f'command arrived {late / 1e6:.3f} ms after the time it applies and '
            'was applied at once: raise lead_time of the planner', late))
