"""Residuals of moves on an actuator that differs from the model."""

from dataclasses import dataclass
import math

import numpy as np

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
from hmsa.model.moves import Level, Move, State
from hmsa.model.parameters import NondimensionalParameters
from hmsa.model.simulation import residual_vibration, sampled
from hmsa.model.status import Code
from hmsa.motion import STRETCH
from hmsa.planning.two_step import plan_two_step
from hmsa_studies.axes import Setting

__all__ = ['Actual', 'arrival_of', 'Errors']

# The peak-to-peak value of a decaying motion is final after one period, or after its decay.
_PERIODS = 2.0
_DECADES = 12.0
# 150 samples per period miss 2e-4 of an extremum.
_SAMPLES = 301
_EXACT = Errors()


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
