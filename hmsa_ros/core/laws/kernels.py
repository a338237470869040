"""
Compiled force, stiffness and energy of the families of laws beside Gent.

Each takes a stretch and a packed material, whose numbers from `CONSTANTS` on are those of the
law, and works in units of the shear modulus at small strain. The stretch is above 0; a beam has
a deflection of its tip in its place.
"""

import math

from hmsa_ros.core.compiling import compiled
from hmsa_ros.core.laws.record import BEAM, CONSTANTS, OGDEN, POLYNOMIAL, TABLE


@compiled(inline=True)
def polynomial(l, material):  # noqa: E741
    """Return psi' and psi'' of b (I2 - 3) + sum a_k (I1 - 3)^k."""
    b = material[CONSTANTS]
    a1, a2, a3 = material[CONSTANTS + 1], material[CONSTANTS + 2], material[CONSTANTS + 3]
    a4, a5 = material[CONSTANTS + 4], material[CONSTANTS + 5]
    i_l = 1.0 / l
    # I1 - 3, half its first and all of its second derivative, free of cancellation near l = 1.
    x = (l - 1.0) * (l - 1.0) * (l + 2.0) * i_l
    half = (l - 1.0) * (l * l + l + 1.0) * i_l * i_l
    second = 2.0 + 4.0 * i_l * i_l * i_l
    p1 = a1 + x * (2.0 * a2 + x * (3.0 * a3 + x * (4.0 * a4 + x * 5.0 * a5)))
    p2 = 2.0 * a2 + x * (6.0 * a3 + x * (12.0 * a4 + x * 20.0 * a5))
    force = 2.0 * half * (p1 + b * i_l)
    stiffness = second * p1 + 4.0 * half * half * p2 + 6.0 * b * (i_l * i_l) * (i_l * i_l)
    return force, stiffness


@compiled()
def _polynomial_energy(l, material):  # noqa: E741
    """Return b (I2 - 3) + sum a_k (I1 - 3)^k."""
    x = (l - 1.0) * (l - 1.0) * (l + 2.0) / l
    total = 0.0
    for k in range(5, 0, -1):
        total = x * (material[CONSTANTS + k] + total)
    return total + material[CONSTANTS] * (l - 1.0) * (l - 1.0) * (2.0 * l + 1.0) / (l * l)


@compiled(inline=True)
def ogden(l, material):  # noqa: E741
    """Return psi' and psi'' of sum mu/a (l^a + 2 l^(-a/2) - 3)."""
    logarithm = math.log(l)
    force = stiffness = 0.0
    for i in range(int(material[CONSTANTS])):
        mu = material[CONSTANTS + 1 + 2 * i]
        a = material[CONSTANTS + 2 + 2 * i]
        low = math.exp(-0.5 * a * logarithm)
        high = 1.0 / (low * low)
        force += mu * (high - low)
        stiffness += mu * ((a - 1.0) * high + (0.5 * a + 1.0) * low)
    i_l = 1.0 / l
    return force * i_l, stiffness * i_l * i_l


@compiled()
def _ogden_energy(l, material):  # noqa: E741
    """Return sum mu/a (l^a + 2 l^(-a/2) - 3)."""
    logarithm = math.log(l)
    total = 0.0
    for i in range(int(material[CONSTANTS])):
        a = material[CONSTANTS + 2 + 2 * i]
        total += material[CONSTANTS + 1 + 2 * i] / a * (
            math.expm1(a * logarithm) + 2.0 * math.expm1(-0.5 * a * logarithm))
    return total


@compiled()
def _piece(l, material):  # noqa: E741
    """Return the place of the piece of a table that a stretch is in."""
    low, high = 0, int(material[CONSTANTS])
    while high - low > 1:
        middle = (low + high) // 2
        if l < material[CONSTANTS + 3 + 8 * middle]:
            high = middle
        else:
            low = middle
    return CONSTANTS + 3 + 8 * low


@compiled()
def _beyond(l, material):  # noqa: E741
    """
    Return the way beyond an end of a table, 0 inside it, and the depth of the stop there.

    Then force, stiffness and energy at the end.
    """
    first = CONSTANTS + 3
    last = first + 8 * int(material[CONSTANTS])
    if l < material[first]:
        return (l - material[first], material[CONSTANTS + 1], material[first + 2],
                material[first + 3], material[first + 1])
    if l > material[last]:
        return (l - material[last], material[CONSTANTS + 2], material[last + 2],
                material[last + 3], material[last + 1])
    return 0.0, 1.0, 0.0, 0.0, 0.0


@compiled()
def table(l, material):  # noqa: E741
    """
    Return psi' and psi'' of a table.

    Beyond its ends the force goes on with the slope there and rises without bound at a stop.
    """
    way, depth, force, stiffness, _ = _beyond(l, material)
    if way != 0.0:
        room = 1.0 - way / depth
        if not room > 0.0:
            return math.nan, math.nan
        return force + stiffness * way / room, stiffness / (room * room)
    i = _piece(l, material)
    u = l - material[i]
    c1, c2, c3 = material[i + 3], material[i + 4], material[i + 5]
    c4, c5 = material[i + 6], material[i + 7]
    force = material[i + 2] + u * (c1 + u * (c2 + u * (c3 + u * (c4 + u * c5))))
    stiffness = c1 + u * (2.0 * c2 + u * (3.0 * c3 + u * (4.0 * c4 + u * 5.0 * c5)))
    return force, stiffness


@compiled()
def _table_energy(l, material):  # noqa: E741
    """Return the integral of a table's force from stretch 1."""
    way, depth, force, stiffness, total = _beyond(l, material)
    if way != 0.0:
        share = way / depth
        if not share < 1.0:
            return math.nan
        return total + force * way - stiffness * depth * depth * (math.log1p(-share) + share)
    i = _piece(l, material)
    u = l - material[i]
    for k in range(6, 0, -1):
        total = u * (material[i + 1 + k] / k + total)
    return material[i + 1] + total


@compiled(inline=True)
def _bent(a, material):
    """Return the place of the piece of a beam's tables that a deflection's size is in."""
    i = int((1.0 - math.sqrt(1.0 - a / material[CONSTANTS + 1])) * material[CONSTANTS + 3])
    return CONSTANTS + 8 + 26 * min(max(i, 0), int(material[CONSTANTS]) - 1)


@compiled(inline=True)
def _seventh(u, i, material):
    """Return a polynomial of degree 7, whose factors begin at a place, and its derivatives."""
    value = slope = curve = 0.0
    for k in range(7, -1, -1):
        curve = 2.0 * slope + u * curve
        slope = value + u * slope
        value = material[i + k] + u * value
    return value, slope, curve


@compiled()
def beam(l, material):  # noqa: E741
    """
    Return psi' and psi'' of a beam against the deflection of its tip.

    Beyond the end of the tables the force goes on as that of `table`.
    """
    a = abs(l)
    way = a - material[CONSTANTS + 2]
    if way > 0.0:
        force, stiffness = material[CONSTANTS + 4], material[CONSTANTS + 5]
        room = 1.0 - way / (material[CONSTANTS + 1] - material[CONSTANTS + 2])
        if not room > 0.0:
            return math.nan, math.nan
        return math.copysign(force + stiffness * way / room, l), stiffness / (room * room)
    if not a >= 0.0:
        return math.nan, math.nan
    i = _bent(a, material)
    force, stiffness, _ = _seventh(a - material[i], i + 2, material)
    return math.copysign(force, l), stiffness


@compiled()
def beam_inertia(l, material):  # noqa: E741
    """Return m, m', m'' of a beam, and by what its damping grows, with its derivative."""
    a = abs(l)
    if not a <= material[CONSTANTS + 2]:
        return material[CONSTANTS + 6], 0.0, 0.0, material[CONSTANTS + 7], 0.0
    i = _bent(a, material)
    u = a - material[i]
    m, m1, m2 = _seventh(u, i + 10, material)
    d, d1, _ = _seventh(u, i + 18, material)
    return m, math.copysign(m1, m1 * l), m2, d, math.copysign(d1, d1 * l)


@compiled()
def beam_motion(l, v, beta, damping, material):  # noqa: E741
    """Return what `hmsa_ros.core.law.motion` does, for a beam."""
    force, stiffness = beam(l, material)
    m, m1, m2, d, d1 = beam_inertia(l, material)
    i_mass = 1.0 / m
    a = (beta - force - (damping * d + 0.5 * m1 * v) * v) * i_mass
    a_l = -(stiffness + (damping * d1 + 0.5 * m2 * v) * v + m1 * a) * i_mass
    return a, a_l, -(damping * d + m1 * v) * i_mass, i_mass


@compiled()
def _beam_energy(l, material):  # noqa: E741
    """Return the integral of a beam's force."""
    a = abs(l)
    way = a - material[CONSTANTS + 2]
    i = _bent(min(a, material[CONSTANTS + 2]), material)
    u = min(a, material[CONSTANTS + 2]) - material[i]
    total = 0.0
    for k in range(8, 0, -1):
        total = u * (material[i + 1 + k] / k + total)
    total += material[i + 1]
    if way > 0.0:
        depth = material[CONSTANTS + 1] - material[CONSTANTS + 2]
        share = way / depth
        if not share < 1.0:
            return math.nan
        total += material[CONSTANTS + 4] * way \
            - material[CONSTANTS + 5] * depth * depth * (math.log1p(-share) + share)
    return total


@compiled()
def elastic(l, family, material):  # noqa: E741
    """Return psi' and psi''; NaN at a stretch that there is not."""
    if family == BEAM:
        return beam(l, material)
    if not 0.0 < l < math.inf:
        return math.nan, math.nan
    if family == POLYNOMIAL:
        return polynomial(l, material)
    if family == OGDEN:
        return ogden(l, material)
    if family == TABLE:
        return table(l, material)
    return math.nan, math.nan


@compiled()
def energy(l, family, material):  # noqa: E741
    """Return psi, zero at rest; NaN at a stretch that there is not."""
    if family == BEAM:
        return _beam_energy(l, material)
    if not 0.0 < l < math.inf:
        return math.nan
    if family == POLYNOMIAL:
        return _polynomial_energy(l, material)
    if family == OGDEN:
        return _ogden_energy(l, material)
    if family == TABLE:
        return _table_energy(l, material)
    return math.nan
