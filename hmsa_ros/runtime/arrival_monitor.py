"""The setpoints of a request as requested, the findings from samples of each, and outcomes."""

from bisect import bisect_left
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

from hmsa.interfaces.diagnostics import LEVELS, Outcome, PATH, REPLACED, SETPOINT, STOPPED
from hmsa.judge.records import (
    Finding,
    GoalTolerances,
    missed,
    RequestedSetpoint,
    Tolerances,
    worst,
)
from hmsa.judge.setpoint_samples import AHEAD, SetpointSamples
from hmsa.model.equations import stretch_limits
from hmsa.model.law import critical_zeta
from hmsa.model.status import Code
from hmsa.offload import Awaited, Doing
from hmsa.planning.group import PlannerGroup
from hmsa.planning.timeline import PlannedSegment, Timeline
from hmsa_ros.runtime.follower import Follower
from hmsa_ros.runtime.records import Environment, Request, Stop, Trajectory

# Largest age of the newest sample for further samples to be expected, by the steady clock.
_RECENT = 10_000_000_000
_LEFT_OUT = 'commands came late, and there was no time left for it'
_UNDONE = 'its commands were not sent in time, or took no effect'
_STOPPED = 'the joint came to rest instead'
# Why a setpoint is missed, by the code of the status that drops its plan.
_DROPPED = {
    Code.CUT_OFF: 'the coil was cut off', Code.INTERLOCK: 'the interlock was opened',
    Code.CLOCKS_DIFFER: 'the clocks of planner and device differ',
    Code.MISSED: 'plant or driver started after its commands were sent'}
# What was asked for by the code of its plan.
_ASKED = {Code.LEVELS: LEVELS, Code.PATH: PATH}


class Adopted(NamedTuple):
    """New plans of a request."""

    request: Request
    number: int  # of the request in the group
    time: int  # in ns
    plans: Mapping[str, Timeline]  # of the joints that it moves


@dataclass(eq=False)
class _Joint:
    """The setpoints of a joint as requested, and their findings."""

    key: str
    name: str  # empty if there is only one
    doing: Doing  # executes the judging
    asked: Timeline  # plan as accepted
    plan: Timeline  # plan now
    request: int  # number of the request in the group
    label: str | None = None  # name of the request; None for a stop, which has no outcome
    goal: GoalTolerances | None = None  # tolerances at the last setpoint
    following: int = 0  # number, from 0, of the next setpoint to watch
    ended: str = ''  # why the request is over before its time
    until: int | None = None  # when it is
    left: Sequence[int] = field(init=False)  # numbers of setpoints that are still planned
    reached: int = field(init=False)  # number of the first one that is not reached any more
    holds: list[SetpointSamples] = field(
        default_factory=list)  # the last one stays after it is over
    news: list[Finding] = field(default_factory=list)  # findings that need no samples
    corrected: bool = False  # whether the next plan is a correction from samples
    needed: bool = False  # whether the plan was replanned after a deviation
    newest: Finding | None = None
    unshown: bool = False  # whether that is not in a status yet
    closed: Finding | None = None  # worst finding of the setpoints that are over
    # Begin and arrival of the moves of setpoints that have begun, by number.
    moves: dict[int, list[tuple[int, int | None]]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.left, self.reached = range(self.count), self.count

    @property
    def count(self) -> int:
        """Number of setpoints requested."""
        return len(self.asked.segments) - self.asked.kept

    @property
    def begins(self) -> int | None:
        """Time in ns at which the next setpoint to watch begins; None if there is none."""
        if self.following >= self.reached:
            return None
        return self.asked.segments[self.asked.kept + self.following].since

    @property
    def open(self) -> bool:
        """Whether setpoints that have started are still to be judged."""
        return bool(self.news) or any(not x.over or x.unreported for x in self.holds)

    @property
    def worst(self) -> Finding | None:
        return worst(x for x in (self.closed, *(y.found for y in self.holds)) if x is not None)

    def close(self, found: Finding | None) -> None:
        """Record the finding of a setpoint that is over."""
        self.closed = worst(x for x in (self.closed, found) if x is not None)

    def segment(self, number: int) -> PlannedSegment | None:
        """Return a setpoint as planned now; None if it was left out."""
        place = bisect_left(self.left, number)
        if place == len(self.left) or self.left[place] != number:
            return None
        # All plans end with the last setpoint.
        back = len(self.left) - place
        return self.plan.segments[-back] if back <= len(self.plan.segments) else None

    def leave_out(self, plan: Timeline, now: int) -> Sequence[int]:
        """Adopt a new plan, and return the numbers of the setpoints that it leaves out."""
        before, after = self.plan.segments, plan.segments
        # Finished setpoints stay as they are.
        place = max(self.plan.under_way(now), 0)
        while place < min(len(before), len(after)) and before[place] is after[place]:
            place += 1
        self.plan = plan
        at = max(place + len(self.left) - len(before), 0)
        gone = self.left[at:at + max(len(before) - len(after), 0)]
        if gone:
            self.left = [*self.left[:at], *self.left[at + len(gone):]]
        return gone

    def undone(self) -> set[int]:
        """Return the numbers of the setpoints that have started and were not carried out."""
        return {x for x in range(self.following)
                if (one := self.segment(x)) is not None and not one.carried_out}

    def stop(self, plan: Timeline, now: int) -> None:
        """Record that a joint comes to rest instead of completing a request."""
        self.plan, self.ended, self.until = plan, STOPPED, now
        for hold in self.holds:
            hold.miss(_STOPPED)
        self._miss((x for x in self.left if x >= self.following), _STOPPED)
        self.following = self.count

    def change(self, plan: Timeline, now: int, dropped: Code | None = None) -> None:
        """Adopt a new plan, or none if dropped; the setpoints that it leaves out are missed."""
        why = _LEFT_OUT
        if dropped is not None:
            why, self.ended, self.until = _DROPPED[dropped], dropped, now
        self.needed |= not self.corrected
        self.corrected = False
        begun = {x.setpoint.number - 1: x for x in self.holds}
        undone = self.undone()
        gone = self.leave_out(plan, now)
        for number in begun.keys() & gone:
            hold = begun[number]
            # What is over before a plan is dropped, such as a long hold, was carried out.
            if dropped is None or not hold.over or (hold.requested.end or now) > now:
                hold.miss(why)
        self._miss((x for x in gone if x not in begun and x >= self.following), why)
        # After a plan that was dropped, what was reached before stays so.
        for hold in self.holds if plan.segments else ():
            self._keep_up(hold)
        self._miss(sorted(self.undone() - undone - begun.keys()), _UNDONE)

    def _miss(self, numbers: Iterable[int], reason: str) -> None:
        """Record as missed setpoints that have no samples."""
        self.news += [missed(self._setpoint(x), reason) for x in numbers]

    def open_next(self) -> None:
        """Watch the next setpoint."""
        number, self.following = self.following, self.following + 1
        if number in self.left:
            self.forget()
            self.holds.append(self._hold(number))

    def forget(self, last: int = 0) -> None:
        """Keep only the finding of setpoints that are over, except of the ``last`` ones."""
        end = len(self.holds) - last
        for hold in self.holds[:end]:
            if hold.over:
                self.close(hold.found)
        self.holds = [x for i, x in enumerate(self.holds)
                      if not x.over or x.unreported or i >= end]
        self.moves = {x: self.moves[x] for y in self.holds
                      if (x := y.setpoint.number - 1) in self.moves}

    def restart_holds(self) -> None:
        """Restart gathering samples of unfinished setpoints, since all times have changed."""
        self.moves.clear()
        self.holds = [
            x if x.over else self._hold(x.setpoint.number - 1) for x in self.holds]

    def _hold(self, number: int) -> SetpointSamples:
        """Return a new hold for a setpoint."""
        setpoint = self._setpoint(number)
        hold = SetpointSamples(setpoint, self.goal if setpoint.held else None, self.doing)
        if self.until is not None:
            hold.cut(self.until)
        self._keep_up(hold)
        return hold

    def _keep_up(self, hold: SetpointSamples) -> None:
        """Have a setpoint judged from its arrival in the plan in force."""
        number = hold.setpoint.number - 1
        segment = self.segment(number)
        if segment is not None:
            moves = self.moves.setdefault(number, [])
            asked = self.asked.segments[self.asked.kept + number]
            for x in (asked, segment) if not moves else (segment,):
                if not moves or moves[-1][1] != x.arrival:
                    moves.append((x.begin, x.arrival))
        if segment is None:
            hold.miss(_LEFT_OUT)
        elif not segment.carried_out:
            hold.miss(_UNDONE)
        elif segment.arrival is not None:
            hold.move(segment.arrival, corrected=not self.needed)
        elif hold.setpoint.arrival is not None:
            hold.miss('its time ended before the move to it')

    # -- outcomes ------------------------------------------------------------------------------

    def outcome(
            self, setpoint: RequestedSetpoint, now: int, finding: Finding | None = None,
            through: int = 0) -> Outcome:
        """Return the outcome of a setpoint, or of it and all up to a number from 1."""
        number = setpoint.number - 1
        asked = self.asked.segments[self.asked.kept + number]
        early = self.until is not None and (
            through or finding is None or setpoint.end is None or setpoint.end > self.until)
        moves = tuple(self.moves.get(number, [(asked.begin, asked.arrival)]))
        return Outcome(
            setpoint=setpoint, asked=_ASKED.get(asked.code, SETPOINT), request=self.label or '',
            plan=self.asked.number, joint=self.key,
            coordinate=self.plan.levels[0].model.units.coordinate, decided=now, through=through,
            moves=moves, corrected=not self.needed and len(moves) > 1,
            ended=self.ended if early else '', until=self.until if early else None,
            finding=finding)

    def end(self, until: int, ended: str, now: int) -> Iterator[Outcome]:
        """
        End the request at a time in ns; yield the outcomes of what cannot be judged any more.

        Setpoints that were to be reached before are judged by their samples until then.
        """
        dropped = bool(self.ended)
        if not dropped:
            self.until, self.ended = until, ended
        for found in self.news:
            yield self.outcome(found.setpoint, now, found)
        self.news.clear()
        kept = []
        for hold in self.holds:
            setpoint = hold.requested
            if hold.unreported or hold.over and not dropped and (
                    setpoint.end is None or setpoint.end > until):
                yield self.outcome(setpoint, now, hold.found)
            elif not hold.over and _rest(setpoint) >= until:
                yield self.outcome(setpoint, now)
            elif not hold.over:
                hold.cut(until)
                kept.append(hold)
        self.holds = kept
        for number in (x for x in self.left if x >= self.following):
            setpoint = self._planned(number)
            if _rest(setpoint) >= until:
                yield self.outcome(setpoint, now, through=self.count)
                self.reached = number
                break

    def _planned(self, number: int) -> RequestedSetpoint:
        """Return a setpoint that has not begun, with its arrival in the plan in force."""
        setpoint, segment = self._setpoint(number), self.segment(number)
        if segment is None or segment.arrival == setpoint.arrival:
            return setpoint
        return replace(setpoint, moved=segment.arrival)

    def _setpoint(self, number: int) -> RequestedSetpoint:
        """Return a setpoint as requested."""
        asked, place, last = self.asked, self.asked.kept + number, number + 1 == self.count
        segment = asked.segments[place]
        level = asked.level(segment.rests)
        model = level.model
        omega = model.frequency(segment.stretch) / model.units.time
        ratio = model.material.zeta / critical_zeta(segment.stretch, model.material.packed)
        return RequestedSetpoint(
            segment.stretch, asked.segments[place - 1].stretch if number
            else asked.level(segment.begin).stretch,
            segment.since, segment.arrival, segment.until if last
            else asked.segments[place + 1].since, omega, ratio * omega, self.name, number + 1,
            self.count, possible=stretch_limits(model.material), held=last)


def _rest(setpoint: RequestedSetpoint) -> int:
    """Return the planned time of rest in ns; the begin of what is only approached."""
    arrival = setpoint.newest_arrival
    return setpoint.begins if arrival is None else arrival


class ArrivalMonitor:
    """Gather samples of each setpoint as requested, and judge them."""

    def __init__(
            self, group: PlannerGroup, environment: Environment,
            follower: Follower, publish: Callable[[Outcome], None]) -> None:
        """Begin without setpoints; ``publish`` is called with each outcome."""
        self._group, self._around = group, environment
        #: Estimates the sensors; feedback may take its place.
        self.follower = follower
        self._publish = publish
        #: Publishes a status with the newest findings.
        self.show: Callable[[], None] = lambda: None
        # Goal tolerances of the newest request by joint, and its name; None for a stop.
        self._goals: Mapping[str, GoalTolerances] = {}
        self._label: str | None = ''
        self._number = group.number  # number of the newest request
        #: What is still to be followed, since requests were adopted.
        self.adopted: list[Adopted] = []
        self._dropped: Code | None = None  # code of the status that drops a plan
        self._joints: dict[str, _Joint] = {}
        # Requests that another replaced, with setpoints that were reached before.
        self._replaced: list[_Joint] = []
        self._now = 0  # time in ns of the newest judging
        self._heard: int | None = None
        # Begin of the next setpoint in ns: its samples may arrive before the next tick.
        self._opens: int | None = None
        self.restart()

    def restart(self) -> None:
        """Discard all findings; present plans are not judged."""
        self._catch_up()
        self._opens = None
        for joint in (*self._replaced, *self._joints.values()):
            for hold in joint.holds:
                if not hold.over or hold.unreported:
                    self._tell(joint, hold.requested, hold.found)
        self._replaced.clear()
        for name, planner in self._group.planners.items():
            plan = planner.plan
            self._begin(name, replace(plan, kept=len(plan.segments)), plan)

    def close(self) -> None:
        """Publish an outcome of each setpoint that has none, since the planner ends."""
        now = self._around.clock()
        self.follow(now)
        for joint in self._joints.values():
            if not joint.ended:
                joint.until, joint.ended = now, Code.INACTIVE
            self._end(joint, now, joint.ended, now)
        self._joints.clear()
        self.restart()

    def dropped(self, code: Code, now: int) -> None:
        """Record that plans that now have no setpoints were dropped, with a code of a status."""
        self._dropped = code
        self.follow(now)
        self._dropped = None

    def _begin(self, name: str, asked: Timeline, plan: Timeline) -> None:
        """Watch the requested setpoints of a joint."""
        self._joints[name] = _Joint(
            name, name if len(self._group.planners) > 1 else '', self._do, asked, plan,
            self._number, self._label, self._goals.get(name))

    def _replace(self, name: str, plan: Timeline, now: int) -> None:
        """Watch the setpoints of a new request of a joint instead of the previous ones."""
        old = self._joints[name]
        begin = plan.segments[plan.kept].since if plan.kept < len(plan.segments) else now
        self._end(old, begin, STOPPED if self._label is None else REPLACED, now)
        self._begin(name, plan, plan)

    def _end(self, joint: _Joint, until: int, ended: str, now: int) -> None:
        if joint.label is None:
            return
        for outcome in joint.end(until, ended, now):
            self._publish(outcome)
        if joint.holds or joint.begins is not None:
            self._replaced.append(joint)

    def _do(self, *work: Any) -> Awaited[Any]:
        """Execute judging where feedback executes its work."""
        return self.follower.do(*work)

    def clock_set(self, by: int) -> None:
        """Shift all times by the ns that the clock was set ahead."""
        self._catch_up()
        for joint in self._watched:
            joint.asked = joint.asked.shifted(by)
            if joint in self._replaced:
                joint.plan = joint.plan.shifted(by)
                joint.until = None if joint.until is None else joint.until + by
            else:
                joint.plan = self._group.planners[joint.key].plan
            joint.restart_holds()
        if self._opens is not None:
            self._opens += by

    def _asked(self) -> list[_Joint]:
        """Return the joints of the newest request."""
        newest = max(x.request for x in self._joints.values())
        return [x for x in self._joints.values() if x.request == newest]

    @property
    def open(self) -> bool:
        """Whether started setpoints are still to be judged."""
        return any(x.open for x in self._watched)

    @property
    def _watched(self) -> list[_Joint]:
        """The requests with setpoints to judge, replaced ones first."""
        return [*self._replaced, *self._joints.values()]

    @property
    def finished(self) -> bool:
        """Whether all setpoints have been judged."""
        return not self.open and all(x.following >= x.count for x in self._asked())

    @property
    def measuring(self) -> bool:
        """Whether there are recent samples."""
        return self._heard is not None and self._around.steady() - self._heard < _RECENT

    @property
    def findings(self) -> dict[str, Finding]:
        """The newest finding of each joint that has one."""
        return {
            name: x.newest for name, x in self._joints.items() if x.newest is not None}

    def shown(self) -> dict[str, Finding]:
        """Return ``findings``, and record that they are in a status."""
        for joint in self._joints.values():
            joint.unshown = False
        return self.findings

    @property
    def worst(self) -> Finding | None:
        """The worst finding of the newest request."""
        return worst(x.worst for x in self._asked() if x.worst is not None)

    def wake(self, now: int) -> int | None:
        """Return the time in ns at which to judge next; None for never, 0 for now."""
        times = [0 for x in self._watched if x.news]
        times += [
            y.wake(now) for x in self._watched for y in x.holds if not y.over or y.unreported]
        return min(times, default=None)

    # -- setpoints -----------------------------------------------------------------------------

    def corrected(self, name: str) -> None:
        """Record that the next plan of a joint is a correction, not a replanning in need."""
        self._catch_up()
        self._joints[name].corrected = True

    def follow(self, now: int) -> None:
        """Watch the setpoints that have started by a time in ns, as requested."""
        self._catch_up()
        self._compare({name: x.plan for name, x in self._group.planners.items()}, now)
        self._open_until(now)

    def _catch_up(self) -> None:
        """Follow the plans of requests since the last call."""
        adopted, self.adopted = self.adopted, []
        for request, number, time, plans in adopted:
            self._number, self._label = number, None if isinstance(request, Stop) else request.name
            self._goals = request.goals if isinstance(request, Trajectory) else {}
            self._compare(plans, time)

    def _compare(self, plans: Mapping[str, Timeline], now: int) -> None:
        """Watch what is planned now, if it is another plan."""
        for name, plan in plans.items():
            joint = self._joints[name]
            if plan.number == joint.plan.number:
                if plan.segments is not joint.plan.segments:
                    joint.change(plan, now, None if plan.segments else self._dropped)
            elif self._number == joint.request:
                joint.stop(plan, now)
            else:
                self._replace(name, plan, now)

    def _open_until(self, time: int) -> None:
        """Watch the setpoints that start by a time in ns."""
        for joint in self._watched:
            while joint.begins is not None and joint.begins <= time:
                joint.open_next()
        self._opens = min(
            (x.begins for x in self._watched if x.begins is not None), default=None)

    # -- samples -------------------------------------------------------------------------------

    def hear(self, stamp: int) -> bool:
        """Record a sample with a timestamp in ns; return whether samples are needed."""
        self._heard = self._around.steady()
        if self.adopted:
            self.follow(self._around.clock())
        if self._opens is not None and stamp >= self._opens:
            self._open_until(min(stamp, self._around.clock() + AHEAD))
        return self.open

    def add(
            self, name: str, stamps: Sequence[int], stretches: Sequence[float],
            now: int) -> None:
        """
        Add stretches measured at timestamps in ns and read at a time in ns.

        Samples may arrive in any order.
        """
        if name not in self._joints:
            return
        steady = self._around.steady()
        for joint in (*(x for x in self._replaced if x.key == name), self._joints[name]):
            for hold in joint.holds:
                hold.add(stamps, stretches, now, steady)

    def judge(
            self, now: int, tolerances: Tolerances, until: int, *,
            observable: bool) -> Finding | None:
        """
        Judge one setpoint that is due at a time in ns; return its finding if it is new.

        No judging begins after the steady time ``until`` in ns.
        """
        self._now = now
        for joint in self._watched:
            current = joint not in self._replaced
            if joint.news:
                miss = joint.news.pop(0)
                self._renew(joint, miss)
                self._tell(joint, miss.setpoint, miss)
                joint.close(miss)
                return miss
            for hold in joint.holds:
                if hold.rests(now, observable=observable):
                    continue
                if (steady := self._around.steady()) >= until:
                    return None
                found = hold.judge(
                    now, steady, tolerances, self.follower.sensor(joint.key),
                    observable=observable)
                if hold.news:
                    hold.news = False
                    if current:
                        self.follower.audit(joint.key, hold)
                if found is not None:
                    # Also before it is over: the planner or a recording may end.
                    self._tell(joint, hold.requested, found)
                if found is not None and current:
                    self._renew(joint, found)
                    joint.forget(last=1)
                    return found
        self._replaced = [x for x in self._replaced if x.open or x.begins is not None]
        return None

    def _renew(self, joint: _Joint, found: Finding) -> None:
        """Adopt a finding of a joint, once the one before is in a status."""
        if joint.unshown:
            self.show()
        joint.newest, joint.unshown = found, True

    def _tell(
            self, joint: _Joint, setpoint: RequestedSetpoint, found: Finding | None) -> None:
        """Publish the outcome of a setpoint that is decided, unless it is that of a stop."""
        if joint.label is not None:
            self._publish(joint.outcome(setpoint, self._now, found))
