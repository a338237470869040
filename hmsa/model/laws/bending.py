"""
One mode of a clamped-free beam at large deflections, as functions of its tip.

The tangent at the fraction ``s`` of the length turns by ``theta(s) = q f(s)``, where ``f`` is the
slope of the first mode of a beam, scaled so that ``q`` is the angle of the tip. The coordinate
is ``u = integral of sin(theta)``, the deflection of the tip across the beam over its length: the
work of a uniform field across it is that of a constant force at the tip. In the units of
`hmsa.model.laws.beam`, elastic force, inertia and damping are then functions of ``u`` alone,
the same for every beam.
"""

from collections.abc import Callable
from functools import cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

#: Root of cos x cosh x = -1; the first frequency is its square times sqrt(EI/(rho A L^4)).
ROOT = 1.8751040687119611
#: Maximum angle of the tip in plans.
LARGEST_ANGLE = np.radians(80.0)
# End of the tables, where an artificial stop begins.
_TABLE_ANGLE = np.radians(95.0)
# Points of the quadrature along the beam, and number and degree of the pieces of the tables.
_POINTS, _PIECES, DEGREE = 48, 96, 7
_NEWTON = 60


@cache
def _rule() -> tuple[Array, Array, Array]:
    """Return quadrature weights, the matrix that integrates up to each point, and f there."""
    legendre = np.polynomial.legendre
    x, weights = legendre.leggauss(_POINTS)
    # Integrate the Legendre polynomials, and change the basis to values at the points.
    integrals = legendre.legval(x, legendre.legint(np.eye(_POINTS), lbnd=-1)).T
    up_to: Array = 0.5 * integrals @ np.linalg.inv(legendre.legvander(x, _POINTS - 1))
    return 0.5 * weights, up_to, slope(0.5 + 0.5 * x)


def slope(share: ArrayLike) -> Array:
    """Return the slope of the first mode at fractions of the length, 1 at the tip."""
    ratio = (np.sin(ROOT) - np.sinh(ROOT)) / (np.cos(ROOT) + np.cosh(ROOT))
    x = ROOT * np.append(np.ravel(share), 1.0)
    unscaled = np.sinh(x) + np.sin(x) + ratio * (np.cosh(x) - np.cos(x))
    made: Array = (unscaled[:-1] / unscaled[-1]).reshape(np.shape(share))
    return made


def _turned(angle: ArrayLike) -> Array:
    """Return the rotation of the beam at its points, for angles of the tip in rad."""
    return np.multiply.outer(np.asarray(angle, dtype=np.float64), _rule()[2])


def deflection(angle: ArrayLike) -> Array:
    """Return the deflection over length at angles of the tip in rad."""
    weights, _, _ = _rule()
    made: Array = np.sin(_turned(angle)) @ weights
    return made


def _gain(angle: ArrayLike) -> Array:
    """Return the derivative of `deflection`."""
    weights, _, f = _rule()
    made: Array = np.cos(_turned(angle)) @ (f * weights)
    return made


@cache
def fold() -> float:
    """Return the angle at which the tip deflects most: beyond it a field pulls it back."""
    angle = 1.8
    weights, _, f = _rule()
    for _ in range(_NEWTON):
        angle += float(_gain(angle)) / float(np.sin(angle * f) @ (f * f * weights))
    return angle


def angle_of(deflections: ArrayLike) -> Array:
    """Return the angle of the tip in rad at deflections, each within that of `fold`."""
    wanted = np.asarray(deflections, dtype=np.float64)
    most = float(deflection(fold()))
    # Near the fold the missing deflection is about as the square of the missing angle.
    angle: Array = np.sign(wanted) * fold() * (
        1.0 - np.sqrt(np.maximum(1.0 - np.abs(wanted) / most, 0.0)))
    for _ in range(_NEWTON):
        step = (deflection(angle) - wanted) / np.maximum(_gain(angle), 1e-9)
        angle = np.clip(angle - step, -fold(), fold())
        if np.max(np.abs(step), initial=0.0) < 1e-9:
            break
    return angle


def inertia_of_angle(angle: ArrayLike) -> Array:
    """Return the integral of the squared velocities at a unit rate of the angle, for length 1."""
    weights, up_to, f = _rule()
    turned = _turned(angle)
    along, across = ((of(turned) * f) @ up_to.T for of in (np.sin, np.cos))
    made: Array = (along ** 2 + across ** 2) @ weights
    return made


def tangent(deflected: float, share: ArrayLike) -> Array:
    """Return the rotation in rad of a bent beam at fractions of its length."""
    return float(angle_of(deflected)) * slope(share)


def centreline(deflected: float, points: int) -> tuple[Array, Array]:
    """Return positions along and across the beam from clamp to tip, over its length."""
    # At the points, and halfway between them.
    turned = tangent(deflected, np.linspace(0.0, 1.0, 2 * points - 1))
    ends, middle = turned[::2], turned[1::2]
    # Simpson's rule, from each point to the next.
    sums = [
        np.append(0.0, np.cumsum(
            (of(ends[1:]) + 4.0 * of(middle) + of(ends[:-1])) / (6.0 * (points - 1))))
        for of in (np.cos, np.sin)]
    return sums[0], sums[1]


def tabulated(
        fold: float, end: float, count: int, quantities: Callable[[Array], Array],
        energy: Callable[[Array, Array, Array], Array]) -> tuple[float, ...]:
    """
    Return the constants of ``Beam`` in ``motion/hmsa/system.hpp``.

    The order is: number of pieces; deflections of the fold and of the end of the tables; inverse
    width of the pieces in ``1 - sqrt(1 - u/fold)``; force, stiffness, inertia and damping at the
    end. For each piece follow its initial deflection and energy, and the polynomial coefficients
    of the quantities.

    Parameters
    ----------
    fold, end : float
        Deflections of the fold and of the end of the tables.
    count : int
        Number of pieces.
    quantities : callable
        Returns force, inertia, damping and further quantities, shape (m, p, n), at deflections of
        shape (p, n).
    energy : callable
        Returns the energies at the starts of the pieces, (p,), of these, their widths, and the
        coefficients of the force, (p, n).

    Returns
    -------
    tuple of float
        The constants, in this order.

    """
    share = (1.0 - np.sqrt(1.0 - end / fold)) / count
    breaks = fold * (1.0 - (1.0 - share * np.arange(count + 1)) ** 2)
    breaks[-1] = end
    widths = np.diff(breaks)
    nodes = 0.5 - 0.5 * np.cos(np.pi * (np.arange(DEGREE + 1) + 0.5) / (DEGREE + 1))
    values = quantities(breaks[:-1, None] + widths[:, None] * nodes)
    powers = nodes[:, None] ** np.arange(DEGREE + 1)
    factors = np.linalg.solve(powers, values[..., None])[..., 0]
    pieces = factors / widths[:, None] ** np.arange(DEGREE + 1)
    # The force on a straight beam is exactly zero.
    pieces[0, 0, 0] = 0.0
    at_end = widths[-1] ** np.arange(DEGREE + 1)
    force, inertia, damping = (pieces[:3, -1] @ at_end).tolist()
    stiffness = float(pieces[0, -1, 1:] @ (np.arange(1, DEGREE + 1) * at_end[:-1]))
    rows = np.column_stack([breaks[:-1], energy(breaks[:-1], widths, pieces[0]), *pieces])
    return (
        float(count), fold, end, float(1.0 / share), force, stiffness, inertia, damping,
        *rows.ravel().tolist())


@cache
def packed() -> tuple[float, ...]:
    """Return the constants of ``Beam`` in ``motion/hmsa/system.hpp``; see `tabulated`."""
    rest = float(_gain(0.0))

    def quantities(at: Array) -> Array:
        angle = angle_of(at)
        per = _gain(angle)
        return np.stack([
            3.0 * rest ** 2 * angle / per, 4.0 * inertia_of_angle(angle) / per ** 2,
            (rest / per) ** 2])

    return tabulated(
        float(deflection(fold())), float(deflection(_TABLE_ANGLE)), _PIECES, quantities,
        lambda starts, widths, force: 1.5 * (rest * angle_of(starts)) ** 2)
