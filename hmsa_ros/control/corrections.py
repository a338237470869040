"""Plans that are corrected from what feedback has seen."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
import math

import numpy as np

from hmsa_ros.control.feedback import Feedback
from hmsa_ros.control.learnt import as_of_path, believed, learnt_model
from hmsa_ros.control.records import Severity, Verdict
from hmsa_ros.control.slices import Clock, Drafting, in_time, Work
from hmsa_ros.control.trimming import trimmed
from hmsa_ros.estimation import Estimate
from hmsa_ros.estimation.correction import (
    Ahead,
    AT_REST,
    caution,
    CLEARLY,
    Course,
    expect,
    expect_along,
    LITTLE,
    MUCH,
    Outcome,
    SHARE,
    worthwhile,
)
from hmsa_ros.estimation.words import confounded
from hmsa_ros.model.status import Code, RefusedError
from hmsa_ros.model.units import NANOSECONDS
from hmsa_ros.planning.drafting import Steps
from hmsa_ros.planning.group import PlannerGroup
from hmsa_ros.planning.planner import Planner
from hmsa_ros.planning.timeline import Draft, Model, Plan, PlannedLevel

# A correction gains at least this share of the step, less while a move has time for corrections:
# what rests is not to be moved for little.
_GAIN, _LITTLE = 5e-4, 5e-5
# And this share of the noise of a sample.
_NOISE = 0.02
# Units of time before its end from which on a move is not corrected any more.
_SHORTEST = 0.3
# Share of the step from which on a bias matters that may be a force: after a move that began this
# near to rest without field, where they look alike, what rests is then corrected for much alone.
_HIDDEN, _FIRST = 0.01, 0.02
# Levels that differ by less, in units of load, are the same.
_SAME = 1e-5
# Natural periods after which a path that was joined is looked at again, and at least as many times
# as long as planning took; periods and samples it is looked ahead for; levels before that count.
_JOINED, _IDLE, _PERIODS, _SAMPLES, _BEFORE = 2, 4, 3, 61, 8
# Deviations by which creep is known that a path takes into account: of what samples cannot tell
# apart the sum counts.
_CREEPS = 1.0
# A step that is smaller counts as this one.
_LEAST_STEP = 0.1


class Corrections:
    """Corrects plans where that is expected to leave less."""

    def __init__(self, group: PlannerGroup, feedback: Feedback, clock: Clock) -> None:
        self._group, self._feedback, self._clock = group, feedback, clock
        # Times in ns at which moves that take longer are at rest.
        self._arrivals: dict[str, int] = {}
        # Times in ns from which on paths are looked at again, and that planning one took.
        self._looks: dict[str, int] = {}
        self._spent: dict[str, int] = {}
        # What corrections that have been worked out are expected to leave.
        self._after: dict[str, float] = {}

    def cautious(self, drafts: Mapping[str, Draft]) -> Mapping[str, Draft]:
        """
        Give first moves more time to be corrected in, where they are expected to leave much.

        Their levels stay: the early effect of these shows what the actuator is.
        """
        self._arrivals = {x: y for x, y in self._arrivals.items() if x not in drafts}
        return {name: self._slowly(name, draft) for name, draft in drafts.items()}

    def _slowly(self, name: str, draft: Draft) -> Draft:
        segment, *rest = draft.segments
        estimate = self._feedback.foreseen(name, draft.begin)
        model = draft.levels[-1].model
        self._feedback.planned(name, model, 0.0)
        if estimate is None or segment.arrival is None or segment.code in (
                Code.LEVELS, Code.PATH):
            return draft
        step = max(abs(segment.stretch - draft.levels[0].stretch), _LEAST_STEP)
        course = _drafted(draft, self._group.planners[name].plan)
        slew = self._group.planners[name].options.slew_limit
        self._feedback.planned(name, model, expect(estimate, course, slew).size)
        if math.isinf(self._feedback.tolerance):
            return draft
        # What is only suspected is no reason to take longer.
        size = expect(estimate.sure_of(self._feedback.named), course, slew).size
        if size <= self._feedback.tolerance * step:
            return draft
        longer = caution(self._feedback.named, estimate.noise / step)
        arrival = segment.begin + round(longer * (segment.arrival - segment.begin))
        if rest:
            arrival = max(min(arrival, rest[0].begin), segment.arrival)
        self._arrivals[name] = arrival
        self._feedback.takes_longer(name, arrival)
        return replace(draft, segments=(replace(segment, arrival=arrival), *rest))

    def due(self, now: int) -> Iterator[Work]:
        """Yield what may be worth correcting by a time in ns; the results are for `take`."""
        for name in self._feedback.taken_back():
            yield self._work(name, partial(self._take_back, name))
        for name, planner in self._feedback.news():
            if not planner.plan.segments:
                continue
            if planner.as_sent(planner.soonest(now)):
                if self._leaves_path(name, now):
                    yield self._work(name, partial(self._rejoin, name))
                continue
            estimate = self._feedback.state(name, planner.soonest(now))
            if estimate is None:
                continue
            level = trimmed(planner, estimate, self._feedback.trim)
            if level is not None:
                steps = partial(self._trim, name, level)
            elif self._feedback.adapted(name) and self._worthwhile(
                    name, estimate, planner, now):
                steps = partial(self._correct, name)
            else:
                continue
            yield self._work(name, steps)

    def _work(self, name: str, steps: Callable[[int], Steps[Mapping[str, Draft]]]) -> Work:
        joints = frozenset([name])
        work = in_time(steps, self._group, joints, self._clock)
        return Work(joints, self._timed(name, work), corrects=True)

    def _timed(self, name: str, steps: Drafting) -> Drafting:
        """Do work, and let commands have their share of the time after it."""
        spent = 0
        while True:
            begun = self._clock()
            try:
                next(steps)
            except StopIteration as end:
                self._feedback.spent(name, spent + self._clock() - begun)
                drafts: tuple[Mapping[str, Draft], int] = end.value
                return drafts
            spent += self._clock() - begun
            yield

    def _take_back(self, name: str, now: int) -> Steps[Mapping[str, Draft]]:
        """Go on by the model in force, whatever was corrected before."""
        planner = self._group.planners[name]
        plan, soonest = planner.plan, planner.soonest(now)
        place = plan.under_way(soonest)
        if place < 0:
            return {}
        segment = plan.segments[place]
        if planner.as_sent(soonest):
            return {} if _ahead(planner, soonest) is None else {
                name: (yield from planner.draft_path_anew(soonest, planner.model, None))}
        if place + 1 < len(plan.segments) or segment.arrival is None or segment.arrival > soonest:
            draft = yield from planner.draft_resumption(now)
            return {} if draft is None or draft.missed else {name: draft}
        model, level = planner.model, plan.levels[-1].flux_density
        holding = model.flux_density(model.holding(segment.stretch))
        return {} if abs(holding - level) < _SAME * model.units.load else {
            name: (yield from planner.draft_trim(now, holding))}

    def _trim(self, name: str, level: float, now: int) -> Steps[Mapping[str, Draft]]:
        """Hold by another level in T."""
        return {name: (yield from self._group.planners[name].draft_trim(now, level))}

    def _arrival(self, name: str, now: int) -> int:
        """Return the time in ns of rest of a move that has time for corrections; 0 without one."""
        planner, arrival = self._group.planners[name], self._arrivals.get(name, 0)
        left = arrival - planner.soonest(now)
        return arrival if left >= _SHORTEST * planner.model.units.time * NANOSECONDS else 0

    def _worthwhile(self, name: str, estimate: Estimate, planner: Planner, now: int) -> bool:
        """Return whether a plan is expected to leave more than it must."""
        share = _LITTLE if self._arrival(name, now) else (
            _GAIN if self._feedback.shown(name, now) else MUCH)
        course, gain = course_of(planner.plan, estimate.time, share)
        return expect(estimate, course, planner.options.slew_limit).size > gain

    def _correct(self, name: str, now: int) -> Steps[Mapping[str, Draft]]:
        """Plan the rest anew, if that is expected to leave less."""
        planner, arrival = self._group.planners[name], self._arrival(name, now)
        try:
            draft = yield from planner.draft_resumption(now, arrival or None)
        except RefusedError:
            if not arrival:
                raise
            return {}
        estimate = None if draft is None else self._feedback.state(name, draft.begin)
        if draft is None or estimate is None or draft.missed:
            # A correction leaves no setpoint out.
            return {}
        if max(abs(x.flux_density) for x in draft.levels) > self._feedback.possible(name):
            # An amplifier that is saturated follows no larger level.
            return {}
        slew = planner.options.slew_limit
        course, gain = course_of(planner.plan, draft.begin, _LITTLE if arrival else _GAIN)
        segment = draft.segments[0]
        start = self._feedback.start(name)
        step = max(abs(segment.stretch - start), _LEAST_STEP)
        # A force that samples do not show either way is not to make it worse.
        doubted = estimate.doubted
        hidden = MUCH * step if not arrival and abs(
            start - planner.model.actuator.rest) < _FIRST and confounded(
                doubted, _HIDDEN * step) else 0.0
        for each, least in ((doubted, hidden), (estimate, 0.0)):
            before = expect(each, course, slew, segment.arrival or 0)
            after = expect(each, _drafted(draft, planner.plan), slew)
            if not worthwhile(
                    before, after, max(gain, least, _NOISE * estimate.noise),
                    little=LITTLE * step, share=SHARE if arrival else AT_REST):
                return {}
        self._after[name] = after.size
        return {name: draft}

    def _leaves_path(self, name: str, now: int) -> bool:
        """Return whether a path under way may be expected to be left, every natural period."""
        planner = self._group.planners[name]
        begin = planner.soonest(now + self._spent.get(name, 0))
        ahead = _ahead(planner, begin) if begin >= self._looks.get(name, 0) else None
        estimate = None if ahead is None else self._feedback.state(name, begin)
        if ahead is None or estimate is None:
            return False
        self._looks[name] = begin + _period(planner)
        left = self._leaves(estimate, planner, planner.plan.levels, ahead)
        # At best nothing but what is not known.
        return self._nearer(name, left, replace(left, misses=0.0 * left.misses), estimate)

    def _leaves(
            self, estimate: Estimate, planner: Planner, levels: Sequence[PlannedLevel],
            ahead: Ahead) -> Outcome:
        """Return how far levels from the time of an estimate on lead off a path."""
        first, begin = planner.plan.place(estimate.time - 1), estimate.time
        end = begin + round(ahead.times[-1] * NANOSECONDS)
        course = (*planner.plan.levels[max(first - _BEFORE, 0):first + 1],
                  *(x for x in levels if begin <= x.stamp <= end))
        return expect_along(
            estimate, [(x.stamp, x.flux_density) for x in course], ahead,
            planner.options.slew_limit)

    def _nearer(self, name: str, before: Outcome, after: Outcome, estimate: Estimate) -> bool:
        """Return whether another course of a path is to take the place of that in force."""
        planner = self._group.planners[name]
        model = planner.plan.level(estimate.time).model
        return worthwhile(
            before, after, max(_GAIN * _range(planner, estimate.time), _NOISE * estimate.noise),
            little=0.0, share=SHARE if self._feedback.adapted(name, model) else CLEARLY)

    def _rejoin(self, name: str, now: int) -> Steps[Mapping[str, Draft]]:
        """Plan the rest of a path anew by what is known now, if that stays nearer to it."""
        planner, begun = self._group.planners[name], self._clock()
        begin = planner.soonest(now + self._spent.get(name, 0))
        estimate = self._feedback.state(name, begin)
        ahead = _ahead(planner, begin)
        if estimate is None or ahead is None:
            return {}
        model = learnt_model(
            planner.model, estimate, planner.plan.segments[-1].stretch, _CREEPS)
        model = as_of_path(model, planner.model, estimate)
        draft = yield from planner.draft_path_anew(
            begin, model, believed(estimate, creeps=bool(model.actuator.creep)))
        spent = self._clock() - begun
        self._spent[name] = spent + spent // 2
        self._looks[name] = begin + max(_JOINED * _period(planner), _IDLE * spent)
        before, after = (self._leaves(estimate, planner, x, ahead)
                         for x in (planner.plan.levels, draft.levels))
        if max(abs(x.flux_density) for x in draft.levels) > self._feedback.possible(
                name) or not self._nearer(name, before, after, estimate):
            return {}
        self._after[name] = after.size
        return {name: draft}

    def take(self, drafts: Mapping[str, Draft], now: int, request: str) -> Verdict | None:
        """Take a correction worked out for a time in ns; None where nothing changes."""
        for name, draft in drafts.items():
            words = self._feedback.words(name, self._clock())
            self._group.planners[name].take(draft, now)
            self._feedback.corrected(name, draft.begin, self._after.pop(name, 0.0))
            if draft.segments[0].path is not None:
                # What the path was corrected by also takes it to rest, should it be stopped.
                self._feedback.use(name, draft.levels[0].model)
            return Verdict(
                Severity.OK, Code.CORRECTED, f'corrected from samples: {words}', request)
        return None


def _drafted(draft: Draft, plan: Plan) -> Course:
    """Return the course of the first setpoint of a draft that takes the place of a plan."""
    segment, *rest = draft.segments
    before = _until(plan, plan.place(draft.begin - 1) + 1)
    return Course(
        tuple((x.stamp, x.flux_density) for x in (*before, *draft.levels)
              if not rest or x.stamp < rest[0].begin),
        segment.arrival or draft.begin, segment.stretch, before[0].flux_density,
        _relaxed(draft.levels[0].model, segment.stretch) if rest else math.nan)


def _relaxed(model: Model, stretch: float) -> float:
    """Return the level in T where a tail leads that the next setpoint cuts; NaN without creep."""
    return model.flux_density(model.holding(stretch)) if model.material.creep else math.nan


def _until(plan: Plan, place: int) -> Sequence[PlannedLevel]:
    """Return the last levels before a place, which the field of a coil that lags remembers."""
    return plan.levels[max(place - _BEFORE, 0):place]


def course_of(plan: Plan, begin: int, gain: float) -> tuple[Course, float]:
    """Return what is planned from a time in ns to its setpoint's end, and what counts then."""
    levels, place = plan.levels, max(plan.under_way(begin), 0)
    segment = plan.segments[place]
    end = plan.segments[place + 1].begin if place + 1 < len(plan.segments) else None
    first = plan.place(begin)
    kept = [x for x in levels[first:] if end is None or x.stamp < end or x is levels[first]]
    start = plan.segments[place - 1].stretch if place else levels[0].stretch
    course = [*_until(plan, first), *kept]
    return Course(
        tuple((x.stamp, x.flux_density) for x in course),
        segment.arrival or kept[-1].stamp, segment.stretch, course[0].flux_density,
        math.nan if end is None else _relaxed(kept[-1].model, segment.stretch)), max(
            gain * abs(segment.stretch - start), gain * _LEAST_STEP, segment.vibration)


def _period(planner: Planner) -> int:
    """Return the natural period about the end of the plan in ns."""
    model = planner.model
    return model.ns(2.0 * math.pi / model.frequency(planner.plan.segments[-1].stretch))


def _ahead(planner: Planner, begin: int) -> Ahead | None:
    """Return the next part of the path under way at a time in ns; None where little is left."""
    plan = planner.plan
    segment, period = plan.segments[plan.under_way(begin)], _period(planner)
    if segment.path is None or segment is not plan.segments[-1]:
        return None
    since = (begin - segment.since) / NANOSECONDS
    left = segment.path.breaks[-1] - since
    if left * NANOSECONDS < _JOINED * period:
        return None
    # Not the way back to it.
    times = np.linspace(period, min(_PERIODS * period, left * NANOSECONDS), _SAMPLES) / NANOSECONDS
    return Ahead(times, segment.path.course(times + since)[0])


def _range(planner: Planner, time: int) -> float:
    """Return the range of the path under way at a time in ns."""
    path = planner.plan.segments[planner.plan.under_way(time)].path
    return 0.0 if path is None else float(np.ptp(path.course(path.breaks)[0]))
