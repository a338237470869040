"""Devices, and their watchdogs: what a coil does when nobody commands it any more."""

from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
import math

from hmsa_ros.core.units import NANOSECONDS
from hmsa_ros.device.protocol import Change, Kind, Notice, Sample
from hmsa_ros.errors import BadInputError

#: What to do: keep the last level, go to zero at once, or ramp to zero.
SAFE_FLUX = ('hold', 'zero', 'ramp')
_REASONS = {
    'hold': 'what is commanded stays (safe_flux hold)', 'zero': 'the field goes to zero',
    'ramp': 'the field ramps to zero'}
_RAMP_STEP_NS = 1_000_000


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
        self._ramp: tuple[int, float] | None = None
        self.tripped = False
        self.trips = 0

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
            elif self._fallback.safe_flux == 'ramp':
                self._ramp = now, level
        if self._ramp is None:
            return
        begin, level = self._ramp
        for step in range(-(-(now - begin) // _RAMP_STEP_NS),
                          (until - begin) // _RAMP_STEP_NS + 1):
            passed = step * _RAMP_STEP_NS
            left = abs(level) - self._fallback.ramp_rate * passed / NANOSECONDS
            yield begin + passed, math.copysign(max(left, 0.0), level)
            if left <= 0.0:
                self._ramp = None
                return

    def _trips(self, now: int) -> bool:
        if self._last is None or self.tripped or self._timeout == 0:
            return False
        self._last = min(self._last, now)
        if now - self._last <= self._timeout:
            return False
        self.tripped = True
        self.trips += 1
        return True

    def due(self, now: int) -> int | None:
        """Return when to `watch` next, in ns; None if there is nothing to watch."""
        if self._ramp is not None:
            return now + _RAMP_STEP_NS
        if self._last is None or self.tripped or self._timeout == 0:
            return None
        return self._last + self._timeout + 1

    def pass_over(self, span: int) -> None:
        """Leave out a span of time in ns, which was no silence."""
        if self._last is not None:
            self._last += span

    def disarm(self) -> None:
        """Wait for a first command again."""
        self._last = self._ramp = None
        self.tripped = False


class Device(ABC):
    """
    Actuators with their amplifiers, sensors and watchdogs.

    Whoever drives it says what time it is, and collects what came of it: `changes`, `samples` and
    `notices` return what is new since they were last called, in the order in which it happened.
    """

    def __init__(self, fallbacks: Iterable[Fallback]) -> None:
        self._watchdogs = [Watchdog(x) for x in fallbacks]
        self._changes: list[Change] = []
        self._samples: list[Sample] = []
        self._notices: list[Notice] = []

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
            self._notices.append(Notice(Kind.SILENT, joint, watchdog.alarm))

    def _note_late(self, joint: int, late: int) -> None:
        """Note that a command came some ns after its stamp."""
        self._notices.append(Notice(
            Kind.LATE, joint, f'command arrived {late / 1e6:.3f} ms after the time it applies and '
            'was applied at once: raise lead_time of the planner', late))
