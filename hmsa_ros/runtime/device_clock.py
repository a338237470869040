"""The offset of a device's clock from the planner's, measured by commands and their receipts."""

from collections import deque
from typing import NamedTuple

from hmsa.model.units import NANOSECONDS

# Number of commands whose sending time is stored, and of exchanges and receipts compared.
_REMEMBERED, _COMPARED = 64, 32
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
        if len(self._sent) > _REMEMBERED:
            del self._sent[next(iter(self._sent))]

    def awaits(self, command: int | None) -> bool:
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
