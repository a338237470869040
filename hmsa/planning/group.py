"""
Planners of several joints that accept a request together or not at all.

A single joint is a group of one, planned as by its planner alone.
"""

from bisect import bisect_left, bisect_right
from collections.abc import Callable, Iterable, Mapping, Sequence
from copy import copy
from dataclasses import dataclass
from itertools import groupby
import math
from typing import Any

from hmsa.model.status import RefusedError
from hmsa.planning import Check, proceed
from hmsa.planning.history import Deviation
from hmsa.planning.planner import Planner
from hmsa.planning.timeline import Draft, PlannedSegment, Timeline

# Maximum number of successive replans without a command in time.
_ATTEMPTS = 3
# Load and rate tolerance within which a joint counts as at rest, relative.
_AT_REST = 1e-6
# The state of the group is the first of these that any joint is in.
_STATES = ('moving', 'waiting', 'holding', 'settling', 'at_rest', 'idle')
# Setpoints whose arrivals are compared between two checks.
_COMPARED = 100


@dataclass(frozen=True)
class Progress:
    """Progress of a joint, or of all joints, in their sequence."""

    state: str = 'idle'  #: idle, or another of `_STATES`
    setpoint: int = 0  #: current setpoint, from 1
    setpoints: int = 0
    stretch: str = ''  #: target; empty for none, or for several joints


@dataclass(frozen=True)
class Resumption:
    """Continuation of a joint after a deviation: a draft (None if done), or the reason to stop."""

    draft: Draft | None
    refusal: str = ''
    left: float = 0.0  #: residual vibration of the unchanged plan, as a fraction of the step


class PlannerGroup:
    """
    Several planners, each with its own block, limits and timeline.

    Lead time and command period must be the same for all. With ``simultaneous``, which may change
    between requests, faster joints start later so that all arrive together. ``number`` counts
    accepted requests from 1.
    """

    def __init__(
            self, planners: Mapping[str, Planner], *, simultaneous: bool = False) -> None:
        """Keep the planners."""
        self.planners = dict(planners)
        self.simultaneous = simultaneous
        self.number = 0
        self._attempts = dict.fromkeys(self.planners, 0)
        self.check: Check = proceed

    def snapshot(self, start: Callable[[Planner], int]) -> 'PlannerGroup':
        """Return a group with the present plans, to draft from a start in another thread."""
        group = copy(self)
        group.planners = {name: x.snapshot([start(x)]) for name, x in self.planners.items()}
        return group

    def checked(self, check: Check) -> 'PlannerGroup':
        """Return a group with the same plans whose drafts call ``check``."""
        group = copy(self)
        group.planners = {name: x.checked(check) for name, x in self.planners.items()}
        group.check = check
        return group

    # -- requests ------------------------------------------------------------------------------

    def draft_request(
            self, points: Mapping[str, Sequence[tuple[Any, int]]], stamp: int | None,
            now: int, *, raw: bool = False, path: bool = False) -> dict[str, Draft]:
        """Draft a sequence, levels if raw, or a path; omit joints that it does not change."""
        draft: Callable[..., Draft | None] = (
            Planner.draft_levels if raw else Planner.draft_path if path
            else Planner.draft_request)
        drafts = self._each(
            points, lambda name: draft(self.planners[name], points[name], stamp, now))
        if self.simultaneous and not (raw or path):
            return self._together(drafts)
        return drafts

    def draft_setpoint(self, name: str, stretch: float, now: int) -> dict[str, Draft]:
        """Draft a move of one joint; see `draft_request`."""
        try:
            draft = self.planners[name].draft_setpoint(stretch, now)
        except RefusedError as error:
            if len(self.planners) == 1:
                raise
            raise _of_joint(name, error) from error
        return {} if draft is None else {name: draft}

    def draft_stop(self, now: int) -> dict[str, Draft]:
        """Draft a stop of all joints; see `draft_request`."""
        return self._each(
            self.planners, lambda name: self.planners[name].draft_stop(now))

    def take(self, drafts: Mapping[str, Draft], now: int) -> dict[str, Timeline]:
        """Take drafts of one request, made at the same time (ns); return the new plans."""
        plans = {}
        for name, draft in drafts.items():
            plans[name] = self.planners[name].take(draft, now)
            self._attempts[name] = 0
        self.number += bool(drafts)
        return plans

    def resume(self, name: str, found: Resumption, now: int) -> None:
        """Take the new plan of a joint."""
        self._attempts[name] += 1
        self.planners[name].take(found.draft, now)

    def may_resume(self, name: str) -> bool:
        """Return whether a joint may replan; False after several replans that came too late."""
        return self._attempts[name] < _ATTEMPTS

    def applied(
            self, name: str, stamp: int, flux_density: float,
            tolerance: int) -> Deviation | None:
        """Record a change of level of a joint, as `RunningPlan.applied` does."""
        found = self.planners[name].applied(stamp, flux_density, tolerance)
        if found is not None and found.effect == 0.0:
            self._attempts[name] = 0
        return found

    def _each(
            self, names: Iterable[str],
            draft: Callable[[str], Draft | None]) -> dict[str, Draft]:
        drafts = {}
        for name in names:
            try:
                made = draft(name)
            except RefusedError as error:
                if len(self.planners) == 1:
                    raise
                raise _of_joint(name, error) from error
            if made is not None:
                drafts[name] = made
        return drafts

    def _together(self, drafts: dict[str, Draft]) -> dict[str, Draft]:
        """Delay moves that would arrive before the slowest one to the same setpoint."""
        delays: dict[str, list[int]] = {name: [] for name in drafts}
        for number, row in enumerate(zip(*(x.segments for x in drafts.values()), strict=True)):
            latest = max((x.arrival for x in row if x.arrival is not None), default=None)
            for (name, draft), segment in zip(drafts.items(), row, strict=True):
                delays[name].append(
                    latest - segment.arrival
                    if latest is not None and segment.arrival is not None
                    and _rests(draft, segment) else 0)
            if number % _COMPARED == _COMPARED - 1:
                self.check()
        return {name: draft.delayed(delays[name]) for name, draft in drafts.items()}

    # -- progress ------------------------------------------------------------------------------

    def restart(self) -> None:
        """Drop all plans, after the clock has jumped back."""
        for planner in self.planners.values():
            planner.restart()

    def clock_set(self, by: int) -> None:
        """Shift all plans by the ns that the clock was set ahead."""
        for planner in self.planners.values():
            planner.clock_set(by)

    def next_command(self) -> int | None:
        """Return the time in ns at which to send the next command; None if there is none."""
        times = ((x.next_stamp, x.options.lead_time) for x in self.planners.values())
        return min((stamp - lead for stamp, lead in times if stamp is not None), default=None)

    def next_change(self, now: int) -> int | None:
        """Return the time in ns of the next change of progress after now; None for none."""
        return min((
            x for planner in self.planners.values() for x in _changes(planner.plan, now)
        ), default=None)

    def progress(self, now: int) -> tuple[Progress, dict[str, Progress]]:
        """Return the progress of all joints, with the counts of the busiest one, and of each."""
        each = {name: _progress(x.plan, now) for name, x in self.planners.items()}
        if len(each) == 1:
            return next(iter(each.values())), each
        busy = [x for x in each.values() if x.state != 'idle']
        if not busy:
            return Progress(), each
        last = max(busy, key=lambda x: x.setpoints - x.setpoint)
        return Progress(
            min((x.state for x in busy), key=_STATES.index), last.setpoint,
            last.setpoints), each

    def preview(
            self, begin: int,
            limit: int) -> tuple[list[int], dict[str, list[tuple[float, float, float]]]]:
        """Return timestamps (ns) and, by joint, stretch, rate (1/s) and flux density (T)."""
        # From the latest change at or before begin on, at most limit changes of all joints.
        ahead = [
            [x.stamp for x in planner.plan.ahead(begin, limit)]
            for planner in self.planners.values()]
        start = max((x[0] for x in ahead if x and x[0] <= begin), default=0)
        stamps = sorted({x for each in ahead for x in each if x >= start})[:limit]
        return stamps, {
            name: _samples(planner.caught_up(), stamps)
            for name, planner in self.planners.items()}


def _of_joint(name: str, error: RefusedError) -> RefusedError:
    return RefusedError(error.code, f'joint {name}: {error}')


def resumed(planner: Planner, now: int) -> Resumption:
    """Draft the rest of a joint's plan, or else a stop."""
    try:
        return Resumption(planner.draft_resumption(now))
    except RefusedError as error:
        return Resumption(planner.draft_stop(now), str(error))


def _rests(draft: Draft, segment: PlannedSegment) -> bool:
    """Return whether a joint can start a move later, since it rests until then."""
    level = draft.levels[bisect_left(draft.levels, segment.begin, key=lambda x: x.stamp)]
    model = level.model
    # A creeping joint would have relaxed further by then.
    return not model.material.creeps and (
        abs(level.state.rate) <= _AT_REST
        and math.isclose(
            level.state.load, model.holding(level.stretch), rel_tol=_AT_REST, abs_tol=_AT_REST))


def _samples(plan: Timeline, stamps: Sequence[int]) -> list[tuple[float, float, float]]:
    """Return stretch, rate in 1/s and flux density in T of a plan at increasing times in ns."""
    samples: list[tuple[float, float, float]] = []
    for place, group in groupby(stamps, key=plan.place):
        level = plan.levels[place]
        times = [max(x, level.stamp) for x in group]
        samples += [(*x, level.flux_density) for x in level.sample(times)]
    return samples


def _changes(plan: Timeline, now: int) -> Iterable[int]:
    """Return the next times after now at which the progress of a plan changes."""
    place = bisect_right(plan.segments, now, key=lambda x: x.since)
    for segment in plan.segments[place:place + 1]:
        yield segment.since
    for segment in plan.segments[max(place - 1, 0):place + 1]:
        if segment.arrival is not None and segment.arrival > now:
            yield segment.arrival


def _progress(plan: Timeline, now: int) -> Progress:
    """Return the progress of a plan."""
    count = len(plan.segments) - plan.kept
    place = plan.under_way(now)
    if place < plan.kept:
        return Progress('waiting' if count else 'idle', 0, count)
    segment = plan.segments[place]
    last = place == len(plan.segments) - 1
    if segment.arrival is None:
        state = 'settling' if last else 'moving'
    elif now < segment.arrival:
        state = 'moving'
    else:
        state = 'at_rest' if last else 'holding'
    return Progress(state, place - plan.kept + 1, count, f'{segment.stretch:.12g}')
