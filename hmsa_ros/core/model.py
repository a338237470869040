"""
The actuator's equations: energies, forces, equilibrium, limits and linearised motion.

Every function takes arrays or scalars, broadcast against each other, and returns float64.
Stretch comes first, then rate and load; material constants follow. The load is the signed
``beta = Br B/(mu0 G)``; the paper's b is ``sign(beta) sqrt|beta|``. Equation numbers are those
of Polymers 2022, 14, 3037. Written in energy form, Eq. 11 is

    m(l) l'' + m'(l) l'^2 / 2 + d l' + psi'(l) = beta

with constant d, of which `mass`, `damping` and `elastic_force` are the parts.
"""

from typing import Any

from numba import vectorize
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.constants import mu_0

from hmsa_ros.core import kernels
from hmsa_ros.core.parameters import ActuatorParameters, NondimensionalParameters

Array = NDArray[np.float64]
#: What functions accept: older NumPy types do not know what ``linspace`` returns.
Floats = NDArray[np.floating[Any]]


def _array(value: ArrayLike) -> Array:
    return np.asarray(value, dtype=np.float64)


def extensibility(stretch: ArrayLike, j_lim: float) -> Array:
    """
    Return how much of the chains' extension is left, g of Eq. 4.

    Parameters
    ----------
    stretch : array_like
        Principal stretch, greater than 0.
    j_lim : float
        Chain limit.

    Returns
    -------
    ndarray
        1 at rest, 0 at either limiting stretch, negative beyond.

    """
    stretch = _array(stretch)
    # 2/l + l^2 - 3 = (l - 1)^2 (l + 2)/l loses no digits near l = 1.
    return 1.0 - (stretch - 1.0) ** 2 * (stretch + 2.0) / (stretch * j_lim)


def elastic_energy(stretch: ArrayLike, j_lim: float) -> Array:
    """
    Return the elastic energy per volume in units of G, Eq. 4.

    Parameters
    ----------
    stretch : array_like
        Principal stretch inside the limits.
    j_lim : float
        Chain limit.

    Returns
    -------
    ndarray
        psi, 0 at stretch 1; NaN outside the limits.

    """
    stretch = _array(stretch)
    with np.errstate(invalid='ignore', divide='ignore'):
        return np.asarray(-0.5 * j_lim * np.log1p(
            -(stretch - 1.0) ** 2 * (stretch + 2.0) / (stretch * j_lim)))


def elastic_force(stretch: ArrayLike, j_lim: float) -> Array:
    """
    Return the load that holds a stretch at rest, psi' = beta_1.

    Parameters
    ----------
    stretch : array_like
        Principal stretch inside the limits.
    j_lim : float
        Chain limit.

    Returns
    -------
    ndarray
        Signed load beta.

    """
    stretch = _array(stretch)
    return (stretch - stretch ** -2) / extensibility(stretch, j_lim)


def elastic_stiffness(stretch: ArrayLike, j_lim: float) -> Array:
    """
    Return psi'', the stiffness about a stretch.

    Parameters
    ----------
    stretch : array_like
        Principal stretch inside the limits.
    j_lim : float
        Chain limit.

    Returns
    -------
    ndarray
        Positive.

    """
    stretch = _array(stretch)
    left = extensibility(stretch, j_lim)
    force = stretch - stretch ** -2
    return (1.0 + 2.0 * stretch ** -3) / left + 2.0 * force ** 2 / (j_lim * left ** 2)


def mass(stretch: ArrayLike, c1: float) -> Array:
    """
    Return the inertia m(l) = (l^-3 + c1)/6, from Eq. 7.

    Parameters
    ----------
    stretch : array_like
        Principal stretch, greater than 0.
    c1 : float
        Shape 2 H^2/L^2.

    Returns
    -------
    ndarray
        Positive.

    """
    return (_array(stretch) ** -3 + c1) / 6.0


def damping(material: NondimensionalParameters) -> float:
    """
    Return the constant d = zeta c1/2 that multiplies the stretch rate.

    Parameters
    ----------
    material : NondimensionalParameters
        The group.

    Returns
    -------
    float
        At least 0.

    """
    return material.zeta * material.c1 / 2.0


def acceleration(
        stretch: ArrayLike, rate: ArrayLike, load: ArrayLike,
        material: NondimensionalParameters) -> Array:
    """
    Return the second derivative of the stretch, Eq. 11.

    Parameters
    ----------
    stretch, rate, load : array_like
        Nondimensional state and signed load.
    material : NondimensionalParameters
        zeta, J_lim and c1.

    Returns
    -------
    ndarray
        In nondimensional time.

    """
    stretch, rate, load = _array(stretch), _array(rate), _array(load)
    cube = stretch ** 3
    inertia = 1.0 + material.c1 * cube
    elastic = (stretch ** 4 - stretch) / extensibility(stretch, material.j_lim)
    return (1.5 * rate ** 2 / (stretch * inertia)
            - 3.0 * material.zeta * material.c1 * cube * rate / inertia
            - 6.0 / inertia * (elastic - load * cube))


def acceleration_si(
        stretch: ArrayLike, rate: ArrayLike, flux_density: ArrayLike,
        actuator: ActuatorParameters) -> Array:
    """
    Return the second derivative of the stretch in SI units, Eq. 10.

    Parameters
    ----------
    stretch : array_like
        Principal stretch.
    rate : array_like
        Stretch rate in 1/s.
    flux_density : array_like
        Signed applied flux density in T.
    actuator : ActuatorParameters
        The block.

    Returns
    -------
    ndarray
        In 1/s^2.

    """
    stretch, rate = _array(stretch), _array(rate)
    flux_density = _array(flux_density)
    shape = 2.0 * (actuator.half_thickness / actuator.half_length) ** 2
    cube = stretch ** 3
    inertia = 1.0 + shape * cube
    elastic = (stretch ** 4 - stretch) / extensibility(stretch, actuator.chain_limit)
    magnetic = (actuator.remanence * flux_density * cube
                / (actuator.shear_modulus * float(mu_0)))
    return (1.5 * rate ** 2 / (stretch * inertia)
            - 6.0 * actuator.damping_coefficient * rate * actuator.half_thickness * cube
            / (8.0 * actuator.density * actuator.half_length ** 4 * inertia)
            - 6.0 * actuator.shear_modulus
            / (actuator.density * actuator.half_length ** 2 * inertia) * (elastic - magnetic))


def energy(
        stretch: ArrayLike, rate: ArrayLike, load: ArrayLike,
        material: NondimensionalParameters) -> Array:
    """
    Return the total energy m l'^2/2 + psi - beta l, which falls at the rate d l'^2.

    Parameters
    ----------
    stretch, rate, load : array_like
        Nondimensional state and signed load.
    material : NondimensionalParameters
        zeta, J_lim and c1.

    Returns
    -------
    ndarray
        In units of the shear modulus.

    """
    stretch, rate, load = _array(stretch), _array(rate), _array(load)
    return (0.5 * mass(stretch, material.c1) * rate ** 2
            + elastic_energy(stretch, material.j_lim) - load * stretch)


@vectorize(['float64(float64, float64)'], cache=True)
def _equilibrium(load: float, i_j: float) -> float:
    value: float = kernels.equilibrium_stretch(load, i_j)
    return value


def equilibrium_stretch(load: ArrayLike, j_lim: float) -> Array:
    """
    Return the stretch at which a constant load is in balance, the inverse of `elastic_force`.

    Parameters
    ----------
    load : array_like
        Signed load beta, finite.
    j_lim : float
        Chain limit.

    Returns
    -------
    ndarray
        Inside the limits; unique, since the force is monotone.

    """
    return np.asarray(_equilibrium(_array(load), 1.0 / j_lim))


def stretch_limits(j_lim: float) -> tuple[float, float]:
    """
    Return the limiting stretches, at which the chains are fully extended.

    Both are roots of 2/l + l^2 - 3 = J_lim: the upper one is the paper's, the lower one bounds
    contraction.

    Parameters
    ----------
    j_lim : float
        Chain limit.

    Returns
    -------
    tuple of float
        Lower limit below 1 and upper limit above 1; both excluded.

    """
    lower, upper = kernels.stretch_limits(1.0 / j_lim)
    return lower, upper


def natural_frequency(stretch: ArrayLike, material: NondimensionalParameters) -> Array:
    """
    Return the undamped angular frequency of small motion about a stretch.

    Parameters
    ----------
    stretch : array_like
        Equilibrium stretch inside the limits.
    material : NondimensionalParameters
        zeta, J_lim and c1.

    Returns
    -------
    ndarray
        sqrt(psi''/m), per unit of nondimensional time.

    """
    return np.sqrt(elastic_stiffness(stretch, material.j_lim) / mass(stretch, material.c1))


def critical_zeta(stretch: ArrayLike, material: NondimensionalParameters) -> Array:
    """
    Return the damping above which small motion about a stretch does not oscillate.

    Parameters
    ----------
    stretch : array_like
        Equilibrium stretch inside the limits.
    material : NondimensionalParameters
        J_lim and c1; its own zeta plays no part.

    Returns
    -------
    ndarray
        (4/c1) sqrt(m psi'').

    """
    return 4.0 / material.c1 * np.sqrt(
        mass(stretch, material.c1) * elastic_stiffness(stretch, material.j_lim))


def signed_root(load: ArrayLike) -> Array:
    """
    Return the paper's flux density b = sign(beta) sqrt|beta|.

    Parameters
    ----------
    load : array_like
        Signed load beta.

    Returns
    -------
    ndarray
        Signed b; negative in contraction, where the paper's b^2 is negative.

    """
    load = _array(load)
    root: Array = np.sign(load) * np.sqrt(np.abs(load))
    return root
