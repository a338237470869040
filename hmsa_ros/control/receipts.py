"""What plant or driver acknowledge: that commands arrive, and what time it is there."""

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple

from hmsa_ros.model.units import NANOSECONDS

# Receipts come five times a second: how long they may stay away, in ns by the steady clock.
_PATIENCE = 800_000_000
# A pause between two looks that is longer is one of ours, in which none could be taken in.
_PAUSE = 300_000_000
# A receipt that is older than the silence that it ends was on its way all the time.
_STALE = 300_000_000
# How often nobody who gives receipts is found, five times a second, until none are expected.
_MISSING = 25
# Commands of a joint whose sending is remembered, and exchanges of which the quickest counts.
_REMEMBERED, _COMPARED = 64, 32


class Offset(NamedTuple):
    """How far the clock of a device is ahead of ours, and how wrong that may be; in ns."""

    ahead: int
    error: int

    @property
    def words(self) -> str:
        """What it is, as a half sentence, and what helps."""
        return (
            f'the clock of the plant or driver is {abs(self.ahead) / NANOSECONDS:.4f} s '
            f'{"ahead of" if self.ahead > 0 else "behind"} that of the planner (measured to '
            f'{self.error / NANOSECONDS:.4f} s): set the clocks of both hosts by one source, as '
            'with chrony')


@dataclass
class _Joint:
    """What is known of the device of a joint; times in ns, by the steady clock where not said."""

    heard: int  # when the newest receipt came
    time: int = 0  # when that was, by the clock of the device
    command: int = 0  # the stamp that it named; 0 for none
    unanswered: int | None = None  # since when no command is known to have arrived
    silent: bool = False
    missing: int = 0  # how often nobody was found since who gives any
    # By stamp, when a command was sent by our clock.
    sent: dict[int, int] = field(default_factory=dict)
    exchanges: deque[Offset] = field(default_factory=lambda: deque(maxlen=_COMPARED))
    # How old receipts were when they came, by our clock.
    lags: deque[int] = field(default_factory=lambda: deque(maxlen=_COMPARED))


class Receipts:
    """
    Follows receipts, which are optional: only that they cease is an alarm.

    ``silent`` are the joints whose device was heard before and is not any more.
    """

    def __init__(self, steady: Callable[[], int]) -> None:
        self._steady = steady
        self._joints: dict[str, _Joint] = {}
        self._looked = steady()
        self.silent: set[str] = set()

    def __bool__(self) -> bool:
        return bool(self._joints)

    def sent(self, joint: str, stamp: int, now: int) -> None:
        """Take in that a command of a stamp in ns was sent at a time in ns of our clock."""
        known = self._joints.get(joint)
        if known is None:
            return
        if known.unanswered is None:
            known.unanswered = self._steady()
        known.sent[stamp] = now
        if len(known.sent) > _REMEMBERED:
            del known.sent[next(iter(known.sent))]

    def received(
            self, joint: str, time: int, command: int, now: int, *, comparable: bool) -> bool:
        """
        Take in that the newest command there is one of a stamp, by a time of the device.

        The time now is that of our clock; the two are ``comparable`` where they are two. One clock
        for both may be in slow motion, or stand still. Returned is whether the device has begun
        anew: it had received commands, and has received none now.
        """
        steady = self._steady()
        known = self._joints.get(joint)
        if known is None:
            known = self._joints[joint] = _Joint(steady)
        if known.silent and comparable and (
                time - known.time < steady - known.heard - _STALE):
            return False
        anew, known.command = known.command != 0 and command == 0, command
        if anew:
            # What was sent has gone with the old one.
            known.sent.clear()
            known.unanswered = None
        known.heard, known.time, known.missing = steady, time, 0
        known.lags.append(now - time)
        sent = known.sent.pop(command, None)
        if sent is None:
            return anew
        known.unanswered = None
        if comparable and now >= sent:
            known.exchanges.append(Offset(time - (sent + now) // 2, (now - sent) // 2 + 1))
        return anew

    def since(self, joint: str, time: int) -> bool:
        """Return whether a receipt of a joint is at least as new as a time of its device."""
        known = self._joints.get(joint)
        return known is None or known.silent or known.time >= time

    def forget(self, joint: str) -> None:
        """
        Expect no receipts of a joint, since whoever listens now gives none.

        That is to be said again and again: what is found anew is found one topic after the other.
        """
        known = self._joints.get(joint)
        if known is None:
            return
        known.missing += 1
        if known.missing >= _MISSING:
            del self._joints[joint]
            self.silent.discard(joint)

    def clock_set_back(self) -> None:
        """Forget what our clock has said before it was set back."""
        for known in self._joints.values():
            known.sent.clear()
            known.exchanges.clear()
            known.lags.clear()

    def look(self) -> list[str]:
        """Return joints whose device has fallen silent, or is heard of again."""
        steady = self._steady()
        absent, self._looked = steady - self._looked, steady
        changed: list[str] = []
        for name, known in self._joints.items():
            if absent > _PAUSE:
                known.heard += absent
                known.unanswered = None
            silent = steady - known.heard > _PATIENCE
            if silent is not known.silent:
                changed.append(name)
                known.silent = silent
        self.silent = {x for x, known in self._joints.items() if known.silent}
        return changed

    def lost(self, joint: str, patience: int = _PATIENCE) -> bool:
        """Return whether what was sent to a joint has not arrived for longer than that, in ns."""
        known = self._joints.get(joint)
        return known is not None and known.unanswered is not None and (
            self._steady() - known.unanswered > patience)

    @property
    def words(self) -> str:
        """Why commands do not arrive; empty where they do, or where nobody gives receipts."""
        for name, known in self._joints.items():
            if known.silent:
                return (
                    f'no receipt of joint {name} from the plant or driver for more than '
                    f'{_PATIENCE / NANOSECONDS:g} s: it has ended, or its host cannot be '
                    'reached; no command is sent until it is heard again')
            if self.lost(name):
                return (
                    f'commands of joint {name} do not arrive: the plant or driver is heard, and '
                    f'has received none for more than {_PATIENCE / NANOSECONDS:g} s')
        return ''

    def lag(self, joint: str) -> int | None:
        """Return in ns how old the quickest receipt of a joint was by our clock; None for none."""
        known = self._joints.get(joint)
        return None if known is None else min(known.lags, key=abs, default=None)

    @property
    def offset(self) -> Offset | None:
        """How far the clock of a device is ahead, the one that is farthest off; None for none."""
        # The quickest exchange says most.
        found = [min(x.exchanges, key=lambda y: y.error)
                 for x in self._joints.values() if x.exchanges]
        return max(found, key=lambda x: abs(x.ahead), default=None)
