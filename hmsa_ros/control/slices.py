"""Requests that are planned in slices, so that commands and requests are served in between."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from itertools import count
from typing import Any

from hmsa_ros.control.records import Request, Stop, Trajectory
from hmsa_ros.planning.drafting import Steps
from hmsa_ros.planning.group import PlannerGroup
from hmsa_ros.planning.planner import Planner
from hmsa_ros.planning.timeline import Draft

#: Tells the time of the stamps in ns.
Clock = Callable[[], int]
#: Pauses after each bounded piece; returns drafts by joint and the time in ns they are for.
Drafting = Steps[tuple[Mapping[str, Draft], int]]
# What is done with drafts by joint before they are taken.
Then = Callable[[Mapping[str, Draft]], Mapping[str, Draft]]
#: How long work goes on before commands and requests are served again, in ns.
SLICE = 4_000_000
# Points of a trajectory that are read between two pauses.
_READ = 100
# How much longer than estimated or measured planning may take the next time.
_MARGIN = 3
# How many times as long it takes until the first commands have gone out.
_READY = 1.5


@dataclass(eq=False)
class Work:
    """A request, or a plan to be made anew, that is being worked out."""

    joints: frozenset[str]  # whose plans it changes
    steps: Drafting
    request: Request | None = None  # None for a plan that is made anew
    number: int = field(default_factory=count().__next__)  # grows from one to the next
    corrects: bool = False  # from samples
    spent: int = 0  # time in ns

    @property
    def postponed(self) -> bool:
        """Whether a running plan goes on until a stamp before this one begins."""
        return isinstance(self.request, Trajectory) and self.request.stamp is not None

    def replaces(self, others: Iterable['Work']) -> bool:
        """Return whether it makes no difference to its plans that others are planned later."""
        return not self.postponed and all(
            x.joints <= self.joints or x.joints.isdisjoint(self.joints) for x in others)


def work_on(request: Request, group: PlannerGroup, clock: Clock, then: Then) -> Work:
    """Return the work that a request of joints of a group makes; see `in_time`."""
    names = group.planners if isinstance(request, Stop) else request.joints
    planners = [group.planners[x] for x in names]
    if isinstance(request, Trajectory):
        steps = _trajectory(request, group, planners, clock, then)
    elif isinstance(request, Stop):
        steps = in_time(group.draft_stop, planners, clock)
    else:
        steps = in_time(
            partial(group.draft_setpoint, request.joint, request.stretch), planners, clock,
            then=then)
    return Work(frozenset(names), steps, request)


def anew(
        name: str, planner: Planner, make: Callable[[int], Steps[Draft | None]], clock: Clock, *,
        corrects: bool = False) -> Work:
    """Return the work of making a joint's plan anew; without a draft it stays."""
    def steps(now: int) -> Steps[Mapping[str, Draft]]:
        draft = yield from make(now)
        return {} if draft is None else {name: draft}
    return Work(frozenset([name]), in_time(steps, [planner], clock), corrects=corrects)


def _trajectory(
        request: Trajectory, group: PlannerGroup, planners: Sequence[Planner], clock: Clock,
        then: Then) -> Drafting:
    """Read the points, then plan."""
    points: dict[str, list[tuple[Any, int]]] = {name: [] for name in request.joints}
    for number, (stretches, time) in enumerate(
            request.points if request.path is None else request.path):
        for name, stretch in zip(request.joints, stretches, strict=True):
            points[name].append((stretch, time))
        if number % _READ == _READ - 1:
            yield
    return (yield from in_time(
        lambda now: group.draft_request(
            points, request.stamp, now, raw=request.raw, path=request.path is not None),
        planners, clock,
        # The work of a path is not in proportion to its points.
        1 if request.path is not None else request.count * len(request.joints), then))


def in_time(
        make: Callable[[int], Steps[Mapping[str, Draft]]], planners: Sequence[Planner],
        clock: Clock, size: int = 1, then: Then = dict) -> Drafting:
    """
    Return drafts, and the time in ns they are for, which has not come yet when they are ready.

    If what is going to happen to the joints changes meanwhile, it begins anew. The size is about
    how many pauses it makes. What is done with drafts `then` belongs to the work.
    """
    lead = planners[0].options.lead_time
    later = 0
    while True:
        began = clock()
        revisions = [x.revision for x in planners]
        steps = make(began + later)
        drafts: Mapping[str, Draft] | None = None
        for done in count(1):
            try:
                next(steps)
            except StopIteration as end:
                drafts = end.value
                break
            spent = clock() - began
            if 2 * spent > lead + 2 * later and spent * size > (lead + later) * done:
                # It will not be ready in time.
                later = max(_MARGIN * spent * size // done, 2 * later)
                break
            if revisions != [x.revision for x in planners]:
                break
            yield
        if drafts is None or revisions != [x.revision for x in planners]:
            yield
            continue
        if not drafts:
            return drafts, began + later
        drafts = then(drafts)
        spent = clock() - began
        if min(x.begin for x in drafts.values()) >= began + _READY * spent:
            return drafts, began + later
        later = max(_MARGIN * spent, later)
