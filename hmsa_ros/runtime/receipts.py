"""Receipts of plant or driver: acknowledged commands, and the offset of the device's clock."""

from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import NamedTuple

from hmsa.model.units import NANOSECONDS
from hmsa.planning.lateness import Disturbance

# Number of commands whose sending time is stored, and of exchanges and receipts compared.
_SENT, _COMPARED = 64, 32
# Measurements that differ by less, in ns, agree: clocks are slewed by up to 0.5 ms/s.
_SLACK = 5_000_000
# A measurement that contradicts the earlier ones is confirmed by another, at least this much
# later, in ns by the steady clock: it may have been in transit while the planner's clock was set.
_CONFIRMED = 10_000_000
# Time in ns without an exchange after which the age of receipts determines the offset; duration
# over which it is compared, and the smallest number of receipts. There are five a second.
_EXCHANGED, _WINDOW, _ENOUGH = 1_000_000_000, 800_000_000, 3
# Time in ns after the planner's clock was set in which receipts from before may still arrive.
_IN_TRANSIT = 300_000_000
# Receipts arrive five times a second: longest gap between them, in ns by the steady clock.
_PATIENCE = 800_000_000
# A longer pause between two looks is a stall of this process, which could not receive any.
_PAUSE = 300_000_000
# A receipt that is older than the silence that it ends was delayed in transit, unless further
# ones follow at the pace of the device's clock for a time in ns: delayed ones arrive at once.
_STALE, _PACED = 300_000_000, 350_000_000
# Largest difference in ns between that pace and the steady clock.
_UNEVEN = 100_000_000
# Number of looks, five a second, without a publisher until no receipts are expected.
_MISSING = 25
# Number of disturbances that are stored until they are asked for.
_REMEMBERED = 16


class Offset(NamedTuple):
    """Offset of a device's clock from the planner's, and its uncertainty; in ns."""

    ahead: int
    error: int

    @property
    def least(self) -> int:
        """Smallest possible lead of the device's clock; negative if it may be behind."""
        return self.ahead - self.error

    @property
    def most(self) -> int:
        """Largest possible lead of the device's clock."""
        return self.ahead + self.error

    @property
    def words(self) -> str:
        """The offset and the remedy, as a clause."""
        return (
            f'the clock of the plant or driver is {abs(self.ahead) / NANOSECONDS:.4f} s '
            f'{"ahead of" if self.ahead > 0 else "behind"} that of the planner (measured to '
            f'{self.error / NANOSECONDS:.4f} s): set the clocks of both hosts by one source, as '
            'with chrony')


class DeviceClock:
    """
    Measure the offset of a device's clock, and detect that one of the two clocks was set.

    A device reads its clock between the sending of a command and the arrival of its receipt. Each
    exchange thus encloses the offset, whatever the delays are, and each receipt alone bounds it
    from below. While no commands are sent, the offset is estimated from the youngest receipts.
    Times are in ns, ``steady`` ones by the steady clock.
    """

    def __init__(self) -> None:
        #: The offset as known at the last receipt; None if unknown.
        self.offset: Offset | None = None
        self._sent: dict[int, int] = {}  # sending time of commands by timestamp
        self._exchanges: deque[Offset] = deque(maxlen=_COMPARED)
        self._exchanged = 0  # steady time of the last exchange
        self._guessed = False  # whether the offset is estimated from receipts alone
        # Receipts: steady time of arrival, and smallest possible lead of the device's clock.
        self._received: deque[tuple[int, int]] = deque(maxlen=_COMPARED)
        # Steady time of a measurement that contradicts the others, and whether it is above them.
        self._doubt: tuple[int, bool] | None = None
        self._heard_from = 0  # steady time from which on receipts alone are compared

    @property
    def lag(self) -> int | None:
        """Smallest age of receipts at arrival; None for no receipt."""
        return min((-x for _, x in self._received), key=abs, default=None)

    def sent(self, stamp: int, now: int) -> None:
        """Record that a command was sent; timestamp and time of the planner's clock."""
        self._sent[stamp] = now
        if len(self._sent) > _SENT:
            del self._sent[next(iter(self._sent))]

    def awaits(self, command: int) -> bool:
        """Return whether a receipt of a command, given by its timestamp, is awaited."""
        return command in self._sent

    def lost(self) -> None:
        """Record that the commands under way are lost."""
        self._sent.clear()

    def set(self, steady: int) -> None:
        """
        Record that the planner's clock was set.

        The clock of a device on the same host was set with it. If it was not, then the next
        measurements contradict the earlier ones.
        """
        self._sent.clear()
        self._received.clear()
        self._doubt = None
        self._heard_from = steady + _IN_TRANSIT

    def received(self, time: int, command: int | None, now: int, steady: int) -> int:
        """
        Process a receipt with the device's time, at a time of the planner's clock.

        Return by how many ns the device's clock was set ahead, relative to the planner's; 0 if
        neither was set.
        """
        least = time - now
        self._received.append((steady, least))
        sent = None if command is None else self._sent.pop(command, None)
        step = 0
        if sent is not None and now >= sent:
            step = self._compare(Offset(
                time - (sent + now) // 2, (now - sent) // 2 + 1), steady)
        elif self._exchanges and not self._guessed and least > self._best.most:
            # Without an exchange, there is no upper bound.
            error = self._best.error
            step = self._compare(Offset(least + error, error), steady, alone=True)
        if steady - self._exchanged > _EXCHANGED:
            self._guess(steady)
        self.offset = self._best if self._exchanges else None
        return step

    def is_past(self, time: int, now: int) -> bool:
        """Return whether a time of the device's clock can have passed by one of the planner's."""
        return not self._exchanges or time - now <= self._best.most + _SLACK

    @property
    def _best(self) -> Offset:
        """The quickest exchange, which determines the offset best."""
        return min(self._exchanges, key=lambda x: x.error)

    def _compare(self, found: Offset, steady: int, *, alone: bool = False) -> int:
        """Add a measurement, or one from a receipt ``alone``; return the step of the clock."""
        step = 0
        if self._guessed and not alone:
            self._guessed = False
            self._exchanges.clear()
        if self._exchanges:
            best = self._best
            above, below = (
                found.least > best.most + _SLACK, found.most < best.least - _SLACK)
            if above or below:
                if alone and steady < self._heard_from:
                    return 0
                if self._doubt is None or self._doubt[1] is not above:
                    self._doubt = steady, above
                if steady - self._doubt[0] < _CONFIRMED:
                    return 0
                self._exchanges.clear()
                self._received = deque([self._received[-1]], _COMPARED)
                step = found.ahead - best.ahead
            elif alone:
                return 0
        self._doubt = None
        self._exchanges.append(found)
        self._exchanged = steady
        return step

    def _guess(self, steady: int) -> None:
        """Estimate the offset from the youngest receipts if they contradict the exchanges."""
        recent = [x for time, x in self._received if steady - time <= _WINDOW]
        if not self._exchanges or len(recent) < _ENOUGH:
            return
        best, least = self._best, max(recent)
        if not best.least - _SLACK <= least <= best.most + _SLACK:
            self._exchanges.clear()
            self._exchanges.append(Offset(least + best.error, best.error))
            self._guessed = True


@dataclass
class _Receiver:
    """State of the device of a joint; times in ns by the steady clock, unless noted."""

    arrived: int  # arrival of the newest receipt
    time: int = 0  # its time by the clock of the device
    command: int = 0  # timestamp that it acknowledged; 0 for none
    unanswered: int | None = None  # time since which no command is acknowledged
    acknowledged: int = 0  # newest timestamp sent that was acknowledged; 0 for none
    level: int | None = None  # timestamp of the newest level sent; None once acknowledged
    silent: bool = False
    missing: int = 0  # consecutive looks without a publisher of receipts
    clock: DeviceClock = field(default_factory=DeviceClock)
    step: int = 0  # ns by which its clock was set ahead since `Receipts.take_step`
    # During a silence: time of a receipt that seemed delayed, and of its arrival.
    delayed: tuple[int, int] | None = None

    def is_delayed(self, time: int, steady: int) -> bool:
        """Return whether a receipt was sent before the silence during which it arrives."""
        if time - self.time >= steady - self.arrived - _STALE:
            return False
        # It was delayed, or the clock of the device was set back.
        if self.delayed is not None:
            before, came = self.delayed
            if abs((time - before) - (steady - came)) <= _UNEVEN:
                return steady - came < _PACED
        self.delayed = time, steady
        return True

    def void(self) -> None:
        """Expect no acknowledgement of the commands sent so far."""
        self.clock.lost()
        self.unanswered = self.level = None

    def acknowledge(self, command: int, *, late: bool) -> bool:
        """Record the newest command that has arrived; return whether the device restarted."""
        restarted = self.command != 0 and command == 0
        self.command = command
        if restarted:
            # Commands that were sent to the previous device are lost.
            self.void()
            self.acknowledged = 0
        if self.clock.awaits(command):
            self.unanswered = None
            if not late:
                self.acknowledged = command
                if self.level is not None and command >= self.level:
                    self.level = None
        if late:
            # Also after its acknowledgement: a driver that stood still drops what it has accepted.
            self.acknowledged, self.level = min(self.acknowledged, command - 1), command
        return restarted


class Receipts:
    """
    Track receipts, which are optional: only their absence after the first one is an alarm.

    ``joints`` contains the joints whose device gives receipts, and ``silent`` those whose device
    has stopped sending them.
    """

    def __init__(self, steady: Callable[[], int]) -> None:
        #: Returns the steady time in ns.
        self.steady = steady
        self.joints: dict[str, _Receiver] = {}
        self._looked: int | None = None
        self._disturbances: deque[Disturbance] = deque(maxlen=_REMEMBERED)
        self.silent: set[str] = set()

    def __bool__(self) -> bool:
        return bool(self.joints)

    def _known(self, joint: str) -> _Receiver:
        """Return the state of a joint's device; one that nothing is known of without receipts."""
        return self.joints.get(joint) or _Receiver(0)

    def sent(self, joint: str, stamp: int, now: int, *, level: bool = False) -> None:
        """
        Record that a command was sent; timestamp and time in ns of the planner's clock.

        A new ``level`` is to be acknowledged itself, rather than a heartbeat.
        """
        known = self.joints.get(joint)
        if known is None:
            return
        if known.unanswered is None:
            known.unanswered = self.steady()
        if level:
            known.level = stamp
        known.clock.sent(stamp, now)

    def owed(self, joint: str) -> bool:
        """Return whether a joint's device has not acknowledged the newest level."""
        return self._known(joint).level is not None

    def received(
            self, joint: str, time: int, command: int | None, now: int, *,
            comparable: bool, late: bool = False) -> bool:
        """
        Process a receipt with the device's time; return whether the device restarted.

        ``command`` is the timestamp of the newest command that the device has received, 0 for
        none; None if the receipt contains none, as during a cut-off. If it was too ``late``, it
        has arrived, but takes no effect. ``now`` is the time of the planner's clock. The two times
        are ``comparable`` if each side has its own clock: a shared clock may be slowed down or
        paused. A device has restarted if it reports no command after it reported one.
        """
        steady = self.steady()
        known = self.joints.get(joint)
        if known is None:
            known = self.joints[joint] = _Receiver(steady)
        if known.silent and comparable and known.is_delayed(time, steady):
            return False
        if steady - known.arrived > _STALE:
            self._disturbed(known.arrived, _outage(joint, steady - known.arrived))
        known.arrived, known.time, known.missing, known.delayed = steady, time, 0, None
        restarted = command is not None and known.acknowledge(command, late=late)
        if comparable:
            known.step += known.clock.received(time, command, now, steady)
        return restarted

    def _disturbed(self, begin: int, words: str) -> None:
        self._disturbances.append(Disturbance(begin, self.steady(), words))

    def take_disturbances(self) -> list[Disturbance]:
        """Return the disturbances since the last call, and those that last."""
        for name, known in self.joints.items():
            if (silence := self.steady() - known.arrived) > _STALE:
                self._disturbed(known.arrived, _outage(name, silence))
        found = list(self._disturbances)
        self._disturbances.clear()
        return found

    def void(self, joint: str) -> None:
        """Expect no acknowledgement of the commands sent so far, since they are rejected."""
        self._known(joint).void()

    def since(self, joint: str, time: int) -> bool:
        """Return whether a joint's newest receipt is no older than a time of its device."""
        known = self.joints.get(joint)
        return known is None or known.silent or known.time >= time

    def carried_out(self, joint: str, stamp: int) -> bool | None:
        """
        Return whether a joint's device has acknowledged a command and reached its timestamp in ns.

        A newer command acknowledges it too. None if the device sends no receipts.
        """
        known = self.joints.get(joint)
        return None if known is None else (
            not known.silent and known.acknowledged >= stamp and known.time >= stamp)

    def forget(self, joint: str) -> None:
        """
        Expect no more receipts of a joint, since its current subscriber publishes none.

        Only repeated calls take effect, because discovery finds one topic after the other.
        """
        known = self.joints.get(joint)
        if known is None:
            return
        known.missing += 1
        if known.missing >= _MISSING:
            del self.joints[joint]
            self.silent.discard(joint)

    def clock_set(self) -> None:
        """Record that the planner's clock was set."""
        self._disturbed(self.steady() - _STALE, 'the clock of the planner was set')
        for known in self.joints.values():
            known.clock.set(self.steady())
            known.acknowledged, known.level = 0, None

    def take_step(self, joint: str) -> int:
        """Return by how many ns a device's clock was set ahead since the last call."""
        known = self._known(joint)
        step, known.step = known.step, 0
        return step

    def miss(self, joints: Iterable[str]) -> None:
        """Have devices be silent from the next look on, until a receipt arrives."""
        for name in joints:
            if (known := self.joints.get(name)) is not None:
                known.arrived = min(known.arrived, self.steady() - _PATIENCE - 1)

    def look(self) -> list[str]:
        """Return the joints whose device has fallen silent, or is received again."""
        steady = self.steady()
        # Before the first look, a node may still be starting.
        absent, self._looked = 0 if self._looked is None else steady - self._looked, steady
        changed: list[str] = []
        if absent > _PAUSE:
            self._disturbed(
                steady - absent, f'the planner stood still for {absent / NANOSECONDS:.3f} s')
        for name, known in self.joints.items():
            if absent > _PAUSE:
                known.arrived = min(known.arrived + absent, steady)
                if known.unanswered is not None:
                    known.unanswered = min(known.unanswered + absent, steady)
            silent = steady - known.arrived > _PATIENCE
            if silent is not known.silent:
                changed.append(name)
                known.silent = silent
        self.silent = {x for x, known in self.joints.items() if known.silent}
        return changed

    def lost(self, joint: str, patience: int = _PATIENCE) -> bool:
        """Return whether a command has been unacknowledged for longer than ``patience`` in ns."""
        known = self.joints.get(joint)
        return known is not None and known.unanswered is not None and (
            self.steady() - known.unanswered > patience)

    @property
    def words(self) -> str:
        """Why commands do not arrive; empty if they do or if there are no receipts."""
        for name, known in self.joints.items():
            if known.silent:
                return (
                    f'no receipt of joint {name} from the plant or driver for more than '
                    f'{_PATIENCE / NANOSECONDS:g} s: it has ended, or its host cannot be '
                    'reached, or has another address now (then restart it); no command is sent '
                    'until receipts arrive')
            if self.lost(name):
                return (
                    f'commands of joint {name} do not arrive: the plant or driver sends receipts, '
                    f'but has received no command for more than {_PATIENCE / NANOSECONDS:g} s: '
                    'the network carries one direction only, or its host has another address now '
                    '(then restart it)')
        return ''

    def clock(self, joint: str) -> DeviceClock:
        """Return the clock of a joint's device, of which nothing is known without receipts."""
        return self._known(joint).clock

    def figures(self) -> dict[str, object]:
        """Return the values of the clock offset for /diagnostics, if it is known."""
        return {} if self.offset is None else {
            'clock_offset_ms': f'{self.offset.ahead / 1e6:.3f}',
            'clock_offset_error_ms': f'{self.offset.error / 1e6:.3f}'}

    @property
    def offset(self) -> Offset | None:
        """Largest clock offset among the devices; None if unknown."""
        found = (x.clock.offset for x in self.joints.values())
        return max((x for x in found if x is not None), key=lambda x: abs(x.ahead), default=None)


def _outage(joint: str, silence: int) -> str:
    """Return a clause that receipts of a joint were missing for some ns."""
    return (f'no receipt of joint {joint} arrived for {silence / NANOSECONDS:.3f} s, as in an '
            'outage or a stall')
