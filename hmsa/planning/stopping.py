"""The nearest stretch at which a motion can come to rest, and the load for it."""

from dataclasses import dataclass
import math

from hmsa import motion
from hmsa.model.equations import equilibrium_stretch
from hmsa.model.moves import State
from hmsa.model.simulation import RTOL
from hmsa.planning.timeline import JointModel

# Stretch rates below this fraction of the natural frequency are rounding errors.
_AT_REST = 1e-6
# Newton iterations for the braking load, and the tolerance of its duration, relative.
_PASSES = 8
_ON_TIME = 1e-14
# Margin of a stop from the flux density limits, relative.
_INSIDE = 1e-3


@dataclass(frozen=True)
class Brake:
    """A braking load and the stretch at which it stops a motion, its turning point."""

    load: float
    duration: float  #: time to the turning point; 0 if already at rest
    stretch: float


def brake(model: JointModel, state: State, share: float = 1.0) -> Brake:
    """Return the load that stops a motion, and its duration; a share of 1 brakes hardest."""
    # The share interpolates between the load that holds the stretch and the opposite limit. The
    # duration is also 0 if the motion cannot be followed to a turning point.
    holding = model.holding(state.stretch)
    rest = Brake(holding, 0.0, state.stretch)
    frequency = model.frequency(state.stretch)
    if abs(state.rate) <= _AT_REST * frequency:
        return rest
    up = state.rate > 0.0
    load = model.limits.minimum if up else model.limits.maximum
    if not math.isfinite(load):
        # Without limits, use a load that stops the motion within a fraction of a period.
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
    # Commands have whole nanoseconds. The load is solved for the next one, so that the motion is
    # then at rest to rounding: at full load, half a nanosecond leaves more than a move does.
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


def holdable(model: JointModel, stretch: float) -> float:
    """Return the nearest stretch that a flux density within the limits holds."""
    load = model.holding(stretch)
    least, most = model.limits.minimum, model.limits.maximum
    if least <= load <= most:
        return stretch
    nearest = least if load < least else most
    margin = _INSIDE * min(most - least, 1.0 + abs(nearest))
    return float(equilibrium_stretch(
        nearest + math.copysign(margin, nearest - load), model.material))
