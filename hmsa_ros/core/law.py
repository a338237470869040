"""
The law of the actuator: what it weighs, how it pushes back, what drives it.

In nondimensional energy form every actuator of this package obeys

    m(l) l'' + m'(l) l'^2 / 2 + d l' + psi'(l) = beta

with stretch ``l``, time in units of ``L sqrt(rho/G)`` and the signed load
``beta = Br B/(mu0 G)``. This module has the parts: everything else takes them from here. Gent
and its limit are inlined; the other laws are families in `hmsa_ros.core.laws.kernels`. A beam
has the deflection of its tip for ``l``, inertia m of its own, and a damping that grows with it.

The compiled functions take one array ``material``, as `pack` makes it: a header (`KIND` to
`UPPER`), then the constants of the law from `CONSTANTS` on, as many as it has, tables included.
Nothing here checks its arguments. Where there is no energy the results are NaN. Between `LOWER`
and `UPPER` the force rises, so that each stretch can be held.
"""

from collections.abc import Callable
from functools import lru_cache
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hmsa_ros.core.compiling import compiled
from hmsa_ros.core.laws import kernels as families
from hmsa_ros.core.laws.record import (
    ANY,
    BEAM,
    CONSTANTS,
    Elastic,
    GENT,
    NEO_HOOKEAN,
    OGDEN,
    POLYNOMIAL,
    TABLE,
)

# Places in the packed material.
KIND = 0  # which law
ZETA = 1  # damping of the group
C1 = 2  # shape of the block, 2 H^2/L^2
DAMPING = 3  # d, of a beam at rest
LOWER = 4  # limiting stretches; 0 and infinity where there are none
UPPER = 5

# Points and halvings of the search for where a force falls.
_LOOK = 4000
_HALVINGS = 60

#: Columns of `acceleration_slopes` before the constants of the law.
BY_LOAD, BY_MODULUS, BY_ZETA, BY_C1, BY_CONSTANT = 0, 1, 2, 3, 4

# What `evaluate` computes.
FORCE, STIFFNESS, ENERGY, MASS, FREQUENCY, CRITICAL_ZETA, EQUILIBRIUM = range(7)

Array = NDArray[np.float64]


def gent_limits(i_j: Any) -> tuple[Any, Any]:
    """
    Return the stretches at which chains of limit 1/i_j are fully extended, for arrays too.

    They are the positive roots of l^3 - (1/i_j + 3) l + 2; 0 and infinity for i_j = 0.
    """
    with np.errstate(divide='ignore', invalid='ignore'):
        p = 1.0 / np.asarray(i_j, dtype=np.float64) + 3.0
        angle = np.arccos(-((3.0 / p) ** 1.5))
        lower = 2.0 * np.sqrt(p / 3.0) * np.cos((angle - 2.0 * math.pi) / 3.0)
        upper = 2.0 * np.sqrt(p / 3.0) * np.cos(angle / 3.0)
        for _ in range(2):
            # Newton steps recover the digits lost where the roots lie close together.
            lower = lower - (lower ** 3 - p * lower + 2.0) / (3.0 * lower * lower - p)
            upper = upper - (upper ** 3 - p * upper + 2.0) / (3.0 * upper * upper - p)
    endless = np.isinf(p)
    return np.where(endless, 0.0, lower), np.where(endless, math.inf, upper)


def pack(zeta: Any, j_lim: Any, c1: Any, elastic: Elastic | None = None) -> Array:
    """
    Return the packed material of a Gent block, or of one with another law.

    Neo-Hookean where J_lim is infinite. Arrays (n,) give n rows.
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
    """Return the stretches around that at rest between which the force of a law rises."""
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
    """Return the last place on the way to ``outside`` at which a condition holds."""
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
    """Return packed materials as rows, though their laws have different numbers of constants."""
    rows = np.zeros((len(materials), max((len(x) for x in materials), default=0)))
    for row, material in zip(rows, materials, strict=True):
        row[:len(material)] = material
    return rows


@compiled(inline=True)
def elastic(l, material, family):  # noqa: E741
    """
    Return psi' and psi'' by the law of a family; NaN outside its limits.

    The family is a constant, `GENT` also for neo-Hookean, or `ANY`. Where it is known, a step
    of the integration is compiled without calls in it and takes half of the time.
    """
    force = stiffness = math.nan
    if family == POLYNOMIAL:
        if 0.0 < l < math.inf:
            force, stiffness = families.polynomial(l, material)
    elif family == OGDEN:
        if 0.0 < l < math.inf:
            force, stiffness = families.ogden(l, material)
    elif family == TABLE:
        force, stiffness = families.table(l, material)
    elif family == BEAM:
        force, stiffness = families.beam(l, material)
    elif family == ANY and material[KIND] > NEO_HOOKEAN:
        force, stiffness = families.elastic(l, material[KIND], material)
    elif material[KIND] == GENT:
        # psi = -(J/2) ln g, A. N. Gent, Rubber Chem. Technol. 69, 59 (1996), and Eq. 4.
        # lg = l g, free of cancellation near l = 1.
        i_j = material[CONSTANTS]
        lg = l - (l - 1.0) * (l - 1.0) * (l + 2.0) * i_j
        if l > 0.0 and lg > 0.0:
            i_l = 1.0 / l
            i_lg = 1.0 / lg
            force = (l - 1.0) * (l * l + l + 1.0) * i_l * i_lg
            stiffness = (
                3.0 * l - force * (lg * i_l + 1.0 - 3.0 * (l * l - 1.0) * i_j)) * i_lg
    elif l > 0.0:
        # psi = (I1 - 3)/2, the limit of Gent for an endless chain.
        i_l = 1.0 / l
        force = (l - 1.0) * (l * l + l + 1.0) * i_l * i_l
        stiffness = 1.0 + 2.0 * i_l * i_l * i_l
    return force, stiffness


@compiled(inline=True)
def motion(l, v, beta, material, family):  # noqa: E741
    """
    Return the acceleration and its derivatives by stretch, rate and load, Eq. 11.

    Outside the limits they are NaN, which makes a step control reject its step. ``family`` is as
    for `elastic`.
    """
    if family == BEAM or (family == ANY and material[KIND] == BEAM):
        return families.beam_motion(l, v, beta, material[DAMPING], material)
    force, stiffness = elastic(l, material, family)
    i_l = 1.0 / l
    l3 = l * l * l
    # 1/m, with -m'/2 = l^-4/4 and -m''/2 = -l^-5.
    i_mass = 6.0 * l3 / (1.0 + material[C1] * l3)
    half = 0.25 * (i_l * i_l) * (i_l * i_l)
    a = (beta - force - (material[DAMPING] - half * v) * v) * i_mass
    a_l = (half * (2.0 * a - 4.0 * v * v * i_l) - stiffness) * i_mass
    a_v = (2.0 * half * v - material[DAMPING]) * i_mass
    return a, a_l, a_v, i_mass


@compiled(inline=True)
def acceleration(l, v, beta, material, family):  # noqa: E741
    """Return the acceleration alone; NaN outside the limits."""
    return motion(l, v, beta, material, family)[0]


@compiled(inline=True)
def at_rest(material):
    """Return the stretch at rest without a field; the deflection of a beam."""
    return 0.0 if material[KIND] == BEAM else 1.0


@compiled()
def damping(l, material):  # noqa: E741
    """Return what multiplies the rate at a stretch: d, which grows with a beam's deflection."""
    if material[KIND] == BEAM:
        return material[DAMPING] * families.beam_inertia(l, material)[3]
    return material[DAMPING]


@compiled()
def elastic_force(l, material):  # noqa: E741
    """Return the load that balances the stretch at rest, psi'(l)."""
    return elastic(l, material, ANY)[0]


@compiled()
def elastic_stiffness(l, material):  # noqa: E741
    """Return psi''(l)."""
    return elastic(l, material, ANY)[1]


@compiled()
def elastic_energy(l, material):  # noqa: E741
    """Return psi(l), zero at rest."""
    if material[KIND] > NEO_HOOKEAN:
        return families.energy(l, material[KIND], material)
    if not material[LOWER] < l < material[UPPER]:
        return math.nan
    # (I1 - 3), free of cancellation near l = 1.
    strain = (l - 1.0) * (l - 1.0) * (l + 2.0) / l
    if material[KIND] == GENT:
        i_j = material[CONSTANTS]
        return -0.5 / i_j * math.log1p(-strain * i_j)
    return 0.5 * strain


@compiled()
def mass(l, material):  # noqa: E741
    """Return the inertia m(l) = (l^-3 + c1)/6 of a block, from Eq. 7, or that of a beam."""
    if material[KIND] == BEAM:
        return families.beam_inertia(l, material)[0]
    return (1.0 / (l * l * l) + material[C1]) / 6.0


@compiled()
def natural_frequency(l, material):  # noqa: E741
    """
    Return the frequency of small undamped motion about a stretch.

    Where the force falls nothing oscillates; it is then the rate at which motion grows.
    """
    return math.sqrt(abs(elastic_stiffness(l, material)) / mass(l, material))


@compiled()
def critical_zeta(l, material):  # noqa: E741
    """Return the damping that is critical for small motion about a stretch."""
    critical = 4.0 / material[C1] * math.sqrt(mass(l, material) * elastic_stiffness(l, material))
    if material[KIND] == BEAM:
        critical /= families.beam_inertia(l, material)[3]
    return critical


@compiled()
def equilibrium_stretch(beta, material):
    """
    Return the stretch at which a constant load is in balance; psi' is monotone.

    A load beyond what can be held gives the limit on its side.
    """
    lower, upper, rest = material[LOWER], material[UPPER], at_rest(material)
    if beta > 0.0:
        lower = rest
        if upper == math.inf:
            upper = 2.0
            while elastic_force(upper, material) < beta:
                upper *= 2.0
    elif beta < 0.0:
        upper = rest
    else:
        return rest
    l = 0.5 * (lower + upper)  # noqa: E741
    for _ in range(200):
        force, stiffness = elastic(l, material, ANY)
        value = force - beta
        if math.isnan(value):
            # Rounded onto a limit.
            value = beta * math.inf
        if value > 0.0:
            upper = l
        elif value < 0.0:
            lower = l
        else:
            return l
        # Newton on log(force/beta), on which a pole at a limit acts about linearly; on the
        # force itself where it is of the other sign or small.
        ratio = force / beta
        step = value / stiffness
        if ratio > 1.0:
            step = math.log(ratio) * force / stiffness
        new = l - step
        if not lower < new < upper:
            new = 0.5 * (lower + upper)
        if abs(new - l) <= 2e-16 * abs(l):
            return new
        l = new  # noqa: E741
    return l


@compiled(inline=True)
def acceleration_slopes(l, v, beta, material, slopes):  # noqa: E741
    """
    Differentiate the acceleration by what an identification may not know; return `motion`.

    ``slopes`` takes the derivatives by the load, by a factor of the elastic force (the shear
    modulus at a fixed unit of time, load in units of the nominal one), by zeta, by c1 and by
    each constant of the law, 1/J_lim for Gent, in the order of the packed material. With them
    and with `motion`, s'' = a_l s + a_v s' + slope gives the sensitivity of a trajectory.
    """
    force, _ = elastic(l, material, ANY)
    a, a_l, a_v, i_mass = motion(l, v, beta, material, ANY)
    slopes[BY_LOAD] = i_mass
    slopes[BY_MODULUS] = -force * i_mass
    slopes[BY_ZETA] = -0.5 * material[C1] * v * i_mass
    if material[KIND] == BEAM:
        # Its inertia has no c1, and none of its constants is sought.
        slopes[BY_ZETA] *= families.beam_inertia(l, material)[3]
        slopes[BY_C1] = material[ZETA] / material[C1] * slopes[BY_ZETA]
        return a, a_l, a_v, i_mass
    slopes[BY_C1] = -(0.5 * material[ZETA] * v + a / 6.0) * i_mass
    if material[KIND] == GENT:
        extension = (l - 1.0) * (l - 1.0) * (l + 2.0)
        slopes[BY_CONSTANT] = -force * extension * i_mass / (
            l - extension * material[CONSTANTS])
    return a, a_l, a_v, i_mass


@compiled()
def evaluate(what, values, material, out):
    """Compute one quantity, such as `FORCE`, for an array of stretches, or of loads."""
    for i in range(values.size):
        x = values[i]
        if what == FORCE:
            out[i] = elastic_force(x, material)
        elif what == STIFFNESS:
            out[i] = elastic_stiffness(x, material)
        elif what == ENERGY:
            out[i] = elastic_energy(x, material)
        elif what == MASS:
            out[i] = mass(x, material)
        elif what == FREQUENCY:
            out[i] = natural_frequency(x, material)
        elif what == CRITICAL_ZETA:
            out[i] = critical_zeta(x, material)
        else:
            out[i] = equilibrium_stretch(x, material)


@compiled()
def accelerations(stretch, rate, load, material, out):
    """Compute the acceleration for arrays of states and loads."""
    for i in range(stretch.size):
        out[i] = acceleration(stretch[i], rate[i], load[i], material, ANY)
