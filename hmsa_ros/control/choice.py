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
    tried = [[_left(estimate, each, target, to) for each in (used, model)]
             for to in (target - step, target + 0.7 * step)]
    pairs = [(one, other) for one, other in tried if one is not None and other is not None]
    if not pairs:
        return False
    before, after = map(_together, zip(*pairs, strict=True))
    return worthwhile(
        before, after, MUCH if given and not shown else _LEAST,
        little=0.0 if given else _LITTLE, share=CLEARLY if given else AT_REST)


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


def _left(estimate: Estimate, model: Model, start: float, target: float) -> Outcome | None:
    """
    Return what a move from rest that is planned with a model is expected to leave.

    Figures are shares of its step. None where it cannot be planned, or followed.
    """
    try:
        plan = Planner(
            model.actuator, replace(model.options, lead_time=0, period=0),
            stretch=start).setpoint(target, 0)
    except HmsaError:
        return None
    arrival, holding = plan.segments[-1].arrival, model.flux_density(model.holding(start))
    resting = _at_rest(estimate, holding)
    if arrival is None or resting is None:
        return None
    left = expect(resting, Course(
        tuple((x.stamp, x.flux_density) for x in plan.levels if x.stamp >= 0), arrival, target,
        holding), model.options.slew_limit)
    step = abs(target - start)
    return Outcome(left.misses / step, left.covariance / step ** 2) if math.isfinite(
        left.size) else None


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
