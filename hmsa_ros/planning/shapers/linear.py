"""
The plain step and linear input shapers, as references for comparison.

ZV and ZVD (N. C. Singer, W. P. Seering, "Preshaping command inputs to reduce system
vibration", J. Dyn. Syst. Meas. Control 112, 1990) and EI with 5 % tolerated vibration
(W. E. Singhose, W. P. Seering, N. C. Singer, "Residual vibration reduction using vector
diagrams to generate shaped inputs", J. Mech. Des. 116, 1994), designed for the motion
linearised about the target. The actuator is not linear: they leave vibration, the more the
larger the move.
"""

import math

from hmsa_ros.model import law
from hmsa_ros.model.moves import Level, Move
from hmsa_ros.model.status import Code
from hmsa_ros.planning.shapers.creeping import check
from hmsa_ros.planning.shapers.request import Request

_EI_TOLERANCE = 0.05


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
    check(request.material, str(Code.LINEAR))
    holding = request.holding_load()
    material, target = request.material, request.target
    xi = material.zeta / law.critical_zeta(target, material.packed)
    if xi >= 1.0:
        return request.plain(
            Code.TOO_DAMPED,
            f'zeta {material.zeta:g} is above critical damping at {request.named_target}: there '
            'is no oscillation to shape for, the plain step is used')
    frequency = law.natural_frequency(target, material.packed)
    damped = math.sqrt(1.0 - xi * xi)
    half_period = math.pi / (frequency * damped)
    decay = math.exp(-math.pi * xi / damped)
    impulses = [weight * decay ** i for i, weight in enumerate(weights)]
    share = 0.0
    levels = []
    for i, impulse in enumerate(impulses):
        share += impulse / sum(impulses)
        time = i * half_period
        if request.delivery.period > 0.0:
            time = round(time / request.delivery.period) * request.delivery.period
        levels.append(Level(time, request.load + share * (holding - request.load)))
    levels[-1] = Level(levels[-1].time, holding)
    request.check(levels)
    return Move(Code.LINEAR, tuple(levels), levels[-1].time)
