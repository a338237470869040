"""Devices and guards of their joints: watchdogs, and rejected commands after a cut-off."""

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

#: Reactions to silence: keep the last level, go to zero immediately, or ramp to zero.
SAFE_FLUX = ('hold', 'zero', 'ramp')
_REASONS = {
    'hold': 'what is commanded stays (safe_flux hold)', 'zero': 'the field goes to zero',
    'ramp': 'the field ramps to zero'}
_RAMP_STEP_NS = 1_000_000
# Number of levels from before a cut-off that are stored.
_REMEMBERED = 8
#: Times that differ by more, in ns, come from clocks with different epochs.
ANOTHER_CLOCK = 100_000_000 * NANOSECONDS


@dataclass(frozen=True)
class Fallback:
    """
    Reaction to silence.

    Raises
    ------
    BadInputError
        If a value is out of range.

    """

    timeout: float = 1.0  #: longest silence in s; 0 for unlimited
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
    Guard of a coil: its watchdog, and the rejection of commands after a cut-off.

    The watchdog detects that commands and heartbeats have stopped, and then commands the safe
    flux. The first command arms it, so that an actuator without commands raises no alarm. During
    an excessive silence it is ``tripped``; ``trips`` counts these silences.

    After a cut-off, levels that were commanded before are rejected. A commander that was
    disconnected repeats its last level as soon as it is back, and lost messages are sent again:
    either would switch the field on in one unrequested step.

    Notices to log are appended to ``notices``, with the ``number`` of the joint.
    """

    def __init__(self, number: int, fallback: Fallback, notices: deque[Notice]) -> None:
        self.number, self._fallback, self._notices = number, fallback, notices
        self._timeout = round(fallback.timeout * NANOSECONDS)
        self._last: int | None = None
        # Begin and initial level of the ramp, and number of its levels already given.
        self._ramp: tuple[int, float] | None = None
        self._steps = 0
        self.tripped = False
        self.trips = 0
        # Commanded levels, and the time of the cut-off since which they are rejected.
        self._before: deque[float] = deque(maxlen=_REMEMBERED)
        self._since: int | None = None
        self._zero_first = False

    def note(self, kind: Kind, text: str, late: int = 0) -> None:
        """Add a notice to log; ``late`` is a lateness in ns."""
        self._notices.append(Notice(kind, self.number, text, late))

    def note_late(self, late: int) -> None:
        """Add a notice of a command that arrived some ns after its timestamp."""
        self.note(
            Kind.LATE, f'command arrived {late / 1e6:.3f} ms after the time it applies and was '
            'applied at once: raise lead_time of the planner', late)

    def pass_over(self, span: int) -> None:
        """Exclude a duration in ns from any silence."""
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
        """Whether to ramp the coil down rather than switch it off."""
        return self._fallback.safe_flux == 'ramp'

    def feed(self, now: int) -> None:
        """Record a command or heartbeat at a time in ns."""
        if self.tripped:
            self.note(Kind.HEARD, 'commands have come back')
        self.tripped = False
        self._ramp = None
        self._last = now

    def watch(self, now: int, until: int, level: float) -> Iterator[tuple[int, float]]:
        """Yield timestamps (ns) and levels (T) of the safe flux once commands have stopped."""
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
        """Start to ramp a level in T to zero at a time in ns."""
        self._ramp, self._steps = (now, level), 0

    @property
    def watch_due(self) -> int | None:
        """Time in ns of the next `watch`; None if there is nothing to watch."""
        return self._alarm if self._ramp is None else (
            self._ramp[0] + self._steps * _RAMP_STEP_NS)

    @property
    def _alarm(self) -> int | None:
        """Time in ns at which the silence becomes excessive; None if disarmed or tripped."""
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
        """Whether levels from before a cut-off are rejected."""
        return self._since is not None

    def cut_off(self, now: int, *, zero_first: bool = False) -> None:
        """
        Reject levels commanded before a time in ns, if there are any.

        With ``zero_first``, reject all levels except 0 T, regardless of earlier commands.
        """
        if self._before or zero_first:
            self._since = now
            self._zero_first = self._zero_first or zero_first

    def end_cut_off(self) -> None:
        """End the rejection, and discard the stored levels."""
        self._since, self._zero_first = None, False
        self._before.clear()

    def refuses(self, stamp: int, level: float, now: int, current: float) -> bool:
        """Return whether a level in T, other than the current one, is rejected after a cut-off."""
        if self._since is not None:
            why, ago = '', (now - self._since) / NANOSECONDS
            if self._zero_first and (level or current):
                why = (f'{level:g} T, and an open interlock or a failure switched the coil off '
                       f'{ago:.3f} s ago: expected 0 T first, with the coil off')
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

    The caller supplies the time and collects the results, also from another thread: `changes`,
    `samples` and `notices` return new items since their last call in chronological order.
    """

    guards: Sequence[GuardedJoint]  # one for each joint

    def __init__(self) -> None:
        self._changes: deque[Change] = deque()
        self._samples: deque[Sample] = deque()
        self._notices: deque[Notice] = deque()
        #: Why commands are rejected; empty if they are accepted.
        self.locked = ''

    @property
    @abstractmethod
    def time(self) -> int:
        """Time in ns that the device has been advanced to."""

    @abstractmethod
    def receive(self, joint: int, stamp: int, level: float) -> None:
        """Accept a level in T from a timestamp in ns on (0: now); it replaces all later ones."""

    @abstractmethod
    def advance(self, time: int) -> None:
        """Do the work due up to a time in ns."""

    def changes(self) -> list[Change]:
        """Return the levels that took effect since the last call."""
        return _emptied(self._changes)

    def samples(self) -> list[Sample]:
        """Return the samples since the last call."""
        return _emptied(self._samples)

    def notices(self) -> list[Notice]:
        """Return the notices to log since the last call."""
        return _emptied(self._notices)

    @property
    def silent(self) -> list[int]:
        """Numbers of the joints whose commands have stopped."""
        return [x.number for x in self.guards if x.tripped]

    @property
    def trips(self) -> int:
        """Number of excessive silences, summed over the joints."""
        return sum(x.trips for x in self.guards)

    @property
    def cut_offs(self) -> list[int]:
        """Numbers of the joints that reject levels from before a cut-off."""
        return [x.number for x in self.guards if x.is_cut_off]

    def _check_clock(self, stamp: int) -> None:
        """Refuse a timestamp in ns of a clock with a different epoch."""
        if stamp and self.time and abs(stamp - self.time) > ANOTHER_CLOCK:
            raise BadInputError(
                f'command has timestamp {stamp / NANOSECONDS:.3f} s, and the time is '
                f'{self.time / NANOSECONDS:.3f} s: expected one clock for both (use_sim_time the '
                'same on both sides, no time since a start beside the time of day)')


def _emptied(queue: deque[T]) -> list[T]:
    """Empty a queue, which another thread may be filling, and return its items."""
    return [queue.popleft() for _ in range(len(queue))]
