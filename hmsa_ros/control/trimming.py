"""A holding level that makes up for a constant force, which plans do not know of."""

import math

from hmsa_ros.estimation import Estimate
from hmsa_ros.estimation.motion import rest
from hmsa_ros.model.units import NANOSECONDS
from hmsa_ros.planning.planner import Planner

# Units of time after the last change from which on a level is trimmed, so that it is slow beside
# any vibration, and what share of the bound one change may be.
_PAUSE, _SHARE = 60.0, 0.25
# Deviations by which the rest must be beside the target, and the least offset.
_SURE, _LEAST = 3.0, 1e-4


def trimmed(planner: Planner, estimate: Estimate, bound: float) -> float | None:
    """
    Return the level in T to hold a setpoint by, at most a bound in T off that of the model.

    The estimate is of the time from which on levels may be changed. None where the level in force
    is to be kept: on the way, within what is not known of the rest, at the bound, or where no
    constant force is tracked.
    """
    plan, model = planner.plan, planner.model
    place = plan.under_way(estimate.time)
    if bound <= 0.0 or 'constant_force' not in estimate.free or place + 1 < len(plan.segments):
        return None
    segment, last = plan.segments[place], plan.levels[-1]
    pause = round(_PAUSE * model.units.time * NANOSECONDS)
    if segment.arrival is None or estimate.time < max(segment.arrival, last.stamp) + pause:
        return None
    level, small = last.flux_density, 1e-4 * model.units.load
    at = rest(estimate.values, estimate.free, level)
    above = rest(estimate.values, estimate.free, level + small)
    if at is None or above is None:
        return None
    count = len(estimate.free)
    spread = math.sqrt(max(float(at[2] @ estimate.covariance[:count, :count] @ at[2]), 0.0))
    off = at[0] - segment.stretch
    if abs(off) <= max(_SURE * spread, _LEAST):
        return None
    share = _SHARE * bound
    wanted = level - min(max(off * small / (above[0] - at[0]), -share), share)
    holding = model.flux_density(model.holding(segment.stretch))
    options = model.options
    wanted = min(max(wanted, holding - bound, options.flux_density_min),
                 holding + bound, options.flux_density_max)
    return wanted if abs(wanted - level) > 0.1 * small else None
