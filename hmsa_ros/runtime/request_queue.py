"""Requests that wait to be planned, and their results."""

from collections import deque
from collections.abc import Callable, Mapping

from hmsa.errors import BadInputError, HmsaError
from hmsa.model.status import Code, RefusedError
from hmsa.planning.group import PlannerGroup
from hmsa.planning.timeline import Draft
from hmsa_ros.runtime.deviations import Deviations
from hmsa_ros.runtime.environment import Environment
from hmsa_ros.runtime.follower import Follower
from hmsa_ros.runtime.planning_task import Drafts, PlanningTask, SLICE, work_on
from hmsa_ros.runtime.records import Note, Request, Severity, Stop, Verdict
from hmsa_ros.runtime.reporting import Reporting

# Number of levels and setpoints of replaced plans that are freed at a time.
_FREED = 2_000


class RequestQueue:
    """Have waiting requests planned, and report the results."""

    def __init__(
            self, group: PlannerGroup, following: Deviations, follower: Callable[[], Follower],
            reporting: Reporting, environment: Environment, send: Callable[[], None],
            stopping: Callable[[str], None]) -> None:
        """Begin without requests; ``stopping`` is called with the name of an adopted stop."""
        self._group, self._following, self._reporting = group, following, reporting
        self._follower = follower
        self._around, self._send, self._stopping = environment, send, stopping
        self._queue: deque[PlanningTask] = deque()
        # Parts of replaced plans: freeing all at once takes tens of ms.
        self._leftovers: list[object] = []
        self.refused = 0

    def __bool__(self) -> bool:
        return bool(self._queue or self._leftovers)

    @property
    def requests(self) -> list[Request]:
        """Requests that have no result yet."""
        return [x.request for x in self._queue if x.request is not None]

    def refuse_all(self, error: HmsaError) -> None:
        """Refuse all waiting requests for the same reason."""
        for work in list(self._queue):
            if work.request is not None:
                work.abandon()
                self._queue.remove(work)
                self.refuse(error, work.request)

    def __contains__(self, work: PlanningTask) -> bool:
        return work in self._queue

    def clear(self) -> None:
        """Drop all waiting work."""
        for work in self._queue:
            work.abandon()
        self._queue.clear()
        self._leftovers.clear()

    def add(self, request: Request, *, engaged: bool) -> PlanningTask:
        """Add a checked request; once ``engaged``, one that replaces all others comes first."""
        work = work_on(request, self._group, lambda drafts: self._follower().cautious(drafts))
        if engaged and work.replaces(self._queue):
            self._queue.appendleft(work)
        else:
            self._queue.append(work)
        return work

    def _supersede(self, work: PlanningTask) -> None:
        """Drop earlier requests that this one would replace as soon as they are planned."""
        for old in list(self._queue):
            if old.number < work.number and old.joints <= work.joints and not work.postponed:
                old.abandon()
                self._queue.remove(old)
                if old.request is not None:
                    self._reporting.give(Verdict(
                        Severity.WARN, Code.SUPERSEDED, 'another request came before this one was '
                        'planned', old.request.name))

    def work_on(self) -> None:
        """Wait for the plans of waiting work, for the duration of a slice."""
        for name in self._following.to_resume():
            if not any(x.request is None and name in x.joints for x in self._queue):
                self._queue.appendleft(self._following.resumption(name))
        if not self._queue:
            self._queue += self._follower().due(self._around.clock())
        del self._leftovers[-_FREED:]
        end = self._around.steady() + SLICE
        while self._queue and (left := end - self._around.steady()) > 0:
            work = self._queue[0]
            if self.advance(work, left) and work in self._queue:
                self._queue.remove(work)
        while self._following.verdicts:
            self._reporting.go_on(self._following.verdicts.pop(0))

    def advance(self, work: PlanningTask, wait: int = SLICE) -> bool:
        """Continue work for some ns; return whether it is done."""
        begun = self._around.clock() if work.corrects else 0
        found: tuple[Drafts, int] | None = None
        try:
            found = work.advance(self._group, self._around, wait)
        except HmsaError as error:
            if work.corrects:
                self._reporting.note(f'plan not corrected: {error}')
            elif work.request is None:
                self._reporting.go_on(self._following.abandon(work, error), log=True)
            else:
                self.refuse(error, work.request)
            return True
        if work.corrects:
            work.spent += self._around.clock() - begun
        if found is None:
            return False
        planners = [self._group.planners[x] for x in work.joints]
        plans = [x.plan for x in planners]
        if work.request is None:
            self._go_on(work, *found)
        else:
            self._supersede(work)
            self._answer(work.request, *found)
        for planner, plan in zip(planners, plans, strict=True):
            if planner.plan is not plan:
                self._leftovers += (*plan.levels, *plan.segments)
        return True

    def _answer(self, request: Request, drafts: Mapping[str, Draft], now: int) -> None:
        """Start to carry out a request."""
        self._following.dropped(drafts)
        changed = self._group.take(drafts, now)
        self._reporting.asked(request)
        # Commands are sent first, since reporting takes time.
        self._send()
        warnings = [x.warning for x in drafts.values() if x.warning is not None]
        if changed:
            self._reporting.show()
        self._reporting.look_for_listeners()
        severity, code, words = Severity.OK, Code.ACCEPTED, _accepted(drafts)
        if isinstance(request, Stop):
            self._stopping(request.name)
            words = (
                'stopping: comes to rest without vibration; ~/status says once plant or driver '
                'has acknowledged it')
        if warnings:
            severity, code, words = Severity.WARN, warnings[0].code, warnings[0].told
        elif not changed:
            code, words = Code.UNCHANGED, 'already on the way there: the plan is unchanged'
        self._reporting.give(Verdict(severity, code, words, request.name), log=bool(warnings))

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
        by = self._follower() if work.corrects else self._following
        verdict = by.take(work, drafts, now)
        self._send()
        if verdict is None:
            return
        if work.corrects:
            self._reporting.corrected(drafts, now)
        else:
            self._reporting.show()
        self._reporting.go_on(
            verdict, log=not work.corrects and self._following.replanned_due())


def _accepted(drafts: Mapping[str, Draft]) -> str:
    """Return a message that drafts are accepted, with the vibration that modes and creep leave."""
    planned = [x for draft in drafts.values() for x in draft.segments]
    words = ['accepted']
    ringing = [x for x in planned if x.left is not None]
    if ringing:
        words.append(max(ringing, key=lambda x: x.left.vibration if x.left else 0.0).told)
    if left := max((x.vibration for x in planned), default=0.0):
        words.append(f'levels that follow creep leave a vibration of up to {left:.1e}')
    return '; '.join(words)
