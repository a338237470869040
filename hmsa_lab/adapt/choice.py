"""
Choose between the parameters in use and those that the samples suggest.

Both are tried on likely next moves from the current target. The predicted error of each move is
computed with the exact motion and includes the uncertainty of the estimate, so an estimate
replaces the parameters in use only once it is well determined.
"""

from collections.abc import Sequence
from dataclasses import replace
import math

import numpy as np

from hmsa.errors import HmsaError
from hmsa.identification.quantities import TEMPERATURE
from hmsa.model.thermal import Thermal
from hmsa.planning.planner import Planner
from hmsa.planning.timeline import JointModel
from hmsa_lab.adapt.estimator import StateEstimate
from hmsa_lab.adapt.expected_error import (
    AT_REST,
    CandidateLevels,
    CLEARLY,
    expect,
    ExpectedError,
    MUCH,
    worthwhile,
)
from hmsa_lab.adapt.motion import rest

# Other parameters must reduce the predicted error by at least this fraction of the step.
_LEAST = 3e-4
# Fraction of the step up to which a change is small; 0 while the given parameters are in use.
_LITTLE = 0.015
# Shorter steps are replaced by this one.
_STEP = 0.15


def clearly_better(
        estimate: StateEstimate, model: JointModel, used: JointModel, start: float, target: float,
        *,
        given: bool, shown: bool) -> bool:
    """
    Return whether moves planned with a model have a clearly smaller predicted error.

    The joint went from the start to the target; the trial moves lead back and further on. The
    parameters in use are kept unless ``model`` is clearly better. If they are the ``given`` ones,
    it must be much better until samples have ``shown`` an arrival.
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


def _together(outcomes: Sequence[ExpectedError]) -> ExpectedError:
    """Return the average predicted error of several moves."""
    count = len(outcomes)
    size = len(outcomes[0].misses)
    covariance = np.zeros((count, size, count, size))
    for i, each in enumerate(outcomes):
        covariance[i, :, i] = each.covariance / count
    return ExpectedError(
        np.concatenate([x.misses for x in outcomes]) / math.sqrt(count),
        covariance.reshape(count * size, -1))


def _left(
        estimate: StateEstimate, model: JointModel, start: float, target: float
) -> ExpectedError | None:
    """
    Return the predicted error of a move from rest that is planned with a model.

    The values are fractions of the step. None if the move cannot be planned or simulated.
    """
    try:
        model = model.at_temperature(estimate.values[TEMPERATURE])
        plan = Planner(
            replace(model.actuator, thermal=Thermal()),
            replace(model.options, lead_time=0, period=0), stretch=start).setpoint(target, 0)
    except HmsaError:
        return None
    arrival, holding = plan.segments[-1].arrival, model.flux_density(model.holding(start))
    resting = _at_rest(estimate, holding)
    if arrival is None or resting is None:
        return None
    left = expect(resting, CandidateLevels(
        tuple((x.stamp, x.flux_density) for x in plan.levels if x.stamp >= 0), arrival, target,
        holding), model.options.slew_limit)
    step = abs(target - start)
    return ExpectedError(left.misses / step, left.covariance / step ** 2) if math.isfinite(
        left.size) else None


def _at_rest(estimate: StateEstimate, level: float) -> StateEstimate | None:
    """Return the estimate at time 0 after a level in T has been in force for a long time."""
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
