"""
Equations of the actuator for arrays: energies, forces, equilibrium, limits, linearised motion.

All functions take arrays or scalars that broadcast with each other, and return float64, NaN
outside the limits. Stretch comes first, then rate and load, then the material: a dimensionless
group, or J_lim of a Gent block. The load is the signed
``beta = Br B/(mu0 G)``; the paper's b is ``sign(beta) sqrt|beta|``. Equation numbers are those
of Polymers 2022, 14, 3037. The equations themselves are in `hmsa.model.law`.
"""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hmsa.model import law
from hmsa.model.parameters import NondimensionalParameters

Array = NDArray[np.float64]
#: Accepted array types: older NumPy stubs do not type the result of ``linspace`` precisely.
Floats = NDArray[np.floating[Any]]
# A number is J_lim of a Gent block.
Material = NondimensionalParameters | float


def _array(value: ArrayLike) -> Array:
    return np.asarray(value, dtype=np.float64)


def packed(material: Material) -> Array:
    """Return the packed material for `hmsa.motion`."""
    if isinstance(material, NondimensionalParameters):
        return material.packed
    return law.pack(0.0, material, 1.0)


def _evaluate(what: int, values: ArrayLike, material: Material) -> Array:
    flat = np.array(values, dtype=np.float64, order='C')
    out = np.empty(flat.size)
    law.evaluate(what, flat.ravel(), packed(material), out)
    return out.reshape(flat.shape)


def elastic_energy(stretch: ArrayLike, material: Material) -> Array:
    """Return the elastic energy per volume in units of G, 0 at rest; Eq. 4 for Gent."""
    return _evaluate(law.ENERGY, stretch, material)


def elastic_force(stretch: ArrayLike, material: Material) -> Array:
    """Return the signed load beta_1 = psi' that holds a stretch at rest."""
    return _evaluate(law.FORCE, stretch, material)


def elastic_stiffness(stretch: ArrayLike, material: Material) -> Array:
    """Return psi'', the stiffness about a stretch."""
    return _evaluate(law.STIFFNESS, stretch, material)


def mass(stretch: ArrayLike, material: NondimensionalParameters) -> Array:
    """Return the inertia m(l) = (l^-3 + c1)/6 of a block, from Eq. 7."""
    return _evaluate(law.MASS, stretch, material)


def damping(material: NondimensionalParameters) -> float:
    """Return the constant d = zeta c1/2 that multiplies the stretch rate."""
    return float(material.packed[law.DAMPING])


def acceleration(
        stretch: ArrayLike, rate: ArrayLike, load: ArrayLike,
        material: NondimensionalParameters) -> Array:
    """Return the second derivative of the stretch with respect to dimensionless time, Eq. 11."""
    columns = np.broadcast_arrays(_array(stretch), _array(rate), _array(load))
    out = np.empty(columns[0].size)
    stretches, rates, loads = (np.array(x).ravel() for x in columns)
    law.accelerations(stretches, rates, loads, material.packed, out)
    return out.reshape(columns[0].shape)


def energy(
        stretch: ArrayLike, rate: ArrayLike, load: ArrayLike,
        material: NondimensionalParameters) -> Array:
    """Return the total energy m l'^2/2 + psi - beta l, which decreases at the rate d l'^2."""
    return (0.5 * mass(stretch, material) * _array(rate) ** 2
            + elastic_energy(stretch, material) - _array(load) * _array(stretch))


def equilibrium_stretch(load: ArrayLike, material: Material) -> Array:
    """Return the equilibrium stretch of a finite load; inverse of `elastic_force`."""
    return _evaluate(law.EQUILIBRIUM, load, material)


def stretch_limits(material: Material) -> tuple[float, float]:
    """
    Return the limiting stretches between which the force increases, both excluded.

    For Gent, they are those at full extension of the chains; for neo-Hookean, 0 and infinity.
    """
    made = packed(material)
    return float(made[law.LOWER]), float(made[law.UPPER])


def natural_frequency(stretch: ArrayLike, material: NondimensionalParameters) -> Array:
    """Return sqrt(psi''/m), undamped and angular, of small motion about a stretch."""
    return _evaluate(law.FREQUENCY, stretch, material)


def critical_zeta(stretch: ArrayLike, material: NondimensionalParameters) -> Array:
    """Return (4/c1) sqrt(m psi''), above which small motion does not oscillate."""
    return _evaluate(law.CRITICAL_ZETA, stretch, material)


def signed_root(load: ArrayLike) -> Array:
    """Return the paper's flux density b = sign(beta) sqrt|beta|, negative in contraction."""
    load = _array(load)
    root: Array = np.sign(load) * np.sqrt(np.abs(load))
    return root
