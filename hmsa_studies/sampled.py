"""
Sampled hardware: residuals of a move with a fixed command period.

Either the two-step command is solved for on the sampling grid, or the switching time of the ideal
one is rounded to the grid.
"""

from dataclasses import dataclass
import math

import numpy as np

from hmsa.errors import HmsaError
from hmsa.model.delivery import Delivery
from hmsa.model.equations import Array, Floats
from hmsa.model.moves import Level, Move, State
from hmsa.model.parameters import NondimensionalParameters
from hmsa.model.status import Code, RefusedError
from hmsa.planning.shapers.request import MoveRequest
from hmsa.planning.shapers.two_step import two_step
from hmsa_studies.residual import Actual

#: Maximum command period, as a fraction of tau_p, for which the residual should be exact.
PROMISED = 1.0 / 3.0


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
