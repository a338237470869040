"""Plans that are corrected from what feedback has seen."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
import math

import numpy as np

from hmsa_ros.control.feedback import Feedback
from hmsa_ros.control.learnt import alike, as_of_path, believed, learnt_model
from hmsa_ros.control.ledger import Moves
from hmsa_ros.control.records import Severity, Verdict
from hmsa_ros.control.slices import anew, Clock, Work
from hmsa_ros.control.tracked import Joint
from hmsa_ros.control.weighing import LEAST_STEP, step_of
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
from hmsa_ros.estimation.motion import rest
from hmsa_ros.estimation.words import confounded
from hmsa_ros.model.status import Code, RefusedError
from hmsa_ros.model.units import NANOSECONDS
from hmsa_ros.planning.drafting import Steps
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
# Units of time after the last change from which on a level is trimmed, so that it is slow beside
# any vibration, and what share of the bound one change may be.
_PAUSE, _PART = 60.0, 0.25
# Deviations by which the rest must be beside the target for that, and the least offset.
_SURE, _OFF = 3.0, 1e-4


class Corrections:
    """Corrects plans where that is expected to leave less."""

    def __init__(self, feedback: Feedback, clock: Clock) -> None:
        self._feedback, self._clock = feedback, clock

    def cautious(self, drafts: Mapping[str, Draft]) -> Mapping[str, Draft]:
        """
        Give first moves more time to be corrected in, where they are expected to leave much.

        Their levels stay: the early effect of these shows what the actuator is.
        """
        joints = self._feedback.joints
        return {name: self._slowly(joints[name], draft) if name in joints else draft
                for name, draft in drafts.items()}

    def _slowly(self, joint: Joint, draft: Draft) -> Draft:
        segment, *rest = draft.segments
        estimate = joint.foreseen(draft.begin)
        joint.moves = Moves(not alike(draft.levels[-1].model, joint.given))
        joint.next_update = joint.next_sample = joint.waits = 0
        if estimate is None or segment.arrival is None or segment.code in (
                Code.LEVELS, Code.PATH):
            return draft
        step = max(abs(segment.stretch - draft.levels[0].stretch), LEAST_STEP)
        course = _drafted(draft, joint.planner.plan)
        slew = joint.planner.options.slew_limit
        joint.moves.expected = expect(estimate, course, slew).size
        if math.isinf(joint.tolerance):
            return draft
        # What is only suspected is no reason to take longer.
        named = len(joint.settings.feedback_parameters)
        if expect(estimate.sure_of(named), course, slew).size <= joint.tolerance * step:
            return draft
        longer = caution(named, estimate.noise / step)
        arrival = segment.begin + round(longer * (segment.arrival - segment.begin))
        if rest:
            arrival = max(min(arrival, rest[0].begin), segment.arrival)
        joint.waits = arrival
        return replace(draft, segments=(replace(segment, arrival=arrival), *rest))

    def due(self, now: int) -> Iterator[Work]:
        """Yield what may be worth correcting by a time in ns; the results are for `take`."""
        for joint in self._feedback.taken_back():
            yield self._work(joint, _take_back)
        for joint in self._feedback.news():
            planner = joint.planner
            if not planner.plan.segments:
                continue
            if planner.as_sent(planner.soonest(now)):
                if _leaves_path(joint, now):
                    yield self._work(joint, self._rejoin)
                continue
            estimate = joint.state(planner.soonest(now))
            if estimate is None:
                continue
            level = _trimmed(joint, estimate)
            if level is not None:
                yield self._work(joint, partial(_trim, level=level))
            elif joint.adapted() and _may_gain(joint, estimate, now):
                yield self._work(joint, _correct)

    def _work(self, joint: Joint, make: Callable[[Joint, int], Steps[Draft | None]]) -> Work:
        return anew(
            joint.name, joint.planner, partial(make, joint), self._clock, corrects=True)

    def _rejoin(self, joint: Joint, now: int) -> Steps[Draft | None]:
        """Plan the rest of a path anew by what is known now, if that stays nearer to it."""
        planner, begun = joint.planner, self._clock()
        begin = planner.soonest(now + joint.planning)
        estimate, ahead = joint.state(begin), _ahead(planner, begin)
        if estimate is None or ahead is None:
            return None
        model = learnt_model(
            planner.model, estimate, planner.plan.segments[-1].stretch, _CREEPS)
        model = as_of_path(model, planner.model, estimate)
        draft = yield from planner.draft_path_anew(
            begin, model, believed(estimate, creeps=bool(model.actuator.creep)))
        spent = self._clock() - begun
        joint.planning = spent + spent // 2
        joint.next_path = begin + max(_JOINED * _period(planner), _IDLE * spent)
        before, after = (_leaves(estimate, planner, x, ahead)
                         for x in (planner.plan.levels, draft.levels))
        if _saturates(joint, draft) or not _nearer(joint, before, after, estimate):
            return None
        joint.after = after.size
        return draft

    def take(self, work: Work, drafts: Mapping[str, Draft], now: int) -> Verdict | None:
        """Take a correction worked out for a time in ns; None where nothing changes."""
        name, = work.joints
        joint, draft = self._feedback.joints.get(name), drafts.get(name)
        if joint is not None:
            # Commands have their share of the time after it.
            self._feedback.spent(joint, work.spent)
        if joint is None or draft is None:
            return None
        words = joint.words(self._clock())
        joint.planner.take(draft, now)
        self._feedback.corrections += 1
        joint.next_sample = 0
        joint.moves.corrected.append(draft.begin)
        joint.moves.expected, joint.after = joint.after, 0.0
        if draft.segments[0].path is not None:
            # What the path was corrected by also takes it to rest, should it be stopped.
            joint.used = draft.levels[0].model
            joint.planner.take_model(joint.used)
        return Verdict(Severity.OK, Code.CORRECTED, f'corrected from samples: {words}')


def _take_back(joint: Joint, now: int) -> Steps[Draft | None]:
    """Go on by the model in force, whatever was corrected before."""
    planner = joint.planner
    plan, model, soonest = planner.plan, planner.model, planner.soonest(now)
    place = plan.under_way(soonest)
    if place < 0:
        return None
    segment = plan.segments[place]
    if planner.as_sent(soonest):
        return None if _ahead(planner, soonest) is None else (
            yield from planner.draft_path_anew(soonest, model, None))
    if place + 1 < len(plan.segments) or segment.arrival is None or segment.arrival > soonest:
        draft = yield from planner.draft_resumption(now)
        return None if draft is None or draft.missed else draft
    holding = model.flux_density(model.holding(segment.stretch))
    level = plan.levels[-1].flux_density
    return None if abs(holding - level) < _SAME * model.units.load else (
        yield from planner.draft_trim(now, holding))


def _trim(joint: Joint, now: int, *, level: float) -> Steps[Draft | None]:
    """Hold by another level in T."""
    return (yield from joint.planner.draft_trim(now, level))


def _arrival(joint: Joint, now: int) -> int:
    """Return the time in ns of rest of a move that has time for corrections; 0 without one."""
    planner = joint.planner
    left = joint.waits - planner.soonest(now)
    return joint.waits if left >= _SHORTEST * planner.model.units.time * NANOSECONDS else 0


def _may_gain(joint: Joint, estimate: Estimate, now: int) -> bool:
    """Return whether a plan is expected to leave more than it must."""
    share = _LITTLE if _arrival(joint, now) else _GAIN if joint.shown(now) else MUCH
    course, gain = course_of(joint.planner.plan, estimate.time, share)
    return expect(estimate, course, joint.planner.options.slew_limit).size > gain


def _saturates(joint: Joint, draft: Draft) -> bool:
    """Return whether a draft has a level that an amplifier which is saturated does not follow."""
    return max(abs(x.flux_density) for x in draft.levels) > joint.largest


def _correct(joint: Joint, now: int) -> Steps[Draft | None]:
    """Plan the rest anew, if that is expected to leave less."""
    planner, arrival = joint.planner, _arrival(joint, now)
    try:
        draft = yield from planner.draft_resumption(now, arrival or None)
    except RefusedError:
        if not arrival:
            raise
        return None
    estimate = None if draft is None else joint.state(draft.begin)
    if draft is None or estimate is None or draft.missed or _saturates(joint, draft):
        # A correction leaves no setpoint out.
        return None
    slew = planner.options.slew_limit
    course, gain = course_of(planner.plan, draft.begin, _LITTLE if arrival else _GAIN)
    segment = draft.segments[0]
    step = max(abs(segment.stretch - joint.start), LEAST_STEP)
    # A force that samples do not show either way is not to make it worse.
    doubted = estimate.doubted
    hidden = MUCH * step if not arrival and abs(
        joint.start - planner.model.actuator.rest) < _FIRST and confounded(
            doubted, _HIDDEN * step) else 0.0
    for each, least in ((doubted, hidden), (estimate, 0.0)):
        before = expect(each, course, slew, segment.arrival or 0)
        after = expect(each, _drafted(draft, planner.plan), slew)
        if not worthwhile(
                before, after, max(gain, least, _NOISE * estimate.noise),
                little=LITTLE * step, share=SHARE if arrival else AT_REST):
            return None
    joint.after = after.size
    return draft


def _leaves_path(joint: Joint, now: int) -> bool:
    """Return whether a path under way may be expected to be left, every natural period."""
    planner = joint.planner
    begin = planner.soonest(now + joint.planning)
    ahead = _ahead(planner, begin) if begin >= joint.next_path else None
    estimate = None if ahead is None else joint.state(begin)
    if ahead is None or estimate is None:
        return False
    joint.next_path = begin + _period(planner)
    left = _leaves(estimate, planner, planner.plan.levels, ahead)
    # At best nothing but what is not known.
    return _nearer(joint, left, replace(left, misses=0.0 * left.misses), estimate)


def _leaves(
        estimate: Estimate, planner: Planner, levels: Sequence[PlannedLevel],
        ahead: Ahead) -> Outcome:
    """Return how far levels from the time of an estimate on lead off a path."""
    first, begin = planner.plan.place(estimate.time - 1), estimate.time
    end = begin + round(ahead.times[-1] * NANOSECONDS)
    course = (*planner.plan.levels[max(first - _BEFORE, 0):first + 1],
              *(x for x in levels if begin <= x.stamp <= end))
    return expect_along(
        estimate, [(x.stamp, x.flux_density) for x in course], ahead, planner.options.slew_limit)


def _nearer(joint: Joint, before: Outcome, after: Outcome, estimate: Estimate) -> bool:
    """Return whether another course of a path is to take the place of that in force."""
    plan = joint.planner.plan
    path = plan.segments[plan.under_way(estimate.time)].path
    span = 0.0 if path is None else float(np.ptp(path.course(path.breaks)[0]))
    return worthwhile(
        before, after, max(_GAIN * span, _NOISE * estimate.noise), little=0.0,
        share=SHARE if joint.adapted(plan.level(estimate.time).model) else CLEARLY)


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
    course = [*_until(plan, first), *kept]
    return Course(
        tuple((x.stamp, x.flux_density) for x in course),
        segment.arrival or kept[-1].stamp, segment.stretch, course[0].flux_density,
        math.nan if end is None else _relaxed(kept[-1].model, segment.stretch)), max(
            gain * step_of(plan, place), segment.vibration)


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


def _trimmed(joint: Joint, estimate: Estimate) -> float | None:
    """
    Return the level in T to hold a setpoint by, which makes up for a constant force.

    It is at most ``feedback_trim`` off that of the model. The estimate is of the time from which
    on levels may be changed. None where the level in force is to be kept: on the way, within what
    is not known of the rest, at the bound, or where no constant force is tracked.
    """
    plan, model, bound = joint.planner.plan, joint.planner.model, joint.settings.feedback_trim
    place = plan.under_way(estimate.time)
    if bound <= 0.0 or 'constant_force' not in estimate.free or place + 1 < len(plan.segments):
        return None
    segment, last = plan.segments[place], plan.levels[-1]
    if segment.arrival is None or (
            estimate.time < max(segment.arrival, last.stamp) + model.ns(_PAUSE)):
        return None
    level, small = last.flux_density, 1e-4 * model.units.load
    at = rest(estimate.values, estimate.free, level)
    above = rest(estimate.values, estimate.free, level + small)
    if at is None or above is None:
        return None
    count = len(estimate.free)
    spread = math.sqrt(max(float(at[2] @ estimate.covariance[:count, :count] @ at[2]), 0.0))
    off = at[0] - segment.stretch
    if abs(off) <= max(_SURE * spread, _OFF):
        return None
    share = _PART * bound
    wanted = level - min(max(off * small / (above[0] - at[0]), -share), share)
    holding = model.flux_density(model.holding(segment.stretch))
    options = model.options
    wanted = min(max(wanted, holding - bound, options.flux_density_min),
                 holding + bound, options.flux_density_max)
    return wanted if abs(wanted - level) > 0.1 * small else None
