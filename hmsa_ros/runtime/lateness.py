"""How late commands take effect, and what helps: delays of transport and of the driver differ."""

from collections import deque

from hmsa_ros.core.units import NANOSECONDS

# Commands that are compared, and the least number that says something.
_RECENT = 16
_ENOUGH = 3
# Commands of a joint whose time of sending is remembered.
_REMEMBERED = 64
# A driver's delay is called constant where sending earlier or later explains it less than this.
_CONSTANT = 0.5


class Lateness:
    """
    Counts late commands and finds what they have in common.

    A command that arrives late is the later the later it was sent. One that a driver applies late
    is as late as any other, however far ahead of its stamp it was sent.
    """

    def __init__(self) -> None:
        self.count = 0
        self.largest = 0  # how late the latest was, in ns
        self.earliest = 0  # how long before its stamp a command took effect, in ns
        self._sent: dict[str, dict[int, int]] = {}
        # How late, and how long ahead of its stamp it was sent, in ns.
        self._recent: deque[tuple[int, int]] = deque(maxlen=_RECENT)

    def sent(self, joint: str, stamp: int, now: int) -> None:
        """Remember when a command was sent; times in ns."""
        sent = self._sent.setdefault(joint, {})
        sent.pop(stamp, None)
        sent[stamp] = now
        if len(sent) > _REMEMBERED:
            del sent[next(iter(sent))]

    def note(self, late: int, joint: str, stamp: int) -> None:
        """Count a command of a joint that took effect so many ns after its stamp."""
        self.count += 1
        self.largest = max(self.largest, late)
        sent = self._sent.get(joint, {}).get(stamp)
        if sent is not None:
            self._recent.append((late, stamp - sent))

    def _by_driver(self) -> bool | None:
        """Return whether the driver delays the last commands; None if that cannot be told."""
        if self._recent and self._recent[-1][1] < 0:
            # They were sent too late.
            return False
        if len(self._recent) < _ENOUGH:
            return None
        late = [x for x, _ in self._recent]
        under_way = [x + ahead for x, ahead in self._recent]
        spread, explained = max(late) - min(late), max(under_way) - min(under_way)
        if spread < _CONSTANT * explained:
            return True
        return False if explained < _CONSTANT * spread else None

    @property
    def words(self) -> str:
        """What happens to commands, as the first half of a sentence."""
        if self.largest:
            return f'commands are repeatedly late, by up to {self.largest / 1e6:.3f} ms,'
        if self.earliest:
            return f'commands are repeatedly applied early, by up to {self.earliest / 1e6:.3f} ms,'
        return 'commands are repeatedly lost, or overridden by somebody else,'

    def advice(self, lead_time: int) -> str:
        """Return what helps, the rest of a sentence; commands are sent `lead_time` ns ahead."""
        if not self.largest and self.earliest:
            return (
                'let the driver apply commands at their stamps, or raise lateness_tolerance to '
                f'more than {self.earliest / NANOSECONDS:.3g} s')
        if not self.largest:
            return 'see who else publishes commands, or what drops them'
        by_driver = self._by_driver()
        if by_driver:
            return (
                f'the driver applies commands up to {self.largest / 1e6:.3f} ms after their '
                'stamps however early they are sent, so a larger lead_time does not help: let '
                'the driver write that much earlier, or raise lateness_tolerance to more than '
                f'{self.largest / NANOSECONDS:.3g} s, since a constant delay leaves no vibration')
        needed = (lead_time + self.largest) / NANOSECONDS
        return f'raise lead_time to more than {needed:.3g} s' + (
            ', unless the driver itself is that slow' if by_driver is None else '')
