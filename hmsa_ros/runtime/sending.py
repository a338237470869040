"""Commands that are handed out in time, and signs of life between them."""

from hmsa_ros.core.group import PlannerGroup
from hmsa_ros.runtime.following import Following
from hmsa_ros.runtime.records import Output, Send, Settings

# So far ahead that all there is gets sent.
_FAR = 2**62


class Sending:
    """Hands out the commands of plans."""

    def __init__(
            self, group: PlannerGroup, following: Following, outputs: list[Output]) -> None:
        self._group, self._following, self._outputs = group, following, outputs
        self.sent = self.heartbeats = 0
        self.next_beat = 0  # time in ns of the next sign of life

    def send(self, now: int, *, everything: bool = False) -> None:
        """Send what is due at a time in ns, or everything that is planned."""
        for name, planner in self._group.planners.items():
            for level in planner.due(_FAR if everything else now):
                self._outputs.append(Send(name, level.stamp, level.flux_density))
                self.sent += 1
                self._outputs += self._following.sent(name, level.stamp, now)

    def beat(self, now: int, settings: Settings) -> None:
        """Send the level in force again: who listens learns that somebody is there."""
        period = settings.heartbeat_period
        if not period or now < self.next_beat:
            return
        self.next_beat = now + period
        if settings.replan_late:
            self._following.look_for_unheard(now)
        for name, planner in self._group.planners.items():
            level = planner.last_sent
            stamp = planner.beat_stamp(now)
            following = planner.next_stamp
            if following is None or stamp < following:
                self._outputs.append(Send(name, stamp, level.flux_density))
                self.heartbeats += 1
