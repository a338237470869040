"""Late, lost and foreign commands, and the new plans that they call for."""

from collections.abc import Callable, Collection, Mapping

from hmsa_ros.core.drafting import Steps
from hmsa_ros.core.group import PlannerGroup, Resumption
from hmsa_ros.core.timeline import Draft
from hmsa_ros.core.units import NANOSECONDS
from hmsa_ros.errors import HmsaError
from hmsa_ros.runtime.lateness import Lateness
from hmsa_ros.runtime.records import Note, Settings, Severity, Verdict
from hmsa_ros.runtime.seldom import Seldom
from hmsa_ros.runtime.slices import Clock, in_time, Work


class Following:
    """Holds what takes effect against the plans."""

    def __init__(self, group: PlannerGroup) -> None:
        self._group = group
        self.lateness = Lateness()
        # Stamp in ns and level in T of the newest change that took effect.
        self.newest: dict[str, tuple[int, float]] = {}
        self.astray: set[str] = set()  # joints whose plan reality has left
        self.given_up: list[str] = []  # those whose plan stays as it is all the same
        self.replanned = 0  # plans made anew
        # Joints that may have left their plan, and the stamp of what was not heard of.
        self._suspected: dict[str, int] = {}
        self._found: dict[str, Resumption] = {}
        #: Returns how the clocks of plant or driver and planner differ; empty where they do not.
        self.clocks: Callable[[], str] = str
        self._tell_late, self._tell_foreign, self.tell_replanned = Seldom(), Seldom(), Seldom()

    def restart(self) -> None:
        """Forget what belongs to plans that are dropped."""
        self.newest.clear()
        self.astray.clear()
        self._suspected.clear()

    # -- commands and their effects -------------------------------------------------------------

    def sent(self, joint: str, stamp: int, now: int) -> list[Note]:
        """Take in that a command was handed out."""
        self.lateness.sent(joint, stamp, now)
        return self._late(now - stamp, joint, stamp) if stamp < now else []

    def applied(
            self, joint: str, stamp: int, flux_density: float, settings: Settings) -> list[Note]:
        """Hold a change of level that has taken effect against the plan."""
        self.newest[joint] = stamp, flux_density
        found = self._group.applied(joint, stamp, flux_density, settings.lateness_tolerance)
        if found is None:
            return []
        if settings.replan_late:
            self.astray.add(joint)
        if found.late > 0:
            return self._late(found.late, joint, stamp - found.late)
        if found.late < 0:
            self.lateness.earliest = max(self.lateness.earliest, -found.late)
        if found.foreign and self._tell_foreign():
            return [Note(Severity.WARN, (
                f'joint {joint}: {flux_density:g} T took effect but was not commanded'))]
        return []

    def drop_missed(
            self, now: int, tolerance: int, but: Collection[str] = ()) -> list[Note]:
        """Take out of the plans what is too late to be sent, as after a jump of the clock."""
        notes = []
        for name, planner in self._group.planners.items():
            stamp = planner.next_stamp
            if name in but or stamp is None or stamp >= now - tolerance or (
                    not self._group.may_resume(name)):
                continue
            notes += self._late(now - stamp, name, stamp)
            self.lateness.count += planner.drop_missed(now, tolerance) - 1
            self.astray.add(name)
        return notes

    def look_for_unheard(self, now: int) -> None:
        """Find plans that reality has left without a word; news may be as late as commands."""
        before, self._suspected = self._suspected, {}
        for name, planner in self._group.planners.items():
            if name not in self.newest:
                # Nobody reports what took effect.
                continue
            stamp = planner.unheard(now - planner.options.lead_time)
            if stamp is None:
                continue
            if before.get(name) != stamp:
                # It may wait to be read.
                self._suspected[name] = stamp
                continue
            planner.drop_unheard(stamp)
            self.astray.add(name)

    def _late(self, late: int, joint: str, stamp: int) -> list[Note]:
        self.lateness.note(late, joint, stamp)
        if not self._tell_late():
            return []
        return [Note(Severity.WARN, (
            f'command {late / 1e6:.3f} ms after the time it applies: {self.advice}'))]

    @property
    def advice(self) -> str:
        """What helps where commands come late; all joints have the same lead time."""
        if clocks := self.clocks():
            return clocks
        planner = next(iter(self._group.planners.values()))
        return self.lateness.advice(planner.options.lead_time)

    # -- plans made anew -----------------------------------------------------------------------

    def to_resume(self) -> list[str]:
        """Return joints whose plan is to be made anew, and note those for which that is vain."""
        names = sorted(self.astray)
        self.given_up += [x for x in names if not self._group.may_resume(x)]
        self.astray -= set(self.given_up)
        return sorted(self.astray)

    def resumption(self, name: str, clock: Clock) -> Work:
        """Return the work of planning a joint's rest anew."""
        def make(now: int) -> Steps[Mapping[str, Draft]]:
            found = yield from self._group.draft_resumption(name, now)
            self._found[name] = found
            return {} if found.draft is None else {name: found.draft}
        joints = frozenset([name])
        return Work(joints, in_time(make, self._group, joints, clock))

    def resume(
            self, work: Work, drafts: Mapping[str, Draft], now: int,
            request: str) -> Verdict | None:
        """Take a plan made anew for a time in ns; None if nothing was left to do."""
        name, = work.joints
        found = self._found.pop(name)
        self.astray.discard(name)
        self._group.resume(name, found, now)
        if found.draft is None:
            return None
        if found.refusal:
            return Verdict(
                Severity.ERROR, 'stopped', f'joint {name} comes to rest, since its sequence '
                f'cannot be resumed: {found.refusal}', request)
        self.replanned += 1
        missed = drafts[name].missed
        return Verdict(
            Severity.WARN, 'replanned', 'commands did not take effect as planned: the rest is '
            'replanned' + (
                f', without {missed} setpoints whose time has passed' if missed else ''), request)

    def abandon(self, work: Work, error: HmsaError, request: str) -> Verdict:
        """Leave a plan as it is that cannot even be stopped."""
        name, = work.joints
        self.astray.discard(name)
        return Verdict(
            Severity.ERROR, 'not_converged', f'joint {name} cannot be replanned: {error}',
            request)

    def give_up(self, request: str) -> Verdict:
        """Return the verdict where commands come late for ever."""
        self.given_up.clear()
        return Verdict(
            Severity.WARN, 'late',
            f'{self.lateness.words} and leave vibration: {self.advice}', request,
            {'largest_lateness': self.lateness.largest / NANOSECONDS})
