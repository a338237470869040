"""
Which parameters to plan with: those in use, or those that samples suggest.

Both are tried on moves that may come, from where the joint is. What each is expected to leave is
worked out with the exact motion over all that samples leave open, so that an estimate has to be
known well before it takes the place of what is in use.
"""

from collections.abc import Sequence
from dataclasses import replace
import math

import numpy as np

from hmsa_ros.errors import HmsaError
from hmsa_ros.estimation import Estimate
from hmsa_ros.estimation.correction import (
    AT_REST,
    CLEARLY,
    Course,
    expect,
    MUCH,
    Outcome,
    worthwhile,
)
from hmsa_ros.estimation.motion import rest
from hmsa_ros.planning.planner import Planner
from hmsa_ros.planning.timeline import Model

# Other parameters are to leave less by this share of the step.
_LEAST = 3e-4
# Share of the step up to which a change is little; none is where the given ones are in use.
_LITTLE = 0.015
# Smaller steps are tried as this one.
_STEP = 0.15


def clearly_better(
        estimate: Estimate, model: Model, used: Model, start: float, target: float, *,
        given: bool, shown: bool) -> bool:
    """
    Return whether moves planned with a model are expected to leave clearly less than with another.

    The joint went from the start to the target, and is tried on the way back and further on. What
    is given may be right: it is left for what is clearly better alone, and for what is much better
    unless samples have shown an arrival.
    """
    step = math.copysign(max(abs(target - start), _STEP), target - start)
    pairs: list[list[Outcome]] = []
    for to in (target - step, target + 0.7 * step):
        pair = []
        for each in (used, model):
            left = _left(estimate, _planned(each, target, to), each.options.slew_limit)
            if left is None:
                break
            pair.append(_shared(left, abs(to - target)))
        else:
            pairs.append(pair)
    if not pairs:
        return False
    before, after = (_together([x[i] for x in pairs]) for i in (0, 1))
    return worthwhile(
        before, after, MUCH if given and not shown else _LEAST,
        little=0.0 if given else _LITTLE, share=CLEARLY if given else AT_REST)


def _shared(left: Outcome, step: float) -> Outcome:
    """Return what a move leaves as shares of its step."""
    return Outcome(left.misses / step, left.covariance / step ** 2)


def _together(outcomes: Sequence[Outcome]) -> Outcome:
    """Return what moves leave on average."""
    count = len(outcomes)
    size = len(outcomes[0].misses)
    covariance = np.zeros((count, size, count, size))
    for i, each in enumerate(outcomes):
        covariance[i, :, i] = each.covariance / count
    return Outcome(
        np.concatenate([x.misses for x in outcomes]) / math.sqrt(count),
        covariance.reshape(count * size, -1))


def _planned(model: Model, start: float, target: float) -> Course | None:
    """Return a move from rest as planned with a model; None where it cannot be."""
    try:
        planner = Planner(
            model.actuator, replace(model.options, lead_time=0, period=0), stretch=start)
        plan = planner.setpoint(target, 0)
    except HmsaError:
        return None
    arrival = plan.segments[-1].arrival
    if arrival is None:
        return None
    return Course(
        tuple((x.stamp, x.flux_density) for x in plan.levels if x.stamp >= 0), arrival, target,
        model.flux_density(model.holding(start)))


def _left(estimate: Estimate, course: Course | None, slew_limit: float) -> Outcome | None:
    """Return what a move from rest is expected to leave; None without."""
    if course is None:
        return None
    resting = _at_rest(estimate, course.before)
    left = None if resting is None else expect(resting, course, slew_limit)
    return left if left is not None and math.isfinite(left.size) else None


def _at_rest(estimate: Estimate, level: float) -> Estimate | None:
    """Return what is believed once a level in T has been in force for long, at the time 0."""
    values = {x: y for x, y in estimate.values.items() if x != 'behind'}
    at = rest(values, estimate.free, level)
    if at is None:
        return None
    count = len(estimate.free)
    change = np.zeros((count + 2, count))
    change[:count], change[count] = np.eye(count), at[2]
    known = estimate.covariance[:count, :count]
    return replace(
        estimate, time=0, stretch=at[0], rate=0.0, values=values,
        covariance=change @ known @ change.T, off=change @ estimate.off[:count])
