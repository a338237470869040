"""Commands that are handed out in time, and signs of life between them."""

from collections.abc import Callable

from hmsa_ros.control.following import Following
from hmsa_ros.control.hearing import Hearing
from hmsa_ros.control.records import Output, Send
from hmsa_ros.planning.group import PlannerGroup

# So far ahead that all there is gets sent.
_FAR = 2**62


class Sending:
    """Hands out the commands of plans."""

    def __init__(
            self, group: PlannerGroup, following: Following, hearing: Hearing,
            outputs: list[Output]) -> None:
        self._group, self._following, self._hearing = group, following, hearing
        #: Takes a command at once: whatever else there is to do comes after it.
        self.deliver: Callable[[Send], None] = outputs.append
        self.sent = self.heartbeats = 0
        self.next_beat = 0  # time in ns of the next sign of life

    def send(self, now: int, *, everything: bool = False) -> None:
        """Send what is due at a time in ns, or everything that is planned."""
        for name, planner in self._group.planners.items():
            if name in self._hearing.receipts.silent:
                # It would arrive when its time has passed.
                continue
            for level in planner.due(_FAR if everything else now):
                self._hearing.fresh.discard(name)
                self._hand_out(name, level.stamp, level.flux_density, now)
                self.sent += 1
                self._following.sent(name, level.stamp, now)

    def _hand_out(self, name: str, stamp: int, flux_density: float, now: int) -> None:
        self.deliver(Send(name, stamp, flux_density))
        self._hearing.receipts.sent(name, stamp, now)

    def acknowledge(self, name: str, now: int) -> None:
        """Send that its coil is off to a device that refuses other levels after a cut-off."""
        planner = self._group.planners[name]
        self._hand_out(name, planner.soonest(now), 0.0, now)

    def beat(self, now: int) -> None:
        """Send levels in force again: who listens learns that somebody is there."""
        for name, planner in self._group.planners.items():
            if not self._hearing.is_led(name):
                continue
            level = planner.last_sent
            stamp = planner.beat_stamp(now)
            following = planner.next_stamp
            if following is None or stamp < following:
                self._hand_out(name, stamp, level.flux_density, now)
                self.heartbeats += 1
