"""
The fastest shaper that switches on, off and on again, as a reference for comparison.

UM-ZV (W. E. Singhose, N. C. Singer, W. P. Seering, "Time-optimal negative input shapers", J. Dyn.
Syst. Meas. Control 119, 198, 1997): three impulses of 1, -1 and 1 within a third of a period,
where ZV takes half a period. It needs only the levels of start and target, and is less robust.
"""

import cmath
import math

from hmsa.model.moves import Move
from hmsa.planning.shapers.linear import shaped
from hmsa.planning.shapers.request import MoveRequest

# Strides from no damping to full damping, and Newton iterations of each.
_STRIDES, _PASSES = 16, 4
# Minimum of root.real/root.imag: steeper decays, which hardly oscillate, are limited to it.
_STEEPEST = -6.0


def umzv(request: MoveRequest) -> Move:
    """Three impulses of unity magnitude, the second one negative, for the linearised motion."""
    return shaped(request, _impulses)


def _impulses(root: complex) -> list[tuple[float, float]]:
    """Return impulses (time, weight) of a root -decay + i frequency: 1 - e^-rs + e^-rt is 0."""
    # Phase angles, starting with those without damping, a sixth and a third of a period.
    angles = [math.pi / 3.0, 2.0 * math.pi / 3.0]
    for i in range(1, _STRIDES + 1):
        unit = complex(max(root.real / root.imag, _STEEPEST) * i / _STRIDES, 1.0)
        for _ in range(_PASSES):
            early, late = (cmath.exp(-unit * x) for x in angles)
            left, by_early, by_late = 1.0 - early + late, unit * early, -unit * late
            # Two real equations for two angles.
            whole = (by_early.conjugate() * by_late).imag
            angles[0] -= (left.conjugate() * by_late).imag / whole
            angles[1] -= (by_early.conjugate() * left).imag / whole
    return [(0.0, 1.0), (angles[0] / root.imag, -1.0), (angles[1] / root.imag, 1.0)]
