"""Correct plans with estimates from feedback."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
import itertools
import math
from typing import TYPE_CHECKING

import numpy as np

from hmsa.model.status import Code, RefusedError
from hmsa.model.units import NANOSECONDS
from hmsa.planning.lateness import LEAST_STEP, step_of
from hmsa.planning.planner import Planner
from hmsa.planning.timeline import Draft, JointModel, PlannedLevel, Timeline
from hmsa_lab.adapt.adaptive_joint import AdaptiveJoint
from hmsa_lab.adapt.estimator import StateEstimate
from hmsa_lab.adapt.expected_error import (
    Ahead,
    CandidateLevels,
    caution,
    CLEARLY,
    expect,
    expect_along,
    ExpectedError,
    MUCH,
    SHARE,
    worthwhile,
)
from hmsa_lab.adapt.learnt import as_of_path, initial_state, learnt_model, same_parameters
from hmsa_lab.adapt.messages import confounded
from hmsa_lab.adapt.motion import rest
from hmsa_ros.runtime.planning_task import PlanningTask, Replanning, replanning
from hmsa_ros.runtime.records import Clock, Severity, Verdict

if TYPE_CHECKING:
    from hmsa_lab.adapt.feedback import Feedback

# Minimum gain of a correction as a fraction of the step, and the smaller one during a move that
# has time for corrections: an actuator at rest is not moved for a small gain.
_GAIN, _LITTLE = 5e-4, 5e-5
# Time scales before its end from which a move is no longer corrected.
_SHORTEST = 0.3
# Duration of a move, relative to lead_time, from which extending it leaves time to correct it: in
# slower laboratories of `benchmarks harm` it then arrives earlier, in faster ones later.
_REACHED = 2.0
# Fraction of the step from which a bias that may be a force matters. After a move that began this
# close to rest without field, where the two look alike, an actuator at rest is then corrected only
# for a large gain.
_HIDDEN, _FIRST = 0.01, 0.02
# Levels that differ by less, in units of load, count as equal.
_SAME = 1e-5
# Interval between checks of a replanned path in natural periods, and its minimum as a multiple of
# the planning time; natural periods and samples of the prediction; earlier levels that still
# matter.
_JOINED, _IDLE, _PERIODS, _SAMPLES, _BEFORE = 2, 4, 3, 61, 8
# Standard deviations from which creep is included in a path: only the sum of quantities that
# samples cannot distinguish matters.
_CREEPS = 1.0
# Time scales after the last change from which a level is trimmed, slowly compared with any
# vibration, and the largest single change as a fraction of the bound.
_PAUSE, _PART = 60.0, 0.25
# Standard deviations by which the actuator must rest off the target to be trimmed, and the
# smallest such error.
_SURE, _OFF = 3.0, 1e-4


class Corrections:
    """Correct plans if that reduces the predicted error."""

    def __init__(self, feedback: 'Feedback', clock: Clock) -> None:
        self._feedback, self._clock = feedback, clock

    def cautious(self, drafts: Mapping[str, Draft]) -> Mapping[str, Draft]:
        """
        Give first moves with a large predicted error more time, so that they can be corrected.

        Their levels do not change: their early effect identifies the actuator.
        """
        joints = self._feedback.joints
        return {name: self._slowly(joints[name], draft) if name in joints else draft
                for name, draft in drafts.items()}

    def _slowly(self, joint: AdaptiveJoint, draft: Draft) -> Draft:
        segment, *rest = draft.segments
        joint.next_update = joint.next_sample = joint.waits = 0
        self._feedback.wait_for(joint, segment)
        # An amplifier that saturated may not do so any more.
        joint.largest = math.inf
        if math.isinf(joint.tolerance) or segment.arrival is None or segment.code in (
                Code.LEVELS, Code.PATH):
            return draft
        estimate = joint.foreseen(draft.begin)
        if estimate is None:
            return draft
        step = max(abs(segment.stretch - draft.levels[0].stretch), LEAST_STEP)
        duration = segment.arrival - segment.begin
        # Parameters that are only suspected do not justify slowing down.
        named = len(joint.settings.feedback_parameters)
        if duration < _REACHED * joint.planner.options.lead_time or expect(
                estimate.sure_of(named), _drafted(draft, joint.planner.plan),
                joint.planner.options.slew_limit).size <= joint.tolerance * step:
            return draft
        longer = caution(named, estimate.noise / step)
        arrival = segment.begin + round(longer * duration)
        if rest:
            arrival = max(min(arrival, rest[0].begin), segment.arrival)
        joint.waits, joint.next_update = arrival, 0
        return replace(draft, segments=(replace(segment, arrival=arrival), *rest))

    def due(self, now: int) -> Iterator[PlanningTask]:
        """Yield corrections that may help at a time in ns; `take` adopts the results."""
        for joint in self._feedback.taken_back():
            yield self._work(joint, _take_back)
        for joint in self._feedback.news():
            planner = joint.planner
            if not planner.plan.segments or planner.foreign or joint.differs_since is not None:
                continue
            if planner.as_sent(planner.soonest(now)):
                if _leaves_path(joint, now):
                    yield self._work(joint, self._rejoin)
                continue
            estimate = joint.state(planner.soonest(now))
            if estimate is None or joint.estimator.screening.doubts:
                continue
            level = _trimmed(joint, estimate)
            if level is not None:
                yield self._work(joint, partial(_trim, level=level))
                continue
            if joint.adapted() and _may_gain(joint, estimate, now):
                yield self._work(joint, _correct)
            if _outdated(joint, now):
                # Nothing is left to do if a correction has been adopted before.
                yield self._work(joint, _later)

    def _work(
            self, joint: AdaptiveJoint,
            make: Callable[[AdaptiveJoint, int], Replanning | None]) -> PlanningTask:
        return replanning(joint.name, joint.planner, partial(make, joint), corrects=True)

    def _rejoin(self, joint: AdaptiveJoint, now: int) -> Replanning | None:
        """Replan the rest of a path with the current estimate, if that follows it more closely."""
        planner, begun = joint.planner, self._clock()
        begin = planner.soonest(now + joint.planning)
        estimate, ahead = joint.state(begin), _ahead(planner, begin)
        if estimate is None or ahead is None:
            return None
        model = learnt_model(
            planner.base, estimate, planner.plan.segments[-1].stretch, _CREEPS)
        model = as_of_path(model, planner.base, estimate).at_temperature(
            planner.model.temperature)
        state = initial_state(estimate, model)

        def adopt(draft: Draft | None) -> Draft | None:
            spent = self._clock() - begun
            joint.planning = spent + spent // 2
            joint.next_path = begin + max(_JOINED * _period(planner), _IDLE * spent)
            if draft is None:
                return None
            before, after = (_leaves(estimate, planner, x, ahead)
                             for x in (planner.plan.levels, draft.levels))
            if _saturates(joint, draft) or not _nearer(joint, before, after, estimate):
                return None
            return draft

        return Replanning(lambda plan: plan.draft_path_anew(begin, model, state), adopt)

    def take(self, work: PlanningTask, drafts: Mapping[str, Draft], now: int) -> Verdict | None:
        """Adopt a correction made for a time in ns; None if nothing changes."""
        name, = work.joints
        joint, draft = self._feedback.joints.get(name), drafts.get(name)
        if joint is not None:
            # Leaves commands their fraction of the CPU time.
            self._feedback.spent(joint, work.spent)
        if joint is None or draft is None:
            return None
        words = joint.words(self._clock())
        place, segments = draft.resumed, joint.planner.plan.segments
        self._feedback.corrections += 1
        joint.planner.take(draft, now)
        if place and draft.begin == segments[place].since:
            return Verdict(Severity.OK, Code.CORRECTED, (
                f'setpoints from {place + 1} of {len(segments)} on planned anew with the '
                f'estimate: {words}'))
        joint.next_sample = 0
        if draft.segments[0].path is not None:
            # A stop of the path uses its corrected model too.
            joint.used = joint.based(draft.levels[0].model)
            joint.planner.take_model(joint.used)
        return Verdict(Severity.OK, Code.CORRECTED, f'corrected from samples: {words}')


def _take_back(joint: AdaptiveJoint, now: int) -> Replanning | None:
    """Replan the rest with the model in force, discarding earlier corrections."""
    planner = joint.planner
    plan, model, soonest = planner.plan, planner.model, planner.soonest(now)
    place = plan.under_way(soonest)
    if place < 0:
        return None
    segment = plan.segments[place]
    if planner.as_sent(soonest):
        return None if _ahead(planner, soonest) is None else Replanning(
            lambda plan: plan.draft_path_anew(soonest, model, None))
    if place + 1 < len(plan.segments) or segment.arrival is None or segment.arrival > soonest:
        return Replanning(
            lambda plan: plan.draft_resumption(now),
            lambda draft: None if draft is None or draft.missed else draft)
    holding = model.flux_density(model.holding(segment.stretch))
    level = plan.levels[-1].flux_density
    return None if abs(holding - level) < _SAME * model.units.load else (
        _trim(joint, now, level=holding))


def _trim(joint: AdaptiveJoint, now: int, *, level: float) -> Replanning:
    """Hold the setpoint with another level in T."""
    return Replanning(lambda plan: plan.draft_trim(now, level))


def _arrival(joint: AdaptiveJoint, now: int) -> int:
    """Return the arrival in ns of a move that has time for corrections; else 0."""
    planner = joint.planner
    left = joint.waits - planner.soonest(now)
    return joint.waits if left >= _SHORTEST * planner.model.units.time * NANOSECONDS else 0


def _may_gain(joint: AdaptiveJoint, estimate: StateEstimate, now: int) -> bool:
    """Return whether the predicted error of a plan exceeds the smallest useful gain."""
    share = _LITTLE if _arrival(joint, now) else _GAIN if joint.shown(now) else MUCH
    course, gain = course_of(joint.planner.plan, estimate.time, share)
    return expect(estimate, course, joint.planner.options.slew_limit).size > gain


def _saturates(joint: AdaptiveJoint, draft: Draft) -> bool:
    """Return whether a draft has a level beyond the limit of a saturated amplifier."""
    return max(abs(x.flux_density) for x in draft.levels) > joint.largest


def _correct(joint: AdaptiveJoint, now: int) -> Replanning:
    """Replan the rest if that reduces the predicted error."""
    arrival = _arrival(joint, now)

    def draft(plan: Planner) -> Draft | None:
        try:
            return plan.draft_resumption(now, arrival or None)
        except RefusedError:
            if not arrival:
                raise
            return None
    return Replanning(draft, partial(_gains, joint, arrival))


def _outdated(joint: AdaptiveJoint, now: int) -> int:
    """Return the index of the next setpoint if it is planned with another model; else 0."""
    planner = joint.planner
    plan, soonest = planner.plan, planner.soonest(now)
    place = plan.under_way(soonest) + 1
    return place if 0 < place < len(plan.segments) and joint.shown(now) and (
        plan.segments[place].since > soonest) and not same_parameters(
            joint.based(plan.levels[-1].model), planner.base) else 0


def _later(joint: AdaptiveJoint, now: int) -> Replanning | None:
    """Replan the setpoints after the one under way with the model in force."""
    place = _outdated(joint, now)
    if not place:
        return None
    since = joint.planner.plan.segments[place].since
    return Replanning(lambda plan: plan.draft_later(place), starts=(since,))


def _gains(joint: AdaptiveJoint, arrival: int, draft: Draft | None) -> Draft | None:
    """Return a correction if it reduces the predicted error."""
    planner = joint.planner
    estimate = None if draft is None else joint.state(draft.begin)
    if draft is None or estimate is None or draft.missed or _saturates(joint, draft):
        # A correction must not leave out a setpoint.
        return None
    slew = planner.options.slew_limit
    course, gain = course_of(planner.plan, draft.begin, _LITTLE if arrival else _GAIN)
    segment = draft.segments[0]
    start = joint.start(draft.begin)
    step = max(abs(segment.stretch - start), LEAST_STEP)
    # A force of undetermined sign must not be made worse.
    doubted = estimate.doubted
    hidden = MUCH * step if not arrival and abs(
        start - planner.model.actuator.rest) < _FIRST and confounded(
            doubted, _HIDDEN * step) else 0.0
    # So must levels that are late by chance, whose vibration may come on top.
    levels = (planner.plan.level(draft.begin - 1), *draft.levels)
    uneven = math.hypot(*(planner.vibration(planner.uneven, y.flux_density - x.flux_density)
                          for x, y in itertools.pairwise(levels)))
    for each, least in ((doubted, hidden), (estimate, 0.0)):
        before = expect(each, course, slew, segment.arrival or 0)
        after = expect(each, _drafted(draft, planner.plan), slew)
        if not worthwhile(before, after, max(gain, least, uneven)):
            return None
    return draft


def _leaves_path(joint: AdaptiveJoint, now: int) -> bool:
    """Return whether an actuator may deviate from its path; checked every natural period."""
    planner = joint.planner
    begin = planner.soonest(now + joint.planning)
    ahead = _ahead(planner, begin) if begin >= joint.next_path else None
    estimate = None if ahead is None else joint.state(begin)
    if ahead is None or estimate is None:
        return False
    joint.next_path = begin + _period(planner)
    left = _leaves(estimate, planner, planner.plan.levels, ahead)
    # The best possible result leaves only the uncertainty.
    return _nearer(joint, left, replace(left, misses=0.0 * left.misses), estimate)


def _leaves(
        estimate: StateEstimate, planner: Planner, levels: Sequence[PlannedLevel],
        ahead: Ahead) -> ExpectedError:
    """Return the predicted deviation from a path with levels from the estimate's time on."""
    first, begin = planner.plan.place(estimate.time - 1), estimate.time
    end = begin + round(ahead.times[-1] * NANOSECONDS)
    course = (*planner.plan.levels[max(first - _BEFORE, 0):first + 1],
              *(x for x in levels if begin <= x.stamp <= end))
    return expect_along(
        estimate, [(x.stamp, x.flux_density) for x in course], ahead, planner.options.slew_limit)


def _nearer(
        joint: AdaptiveJoint, before: ExpectedError, after: ExpectedError, estimate: StateEstimate
) -> bool:
    """Return whether a new course of a path is to replace that in force."""
    plan = joint.planner.plan
    path = plan.segments[plan.under_way(estimate.time)].path
    span = 0.0 if path is None else float(np.ptp(path.course(path.breaks)[0]))
    return worthwhile(
        before, after, _GAIN * span,
        SHARE if joint.adapted(joint.based(plan.level(estimate.time).model)) else CLEARLY)


def _drafted(draft: Draft, plan: Timeline) -> CandidateLevels:
    """Return the course of the first setpoint of a draft that replaces a plan."""
    segment, *rest = draft.segments
    before = _until(plan, plan.place(draft.begin - 1) + 1)
    return CandidateLevels(
        tuple((x.stamp, x.flux_density) for x in (*before, *draft.levels)
              if not rest or x.stamp < rest[0].begin),
        segment.arrival or draft.begin, segment.stretch, before[0].flux_density,
        _relaxed(draft.levels[0].model, segment.stretch) if rest else math.nan)


def _relaxed(model: JointModel, stretch: float) -> float:
    """Return the final level in T of a tail cut by the next setpoint; NaN without creep."""
    return model.flux_density(model.holding(stretch)) if model.material.creep else math.nan


def _until(plan: Timeline, place: int) -> Sequence[PlannedLevel]:
    """Return the last levels before a place, which affect the field of a coil with lag."""
    return plan.levels[max(place - _BEFORE, 0):place]


def course_of(plan: Timeline, begin: int, gain: float) -> tuple[CandidateLevels, float]:
    """Return the course from a time in ns to the end of its setpoint, and the minimum gain."""
    levels, place = plan.levels, max(plan.under_way(begin), 0)
    segment = plan.segments[place]
    end = plan.segments[place + 1].begin if place + 1 < len(plan.segments) else None
    first = plan.place(begin)
    kept = [x for x in levels[first:] if end is None or x.stamp < end or x is levels[first]]
    course = [*_until(plan, first), *kept]
    return CandidateLevels(
        tuple((x.stamp, x.flux_density) for x in course),
        segment.arrival or kept[-1].stamp, segment.stretch, course[0].flux_density,
        math.nan if end is None else _relaxed(kept[-1].model, segment.stretch)), max(
            gain * step_of(plan, place), segment.vibration)


def _period(planner: Planner) -> int:
    """Return the natural period at the end of the plan in ns."""
    model = planner.model
    return model.ns(2.0 * math.pi / model.frequency(planner.plan.segments[-1].stretch))


def _ahead(planner: Planner, begin: int) -> Ahead | None:
    """Return the path after a time in ns; None if little of it is left."""
    plan = planner.plan
    segment, period = plan.segments[plan.under_way(begin)], _period(planner)
    if segment.path is None or segment is not plan.segments[-1]:
        return None
    since = (begin - segment.since) / NANOSECONDS
    left = segment.path.breaks[-1] - since
    if left * NANOSECONDS < _JOINED * period:
        return None
    # Without the transition back to the path.
    times = np.linspace(period, min(_PERIODS * period, left * NANOSECONDS), _SAMPLES) / NANOSECONDS
    return Ahead(times, segment.path.course(times + since)[0])


def _trimmed(joint: AdaptiveJoint, estimate: StateEstimate) -> float | None:
    """
    Return the level in T that holds a setpoint against a constant force.

    It differs from that of the model by at most ``feedback_trim``. The estimate is for the time
    from which levels may be changed. None if the level in force is to be kept: during a move, if
    the error is within its uncertainty, at the bound, or if no constant force is estimated.
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
