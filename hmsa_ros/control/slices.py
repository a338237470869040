"""Plan requests in slices, so that commands and other requests are served in between."""

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

#: Returns the time in ns of the clock of timestamps.
Clock = Callable[[], int]
#: Pauses after each bounded piece; returns drafts by joint and the time in ns they are for.
Drafting = Steps[tuple[Mapping[str, Draft], int]]
# Processes drafts by joint before they are adopted.
Then = Callable[[Mapping[str, Draft]], Mapping[str, Draft]]
#: Duration of a slice in ns, after which commands and requests are served.
SLICE = 4_000_000
# Number of trajectory points that are read between two pauses.
_READ = 100
# Factor by which planning may take longer next time than estimated or measured.
_MARGIN = 3
# Factor of the planning time until the first commands are sent.
_READY = 1.5


@dataclass(eq=False)
class Work:
    """A request or a replanning in progress."""

    joints: frozenset[str]  # joints whose plans it changes
    steps: Drafting
    request: Request | None = None  # None for a replanning
    number: int = field(default_factory=count().__next__)  # increases with each work
    corrects: bool = False  # whether it is a correction from samples
    spent: int = 0  # time spent on a correction, in ns

    @property
    def postponed(self) -> bool:
        """Whether the present plan continues until a timestamp at which this one begins."""
        return isinstance(self.request, Trajectory) and self.request.stamp is not None

    def replaces(self, others: Iterable['Work']) -> bool:
        """Return whether its plans do not depend on others being planned before."""
        return not self.postponed and all(
            x.joints <= self.joints or x.joints.isdisjoint(self.joints) for x in others)


def work_on(request: Request, group: PlannerGroup, clock: Clock, then: Then) -> Work:
    """Return the work of planning a request for joints of a group; see `in_time`."""
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


def replanning(
        name: str, planner: Planner, make: Callable[[int], Steps[Draft | None]], clock: Clock, *,
        corrects: bool = False) -> Work:
    """Return the work of replanning a joint; without a draft its plan is kept."""
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
        # The work of a path is not proportional to its number of points.
        1 if request.path is not None else request.count * len(request.joints), then))


def in_time(
        make: Callable[[int], Steps[Mapping[str, Draft]]], planners: Sequence[Planner],
        clock: Clock, size: int = 1, then: Then = dict) -> Drafting:
    """
    Return drafts and the time in ns they are for, which has not passed when they are ready.

    Planning restarts if the plans of the joints change meanwhile. ``size`` is the approximate
    number of pauses. The drafts are passed through ``then``, as part of the work.
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
                # The drafts will not be ready in time.
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
