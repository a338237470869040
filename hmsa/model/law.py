"""
The equation of motion of the actuator: inertia, elastic force and load.

In dimensionless energy form every actuator of this package obeys

    m(l) l'' + m'(l) l'^2 / 2 + d l' + psi'(l) = beta

with stretch ``l``, time in units of ``L sqrt(rho/G)`` and the signed load
``beta = Br B/(mu0 G)``. This module defines its terms for all others. A beam
has the deflection of its tip for ``l``, its own inertia m, and a damping that grows with it.

The compiled functions (`hmsa.motion`) take one array ``material``, made by `pack`: a header
(`KIND` to `UPPER`), then the constants of the hyperelastic model from `CONSTANTS` on, including
tables. Arguments are not checked. Where there is no energy, results are NaN. Between `LOWER` and
`UPPER` the force increases, so that each stretch can be held.
"""

from collections.abc import Callable
from functools import lru_cache
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hmsa.model.laws.record import Elastic, GENT, NEO_HOOKEAN
from hmsa.motion import (
    accelerations,
    critical_zeta,
    damping,
    elastic_energy,
    elastic_force,
    elastic_stiffness,
    equilibrium_stretch,
    evaluate,
    mass,
    natural_frequency,
)

__all__ = [
    'accelerations', 'critical_zeta', 'damping', 'elastic_energy', 'elastic_force',
    'elastic_stiffness', 'equilibrium_stretch', 'evaluate', 'gent_limits', 'held', 'mass',
    'natural_frequency', 'pack']

# Indices in the packed material.
KIND = 0  # family of the model
ZETA = 1  # damping
C1 = 2  # shape of the block, 2 H^2/L^2
DAMPING = 3  # d; for a beam, its value at rest
LOWER = 4  # limiting stretches; 0 and infinity without limits
UPPER = 5

# Points and bisections of the search for a falling force.
_LOOK = 4000
_HALVINGS = 60

# Quantities that `evaluate` computes.
FORCE, STIFFNESS, ENERGY, MASS, FREQUENCY, CRITICAL_ZETA, EQUILIBRIUM = range(7)

Array = NDArray[np.float64]


def gent_limits(i_j: Any) -> tuple[Any, Any]:
    """
    Return the stretches at which chains of limit 1/i_j are fully extended, also for arrays.

    They are the positive roots of l^3 - (1/i_j + 3) l + 2; 0 and infinity for i_j = 0.
    """
    with np.errstate(divide='ignore', invalid='ignore'):
        p = 1.0 / np.asarray(i_j, dtype=np.float64) + 3.0
        angle = np.arccos(-((3.0 / p) ** 1.5))
        lower = 2.0 * np.sqrt(p / 3.0) * np.cos((angle - 2.0 * math.pi) / 3.0)
        upper = 2.0 * np.sqrt(p / 3.0) * np.cos(angle / 3.0)
        for _ in range(2):
            # Newton steps recover digits lost if the roots lie close together.
            lower = lower - (lower ** 3 - p * lower + 2.0) / (3.0 * lower * lower - p)
            upper = upper - (upper ** 3 - p * upper + 2.0) / (3.0 * upper * upper - p)
    endless = np.isinf(p)
    return np.where(endless, 0.0, lower), np.where(endless, math.inf, upper)


def pack(zeta: Any, j_lim: Any, c1: Any, elastic: Elastic | None = None) -> Array:
    """
    Return the packed material of a Gent block, or of one with another model.

    The model is neo-Hookean if J_lim is infinite. Arrays (n,) give n rows.
    """
    zeta, j_lim, c1 = (np.asarray(x, dtype=np.float64) for x in (zeta, j_lim, c1))
    if elastic is not None:
        head = np.stack(np.broadcast_arrays(
            elastic.family, zeta, c1, 0.5 * zeta * c1, *held(elastic)), axis=-1)
        constants = np.broadcast_to(
            np.array(elastic.constants), (*head.shape[:-1], len(elastic.constants)))
        made: Array = np.concatenate([head, constants], axis=-1).astype(np.float64)
        return made
    with np.errstate(divide='ignore', over='ignore'):
        i_j = 1.0 / j_lim
    kind = np.where(i_j == 0.0, NEO_HOOKEAN, GENT)
    return np.stack(
        [kind, zeta, c1, 0.5 * zeta * c1, *gent_limits(i_j), i_j], axis=-1)


@lru_cache(maxsize=256)
def held(elastic: Elastic) -> tuple[float, float]:
    """Return the stretches around rest between which the force of a model increases."""
    material = np.array([elastic.family, 0.0, 1.0, 0.0, *elastic.limits, *elastic.constants])

    def rising(end: float) -> float:
        space = np.geomspace if elastic.rest else np.linspace
        path: Array = space(elastic.rest, end, _LOOK).astype(np.float64)
        path[-1] = end
        stiffness = np.empty(_LOOK)
        evaluate(STIFFNESS, path, material, stiffness)
        falls = np.flatnonzero(~(stiffness > 0.0))
        if not len(falls):
            return end
        return boundary(
            lambda x: elastic_stiffness(x, material) > 0.0,
            float(path[max(falls[0] - 1, 0)]), float(path[falls[0]]))

    return rising(elastic.limits[0]), rising(elastic.limits[1])


def boundary(holds: Callable[[float], bool], inside: float, outside: float) -> float:
    """Return the last point on the way to ``outside`` at which a condition holds."""
    if holds(outside):
        return outside
    for _ in range(_HALVINGS):
        middle = 0.5 * (inside + outside)
        if holds(middle):
            inside = middle
        else:
            outside = middle
    return inside


def stack(materials: Any) -> Array:
    """Return packed materials as rows, padded to the same number of constants."""
    rows = np.zeros((len(materials), max((len(x) for x in materials), default=0)))
    for row, material in zip(rows, materials, strict=True):
        row[:len(material)] = material
    return rows
