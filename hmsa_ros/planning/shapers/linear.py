"""
The plain step and linear input shapers, as references for comparison.

ZV and ZVD (N. C. Singer, W. P. Seering, "Preshaping command inputs to reduce system
vibration", J. Dyn. Syst. Meas. Control 112, 1990) and EI with 5 % tolerated vibration
(W. E. Singhose, W. P. Seering, N. C. Singer, "Residual vibration reduction using vector
diagrams to generate shaped inputs", J. Mech. Des. 116, 1994), designed for the motion
linearised about the target, branches that creep included. The actuator is not linear: they leave
vibration, the more the larger the move.
"""

from itertools import accumulate
import math

from hmsa_ros.model.delivery import ramps
from hmsa_ros.model.moves import Level, Move
from hmsa_ros.model.status import Code
from hmsa_ros.planning.shapers.creeping import arrival
from hmsa_ros.planning.shapers.modes import oscillation
from hmsa_ros.planning.shapers.request import Request

_EI_TOLERANCE = 0.05
# Passes in which the levels meet what branches hold at arrival.
_PASSES = 6


def step(request: Request) -> Move:
    """Apply the target's own load at once and let the motion ring down, the paper's unshaped."""
    return request.plain(Code.STEP, '')


def zv(request: Request) -> Move:
    """Two impulses, half a damped period apart."""
    return _shaped(request, (1.0, 1.0))


def zvd(request: Request) -> Move:
    """Three impulses, a ZV shaper convolved with itself."""
    return _shaped(request, (1.0, 2.0, 1.0))


def ei(request: Request) -> Move:
    """
    Three impulses, insensitive at the price of 5 % vibration at the design point.

    The undamped amplitudes are weighted with the decay over half a period, as is usual for
    light damping.
    """
    return _shaped(
        request, (1.0 + _EI_TOLERANCE, 2.0 * (1.0 - _EI_TOLERANCE), 1.0 + _EI_TOLERANCE))


def _shaped(request: Request, weights: tuple[float, ...]) -> Move:
    """Shape the step with impulses half a damped period apart, decaying as the motion does."""
    holding = request.holding_load()
    material, target = request.material, request.target
    mode = oscillation(material, target)
    if mode is None:
        return request.plain(
            Code.TOO_DAMPED,
            f'zeta {material.zeta:g} is above critical damping at {request.named_target}: there '
            'is no oscillation to shape for, the plain step is used')
    half_period = math.pi / mode[0].imag
    decay = math.exp(mode[0].real * half_period)
    impulses = [weight * decay ** i for i, weight in enumerate(weights)]
    times = [i * half_period for i in range(len(impulses))]
    period = request.delivery.period
    if period > 0.0:
        times = [round(x / period) * period for x in times]
    shares = [x / sum(impulses) for x in accumulate(impulses)]

    def shaped(last: float) -> tuple[Level, ...]:
        levels = [Level(time, request.load + share * (last - request.load))
                  for time, share in zip(times, shares, strict=True)]
        return (*levels[:-1], Level(levels[-1].time, last))

    levels = shaped(holding)
    end = levels[-1].time
    for _ in range(_PASSES if material.creep else 0):
        # Of what branches hold at arrival, after the last ramp, and what is followed afterwards.
        rows, _ = ramps(levels, request.load, math.inf, request.delivery.slew)
        end = max(end, rows[-1][0])
        if period > 0.0:
            end = period * math.ceil(end / period - 1e-9)
        here = arrival(request, Move(Code.LINEAR, levels, end))
        levels = shaped(request.balance(here.followed))
    request.check(levels)
    return Move(Code.LINEAR, levels, end)
