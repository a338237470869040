"""Temperatures of the joints as measured, and plans that follow them."""

from collections.abc import Callable, Iterator
from functools import partial

from hmsa.errors import BadInputError
from hmsa.model.thermal import checked_temperature
from hmsa.model.units import NANOSECONDS
from hmsa.planning.group import PlannerGroup
from hmsa_ros.runtime.planning_task import Drafts, PlanningTask, Replanning, replanning
from hmsa_ros.runtime.records import Clock, Settings
from hmsa_ros.timekeeping import Throttle

# Deviation of a level from that which holds the stretch at the measured temperature, as a
# fraction, from which a plan is made again; and shortest time in ns between two of these.
_DRIFT, _PAUSE = 5e-4, NANOSECONDS // 2


class Temperatures:
    """
    Measured temperatures of those joints whose parameters change with it.

    Without a joint of this kind, nothing is done.
    """

    def __init__(
            self, group: PlannerGroup, settings: Callable[[], Settings], clock: Clock,
            note: Callable[[str], None]) -> None:
        """Begin without a measurement; ``note`` is called with sentences for the log."""
        self._group, self._settings, self._clock, self._note = group, settings, clock, note
        # By joint: time in ns of the newest measurement, and the next time to plan again.
        self._newest: dict[str, int] = {}
        self._again: dict[str, int] = {}
        self._hot: set[str] = set()
        self._stale = ''
        self._refused_due = Throttle()
        self.followed = 0  # number of plans made again for a temperature
        #: Joints whose parameters change with the temperature.
        self.joints: tuple[str, ...] = ()
        self.change()

    def change(self) -> None:
        """Adopt the models of the joints."""
        self.joints = tuple(
            name for name, x in self._group.planners.items() if x.warmth is not None)

    def measured(self, joint: str, stamp: int, temperature: float) -> None:
        """Take the temperature of a joint in degrees Celsius, of a time in ns; 0 for now."""
        planner, now = self._group.planners[joint], self._clock()
        if planner.warmth is None:
            return
        stamp = min(stamp or now, now)
        if stamp < self._newest.get(joint, 0):
            return
        try:
            planner.take_temperature(checked_temperature(temperature), stamp)
        except BadInputError as error:
            if self._refused_due():
                self._note(f'joint {joint}: temperature ignored: {error}')
            return
        self._newest[joint] = stamp
        words = planner.warmth.base.actuator.thermal.warning(temperature)
        if words and joint not in self._hot:
            self._note(f'joint {joint}: {words}')
        (self._hot.add if words else self._hot.discard)(joint)

    def restart(self) -> None:
        """Discard the times, since the clock was set."""
        self._newest.clear()
        self._again.clear()

    def words(self) -> str:
        """Return which temperatures are missing or old; empty if all are known."""
        now, most = self._clock(), self._settings().temperature_max_age
        for joint in self.joints:
            warmth = self._group.planners[joint].foreseen(now)
            if warmth is None or warmth.estimated:
                continue
            taken = f'plans take {warmth.temperature:.4g} degrees Celsius'
            newest = self._newest.get(joint)
            if newest is None:
                return (f'the temperature of joint {joint} has not been measured: {taken}, from '
                        'thermal.ambient')
            if now - newest > most:
                return (f'the temperature of joint {joint} is {(now - newest) / NANOSECONDS:.3g} '
                        f's old: {taken}, expected one within temperature_max_age')
        return ''

    def look(self) -> str:
        """Return `words`, and log once that they have changed."""
        found = self.words()
        if bool(found) is not bool(self._stale):
            self._note(found or 'temperatures come again')
        self._stale = found
        return found

    def figures(self) -> dict[str, object]:
        """Return the temperatures that plans are made for, and the number of plans made again."""
        found: dict[str, object] = {}
        now, joints = self._clock(), self.joints
        for joint in joints:
            warmth = self._group.planners[joint].foreseen(now)
            if warmth is not None:
                name = 'temperature' if len(self._group.planners) == 1 else f'temperature.{joint}'
                found[name] = f'{warmth.temperature:.2f}'
        return found | ({'replanned_for_temperature': self.followed} if joints else {})

    def strays(self, joint: str, now: int) -> bool:
        """Return whether the level of a joint in a while holds another stretch than planned."""
        planner = self._group.planners[joint]
        if planner.warmth is None or now < self._again.get(joint, 0):
            return False
        begin, plan = planner.soonest(now), planner.plan
        if plan.under_way(begin) < 0:
            return False
        warmth, level = planner.foreseen(begin), plan.level(begin)
        return warmth is not None and level.stamp >= 0 and (
            abs(warmth.drift(level.model)) > _DRIFT)

    def due(self, now: int) -> Iterator[PlanningTask]:
        """Yield the work of planning again for a temperature, at a time in ns."""
        for joint in self.joints:
            if self.strays(joint, now):
                self._again[joint] = now + _PAUSE
                work = replanning(
                    joint, self._group.planners[joint], partial(self._anew, joint), corrects=True)
                work.take = self.take
                yield work

    def _anew(self, joint: str, now: int) -> Replanning | None:
        planner = self._group.planners[joint]
        begin, plan = planner.soonest(now), planner.plan
        following = plan.segments[plan.under_way(begin) + 1:][:1]
        return Replanning(
            lambda planner: planner.draft_warmed(now),
            starts=(begin, *(x.since for x in following)))

    def take(self, work: PlanningTask, drafts: Drafts, now: int) -> None:
        """Adopt a plan made again for a time in ns; there is nothing to report."""
        for joint, draft in drafts.items():
            self._group.planners[joint].take(draft, now)
            self.followed += 1
