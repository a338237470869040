"""What is to be planned: a request, or a replanning of a joint."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from itertools import count
from typing import Any, NamedTuple

from hmsa.planning import Check
from hmsa.planning.planner import Planner
from hmsa.planning.timeline import Draft
from hmsa_ros.runtime.records import Request, Trajectory, Verdict
from hmsa_ros.runtime.worker import Job

#: Drafts by joint.
Drafts = Mapping[str, Draft]
#: Setpoints up to which drafts are made in the loop, in less than a slice (bench_preemption).
FEW = 10


class Drafting(NamedTuple):
    """What the worker drafts, from plans that do not change, and how the loop completes it."""

    draft: Callable[[Check], Drafts]
    complete: Callable[[Drafts], Drafts] = dict


@dataclass(eq=False)
class PlanningTask:
    """A request or a replanning in progress."""

    joints: frozenset[str]  # joints whose plans it changes
    #: Drafts at once for a time in ns, in much less than a slice.
    at_once: Callable[[int], Drafts] | None = None
    #: Else, returns what a worker drafts for a time in ns; None if nothing is to be changed.
    prepare: Callable[[int], Drafting | None] = lambda now: None
    request: Request | None = None  # None for a replanning
    brief: bool = True  # whether the drafts take less than a slice
    size: int = 1  # approximate number of checks
    #: Reads the request, before anything else.
    read: Callable[[Check], None] | None = None
    number: int = field(default_factory=count().__next__)  # increases with each work
    corrects: bool = False  # whether it is a correction from samples or a temperature
    #: Adopts the drafts of a correction in place of feedback, as `Follower.take`.
    take: 'Callable[[PlanningTask, Drafts, int], Verdict | None] | None' = None
    spent: int = 0  # time spent on a correction, in ns
    job: Job | None = None  # what the worker does
    complete: Callable[[Drafts], Drafts] = dict
    began: int = 0  # time in ns at which the drafts were begun
    later: int = 0  # time in ns by which the drafts begin later than at once
    revisions: tuple[int, ...] = ()  # of the plans that they began with

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
        if self.job is not None:
            self.job.abandon()
            self.job = None


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
        # What is brief is drafted at once.
        plan = planner if brief else planner.snapshot((*planner.resumptions(now), *anew.starts))

        def draft(check: Check) -> dict[str, Any]:
            return {name: anew.draft(plan.checked(check))}

        def complete(drafts: Mapping[str, Any]) -> Drafts:
            adopted = anew.adopt(drafts[name])
            return {} if adopted is None else {name: adopted}
        return Drafting(draft, complete)
    segments = planner.plan.segments
    brief = len(segments) <= FEW and all(x.path is None for x in segments)
    return PlanningTask(frozenset([name]), prepare=prepare, brief=brief, corrects=corrects)
