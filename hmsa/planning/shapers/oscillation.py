"""Linearised motion about rest: the oscillating mode, with viscoelastic branches."""

import math

import numpy as np
from numpy.typing import ArrayLike

from hmsa import motion
from hmsa.model import law
from hmsa.model.equations import Array
from hmsa.model.parameters import NondimensionalParameters
from hmsa.model.simulation import paces

# Minimum rate of a branch, relative to the natural frequency.
_SLOWEST = 1e-6


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
