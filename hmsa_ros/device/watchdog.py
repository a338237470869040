"""Devices and what guards them: watchdogs, commands that are rejected, and an interlock."""

from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass
from enum import Enum
import math
from typing import NamedTuple, TypeVar

from hmsa.errors import BadInputError, check_choice, check_number, listed
from hmsa.model.sensor import Sample
from hmsa.model.units import NANOSECONDS

T = TypeVar('T')

#: Reactions to silence: keep the last level, go to zero immediately, or ramp to zero.
SAFE_FLUX = ('hold', 'zero', 'ramp')
_REASONS = {
    'hold': 'what is commanded stays (safe_flux hold)', 'zero': 'the field goes to zero',
    'ramp': 'the field ramps to zero'}
_RAMP_STEP_NS = 1_000_000
# Number of commands far ahead whose times are stored: an hour of heartbeats.
_REMEMBERED = 10_000
#: Times that differ by more, in ns, come from clocks with different epochs.
ANOTHER_CLOCK = 100_000_000 * NANOSECONDS
# Minimum time open in ns, for planners to receive that state or to stop sending.
_LEAST = NANOSECONDS

_OK, _WARN, _ERROR = 0, 1, 2


class StateLostError(Exception):
    """
    Raised by ``write`` or ``read`` of hardware that has lost its state, such as a rebooted board.

    Its coil is off then, and all earlier commands are discarded.
    """


class Change(NamedTuple):
    """A level in T that took effect on a joint at a time in ns; NaN if unknown."""

    joint: int
    stamp: int
    level: float


class Kind(Enum):
    """Subject of a notice."""

    LATE = 'late'
    SILENT = 'silent'
    HEARD = 'heard'
    REFUSED = 'refused'
    FAILED = 'failed'
    SATURATED = 'saturated'
    LOST = 'lost'
    CLOCK = 'clock'


class Notice(NamedTuple):
    """A message to log; ``late`` is a lateness in ns."""

    kind: Kind
    joint: int
    text: str
    late: int = 0


@dataclass(frozen=True)
class Fallback:
    """
    Reaction to silence, and to commands that come too late.

    Raises
    ------
    BadInputError
        If a value is out of range.

    """

    timeout: float = 1.0  #: longest silence in s; 0 for unlimited
    safe_flux: str = 'hold'  #: one of `SAFE_FLUX`
    ramp_rate: float = 1.0  #: of a ramp to zero, in T/s, above 0
    lateness_limit: float = math.inf  #: lateness in s above which a command is rejected, above 0

    def __post_init__(self) -> None:
        check_number('timeout', self.timeout, 's', least=0.0)
        check_choice('safe flux', self.safe_flux, SAFE_FLUX)
        check_number('ramp rate', self.ramp_rate, 'T/s', above=0.0)
        check_number('lateness limit', self.lateness_limit, 's', above=0.0, endless=True)


class GuardedJoint:
    """
    Guard of a coil: its watchdog, and the rejection of commands that no longer apply.

    The watchdog detects that no command or heartbeat applies any more, and then commands the safe
    flux. A command feeds it once its timestamp is at most the timeout ahead, so that those of a
    commander whose clock differs do not keep a coil on. The first command arms it, so that an
    actuator without commands raises no alarm. During an excessive silence it is ``tripped``;
    ``trips`` counts these silences.

    After a cut-off, every level is rejected, whatever its timestamp: it may have been planned
    before. A commander shows that it knows of the cut-off by commanding 0 T either from exactly
    that time on (`cut_off_time`, as in receipts) or immediately (timestamp 0). This also replaces
    all that it commanded before.

    Notices to log are appended to ``notices``, with the ``number`` of the joint.
    """

    def __init__(self, number: int, fallback: Fallback, notices: deque[Notice]) -> None:
        self.number, self._fallback, self._notices = number, fallback, notices
        self._timeout = round(fallback.timeout * NANOSECONDS)
        self._last: int | None = None
        # Timestamps of commands that are too far ahead to feed the watchdog, rising.
        self._ahead: deque[int] = deque()
        self._stray = ''  # what is wrong with the commands that have not fed the watchdog
        self._stood = 0  # time in ns for which this process stood still, if too long
        # Begin and initial level of the ramp, and number of its levels already given.
        self._ramp: tuple[int, float] | None = None
        self._steps = 0
        self.tripped = False
        self.trips = 0
        self._obeyed = False  # whether a command was accepted since the last restart
        # Time of the cut-off since which levels are rejected, by the clock of now.
        self._since: int | None = None
        #: Time in ns that names the cut-off in force; 0 for none.
        self.cut_off_time = 0
        self._acknowledged = 0  # the last one that was acknowledged
        self._newest: int | None = None  # timestamp of the newest command
        #: Timestamp in ns of the newest command if it was too late and takes no effect; else None.
        self.too_late: int | None = None

    def note(self, kind: Kind, text: str, late: int = 0) -> None:
        """Add a notice to log; ``late`` is a lateness in ns."""
        self._notices.append(Notice(kind, self.number, text, late))

    def note_late(self, late: int) -> None:
        """Add a notice of a command that arrived some ns after its timestamp."""
        self.note(
            Kind.LATE, f'command arrived {late / 1e6:.3f} ms after its timestamp and was '
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

    def clock_set(self, by: int) -> None:
        """Shift all times by the ns that the clock was set ahead."""
        self.pass_over(by)
        self._ahead = deque(x + by for x in self._ahead)

    # -- the watchdog --------------------------------------------------------------------------

    @property
    def ramps(self) -> bool:
        """Whether to ramp the coil down rather than switch it off."""
        return self._fallback.safe_flux == 'ramp'

    def feed(self, now: int, stamp: int = 0) -> None:
        """Record a command or heartbeat for a timestamp in ns (0: now) that came at a time."""
        while self._ahead and self._ahead[-1] >= stamp:
            self._ahead.pop()
        if not self._timeout or stamp - now <= self._timeout:
            self._feed(now)
            return
        self._stray = f'the newest one applies in {(stamp - now) / NANOSECONDS:.3f} s'
        if len(self._ahead) < _REMEMBERED:
            self._ahead.append(stamp)

    def _feed(self, now: int) -> None:
        if self.tripped:
            self.note(Kind.HEARD, 'commands have come back')
        self.tripped = False
        self._ramp = None
        self._last = now
        self._stray = ''

    def set_back(self, now: int) -> None:
        """Have no command come later than now, which is earlier than before."""
        if self._last is not None:
            self._last = min(self._last, now)

    def stood_still(self, now: int, span: int) -> None:
        """Trip if this process stood still for some ns, longer than a planner may be silent."""
        if self._alarm is not None and span > self._timeout:
            self._last, self._stood = now - self._timeout - 1, span

    def watch(self, now: int, until: int, level: float) -> Iterator[tuple[int, float]]:
        """Yield timestamps (ns) and levels (T) of the safe flux once commands have stopped."""
        while self._ahead and self._ahead[0] - self._timeout <= now:
            self._feed(self._ahead.popleft() - self._timeout)
        if self._alarm is not None and now >= self._alarm:
            self.tripped = True
            self.trips += 1
            safe = self._fallback.safe_flux
            self.note(Kind.SILENT, self._why.format(
                limit=f'{self._fallback.timeout:g} s', reason=_REASONS[safe]))
            self._stood = 0
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

    @property
    def _why(self) -> str:
        """Why the watchdog trips, with places for its timeout and its reaction."""
        if self._stood:
            return (f'plant or driver stood still for {self._stood / NANOSECONDS:.3f} s, more '
                    'than {limit}: {reason}; let nothing stop or starve this process')
        if self._stray:
            return (f'no command and no heartbeat that applies ({self._stray}) for {{limit}}: '
                    '{reason}; compare the clocks of planner and driver')
        return 'no command and no heartbeat for {limit}: {reason}; is the planner running?'

    def ramp_down(self, now: int, level: float) -> None:
        """Start to ramp a level in T to zero at a time in ns."""
        self._ramp, self._steps = (now, level), 0

    @property
    def watch_due(self) -> int | None:
        """Time in ns of the next `watch`; None if there is nothing to watch."""
        if self._ramp is not None:
            return self._ramp[0] + self._steps * _RAMP_STEP_NS
        if self._ahead and self._last is None:
            return self._ahead[0] - self._timeout
        return self._alarm

    @property
    def _alarm(self) -> int | None:
        """Time in ns at which the silence becomes excessive; None if disarmed or tripped."""
        if self._last is None or self.tripped or self._timeout == 0:
            return None
        return self._last + self._timeout + 1

    def stand_by(self) -> None:
        """Wait for a first command again."""
        self._last = self._ramp = None
        self._ahead.clear()
        self.tripped = False

    # -- commands that no longer apply ---------------------------------------------------------

    @property
    def lateness_limit(self) -> float:
        """Lateness in ns above which a level is rejected."""
        return self._fallback.lateness_limit * NANOSECONDS

    @property
    def is_cut_off(self) -> bool:
        """Whether levels are rejected until a cut-off is acknowledged."""
        return self._since is not None

    def cut_off(self, now: int, *, always: bool = False) -> None:
        """
        Reject all levels from a time in ns until that is acknowledged.

        Without earlier commands, nothing is rejected unless ``always`` is set.
        """
        if self._obeyed or always:
            self._since = now
            self.cut_off_time = max(now, 1)
        self._ahead.clear()

    def end_cut_off(self) -> None:
        """End the rejection without an acknowledgement, as for a restart."""
        self._since, self.cut_off_time, self._obeyed = None, 0, False

    def refuses(self, stamp: int, level: float, now: int, current: float) -> bool:
        """Return whether a level in T is rejected: after a cut-off, or since it is too late."""
        late = now - stamp if stamp else 0
        self._newest, self.too_late = stamp, None
        if self._since is not None:
            if level or current or stamp not in (0, self.cut_off_time):
                ago = (now - self._since) / NANOSECONDS
                self.note(
                    Kind.REFUSED, f'{level:g} T, and the coil was cut off {ago:.3f} s ago: '
                    'expected 0 T first, with the coil off, and with the timestamp of the cut-off '
                    f'(time_ref of receipts, {self.cut_off_time / NANOSECONDS:.9f} s) or 0')
                return True
            self._acknowledged = self.cut_off_time
            self._since, self.cut_off_time = None, 0
        elif late > self.lateness_limit and not (
                stamp == self._acknowledged and level == current == 0.0):
            self._stray = f'the newest one came {late / NANOSECONDS:.3f} s late'
            self.too_late = stamp
            self.note(
                Kind.REFUSED,
                f'{level:g} T arrived {late / NANOSECONDS:.3f} s after its timestamp: expected '
                f'at most {self._fallback.lateness_limit:g} s (lateness_limit); the '
                'planner plans the rest again; raise its lead_time, or compare the clocks')
            return True
        self._obeyed = True
        return False


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
        #: Whether a command that was received is still to be processed.
        self.busy = False

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

    @abstractmethod
    def stood_still(self, span: int) -> None:
        """Record that this process stood still for some ns until now."""

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


class Interlock:
    """
    Combine the messages of publishers about an interlock; times in ns by a steady clock.

    It is open while the last message of any publisher opens it. If ``required``, it is also open
    until a publisher closes it, and after a publisher has been silent for longer than ``timeout``.
    An opening by a publisher that has left remains in force until another publisher newly closes
    the interlock.
    """

    def __init__(self, *, required: bool, timeout: int) -> None:
        self.required, self._timeout = required, timeout
        # State and time of the last message of each publisher.
        self._messages: dict[bytes, tuple[bool, int]] = {}
        self._until = 0
        self.why = ''  #: reason why it is open; empty while it is closed
        self.openings = 0

    def receive(
            self, publisher: bytes, now: int, *, closed: bool,
            present: Callable[[], Collection[bytes]]) -> None:
        """Process a message of a publisher; ``present`` returns those that have not left."""
        newly = closed and not self._messages.get(publisher, (False, 0))[0]
        self._messages[publisher] = closed, now
        if newly and not all(x for x, _ in self._messages.values()):
            here = present()
            self._messages = {x: y for x, y in self._messages.items() if y[0] or x in here}
        if not closed:
            # Also if it is closed again before the next look.
            self._open('a publisher has opened it', now)

    def look(self, now: int) -> str:
        """Return why it is open; empty if it is closed."""
        if self.required:
            for publisher, (closed, when) in self._messages.items():
                if closed and now - when > self._timeout:
                    self._messages[publisher] = False, when
                    self._open(
                        f'a publisher that closed it has been silent for more than '
                        f'{self._timeout / NANOSECONDS:g} s', now)
            if not self._messages:
                self._open('no publisher has closed it', now)
        if all(x for x, _ in self._messages.values()) and now >= self._until:
            self.why = ''
        return self.why

    def _open(self, why: str, now: int) -> None:
        if not self.why:
            self.openings += 1
        self.why, self._until = why, now + _LEAST


def judge_commands(
        *, late: int = 0, refused: int = 0, refused_source: int = 0, failed: int = 0,
        silent: Sequence[str] = (), crowded: Sequence[str] = (),
        rivals: str = '') -> tuple[int, str]:
    """
    Return the status for /diagnostics: level (0 OK, 1 WARN, 2 ERROR) and message.

    It depends on counts, on the joints without commands (``silent``) or with several publishers
    (``crowded``), and on other devices (``rivals``).
    """
    refused += refused_source
    return _verdict(
        'commands in time', (_ERROR, rivals),
        (_WARN, f'{late} commands late, {refused} refused' if late or refused else ''),
        (_WARN, f'several publishers command {listed(crowded)}' if crowded else ''),
        (_ERROR, f'{failed} times started again after a load too large to follow'
         if failed else ''),
        (_ERROR, f'no command and no heartbeat for {listed(silent)}' if silent else ''))


def judge_hardware(trouble: str, *, saturated: int, state_lost: int) -> tuple[int, str]:
    """Return the status of hardware from an error and counts."""
    return (_ERROR, trouble) if trouble else _verdict(
        'hardware obeys',
        (_WARN, f'{saturated} levels not reached: the amplifier is saturated'
         if saturated else ''),
        (_WARN, f'its state was lost, times: {state_lost}' if state_lost else ''))


def _verdict(fine: str, *notes: tuple[int, str]) -> tuple[int, str]:
    """Return the worst level of the notes, and all their messages."""
    present = [x for x in notes if x[1]]
    return max((x for x, _ in present), default=_OK), '; '.join(x for _, x in present) or fine


def judge_interlock(why: str) -> tuple[int, str]:
    """Return the status of an interlock from the reason why it is open."""
    return (_ERROR, f'open: {why}') if why else (_OK, 'closed')
