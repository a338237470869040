"""
Planners of several joints that take a request together or not at all.

Knows no ROS. One joint is a group of one, planned as by its planner alone.
"""

from bisect import bisect_right
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import groupby
import math

from hmsa_ros.core.history import Deviation
from hmsa_ros.core.planner import Planner
from hmsa_ros.core.status import RefusedError
from hmsa_ros.core.timeline import Draft, Plan, PlannedSegment

# How often running a plan is made anew, with no command in time in between.
_ATTEMPTS = 3
# What a joint counts as resting within, relative to its load and its natural frequency.
_AT_REST = 1e-6
# The first of these that some joint is in is that of all.
_STATES = ('moving', 'waiting', 'holding', 'settling', 'at_rest', 'idle')


@dataclass(frozen=True)
class Progress:
    """
    How far a joint, or all of them, have come in their sequence.

    Attributes
    ----------
    state : str
        idle, waiting, moving, holding, settling or at_rest.
    setpoint, setpoints : int
        Which one is under way, from 1, and how many there are.
    stretch : str
        Target; empty for none, or for several joints.

    """

    state: str = 'idle'
    setpoint: int = 0
    setpoints: int = 0
    stretch: str = ''


@dataclass(frozen=True)
class Resumption:
    """
    What became of plans that were to be made anew.

    Attributes
    ----------
    resumed : int
        Joints whose sequence goes on.
    missed : int
        Setpoints that were left out.
    stopped : mapping of str to str
        Joints that come to rest instead, and why.
    given_up : tuple of str
        Joints whose plan stays as it is, since it was made anew in vain several times running.

    """

    resumed: int = 0
    missed: int = 0
    stopped: Mapping[str, str] = field(default_factory=dict)
    given_up: tuple[str, ...] = ()


class PlannerGroup:
    """
    Several planners, each with a block, limits and a timeline of its own.

    Parameters
    ----------
    planners : mapping of str to Planner
        By joint; lead time and command period must be the same for all.
    simultaneous : bool
        Whether joints that would arrive sooner begin later, so that all arrive together.

    Attributes
    ----------
    planners : mapping of str to Planner
        As given.
    simultaneous : bool
        May be changed; taken from the next request on.
    number : int
        Counts accepted requests from 1.

    """

    def __init__(
            self, planners: Mapping[str, Planner], *, simultaneous: bool = False) -> None:
        """Take the planners as they are."""
        self.planners = dict(planners)
        self.simultaneous = simultaneous
        self.number = 0
        self._attempts = dict.fromkeys(self.planners, 0)

    # -- requests ------------------------------------------------------------------------------

    def draft_request(
            self, points: Mapping[str, Sequence[tuple[float, int]]], stamp: int | None,
            now: int) -> dict[str, Draft]:
        """
        Work out a setpoint sequence for some joints or all.

        Parameters
        ----------
        points : mapping of str to sequence of (float, int)
            By joint: stretch, and time in ns from the start until which it lasts, the times
            alike for all.
        stamp : int or None
            Start in ns; None for now.
        now : int
            Current time in ns.

        Returns
        -------
        dict of str to Draft
            To be taken; joints for which nothing changes are missing.

        Raises
        ------
        RefusedError
            If it cannot be carried out by one of them; it is named.

        """
        drafts = self._each(
            points, lambda name: self.planners[name].draft_request(points[name], stamp, now))
        return self._together(drafts) if self.simultaneous else drafts

    def draft_setpoint(self, name: str, stretch: float, now: int) -> dict[str, Draft]:
        """Work out a single stretch for one joint; `draft_request` says more."""
        return self._each(
            [name], lambda name: self.planners[name].draft_setpoint(stretch, now))

    def draft_stop(self, now: int) -> dict[str, Draft]:
        """Work out how all joints come to rest; `draft_request` says more."""
        return self._each(self.planners, lambda name: self.planners[name].draft_stop(now))

    def take(self, drafts: Mapping[str, Draft], now: int) -> bool:
        """
        Take drafts of the same request.

        Parameters
        ----------
        drafts : mapping of str to Draft
            As worked out, with no other taken since.
        now : int
            Current time in ns, as they were made with.

        Returns
        -------
        bool
            Whether anything changes.

        """
        for name, draft in drafts.items():
            self.planners[name].take(draft, now)
            self._attempts[name] = 0
        self.number += bool(drafts)
        return bool(drafts)

    def resume(self, names: Iterable[str], now: int) -> Resumption:
        """
        Plan what is left of the running plans anew, and stop the joints for which that fails.

        Where commands come late for ever, so would those of every new plan: a joint whose plan
        was made anew several times with no command in time since is left alone.

        Parameters
        ----------
        names : iterable of str
            Joints.
        now : int
            Current time in ns.

        Returns
        -------
        Resumption
            What became of it.

        """
        resumed = missed = 0
        stopped = {}
        given_up = []
        for name in names:
            if not self.may_resume(name):
                given_up.append(name)
                continue
            self._attempts[name] += 1
            planner = self.planners[name]
            try:
                draft = planner.draft_resumption(now)
            except RefusedError as error:
                stopped[name] = str(error)
                draft = planner.draft_stop(now)
            else:
                resumed += draft is not None
                missed += 0 if draft is None else draft.missed
            planner.take(draft, now)
        return Resumption(resumed, missed, stopped, tuple(given_up))

    def may_resume(self, name: str) -> bool:
        """Return whether `resume` would plan for a joint anew."""
        return self._attempts[name] < _ATTEMPTS

    def applied(
            self, name: str, stamp: int, flux_density: float,
            tolerance: int) -> Deviation | None:
        """
        Take in a change of level of a joint that has taken effect.

        Parameters
        ----------
        name : str
            Joint.
        stamp, flux_density, tolerance : int, float, int
            As for `Planner.applied`.

        Returns
        -------
        Deviation or None
            What calls for a plan to be made anew; None if it is near enough as planned.

        """
        found = self.planners[name].applied(stamp, flux_density, tolerance)
        if found is None:
            return None
        if found.foreign or found.lost or abs(found.late) > tolerance:
            return found
        self._attempts[name] = 0
        return None

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
                raise RefusedError(error.code, f'joint {name}: {error}') from error
            if made is not None:
                drafts[name] = made
        return drafts

    def _together(self, drafts: dict[str, Draft]) -> dict[str, Draft]:
        """Have moves begin later that would arrive before the slowest of their spell."""
        arrivals = [
            max((x for x in spell if x is not None), default=None) for spell in zip(
                *([x.arrival for x in draft.segments] for draft in drafts.values()),
                strict=True)]
        return {
            name: draft.delayed([
                latest - segment.arrival
                if latest is not None and segment.arrival is not None
                and self._rests(draft, segment) else 0
                for latest, segment in zip(arrivals, draft.segments, strict=True)])
            for name, draft in drafts.items()}

    def _rests(self, draft: Draft, segment: PlannedSegment) -> bool:
        """Whether a joint can as well begin a move later, since it rests until then."""
        level = next(x for x in draft.levels if x.stamp == segment.begin)
        model = level.model
        load = level.in_force / model.units.load
        return (
            abs(level.rate) * model.units.time <= _AT_REST
            and math.isclose(
                load, model.holding(level.stretch), rel_tol=_AT_REST, abs_tol=_AT_REST))

    # -- what comes of them --------------------------------------------------------------------

    def restart(self) -> None:
        """Drop all plans, after the clock has jumped back."""
        for planner in self.planners.values():
            planner.restart()

    @property
    def pending(self) -> bool:
        """Whether commands remain to be handed out."""
        return any(x.pending for x in self.planners.values())

    def next_event(self, now: int) -> int | None:
        """
        Return when there is something to do or to tell next.

        Parameters
        ----------
        now : int
            Current time in ns.

        Returns
        -------
        int or None
            Time in ns at which a command is to be handed out, a setpoint takes over or is
            arrived at; None if nothing of the kind is ahead.

        """
        times = [
            time for planner in self.planners.values()
            for time in (planner.next_due, *_changes(planner.plan, now)) if time is not None]
        return min(times, default=None)

    def progress(self, now: int) -> tuple[Progress, dict[str, Progress]]:
        """
        Return how far all joints have come, and each.

        Parameters
        ----------
        now : int
            Current time in ns.

        Returns
        -------
        progress : Progress
            Of all: the state of the one that has most before it.
        each : dict of str to Progress
            By joint.

        """
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

    def preview(self) -> tuple[list[int], dict[str, list[tuple[float, float, float]]]]:
        """
        Sample the plans of all joints wherever the level of one changes.

        Returns
        -------
        stamps : list of int
            In ns, increasing.
        samples : dict of str to list of (float, float, float)
            By joint, one for each stamp: stretch, rate in 1/s and flux density in T from then
            on.

        """
        stamps = sorted({
            level.stamp for planner in self.planners.values()
            for level in planner.plan.ahead})
        return stamps, {
            name: _samples(planner.plan, stamps) for name, planner in self.planners.items()}


def _samples(plan: Plan, stamps: Sequence[int]) -> list[tuple[float, float, float]]:
    """Return stretch, rate in 1/s and flux density in T of a plan at increasing times in ns."""
    begins = [x.stamp for x in plan.levels]
    samples: list[tuple[float, float, float]] = []
    for index, group in groupby(
            stamps, key=lambda x: max(bisect_right(begins, x) - 1, 0)):
        level = plan.levels[index]
        times = [max(x, level.stamp) for x in group]
        samples += [(*x, level.flux_density) for x in level.sample(times)]
    return samples


def _changes(plan: Plan, now: int) -> Iterable[int]:
    """Return the times after now at which the progress of a plan changes."""
    for segment in plan.segments:
        if segment.spell > now:
            yield segment.spell
        if segment.arrival is not None and segment.arrival > now:
            yield segment.arrival


def _progress(plan: Plan, now: int) -> Progress:
    """Return how far a plan has come."""
    count = len(plan.segments) - plan.kept
    place = bisect_right([x.spell for x in plan.segments], now) - 1
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
