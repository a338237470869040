"""
The unshaped step and linear input shapers, as references for comparison.

ZV and ZVD (N. C. Singer, W. P. Seering, "Preshaping command inputs to reduce system
vibration", J. Dyn. Syst. Meas. Control 112, 1990) and EI with 5 % tolerated vibration
(W. E. Singhose, W. P. Seering, N. C. Singer, "Residual vibration reduction using vector
diagrams to generate shaped inputs", J. Mech. Des. 116, 1994) are designed for the motion
linearised about the target, including viscoelastic branches. As the actuator is nonlinear, they
leave vibration that increases with the size of the move.
"""

from collections.abc import Callable
from itertools import accumulate, starmap
import math

from hmsa.model.delivery import ramps
from hmsa.model.moves import Level, Move
from hmsa.model.simulation import branches_of
from hmsa.model.status import Code
from hmsa.planning.shapers.creeping import arrival
from hmsa.planning.shapers.oscillation import oscillation
from hmsa.planning.shapers.request import MoveRequest

#: Impulses (time, weight) for a root -decay + i frequency of the motion, by time.
Impulses = Callable[[complex], list[tuple[float, float]]]

_EI_TOLERANCE = 0.05
# Iterations that match the levels to the overstress at arrival.
_PASSES = 6


def step(request: MoveRequest) -> Move:
    """Apply the holding level at once, the paper's unshaped input; the motion rings down."""
    return request.plain(Code.STEP, '')


def zv(request: MoveRequest) -> Move:
    """Two impulses, half a damped period apart."""
    return shaped(request, _spaced(1.0, 1.0))


def zvd(request: MoveRequest) -> Move:
    """Three impulses, a ZV shaper convolved with itself."""
    return shaped(request, _spaced(1.0, 2.0, 1.0))


def ei(request: MoveRequest) -> Move:
    """
    Three impulses, insensitive at the cost of 5 % vibration at the design point.

    The undamped amplitudes are weighted with the decay over half a period, as is usual for
    light damping.
    """
    return shaped(
        request, _spaced(1.0 + _EI_TOLERANCE, 2.0 * (1.0 - _EI_TOLERANCE), 1.0 + _EI_TOLERANCE))


def _spaced(*weights: float) -> Impulses:
    """Return impulses half a damped period apart, which decay as the motion does."""
    def impulses(root: complex) -> list[tuple[float, float]]:
        half_period = math.pi / root.imag
        decay = math.exp(root.real * half_period)
        heights = [weight * decay ** i for i, weight in enumerate(weights)]
        return [(i * half_period, x / sum(heights)) for i, x in enumerate(heights)]

    return impulses


def shaped(request: MoveRequest, impulses: Impulses) -> Move:
    """Shape the step with impulses for the motion linearised about the target."""
    holding = request.holding_load()
    material, target = request.material, request.target
    mode = oscillation(material, target, request.behind(target))
    if mode is None:
        return request.plain(
            Code.TOO_DAMPED,
            f'zeta {material.zeta:g} is above critical damping at {request.named_target}: there '
            'is no oscillation to shape for, the unshaped step is used')
    times, heights = map(list, zip(*impulses(mode[0]), strict=True))
    shares = list(accumulate(heights))
    period = request.delivery.period
    if period > 0.0:
        times = [round(x / period) * period for x in times]

    def levels_to(last: float) -> tuple[Level, ...]:
        # On a coarse grid two levels may coincide in time: the later one applies.
        loads = {time: request.load + share * (last - request.load)
                 for time, share in zip(times, shares, strict=True)} | {times[-1]: last}
        return tuple(starmap(Level, loads.items()))

    levels = levels_to(holding)
    end = levels[-1].time
    for _ in range(_PASSES if material.creeps else 0):
        # Account for the overstress at arrival, after the last ramp, and for the tail.
        rows, _ = ramps(levels, request.load, math.inf, request.delivery.slew)
        end = max(end, rows[-1][0])
        if period > 0.0:
            end = period * math.ceil(end / period - 1e-9)
        here = arrival(request, Move(Code.LINEAR, levels, end))
        levels = levels_to(request.balance(branches_of(here, material)))
    request.check(levels)
    return Move(Code.LINEAR, levels, end)
