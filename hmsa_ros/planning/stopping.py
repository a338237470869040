"""Where a motion can come to rest soonest, and the load that gets it there."""

from dataclasses import dataclass
import math

from hmsa_ros import motion
from hmsa_ros.model.equations import equilibrium_stretch
from hmsa_ros.model.moves import State
from hmsa_ros.model.simulation import RTOL
from hmsa_ros.planning.timeline import Model

# Stretch rates below this share of the natural frequency are rounding, not motion.
_AT_REST = 1e-6
# Newton passes on the load of a brake, and the share of its duration that they may miss.
_PASSES = 8
_ON_TIME = 1e-14
# How far inside the flux density limits a stop keeps where it has to, as a share.
_INSIDE = 1e-3


@dataclass(frozen=True)
class Brake:
    """A load that stops a motion at a stretch, its turning point, where it is held until then."""

    load: float
    duration: float  #: until then; 0 for what is at rest already
    stretch: float


def brake(model: Model, state: State, share: float = 1.0) -> Brake:
    """Return the load that stops a motion, and until when; a share of 1 brakes hardest."""
    # The share is of the way from the load that holds the stretch to the limit on the other side.
    # A brake of no duration is for a motion that cannot be followed to a turning point.
    holding = model.holding(state.stretch)
    rest = Brake(holding, 0.0, state.stretch)
    frequency = model.frequency(state.stretch)
    if abs(state.rate) <= _AT_REST * frequency:
        return rest
    up = state.rate > 0.0
    load = model.limits.minimum if up else model.limits.maximum
    if not math.isfinite(load):
        # Unlimited: a load that stops within a fraction of a period.
        load = holding - math.copysign(10.0 * abs(state.rate) * frequency + 10.0, state.rate)
    if share < 1.0:
        load = holding + share * (load - holding)
    direction = 1.0 if up else -1.0

    def turn(load: float) -> tuple[float, float, float] | None:
        status, time, stretch, _, slope = motion.turning_point(
            state.stretch, state.rate, direction, load, 1.0, model.material.packed, RTOL)
        return (time, stretch, slope) if status == motion.DONE else None

    found = turn(load)
    if found is None:
        return rest
    # A command carries whole nanoseconds. The load is solved for the next one, at which the
    # motion then is at rest to rounding: at full load half of one leaves more than a move does.
    aim = math.ceil(found[0] / model.delivery.resolution) * model.delivery.resolution
    for _ in range(_PASSES):
        time, stretch, slope = found
        if slope == 0.0 or abs(aim - time) <= _ON_TIME * aim:
            break
        found = turn(load + (aim - time) / slope)
        if found is None:
            break
        load += (aim - time) / slope
    return Brake(float(load), aim, stretch)


def holdable(model: Model, stretch: float) -> float:
    """Return the nearest stretch that a flux density inside the limits holds."""
    load = model.holding(stretch)
    least, most = model.limits.minimum, model.limits.maximum
    if least <= load <= most:
        return stretch
    nearest = least if load < least else most
    margin = _INSIDE * min(most - least, 1.0 + abs(nearest))
    return float(equilibrium_stretch(
        nearest + math.copysign(margin, nearest - load), model.material))
