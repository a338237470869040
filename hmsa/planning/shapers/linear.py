"""
The unshaped step and linear input shapers, as references for comparison.

ZV and ZVD (N. C. Singer, W. P. Seering, "Preshaping command inputs to reduce system
vibration", J. Dyn. Syst. Meas. Control 112, 1990) and EI with 5 % tolerated vibration
(W. E. Singhose, W. P. Seering, N. C. Singer, "Residual vibration reduction using vector
diagrams to generate shaped inputs", J. Mech. Des. 116, 1994) are designed for the motion
linearised about the target, including viscoelastic branches. As the actuator is nonlinear, they
leave vibration that increases with the size of the move.

UM-ZV (W. E. Singhose, N. C. Singer, W. P. Seering, "Time-optimal negative input shapers", J. Dyn.
Syst. Meas. Control 119, 198, 1997), the fastest shaper that switches on, off and on again, has
three impulses of 1, -1 and 1 within a third of a period, where ZV takes half a period. It needs
only the levels of start and target, and is less robust.
"""

import cmath
from collections.abc import Callable
from itertools import accumulate, starmap
import math

import numpy as np
from numpy.typing import ArrayLike

from hmsa import motion
from hmsa.model import law
from hmsa.model.delivery import ramps
from hmsa.model.equations import Array
from hmsa.model.moves import Level, Move
from hmsa.model.parameters import NondimensionalParameters
from hmsa.model.simulation import branches_of, paces
from hmsa.model.status import Code
from hmsa.planning.shapers.creeping import arrival
from hmsa.planning.shapers.request import MoveRequest

# Minimum rate of a branch, relative to the natural frequency.
_SLOWEST = 1e-6
#: Impulses (time, weight) for a root -decay + i frequency of the motion, by time.
Impulses = Callable[[complex], list[tuple[float, float]]]

_EI_TOLERANCE = 0.05
# Iterations that match the levels to the overstress at arrival.
_PASSES = 6
# Strides from no damping to full damping, and Newton iterations of each.
_STRIDES, _ITERATIONS = 16, 4
# Minimum of root.real/root.imag: steeper decays, which hardly oscillate, are limited to it.
_STEEPEST = -6.0


def oscillation(
        material: NondimensionalParameters, stretch: float,
        above: ArrayLike) -> tuple[complex, Array, Array] | None:
    """
    Return the oscillating mode about rest at a stretch; None if the motion does not oscillate.

    Branches are taken as linear, with their relaxation rates at the stress ``above`` over their
    ratio.

    The first item is the root, -decay + i frequency. The second are the rows (2, 2 + n) that map a
    state to a vector: deviation of the stretch, rate, and the n branch states less the force at
    rest, over the stiffness. The length of the vector is the amplitude of the stretch. The third
    is the vector (2, n) of a state at rest under a unit load that decays as each branch does.
    """
    packed, branches = material.packed, material.branches
    mass = law.mass(stretch, packed)
    damped = law.damping(stretch, packed) / mass
    squared = law.elastic_stiffness(stretch, packed) / mass
    if not len(branches):
        gap = squared - 0.25 * damped * damped
        if not gap > 0.0:
            return None
        frequency = math.sqrt(gap)
        rows = np.array([[1.0, 0.0], [0.5 * damped / frequency, 1.0 / frequency]])
        return complex(-0.5 * damped, frequency), rows, np.empty((2, 0))
    ratios = branches[:, motion.RATIO]
    speeds = np.maximum(paces(material, above), _SLOWEST * math.sqrt(squared))
    count = 2 + len(branches)
    matrix = np.zeros((count, count))
    matrix[0, 1] = 1.0
    matrix[1] = np.concatenate([[-squared * (1.0 + ratios.sum()), -damped], squared * ratios])
    matrix[2:, 0] = speeds
    matrix[2:, 2:] = -np.diag(speeds)
    roots, modes = np.linalg.eig(matrix)
    place = int(np.argmax(roots.imag))
    root = complex(roots[place])
    if not root.imag > 0.0:
        return None
    # Projection of a state onto the mode, normalised to stretch 1.
    share = 2.0 * np.linalg.inv(modes)[place] * modes[0, place]
    rows = np.array([share.real, -share.imag])
    pushed = np.array([0.0, 1.0 / mass, *np.zeros(len(branches))])
    tail = np.column_stack([
        -rows @ np.linalg.solve(matrix + speed * np.eye(count), pushed) for speed in speeds])
    return root, rows, tail


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


def umzv(request: MoveRequest) -> Move:
    """Three impulses of unity magnitude, the second one negative, for the linearised motion."""
    return shaped(request, _impulses_of_unity)


def _impulses_of_unity(root: complex) -> list[tuple[float, float]]:
    """Return impulses (time, weight) of a root -decay + i frequency: 1 - e^-rs + e^-rt is 0."""
    # Phase angles, starting with those without damping, a sixth and a third of a period.
    angles = [math.pi / 3.0, 2.0 * math.pi / 3.0]
    for i in range(1, _STRIDES + 1):
        unit = complex(max(root.real / root.imag, _STEEPEST) * i / _STRIDES, 1.0)
        for _ in range(_ITERATIONS):
            early, late = (cmath.exp(-unit * x) for x in angles)
            left, by_early, by_late = 1.0 - early + late, unit * early, -unit * late
            # Two real equations for two angles.
            whole = (by_early.conjugate() * by_late).imag
            angles[0] -= (left.conjugate() * by_late).imag / whole
            angles[1] -= (by_early.conjugate() * left).imag / whole
    return [(0.0, 1.0), (angles[0] / root.imag, -1.0), (angles[1] / root.imag, 1.0)]
