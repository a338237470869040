"""
Requests that wait to be planned, and their results.

A setpoint or a stop is planned at once, in the loop. What takes longer is drafted by a worker
beside the loop, which goes on sending commands.
"""

from collections import deque
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

from hmsa.errors import BadInputError, HmsaError
from hmsa.model.status import Code, RefusedError
from hmsa.model.units import NANOSECONDS
from hmsa.planning import Check
from hmsa.planning.group import PlannerGroup
from hmsa.planning.timeline import Draft, PlannedSegment
from hmsa_ros.runtime.deviations import Deviations
from hmsa_ros.runtime.follower import Follower
from hmsa_ros.runtime.planning_task import Drafting, Drafts, FEW, PlanningTask
from hmsa_ros.runtime.records import (
    Environment,
    Note,
    Request,
    Severity,
    Stop,
    StretchRequest,
    Trajectory,
    Verdict,
)
from hmsa_ros.runtime.reporting import Reporting
from hmsa_ros.runtime.temperatures import Temperatures
from hmsa_ros.runtime.worker import Inline

#: Duration in ns that the loop waits for drafts before it serves commands and requests.
SLICE = 4_000_000
# Number of trajectory points that are read between two checks.
_READ = 100
# Factor by which planning may take longer next time than estimated or measured.
_MARGIN = 3
# Fraction of the work, as 1 over it, from which its time is estimated: a pause of the machine
# counts as at most so many. Planning that begins again has lost at most this fraction.
_TRIAL = 20
# Time in ns until a request begins above which its status says so.
_SOON = NANOSECONDS
# Factor of the planning time until the first commands are sent.
_READY = 1.5
_INLINE = Inline()
# Number of levels and setpoints of replaced plans that are freed at a time.
_FREED = 2_000


class _LateError(Exception):
    """Drafts that will not be ready in time, and the ns that they need."""

    def __init__(self, needed: int) -> None:
        super().__init__(needed)
        self.needed = needed


class RequestQueue:
    """Have waiting requests planned, and report the results."""

    def __init__(
            self, group: PlannerGroup, deviations: Deviations, follower: Follower,
            temperatures: Temperatures, reporting: Reporting, environment: Environment,
            send: Callable[[int], None], stopping: Callable[[str], None]) -> None:
        """Begin without requests; ``stopping`` is called with the name of an adopted stop."""
        self._group, self._deviations, self._reporting = group, deviations, reporting
        #: Follows the joints; feedback may take its place.
        self.follower = follower
        #: Temperatures of the joints, for which plans are made.
        self.temperatures = temperatures
        self._around, self._send, self._stopping = environment, send, stopping
        #: What waits, in the order of planning.
        self.tasks: deque[PlanningTask] = deque()
        # Parts of replaced plans: freeing all at once takes tens of ms.
        self._leftovers: list[object] = []
        self.refused = 0

    def __bool__(self) -> bool:
        return bool(self.tasks or self._leftovers)

    @property
    def requests(self) -> list[Request]:
        """Requests that have no result yet."""
        return [x.request for x in self.tasks if x.request is not None]

    @property
    def upcoming(self) -> Request | None:
        """The request that is planned next; None for none."""
        return next((x.request for x in self.tasks if x.request is not None), None)

    def refuse_all(self, error: HmsaError) -> None:
        """Refuse all waiting requests for the same reason."""
        for work in list(self.tasks):
            if work.request is not None:
                work.abandon()
                self.tasks.remove(work)
                self.refuse(error, work.request)

    def clear(self) -> None:
        """Drop all waiting work."""
        for work in self.tasks:
            work.abandon()
        self.tasks.clear()
        self._leftovers.clear()

    def add(self, request: Request, *, engaged: bool) -> PlanningTask:
        """Add a checked request; once ``engaged``, one that replaces all others comes first."""
        if isinstance(request, Trajectory):
            work = _of_trajectory(request, self._group)
        elif isinstance(request, StretchRequest):
            work = PlanningTask(frozenset([request.joint]), at_once=partial(
                self._group.draft_setpoint, request.joint, request.stretch), request=request)
        else:
            work = PlanningTask(
                frozenset(self._group.planners), at_once=self._group.draft_stop, request=request)
        if engaged and work.replaces(self.tasks):
            self.tasks.appendleft(work)
        else:
            self.tasks.append(work)
        return work

    def _supersede(self, work: PlanningTask) -> None:
        """Drop earlier requests that this one would replace as soon as they are planned."""
        for old in list(self.tasks):
            if old.number < work.number and old.joints <= work.joints and not work.postponed:
                old.abandon()
                self.tasks.remove(old)
                if old.request is not None:
                    self._reporting.give(Verdict(
                        Severity.WARN, Code.SUPERSEDED, 'another request came before this one was '
                        'planned', old.request.name))

    def work_on(self) -> None:
        """Wait for the plans of waiting work, for the duration of a slice."""
        for name in self._deviations.to_resume() if self._deviations.astray else ():
            if not any(x.request is None and name in x.joints for x in self.tasks):
                self.tasks.appendleft(self._deviations.resumption(name))
        if not self.tasks:
            self.tasks += self.follower.due(self._around.clock())
            self.tasks += self.temperatures.due(self._around.clock())
        del self._leftovers[-_FREED:]
        end = self._around.steady() + SLICE
        while self.tasks and (left := end - self._around.steady()) > 0:
            work = self.tasks[0]
            if self.advance(work, left) and work in self.tasks:
                self.tasks.remove(work)
        while self._deviations.verdicts:
            self._reporting.go_on(self._deviations.verdicts.pop(0))

    def advance(self, work: PlanningTask, wait: int = SLICE) -> bool:
        """Continue work for some ns; return whether it is done."""
        begun = self._around.clock()
        drafts: Drafts | None = None
        try:
            drafts = self._drafts(work, wait)
        except HmsaError as error:
            if work.corrects:
                self._reporting.note(f'plan not corrected: {error}')
            elif work.request is None:
                self._reporting.go_on(self._deviations.abandon(work, error), log=True)
            else:
                self.refuse(error, work.request)
            return True
        if work.corrects:
            work.spent += self._around.clock() - begun
        if drafts is None:
            return False
        before = {x: self._group.planners[x].plan for x in work.joints}
        if work.request is None:
            self._go_on(work, drafts, work.began + work.later)
        else:
            self._supersede(work)
            self._answer(work.request, drafts, work.began + work.later)
        for name, plan in before.items():
            if self._group.planners[name].plan is not plan:
                self._leftovers += (*plan.levels, *plan.segments)
        return True

    def _drafts(self, work: PlanningTask, wait: int) -> Drafts | None:
        """
        Return drafts for the time at which they were begun, or ``later``, if they are in time.

        None if there are none yet, after some ns: they will begin later, or begin again, since the
        plans have changed meanwhile. Raise `HmsaError` if there will be none.
        """
        if work.at_once is None:
            drafts = self._drafted(work, wait)
            if drafts is None:
                return None
        else:
            work.began = self._around.clock()
            drafts = work.at_once(work.began + work.later)
        if work.request is not None and not isinstance(work.request, Stop):
            drafts = self.follower.cautious(drafts)
        spent = self._around.clock() - work.began
        if not drafts or min(x.begin for x in drafts.values()) >= work.began + _READY * spent:
            return drafts
        work.later = max(_MARGIN * spent, work.later)
        return None

    def _drafted(self, work: PlanningTask, wait: int) -> Drafts | None:
        """Wait some ns for the drafts of a worker; return them, complete, or None."""
        around, planners = self._around, [self._group.planners[x] for x in work.joints]
        worker = _INLINE if work.brief else around.worker
        if work.job is None and work.read is not None:
            work.job = worker.submit(work.read)
        elif work.job is None:
            work.began, work.revisions = around.clock(), tuple(x.revision for x in planners)
            drafting = work.prepare(work.began + work.later)
            if drafting is None:
                return {}
            work.complete = drafting.complete
            work.job = worker.submit(_bounded(
                drafting.draft, work, planners[0].options.lead_time, around))
        if not work.job.done(wait / NANOSECONDS):
            return None
        job, work.job = work.job, None
        if work.read is not None:
            job.result()
            work.read = None
            return None
        try:
            drafts: Drafts = job.result()
        except _LateError as error:
            work.later = max(_MARGIN * error.needed, 2 * work.later)
            return None
        if work.revisions != tuple(x.revision for x in planners):
            return None
        return work.complete(drafts)

    def _answer(self, request: Request, drafts: Drafts, now: int) -> None:
        """Start to carry out a request."""
        # What is still to be reported concerns the plans of before.
        self._reporting.flush()
        self._deviations.dropped(drafts)
        plans = self._group.take(drafts, now)
        # Commands are sent first, since reporting takes time.
        self._send(self._around.clock())
        self._reporting.adopted(request, plans)
        severity, code, words = _accepted(drafts)
        if isinstance(request, Stop):
            self._stopping(request.name)
        if severity is Severity.OK and isinstance(request, Stop):
            words = (
                'stopping: comes to rest without vibration; ~/status says once plant or driver '
                'has acknowledged it')
        if severity is Severity.OK and not plans:
            code, words = Code.UNCHANGED, 'already on the way there: the plan is unchanged'
        if isinstance(request, Trajectory) and request.stamp is None and drafts:
            until = min(x.begin for x in drafts.values()) - self._around.clock()
            if until > _SOON:
                words += f'; begins {until / NANOSECONDS:.2g} s later, since planning takes time'
        if self.temperatures.joints and (why := self.temperatures.words()):
            words = f'{words}; {why}'
        self._reporting.give(
            Verdict(severity, code, words, request.name), log=severity is not Severity.OK)

    def refuse(self, error: HmsaError, request: Request) -> Verdict:
        """Report a request that cannot be read or carried out."""
        code = Code.BAD_INPUT if isinstance(error, BadInputError) else Code.NOT_CONVERGED
        if isinstance(error, RefusedError):
            code = error.code
        self.refused += 1
        self._reporting.give(Verdict(Severity.ERROR, code, str(error), request.name))
        self._reporting.outputs.append(Note(Severity.ERROR, f'request refused ({code}): {error}'))
        return self._reporting.verdict

    def _go_on(self, work: PlanningTask, drafts: Mapping[str, Draft], now: int) -> None:
        """Adopt a plan that was replanned, or corrected from samples."""
        take = work.take or (self.follower if work.corrects else self._deviations).take
        verdict = take(work, drafts, now)
        self._send(self._around.clock())
        if verdict is None:
            return
        if work.corrects:
            self._reporting.corrected(drafts, now)
        else:
            self._reporting.show()
        self._reporting.go_on(
            verdict, log=not work.corrects and self._deviations.replanned_due())


def _accepted(drafts: Mapping[str, Draft]) -> tuple[Severity, Code, str]:
    """Return severity, code and words for drafts, with what modes and creep leave."""
    ringing: PlannedSegment | None = None
    most = left = 0.0
    for draft in drafts.values():
        for segment in draft.segments:
            if segment.warns:
                return Severity.WARN, segment.code, segment.told
            left = max(left, segment.vibration)
            if segment.left is not None and (
                    ringing is None or segment.left.vibration > most):
                ringing, most = segment, segment.left.vibration
    words = ['accepted'] if ringing is None else ['accepted', ringing.told]
    if left:
        words.append(f'levels that follow creep leave a vibration of up to {left:.1e}')
    return Severity.OK, Code.ACCEPTED, '; '.join(words)


def _of_trajectory(request: Trajectory, group: PlannerGroup) -> PlanningTask:
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
            points, request.stamp, now, raw=request.raw, path=path))

    # The work of a path is not proportional to its number of points.
    size = 1 if path else request.count * len(request.joints)
    return PlanningTask(
        frozenset(request.joints), prepare=prepare, request=request,
        brief=not path and size <= FEW, size=size, read=read)


def _bounded(
        draft: Callable[[Check], Drafts], work: PlanningTask, lead: int,
        around: Environment) -> Callable[[Check], Drafts]:
    """Return drafting that ends as soon as it is clear that it takes too long."""
    if work.brief or around.one_clock():
        # The time of the loop does not run with that of the worker.
        return draft
    size, later, steady = work.size, work.later, around.steady

    def drafted(check: Check) -> Drafts:
        begun, done = steady(), 0

        def counted() -> None:
            nonlocal done
            check()
            done += 1
            spent = steady() - begun
            if _TRIAL * done >= size and 2 * spent > lead + 2 * later \
                    and spent * size > (lead + later) * done:
                raise _LateError(spent * size // done)
        return draft(counted)
    return drafted
