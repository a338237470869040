"""What is left of a move on an actuator that is not the one it was planned for."""

import math

import numpy as np

from hmsa_ros.core.mismatch import Errors
from hmsa_ros.core.model import (
    Array,
    critical_zeta,
    elastic_force,
    equilibrium_stretch,
    Floats,
    natural_frequency,
)
from hmsa_ros.core.moves import Move
from hmsa_ros.core.parameters import NondimensionalParameters
from hmsa_ros.core.residual import residual_vibration
from hmsa_ros.core.simulation import simulate
from hmsa_ros.core.status import Code
from hmsa_ros.core.two_step import plan_two_step

__all__ = ['arrival_of', 'Errors', 'residual', 'response', 'rest']

# Peak-to-peak of a decaying motion is final after one period, or once it has died out.
_PERIODS = 2.0
_DECADES = 12.0
# 150 samples a period miss 2e-4 of an extremum.
_SAMPLES = 301


def arrival_of(
        move: Move, start: float, target: float, material: NondimensionalParameters) -> float:
    """Return from when (in the model's time) what still moves counts as residual vibration."""
    # The end of the command. A plain step, which never arrives, counts from when the two-step
    # command would; where there is none, from half a natural period on.
    if math.isfinite(move.duration):
        return move.duration
    plan = plan_two_step(start, target, material)
    if plan.code is Code.TWO_STEP:
        return plan.tau_p
    return math.pi / float(natural_frequency(target, material))


def response(
        move: Move, start: float, times: Floats, material: NondimensionalParameters,
        errors: Errors) -> Array:
    """
    Sample the stretch of an actuator that carries out a move planned for another.

    It starts at rest where the model's load for the start really holds it.

    Parameters
    ----------
    move : Move
        The command, in the model's units.
    start : float
        Stretch at rest from which the move was planned.
    times : ndarray, shape (n,)
        In the model's unit of time, not decreasing, at least 0.
    material : NondimensionalParameters
        Of the model.
    errors : Errors
        Of the model.

    Returns
    -------
    ndarray, shape (n,)
        Stretch.

    Raises
    ------
    BadInputError
        If an argument is out of range.
    HmsaError
        If the motion cannot be followed.

    """
    stiffer = 1.0 + errors.shear_modulus
    faster = math.sqrt(stiffer)
    actual = errors.actual(material)
    begin = equilibrium_stretch(elastic_force(start, material) / stiffer, actual)
    stretch, _ = simulate(
        np.array([x.time for x in move.levels]) * faster,
        np.array([x.load for x in move.levels]) / stiffer, times * faster, actual,
        stretch=float(begin))
    return stretch


def rest(move: Move, material: NondimensionalParameters, errors: Errors) -> float:
    """Return the stretch at which the last level of a move really holds the actuator."""
    load = move.levels[-1].load / (1.0 + errors.shear_modulus)
    return float(equilibrium_stretch(load, errors.actual(material)))


def residual(
        move: Move, start: float, target: float, material: NondimensionalParameters,
        errors: Errors, arrival: float) -> float:
    """
    Return the peak-to-peak stretch after arrival as a share of the commanded step.

    A steady offset, from a load that holds another stretch than the model says, is no
    vibration and does not count.

    Parameters
    ----------
    move : Move
        The command, in the model's units.
    start, target : float
        Stretches that it was planned for, at rest at the start; not equal.
    material : NondimensionalParameters
        Of the model.
    errors : Errors
        Of the model.
    arrival : float
        Time from which it counts, in the model's unit; not before the last level.

    Returns
    -------
    float
        A share, not percent.

    Raises
    ------
    BadInputError
        If an argument is out of range.
    HmsaError
        If the motion cannot be followed.

    """
    actual = errors.actual(material)
    end = rest(move, material, errors)
    frequency = float(natural_frequency(end, actual))
    ratio = actual.zeta / float(critical_zeta(end, actual))
    if ratio < 1.0:
        period = 2.0 * math.pi / (frequency * math.sqrt(1.0 - ratio * ratio))
        decay = frequency * ratio
    else:
        period = math.inf
        decay = frequency * (ratio - math.sqrt(ratio * ratio - 1.0))
    horizon = min(_PERIODS * period, _DECADES / decay if decay > 0.0 else math.inf)
    times = arrival + np.linspace(
        0.0, horizon / math.sqrt(1.0 + errors.shear_modulus), _SAMPLES)
    stretch = response(move, start, times, material, errors)
    return residual_vibration(
        times, stretch, arrival=arrival, end=float(times[-1]), step=target - start)
