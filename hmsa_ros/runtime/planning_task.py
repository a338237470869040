"""Requests and replannings, drafted by a worker while commands are sent."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from itertools import count
from typing import Any, NamedTuple

from hmsa.model.units import NANOSECONDS
from hmsa.planning.drafting import Check
from hmsa.planning.group import PlannerGroup
from hmsa.planning.planner import Planner
from hmsa.planning.timeline import Draft
from hmsa_ros.runtime.environment import Environment
from hmsa_ros.runtime.records import Request, Stop, StretchRequest, Trajectory
from hmsa_ros.runtime.worker import Inline, Job

_INLINE = Inline()
#: Drafts by joint.
Drafts = Mapping[str, Draft]
#: Duration in ns that the loop waits for drafts before it serves commands and requests.
SLICE = 4_000_000
# Setpoints up to which drafts are made in the loop, in less than a slice (bench_preemption).
_FEW = 10
# Number of trajectory points that are read between two checks.
_READ = 100
# Factor by which planning may take longer next time than estimated or measured.
_MARGIN = 3
# Factor of the planning time until the first commands are sent.
_READY = 1.5


class _LateError(Exception):
    """Drafts that will not be ready in time, and the ns that they need."""

    def __init__(self, needed: int) -> None:
        super().__init__(needed)
        self.needed = needed


class Drafting(NamedTuple):
    """What the worker drafts, from plans that do not change, and how the loop completes it."""

    draft: Callable[[Check], Drafts]
    complete: Callable[[Drafts], Drafts] = dict


@dataclass(eq=False)
class PlanningTask:
    """A request or a replanning in progress."""

    joints: frozenset[str]  # joints whose plans it changes
    #: Returns what to draft for a time in ns; None if nothing is to be changed.
    prepare: Callable[[int], Drafting | None]
    request: Request | None = None  # None for a replanning
    brief: bool = True  # whether the drafts take less than a slice
    size: int = 1  # approximate number of checks
    #: Reads the request, before anything else.
    read: Callable[[Check], None] | None = None
    number: int = field(default_factory=count().__next__)  # increases with each work
    corrects: bool = False  # whether it is a correction from samples
    spent: int = 0  # time spent on a correction, in ns
    _job: Job | None = None
    _complete: Callable[[Drafts], Drafts] = dict
    _began: int = 0
    _later: int = 0  # time in ns by which the drafts begin later than at once
    _revisions: tuple[int, ...] = ()

    @property
    def postponed(self) -> bool:
        """Whether the present plan continues until a timestamp at which this one begins."""
        return isinstance(self.request, Trajectory) and self.request.stamp is not None

    def replaces(self, others: Iterable['PlanningTask']) -> bool:
        """Return whether its plans do not depend on others being planned before."""
        return not self.postponed and all(
            x.joints <= self.joints or x.joints.isdisjoint(self.joints) for x in others)

    def abandon(self) -> None:
        """End the drafting, whose result is not wanted any more."""
        if self._job is not None:
            self._job.abandon()
            self._job = None

    def advance(
            self, group: PlannerGroup, around: Environment,
            wait: int) -> tuple[Drafts, int] | None:
        """
        Wait some ns for the drafts; return them, and the time in ns that they are for.

        That time has not passed. Planning begins again if the plans of the joints have changed
        meanwhile. None if there are no drafts yet. Raise `HmsaError` if there will be none.
        """
        planners = [group.planners[x] for x in self.joints]
        worker = _INLINE if self.brief else around.worker
        if self._job is None and self.read is not None:
            self._job = worker.submit(self.read)
        elif self._job is None:
            self._began, self._revisions = around.clock(), tuple(x.revision for x in planners)
            drafting = self.prepare(self._began + self._later)
            if drafting is None:
                return {}, self._began + self._later
            draft, self._complete = drafting
            self._job = worker.submit(self._drafted(
                draft, planners[0].options.lead_time, around))
        if not self._job.done(wait / NANOSECONDS):
            return None
        job, self._job = self._job, None
        if self.read is not None:
            job.result()
            self.read = None
            return None
        try:
            drafts = job.result()
        except _LateError as error:
            self._later = max(_MARGIN * error.needed, 2 * self._later)
            return None
        if self._revisions != tuple(x.revision for x in planners):
            return None
        drafts = self._complete(drafts)
        spent = around.clock() - self._began
        if not drafts or min(x.begin for x in drafts.values()) >= self._began + _READY * spent:
            return drafts, self._began + self._later
        self._later = max(_MARGIN * spent, self._later)
        return None

    def _drafted(
            self, draft: Callable[[Check], Drafts], lead: int,
            around: Environment) -> Callable[[Check], Drafts]:
        """Return drafting that ends as soon as it is clear that it takes too long."""
        if self.brief or around.one_clock():
            # The time of the loop does not run with that of the worker.
            return draft
        size, later, steady = self.size, self._later, around.steady

        def drafted(check: Check) -> Drafts:
            begun, done = steady(), 0

            def counted() -> None:
                nonlocal done
                check()
                done += 1
                spent = steady() - begun
                if 2 * spent > lead + 2 * later and spent * size > (lead + later) * done:
                    raise _LateError(spent * size // done)
            return draft(counted)
        return drafted


def work_on(
        request: Request, group: PlannerGroup,
        complete: Callable[[Drafts], Drafts]) -> PlanningTask:
    """Return the work of planning a request for joints of a group."""
    names = frozenset(group.planners if isinstance(request, Stop) else request.joints)

    if isinstance(request, Trajectory):
        return _of_trajectory(request, group, complete)

    def prepare(now: int) -> Drafting:
        plans = group.snapshot(lambda x: x.start(None, now))
        if isinstance(request, StretchRequest):
            return Drafting(lambda check: plans.checked(check).draft_setpoint(
                request.joint, request.stretch, now), complete)
        return Drafting(lambda check: plans.checked(check).draft_stop(now))
    return PlanningTask(names, prepare, request)


def _of_trajectory(
        request: Trajectory, group: PlannerGroup,
        complete: Callable[[Drafts], Drafts]) -> PlanningTask:
    points: dict[str, list[tuple[Any, int]]] = {name: [] for name in request.joints}
    path = request.path is not None

    def read(check: Check) -> None:
        rows = request.points if request.path is None else request.path
        for number, (stretches, time) in enumerate(rows):
            for name, stretch in zip(request.joints, stretches, strict=True):
                points[name].append((stretch, time))
            if number % _READ == _READ - 1:
                check()

    def prepare(now: int) -> Drafting:
        # The times of levels count from the first one.
        first = next((time for read in points.values() for _, time in read[:1]), 0)
        later = first if request.raw else 0
        plans = group.snapshot(lambda x: x.model.on_grid(x.start(None, now) + later) if (
            request.stamp is None) else x.start(request.stamp + later, now))
        return Drafting(lambda check: plans.checked(check).draft_request(
            points, request.stamp, now, raw=request.raw, path=path), complete)

    # The work of a path is not proportional to its number of points.
    size = 1 if path else request.count * len(request.joints)
    return PlanningTask(
        frozenset(request.joints), prepare, request, not path and size <= _FEW, size, read)


class Replanning(NamedTuple):
    """A new plan of one joint: how it is drafted, and whether it is adopted."""

    draft: Callable[[Planner], Draft | None]
    #: Returns the draft to adopt; None to keep the plan.
    adopt: Callable[[Draft | None], Draft | None] = lambda draft: draft
    #: Further times in ns from which it may be drafted.
    starts: tuple[int, ...] = ()


def replanning(
        name: str, planner: Planner, make: Callable[[int], Replanning | None], *,
        corrects: bool = False) -> PlanningTask:
    """Return the work of replanning a joint; ``make`` returns None to keep its plan."""
    def prepare(now: int) -> Drafting | None:
        anew = make(now)
        if anew is None:
            return None
        plan = planner.snapshot((*planner.resumptions(now), *anew.starts))

        def draft(check: Check) -> dict[str, Any]:
            return {name: anew.draft(plan.checked(check))}

        def complete(drafts: Mapping[str, Any]) -> Drafts:
            adopted = anew.adopt(drafts[name])
            return {} if adopted is None else {name: adopted}
        return Drafting(draft, complete)
    segments = planner.plan.segments
    brief = len(segments) <= _FEW and all(x.path is None for x in segments)
    return PlanningTask(frozenset([name]), prepare, brief=brief, corrects=corrects)
