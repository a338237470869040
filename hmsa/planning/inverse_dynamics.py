"""
The stretch as a flat output: the load that makes it follow a path.

The equation of motion determines the load from a path of the stretch (M. Fliess, J. Lévine,
P. Martin, P. Rouchon, Int. J. Control 61, 1327 (1995)).
"""

import numpy as np

from hmsa import motion
from hmsa.errors import HmsaError
from hmsa.model.equations import acceleration, Array, elastic_force
from hmsa.model.parameters import NondimensionalParameters
from hmsa.model.simulation import STUCK, with_followed


def fade(share: Array) -> tuple[Array, Array, Array]:
    """Return a polynomial from 0 to 1, flat to third order at both ends, and two derivatives."""
    left = 1.0 - share
    return (share ** 4 * (35.0 - 84.0 * share + 70.0 * share ** 2 - 20.0 * share ** 3),
            140.0 * (share * left) ** 3, 420.0 * (share * left) ** 2 * (left - share))


def loads_for(
        stretch: Array, rate: Array, wanted: Array, material: NondimensionalParameters) -> Array:
    """Return the loads for given accelerations, which are linear in the load, (n,) each."""
    zero, one = (acceleration(stretch, rate, x, material) for x in (0.0, 1.0))
    return (wanted - zero) / (one - zero)


def held_along(
        times: Array, stretch: Array, followed: tuple[float, ...],
        material: NondimensionalParameters) -> tuple[Array, Array]:
    """
    Return the overstress (n,) of branches along a path, and the branch states (n, k).

    Raise `HmsaError` if the branches cannot be integrated.
    """
    forces = elastic_force(stretch, material)
    behind = np.empty((len(times), len(followed)))
    if not motion.trail(times, forces, with_followed(material, followed), behind):
        raise HmsaError(STUCK)
    return (forces[:, np.newaxis] - behind) @ material.branches[:, motion.RATIO], behind
