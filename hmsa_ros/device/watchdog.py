"""Devices, and what guards their joints: watchdogs, and what is refused after a cut-off."""

from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
import math
from typing import TypeVar

from hmsa_ros.device.protocol import Change, Kind, Notice, Sample
from hmsa_ros.errors import BadInputError
from hmsa_ros.model.units import NANOSECONDS

T = TypeVar('T')

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


class GuardedJoint:
    """
    What a coil does when nobody commands it any more, and what is refused after it was cut off.

    Its watchdog notices that commands and heartbeats have ceased, and commands the safe flux then.
    It is armed by the first command, so that an actuator nobody has moved yet raises no alarm.
    While the silence is too long it is ``tripped``; ``trips`` counts how often it was.

    After a cut-off, levels that were meant for before are refused. Whoever was out of reach
    repeats its last level as soon as it is back, and what it sent in vain is sent again: either
    would put the field on in one step that nobody has asked for.

    What there is to log is appended to ``notices``, with the ``number`` of the joint.
    """

    def __init__(self, number: int, fallback: Fallback, notices: deque[Notice]) -> None:
        self.number, self._fallback, self._notices = number, fallback, notices
        self._timeout = round(fallback.timeout * NANOSECONDS)
        self._last: int | None = None
        # When it began, from which level, and how many of its levels were given.
        self._ramp: tuple[int, float] | None = None
        self._steps = 0
        self.tripped = False
        self.trips = 0
        # What was commanded, and since when that is refused.
        self._before: deque[float] = deque(maxlen=_REMEMBERED)
        self._since: int | None = None
        self._zero_first = False

    def note(self, kind: Kind, text: str, late: int = 0) -> None:
        """Note something to log; ``late`` is a lateness in ns."""
        self._notices.append(Notice(kind, self.number, text, late))

    def note_late(self, late: int) -> None:
        """Note that a command came some ns after its stamp."""
        self.note(
            Kind.LATE, f'command arrived {late / 1e6:.3f} ms after the time it applies and was '
            'applied at once: raise lead_time of the planner', late)

    def pass_over(self, span: int) -> None:
        """Leave out a span of time in ns, which was no silence."""
        if self._last is not None:
            self._last += span
        if self._ramp is not None:
            begin, level = self._ramp
            self._ramp = begin + span, level
        if self._since is not None:
            self._since += span

    # -- the watchdog --------------------------------------------------------------------------

    @property
    def ramps(self) -> bool:
        """Whether the coil is to be ramped down rather than switched off."""
        return self._fallback.safe_flux == 'ramp'

    def feed(self, now: int) -> None:
        """Take a sign of life at a time in ns."""
        if self.tripped:
            self.note(Kind.HEARD, 'commands have come back')
        self.tripped = False
        self._ramp = None
        self._last = now

    def watch(self, now: int, until: int, level: float) -> Iterator[tuple[int, float]]:
        """Yield stamps (ns) and levels (T) of the safe flux once commands have ceased."""
        if self._last is not None:
            self._last = min(self._last, now)
        if self._alarm is not None and now >= self._alarm:
            self.tripped = True
            self.trips += 1
            safe = self._fallback.safe_flux
            self.note(
                Kind.SILENT, f'no command and no heartbeat for {self._fallback.timeout:g} s: '
                f'{_REASONS[safe]}; is the planner running?')
            if safe != 'hold':
                self.cut_off(now)
            if safe == 'zero':
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

    @property
    def watch_due(self) -> int | None:
        """When to `watch` next, in ns; None if there is nothing to watch."""
        return self._alarm if self._ramp is None else (
            self._ramp[0] + self._steps * _RAMP_STEP_NS)

    @property
    def _alarm(self) -> int | None:
        """When the silence will be too long, in ns; None where none is."""
        if self._last is None or self.tripped or self._timeout == 0:
            return None
        return self._last + self._timeout + 1

    def stand_by(self) -> None:
        """Wait for a first command again."""
        self._last = self._ramp = None
        self.tripped = False

    # -- after a cut-off -----------------------------------------------------------------------

    @property
    def is_cut_off(self) -> bool:
        """Whether levels of before are refused."""
        return self._since is not None

    def cut_off(self, now: int, *, zero_first: bool = False) -> None:
        """
        Refuse what was commanded before a time in ns, if anything was.

        If zero comes first, anything but 0 T is refused, whatever was commanded before.
        """
        if self._before or zero_first:
            self._since = now
            self._zero_first = self._zero_first or zero_first

    def end_cut_off(self) -> None:
        """Forget it, and what was commanded."""
        self._since, self._zero_first = None, False
        self._before.clear()

    def refuses(self, stamp: int, level: float, now: int, current: float) -> bool:
        """Return whether a level in T, other than the current one, is one of before a cut-off."""
        if self._since is not None:
            why, ago = '', (now - self._since) / NANOSECONDS
            if self._zero_first and (level or current):
                why = (f'{level:g} T, and the interlock was opened {ago:.3f} s ago: expected 0 T '
                       'first, with the coil off')
            elif stamp and stamp < max(now, self._since):
                self._remember(level)
                why = (f'{level:g} T applied {(now - stamp) / NANOSECONDS:.3f} s ago, and the '
                       f'coil was cut off {ago:.3f} s ago: expected a command for a time that '
                       'has not passed')
            elif level != current and level in self._before:
                why = (f'{level:g} T was commanded before, and the coil was cut off {ago:.3f} s '
                       f'ago: expected another level, or the one in force, {current:g} T, first')
            if why:
                self.note(Kind.REFUSED, why)
                return True
            self.end_cut_off()
        self._remember(level)
        return False

    def _remember(self, level: float) -> None:
        if not self._before or level != self._before[-1]:
            self._before.append(level)


class Device(ABC):
    """
    Actuators with their amplifiers, sensors and watchdogs.

    Whoever drives it says what time it is, and collects what came of it, also in another thread:
    `changes`, `samples` and `notices` return what is new since they were last called, in the order
    in which it happened.
    """

    guards: Sequence[GuardedJoint]  # of each joint

    def __init__(self) -> None:
        self._changes: deque[Change] = deque()
        self._samples: deque[Sample] = deque()
        self._notices: deque[Notice] = deque()
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
        return _emptied(self._changes)

    def samples(self) -> list[Sample]:
        """Return what was measured."""
        return _emptied(self._samples)

    def notices(self) -> list[Notice]:
        """Return what there is to log."""
        return _emptied(self._notices)

    @property
    def silent(self) -> list[int]:
        """Joints that nobody commands any more."""
        return [x.number for x in self.guards if x.tripped]

    @property
    def trips(self) -> int:
        """How often a joint fell silent."""
        return sum(x.trips for x in self.guards)

    @property
    def cut_offs(self) -> list[int]:
        """Joints whose coil was cut off, and whose levels of before are refused."""
        return [x.number for x in self.guards if x.is_cut_off]

    def _check_clock(self, stamp: int) -> None:
        """Refuse a stamp in ns of a clock that began at another time, before it is obeyed."""
        if stamp and self.time and abs(stamp - self.time) > ANOTHER_CLOCK:
            raise BadInputError(
                f'command has timestamp {stamp / NANOSECONDS:.3f} s, and the time is '
                f'{self.time / NANOSECONDS:.3f} s: expected one clock for both (use_sim_time the '
                'same on both sides, no time since a start beside the time of day)')


def _emptied(queue: deque[T]) -> list[T]:
    """Return what is in a queue, which another thread may be filling."""
    return [queue.popleft() for _ in range(len(queue))]
