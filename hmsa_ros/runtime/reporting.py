"""Reports of a runtime: verdicts, progress and previews, in chronological order."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace

from hmsa.judge.records import Finding, VERDICTS
from hmsa.model.status import Code
from hmsa.model.units import NANOSECONDS
from hmsa.planning.group import PlannerGroup, Progress
from hmsa.planning.timeline import PlannedSegment, Timeline
from hmsa_ros.runtime.arrival_monitor import Adopted, ArrivalMonitor
from hmsa_ros.runtime.deviations import Deviations
from hmsa_ros.runtime.records import (
    Environment,
    Output,
    PlanChanged,
    Request,
    Severity,
    StatusChanged,
    Verdict,
)

# Changes of level in one preview, and the delay in ns until a preview shows a correction: a
# preview takes time to make, and corrections of several joints arrive together.
_PREVIEW, _SOON = 500, 50_000_000
#: Interval in ns at which subscribers are looked up.
LOOK = 200_000_000
# Minimum interval in ns, for each further joint, of a status that only shows progress. A status
# takes 0.1 ms for each joint: `benchmarks joints`.
_PER_JOINT = 2_000_000
# Number of requests whose verdicts are repeated, and time in ns by the steady clock: many requests
# at once replace each other's status before their senders have read it.
_ANSWERS, _REPEATED = 64, 30 * NANOSECONDS


class Reporting:
    """Verdicts, progress, previews and notes that wait to be published."""

    def __init__(
            self, group: PlannerGroup, deviations: Deviations, watch: ArrivalMonitor,
            environment: Environment, outputs: list[Output], note: Callable[[str], None],
            *looks: Callable[[], str]) -> None:
        """Begin without a verdict; ``looks`` return the values of `unheard` and `unseen`."""
        self._group, self._deviations, self._watch = group, deviations, watch
        watch.show = self._publish
        self._around, self._looks = environment, looks
        self.outputs, self.note = outputs, note
        self._look_again = 0
        self.unheard = ''  # why commands are not carried out; empty if they are
        self.unseen = ''  # joint whose samples have stopped; empty for none
        self.verdict = Verdict(Severity.OK, Code.NONE, 'no request yet')
        # By name of request: the newest verdict, the number of plans then, and the steady time.
        self._answers: dict[str, tuple[Verdict, int, int]] = {}
        self.preview_again: int | None = None  # time in ns of the next part of a long plan
        # What `flush` is to report: verdicts, each with the numbers of accepted requests, late
        # commands and replannings then, whether a request was adopted, and a preview. Progress
        # waits, since a status contains all joints.
        self._pending: list[tuple[Verdict, int, int, int]] = []
        self._published: tuple[Verdict, int] | None = None
        self._pause = _PER_JOINT * (len(group.planners) - 1)
        self._not_before = 0
        self._looks_due = self._preview_due = False
        self._reported: tuple[Progress, Mapping[str, Progress], bool] | None = None
        # The plans that progress was computed from, valid until `next_change`.
        self._segments: list[tuple[PlannedSegment, ...]] = []
        self.next_change: int | None = None  # time in ns at which progress changes next
        self.report()

    def give(self, verdict: Verdict, *, log: bool = False) -> None:
        """Set the verdict; a correction does not replace a warning."""
        if verdict.code is not Code.CORRECTED or not self._warned:
            self.verdict = verdict
            if verdict.request:
                self._answers.pop(verdict.request, None)
                self._answers[verdict.request] = (
                    verdict, self._group.number, self._around.steady())
        if log:
            self.note(verdict.message)
        self.report()

    def answered(self, name: str) -> bool:
        """Return whether there is a verdict on a recent request of a name."""
        return name in self._answers

    def go_on(self, verdict: Verdict, *, log: bool = False) -> None:
        """Set a verdict on the same request as the previous one."""
        self.give(replace(verdict, request=self.verdict.request), log=log)

    @property
    def _warned(self) -> bool:
        """Whether the verdict is a warning that does not concern the measured result."""
        return self.verdict.severity > Severity.OK and self.verdict.code not in VERDICTS

    def report(self) -> None:
        """Have verdict and progress reported by `flush`."""
        report = (self.verdict, self._group.number, self._deviations.lateness.count,
                  self._deviations.replanned)
        if self._pending and self._pending[-1][:2] == report[:2]:
            self._pending[-1] = report
        else:
            self._pending.append(report)

    @property
    def pending(self) -> int | None:
        """Time in ns at which there is something for `flush`; None if there is nothing."""
        if self._preview_due:
            return 0
        if not self._pending:
            return None
        # After the clock was set back, nothing waits.
        waits = len(self._pending) == 1 and self._pending[0][:2] == self._published and (
            self._not_before - self._around.clock() <= self._pause)
        return self._not_before if waits else 0

    def flush(self) -> None:
        """
        Report what there is to report.

        This is apart from the decisions, which do not wait for it.
        """
        due = self.pending
        if due is not None and due <= self._around.clock():
            self._publish()

    def _publish(self) -> None:
        if self._looks_due:
            self.look_for_listeners()
        if self._preview_due:
            self._preview()
        self._looks_due = self._preview_due = False
        if not self._pending:
            return
        self._published = self._pending[-1][:2]
        self._not_before = self._around.clock() + self._pause
        self._reported = self._state()
        progress, each, watching = self._reported
        old = self._around.steady() - _REPEATED
        self._answers = {
            name: x for name, x in [*self._answers.items()][-_ANSWERS:] if x[-1] >= old}
        findings = self._watch.shown()
        for verdict, number, late, replanned in self._pending:
            self.outputs.append(StatusChanged(
                verdict, progress, each, number, late, replanned, findings,
                self._watch.worst, watching, self.unheard, self.unseen, self._watch.measuring,
                {name: x.model.units.coordinate for name, x in self._group.planners.items()},
                {name: x[:2] for name, x in self._answers.items()}))
        self._pending.clear()

    def report_progress(self, now: int) -> None:
        """Report the progress if it has changed by a time in ns."""
        self.flush()
        planners = self._group.planners.values()
        # Progress is unchanged if no plan was replaced and no part of a plan has begun or ended.
        same = (self.next_change is None or now < self.next_change) and all(
            x.plan.segments is known for x, known in zip(planners, self._segments, strict=True))
        if not same and self._state() != self._reported:
            self.report()

    def _state(self) -> tuple[Progress, Mapping[str, Progress], bool]:
        now = self._around.clock()
        self._watch.follow(now)
        self._segments = [x.plan.segments for x in self._group.planners.values()]
        self.next_change = self._group.next_change(now)
        return *self._group.progress(now), self._watch.open

    def adopted(self, request: Request, plans: Mapping[str, Timeline]) -> None:
        """Have the setpoints of a request judged that was just given plans, and previewed."""
        self._watch.adopted.append(Adopted(
            request, self._group.number, self._around.clock(), plans))
        self._looks_due, self._preview_due = True, self._preview_due or bool(plans)

    def dropped(self, verdict: Verdict) -> None:
        """Report that a plan was dropped before its end."""
        self._watch.dropped(verdict.code, self._around.clock())
        self.show()
        self.go_on(verdict, log=True)

    def show(self) -> None:
        """Have the plan previewed by `flush`."""
        self._preview_due = True

    def _preview(self) -> None:
        """Preview the plan; of a long plan only the beginning, and the rest in time."""
        stamps, samples = self._group.preview(self._around.clock(), _PREVIEW)
        self.preview_again = stamps[_PREVIEW // 2] if len(stamps) == _PREVIEW else None
        self.outputs.append(PlanChanged(tuple(stamps), samples))

    def found(self, finding: Finding | None, *, judged: bool = False) -> None:
        """Report a finding; the worst one of the request is the verdict, unless it is judged."""
        if finding is not None and not finding.failed and not self._watch.finished:
            # What failed before is the verdict already.
            self.report()
            return
        worst = self._watch.worst
        if judged or worst is None or self.verdict.severity is Severity.ERROR or (
                not worst.failed and (self._warned or not self._watch.finished)):
            self.report()
        else:
            fine = worst.arrived or (
                worst.verdict is Code.UNOBSERVED and not self._watch.measuring)
            self.go_on(
                Verdict(Severity.OK if fine else Severity.WARN, worst.verdict, worst.message),
                log=worst.failed and worst is finding)

    def corrected(self, names: Iterable[str], now: int) -> None:
        """Record that plans were corrected at a time in ns, and preview them soon."""
        for name in names:
            self._watch.corrected(name)
        soon = now + _SOON
        self.preview_again = soon if self.preview_again is None else min(self.preview_again, soon)

    def look_for_listeners(self) -> None:
        """Warn if commands are not carried out or samples have stopped, and report recovery."""
        now = self._around.steady()
        if now < self._look_again:
            return
        self._look_again = now + LOOK
        before = self.unheard, self.unseen
        self.unheard, self.unseen = (look() for look in self._looks)
        for one, other, well in zip(
                before, (self.unheard, self.unseen),
                ('commands are carried out now', 'samples come again'), strict=True):
            if one != other:
                self.note(other or well)
        if before != (self.unheard, self.unseen):
            self.report()
