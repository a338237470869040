"""
Heavy damping: duration of a move if no two-step command exists.

Above critical damping the unshaped step approaches without overshoot; the minimum-time command,
which pushes and brakes within the load limits, arrives in finite time.
"""

from dataclasses import dataclass

import numpy as np

from hmsa.errors import HmsaError
from hmsa.model.equations import Array, elastic_force, Floats
from hmsa.model.moves import Limits, Move, State
from hmsa.model.parameters import NondimensionalParameters
from hmsa.planning.shapers.linear import step
from hmsa.planning.shapers.minimum_time import minimum_time
from hmsa.planning.shapers.request import MoveRequest
from hmsa_studies.residual import Actual, ringing

#: Deviation from the target, as a fraction of the step, at which a motion counts as settled.
SETTLED = 0.01
#: Load limits to compare, relative to the load that holds the target.
LIMITS = ((0.0, 1.2), (-2.0, 2.0))
# At the end, e^-14 of the move remains of the slowest motion.
_DECADES = 14.0
_SAMPLES = 6001


@dataclass(frozen=True)
class DampedStudy:
    """Times of a move between stretches at rest, over zeta (n,)."""

    start: float
    target: float
    zetas: Array
    step: Array  #: (n,), settling time of the unshaped step
    arrival: Array  #: (m, n), move time of the minimum-time command under each of LIMITS
    settled: Array  #: (m, n), its settling time


def limits_of(target: float, material: NondimensionalParameters, number: int) -> Limits:
    """Return the entry of `LIMITS` as loads, relative to the load of a stretch above 1."""
    holding = float(elastic_force(target, material))
    least, most = LIMITS[number]
    return Limits(least * holding, most * holding)


def settling_time(
        move: Move, start: float, target: float, material: NondimensionalParameters) -> float:
    """Return when the stretch stays within 1 % of the step for good, or raise `HmsaError`."""
    _, decay = ringing(target, material)
    times = np.linspace(0.0, move.levels[-1].time + _DECADES / decay, _SAMPLES)
    away = np.abs(Actual.off(material).response(move, start, times) - target)
    band = SETTLED * abs(target - start)
    outside = np.flatnonzero(away > band)
    if outside.size == 0:
        return 0.0
    last = int(outside[-1])
    if last + 1 == times.size:
        raise HmsaError(
            f'the move from {material.coordinate.name} {start:g} to {target:g} has not settled in '
            f'{times[-1]:.4g}: expected a command that leads there')
    share = (away[last] - band) / (away[last] - away[last + 1])
    return float(times[last] + share * (times[last + 1] - times[last]))


def damped_study(start: float, target: float, zetas: Floats) -> DampedStudy:
    """Compare the unshaped step with the minimum-time command over values of zeta above 0."""
    materials = [NondimensionalParameters(float(zeta)) for zeta in zetas]
    plain = np.array([
        settling_time(step(MoveRequest(State(start), target, x)), start, target, x)
        for x in materials])
    arrival = np.empty((len(LIMITS), len(materials)))
    settled = np.empty_like(arrival)
    for row in range(len(LIMITS)):
        for column, material in enumerate(materials):
            move = minimum_time(MoveRequest(
                State(start), target, material, limits_of(target, material, row)))
            arrival[row, column] = move.duration
            settled[row, column] = settling_time(move, start, target, material)
    return DampedStudy(start, target, np.asarray(zetas), plain, arrival, settled)
