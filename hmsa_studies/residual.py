"""
Residuals of moves on an actuator that differs from the model, and on a sampling grid.

Above critical damping the unshaped step approaches without overshoot; the minimum-time command,
which pushes and brakes within the load limits, arrives in finite time.

With a command period, either the two-step command is solved for on the sampling grid, or the
switching time of the ideal one is rounded to the grid.
"""

from dataclasses import dataclass
import math

import numpy as np

from hmsa.errors import HmsaError
from hmsa.model.delivery import Delivery, IDEAL
from hmsa.model.equations import (
    Array,
    critical_zeta,
    elastic_force,
    equilibrium_stretch,
    Floats,
    natural_frequency,
)
from hmsa.model.mismatch import Errors
from hmsa.model.moves import Level, Limits, Move, State
from hmsa.model.parameters import NondimensionalParameters
from hmsa.model.residual import residual_vibration
from hmsa.model.simulation import sampled
from hmsa.model.status import Code, RefusedError
from hmsa.motion import STRETCH
from hmsa.planning.shapers.linear import step
from hmsa.planning.shapers.minimum_time import minimum_time
from hmsa.planning.shapers.request import MoveRequest
from hmsa.planning.shapers.two_step import two_step
from hmsa.planning.two_step import plan_two_step
from hmsa_studies.settings import Setting

__all__ = ['Actual', 'arrival_of', 'Errors']

# The peak-to-peak value of a decaying motion is final after one period, or after its decay.
_PERIODS = 2.0
_DECADES = 12.0
# 150 samples per period miss 2e-4 of an extremum.
_SAMPLES = 301
_EXACT = Errors()

#: Deviation from the target, as a fraction of the step, at which a motion counts as settled.
SETTLED = 0.01
#: Load limits to compare, relative to the load that holds the target.
LIMITS = ((0.0, 1.2), (-2.0, 2.0))
# At the end, e^-14 of the move remains of the slowest motion.
_FADED = 14.0
_SETTLING = 6001

#: Maximum command period, as a fraction of tau_p, for which the residual should be exact.
PROMISED = 1.0 / 3.0


def arrival_of(
        move: Move, start: float, target: float, material: NondimensionalParameters) -> float:
    """Return the time (of the model) from which motion counts as residual vibration."""
    # The end of the command. For an unshaped step, which never arrives, use the arrival of the
    # two-step command; if there is none, half a natural period.
    if math.isfinite(move.duration):
        return move.duration
    if not material.creep:
        plan = plan_two_step(start, target, material)
        if plan.code is Code.TWO_STEP:
            return plan.tau_p
    return math.pi / float(natural_frequency(target, material))


def ringing(stretch: float, material: NondimensionalParameters) -> tuple[float, float]:
    """Return the period (infinite if there is none) and decay of small motion about rest."""
    frequency = float(natural_frequency(stretch, material))
    ratio = material.zeta / float(critical_zeta(stretch, material))
    if ratio < 1.0:
        return 2.0 * math.pi / (frequency * math.sqrt(1.0 - ratio * ratio)), frequency * ratio
    return math.inf, frequency * (ratio - math.sqrt(ratio * ratio - 1.0))


@dataclass(frozen=True)
class Actual:
    """An actuator that carries out moves planned with another model, in the model's units."""

    model: NondimensionalParameters
    material: NondimensionalParameters  #: of the actuator, in its own units
    time: float = 1.0  #: the actuator's units relative to those of the model
    load: float = 1.0
    delivery: Delivery = IDEAL  #: in the actuator's units; commands are those of the move

    @classmethod
    def off(
            cls, model: NondimensionalParameters, errors: Errors = _EXACT,
            delivery: Delivery = IDEAL) -> 'Actual':
        """Return the actuator for errors of a model, with the same coil."""
        return cls(
            model, errors.actual(model), 1.0 / errors.faster, errors.stiffer,
            errors.delivery(delivery))

    @classmethod
    def of(cls, model: Setting, actual: Setting) -> 'Actual':
        """Return an actuator with its own parameters."""
        return cls(
            model.material, actual.material, actual.units.time / model.units.time,
            actual.units.load / model.units.load, actual.delivery)

    def response(self, move: Move, start: float, times: Floats) -> Array:
        """Sample the stretch from the true equilibrium under the model's initial load."""
        held = float(elastic_force(start, self.model)) / self.load
        stretch: Array = sampled(
            [Level(x.time / self.time, x.load / self.load) for x in move.levels],
            State(float(equilibrium_stretch(held, self.material)), load=held),
            np.asarray(times / self.time, dtype=np.float64), self.material,
            self.delivery)[STRETCH]
        return stretch

    def rest(self, move: Move) -> float:
        """Return the true equilibrium stretch under the last level of a move."""
        return float(equilibrium_stretch(move.levels[-1].load / self.load, self.material))

    def residual(self, move: Move, start: float, target: float, arrival: float) -> float:
        """Return the peak-to-peak stretch after arrival as a fraction of the commanded step."""
        # A steady-state error, due to an error of the holding load, is no vibration and does not
        # count.
        period, decay = ringing(self.rest(move), self.material)
        horizon = min(_PERIODS * period, _DECADES / decay if decay > 0.0 else math.inf)
        times = arrival + np.linspace(0.0, horizon * self.time, _SAMPLES)
        return residual_vibration(
            times, self.response(move, start, times), arrival=arrival, end=float(times[-1]),
            step=target - start)

    def offset(self, move: Move, start: float, target: float) -> float:
        """Return the steady-state error of a move beyond the target, as a fraction of the step."""
        return (self.rest(move) - target) / (target - start)


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
    times = np.linspace(0.0, move.levels[-1].time + _FADED / decay, _SETTLING)
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


@dataclass(frozen=True)
class SampledStudy:
    """Residuals of a move between stretches at rest, over the command period."""

    start: float
    target: float
    material: NondimensionalParameters
    tau_p: float  #: of the ideal command
    periods: Floats  #: as fractions of tau_p
    solved: Array  #: of the command solved for on the grid; NaN if there is none
    rounded: Array  #: of the ideal command with its switching time rounded to the grid
    #: The worse of the ideal command switched half a period early and late: the worst rounding
    #: error if the period is not matched to tau_p.
    bound: Array


def ideal_move(start: float, target: float, material: NondimensionalParameters) -> Move:
    """Return the two-step command for ideal hardware; raise `HmsaError` if there is none."""
    move = two_step(MoveRequest(State(start), target, material))
    if move.code is not Code.TWO_STEP:
        raise HmsaError(
            f'there is no two-step command from {material.coordinate.name} {start:g} to '
            f'{target:g} at zeta {material.zeta:g} ({move.code}): expected another move')
    return move


def rounded_move(move: Move, period: float) -> Move:
    """Return a two-step command with its switching time rounded to a grid after its start."""
    return _switched_at(move, max(1, round(move.duration / period)) * period)


def _switched_at(move: Move, time: float) -> Move:
    """Return a two-step command with another switching time, which is its duration."""
    first, last = move.levels
    return Move(move.code, (first, Level(time, last.load)), time)


def solved_move(
        start: float, target: float, material: NondimensionalParameters,
        period: float) -> Move | None:
    """Return the command solved for on a grid, None if there is none."""
    try:
        return two_step(MoveRequest(State(start), target, material, delivery=Delivery(period)))
    except RefusedError:
        return None


def sampled_study(
        start: float, target: float, material: NondimensionalParameters,
        periods: Floats) -> SampledStudy:
    """Compute residuals over the command period, as fractions of tau_p."""
    ideal = ideal_move(start, target, material)
    tau_p = ideal.duration

    def left(move: Move | None) -> float:
        if move is None:
            return math.nan
        return Actual.off(material).residual(move, start, target, move.duration)

    return SampledStudy(
        start, target, material, tau_p, periods,
        np.array([left(solved_move(start, target, material, x * tau_p)) for x in periods]),
        np.array([left(rounded_move(ideal, x * tau_p)) for x in periods]),
        np.array([max(left(_switched_at(ideal, (1.0 + sign * 0.5 * x) * tau_p))
                      for sign in (-1.0, 1.0)) for x in periods]))
