"""Commands that are handed out in time, and signs of life between them."""

from collections.abc import Callable, Container

from hmsa_ros.control.following import Following
from hmsa_ros.control.receipts import Receipts
from hmsa_ros.control.records import Output, Send, Settings
from hmsa_ros.planning.group import PlannerGroup

# So far ahead that all there is gets sent.
_FAR = 2**62


class Sending:
    """Hands out the commands of plans."""

    def __init__(
            self, group: PlannerGroup, following: Following, receipts: Receipts,
            outputs: list[Output], found: Callable[[str], bool]) -> None:
        self._group, self._following, self._outputs = group, following, outputs
        self._receipts, self._found = receipts, found
        # Joints whose device was not found at the last sign of life, and those whose device has
        # been since and has heard no level yet.
        self._absent: set[str] = set()
        self._deaf: set[str] = set()
        self.sent = self.heartbeats = 0
        self.next_beat = 0  # time in ns of the next sign of life

    def send(self, now: int, *, everything: bool = False) -> None:
        """Send what is due at a time in ns, or everything that is planned."""
        for name, planner in self._group.planners.items():
            if name in self._receipts.silent:
                # It would arrive when its time has passed.
                continue
            for level in planner.due(_FAR if everything else now):
                self._deaf.discard(name)
                self._hand_out(name, level.stamp, level.flux_density, now)
                self.sent += 1
                self._outputs += self._following.sent(name, level.stamp, now)

    def _hand_out(self, name: str, stamp: int, flux_density: float, now: int) -> None:
        self._outputs.append(Send(name, stamp, flux_density))
        self._receipts.sent(name, stamp, now)

    def acknowledge(self, name: str, now: int) -> None:
        """Send the level in force to a device that refuses others after a cut-off."""
        planner = self._group.planners[name]
        self._hand_out(
            name, planner.soonest(now), self._following.newest[name][1], now)

    def beat(self, now: int, settings: Settings, cut_off: Container[str] = ()) -> list[str]:
        """
        Send the level in force again: who listens learns that somebody is there.

        Joints that are cut off may be on their way to another one. Returned are joints whose
        device has just come: the level would be a step that it has not been led to.
        """
        period = settings.heartbeat_period
        if not period or now < self.next_beat:
            return []
        come = []
        self.next_beat = now + period
        if settings.replan_late:
            self._following.look_for_unheard(now)
        for name, planner in self._group.planners.items():
            absent = not self._found(name)
            if name in self._absent and not absent:
                come.append(name)
                self._deaf.add(name)
            (self._absent.add if absent else self._absent.discard)(name)
            if name in self._receipts.silent or name in cut_off or name in self._deaf:
                continue
            level = planner.last_sent
            stamp = planner.beat_stamp(now)
            following = planner.next_stamp
            if following is None or stamp < following:
                self._hand_out(name, stamp, level.flux_density, now)
                self.heartbeats += 1
        return come
