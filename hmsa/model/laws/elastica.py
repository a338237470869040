"""
The elastica: a clamped beam in its exact shapes at rest, and its second mode about each of them.

In a field across it, a beam that is magnetised along its length has the shapes at rest

    theta'' + b cos(theta) = 0,    theta(0) = theta'(1) = 0,

with the rotation ``theta`` of the tangent at fractions s of the length, and the load b in units of
E I/l^2. They form a family with the deflection u of the tip as its coordinate. The work of the
field is b u exactly. Small motion about a member of the family has the modes of an inextensible
rod; the first one determines the inertia that belongs to u, the second is a further coordinate a:
with the momenta of both, and without terms of third order in a,

    L = mu(u) u'^2/2 + (a' + h(u) u')^2/2 - U(u) + b u + (b - U'(u)) g(u) a - l(u) a^2/2,

where g is what the mode moves the tip, l the square of its frequency, h its part in a change of
u, and mu = (1 - g h) U'/l_1 gives the first frequency. Viscous bending dissipates with
the coefficients d u'^2 + 2 e u' a' + k a'^2. Rotations are polynomials, by the method of
Rayleigh and Ritz.
"""

from functools import cache
import math
from typing import NamedTuple

import numpy as np
from numpy.polynomial import legendre
from numpy.typing import ArrayLike, NDArray

from hmsa.model.laws.bending import angle_of, DEGREE, ROOT, slope, tabulated

Array = NDArray[np.float64]

# Polynomials of the rotation, and points of the quadrature: with twice as many, the functions
# change by 1e-12 of their values (test_elastica).
_TERMS, _POINTS = 16, 48
# Number of pieces of the tables, their end, and the deflection of a stop.
_PIECES = 32
_END, _STOP = 0.86, 1.0
_NEWTON, _EXACT, _NEAR = 40, 1e-13, 1e-6
# Steps to a deflection: at once, Newton's method diverges above 0.85 with the rounding of some
# libraries (NumPy 2.2; test_elastica).
_STAGES = 8
#: Share of the first mode in the static deflection of a straight beam, 12/1.8751^4: loads here are
#: those of `hmsa.model.laws.bending` over it.
FIRST_SHARE = 12.0 / ROOT ** 4


class Second(NamedTuple):
    """The second mode of a straight beam."""

    ratio: float  #: of its frequency to that of the first mode
    share: float  #: of the static deflection


class _Rod:
    """Integrals of rods whose rotation is a sum of polynomials that vanish at the clamp."""

    def __init__(self) -> None:
        x, weights = legendre.leggauss(_POINTS)
        at: Array = 0.5 + 0.5 * x
        self.weights: Array = 0.5 * weights
        values = legendre.legvander(x, _TERMS - 1).T
        slopes = 2.0 * np.array([
            legendre.legval(x, legendre.legder(row)) for row in np.eye(_TERMS)])
        self.rotations: Array = at * values
        bends = values + at * slopes
        #: Twice the bending energy is the quadratic form of this.
        self.bending: Array = (bends * self.weights) @ bends.T
        integrals = legendre.legval(x, legendre.legint(np.eye(_POINTS), lbnd=-1)).T
        self.up_to: Array = 0.5 * integrals @ np.linalg.inv(
            legendre.legvander(x, _POINTS - 1))
        # The first mode of a straight beam, as a guess.
        weighted: Array = self.rotations * self.weights
        overlaps: Array = weighted @ self.rotations.T
        self.first: Array = np.linalg.solve(overlaps, weighted @ slope(at)).astype(np.float64)

    def lever(self, shapes: Array) -> Array:
        """Return the changes of the deflection of the tip with each polynomial, shape (n, m)."""
        made: Array = (np.cos(shapes @ self.rotations) * self.weights) @ self.rotations.T
        return made

    def stiffness(self, shapes: Array, loads: Array) -> Array:
        """Return the tangent stiffness under loads, shape (n, m, m)."""
        softer = loads[:, None] * self.weights * np.sin(shapes @ self.rotations)
        made: Array = self.bending + (self.rotations * softer[:, None]) @ self.rotations.T
        return made

    def mass(self, shapes: Array) -> Array:
        """Return the mass matrices for a mass of 1, shape (n, m, m)."""
        turned = shapes @ self.rotations
        along, across = (
            (of(turned)[:, None] * self.rotations) @ self.up_to.T for of in (np.sin, np.cos))
        made: Array = (along * self.weights) @ np.swapaxes(along, 1, 2) + (
            across * self.weights) @ np.swapaxes(across, 1, 2)
        return made

    def rest(self, deflections: Array) -> tuple[Array, Array]:
        """Return shapes (n, m) and loads at rest, by Newton's method from smaller deflections."""
        part = deflections / _STAGES
        shapes = angle_of(part)[:, None] * self.first
        loads = np.einsum('ni,ni->n', shapes @ self.bending, shapes) / (
            np.einsum('ni,ni->n', self.lever(shapes), shapes))
        for stage in range(1, _STAGES + 1):
            growth = stage / max(stage - 1, 1)
            shapes, loads = self._rest(
                part * stage, shapes * growth, loads * growth,
                _EXACT if stage == _STAGES else _NEAR)
        return shapes, loads

    def _rest(
            self, deflections: Array, shapes: Array, loads: Array,
            tolerance: float) -> tuple[Array, Array]:
        """Return shapes and loads at rest, from those near them."""
        matrices = np.zeros((len(deflections), _TERMS + 1, _TERMS + 1))
        for _ in range(_NEWTON):
            lever = self.lever(shapes)
            matrices[:, :-1, :-1] = self.stiffness(shapes, loads)
            matrices[:, :-1, -1], matrices[:, -1, :-1] = -lever, lever
            off = np.column_stack([
                shapes @ self.bending - loads[:, None] * lever,
                np.sin(shapes @ self.rotations) @ self.weights - deflections])
            step = np.linalg.solve(matrices, off[..., None])[..., 0]
            shapes, loads = shapes - step[:, :-1], loads - step[:, -1]
            if np.max(np.abs(step)) < tolerance:
                break
        return shapes, loads

    def states(self, deflections: Array) -> Array:
        """Return load, U'/l_1, d, g, h, l, e and k at deflections above 0, shape (8, n)."""
        shapes, loads = self.rest(deflections)
        stiffness, mass = self.stiffness(shapes, loads), self.mass(shapes)
        lever = self.lever(shapes)
        # As a symmetric problem, of flexibility: slow modes have the large eigenvalues.
        lower = np.linalg.inv(np.linalg.cholesky(stiffness))
        slow, modes = np.linalg.eigh(lower @ mass @ np.swapaxes(lower, 1, 2))
        squares = 1.0 / slow[:, :-3:-1]
        second = np.sqrt(squares[:, 1:]) * np.einsum('nij,ni->nj', lower, modes[:, :, -2])
        # All polynomials are 1 at the tip, which the second mode turns against its deflection of a
        # straight beam.
        second *= np.sign(second.sum(axis=1))[:, None]
        flexible = np.linalg.solve(stiffness, lever[..., None])[..., 0]
        per_load = np.einsum('ni,ni->n', lever, flexible)
        family = flexible / per_load[:, None]
        g = np.einsum('ni,ni->n', second, lever)
        h = np.einsum('ni,nij,nj->n', second, mass, family)
        d, e, k = (np.einsum('ni,ij,nj->n', x, self.bending, y) for x, y in (
            (family, family), (second, family), (second, second)))
        return np.stack([
            loads, 1.0 / (per_load * squares[:, 0]), (d - h * e) / (1.0 - g * h), g, h,
            squares[:, 1], e, k])


@cache
def _straight() -> Array:
    """Return the states of a straight beam, in the limit."""
    made: Array = _Rod().states(np.array([1e-7]))[:, 0]
    return made


@cache
def second_mode() -> Second:
    """Return the second mode of a straight beam."""
    _, inertia, _, g, h, square, _, _ = _straight().tolist()
    return Second(math.sqrt(square * inertia / 3.0), g * h)


@cache
def packed() -> tuple[float, ...]:
    """
    Return the constants of ``Beam`` in ``motion/hmsa/system.hpp``; see `bending.tabulated`.

    Each piece has further coefficients, of g, h, l, e and k over their values at rest.
    """
    def quantities(at: Array) -> Array:
        values = _Rod().states(at.ravel()).reshape(8, *at.shape)
        values[1:] /= _straight()[1:, None, None]
        # The first frequency of a straight beam is sqrt(3), with a stiffness of 3 `FIRST_SHARE`.
        values[:2] *= FIRST_SHARE
        return values

    def energy(starts: Array, widths: Array, force: Array) -> Array:
        # The integral of the force.
        within = (force / np.arange(1, DEGREE + 2)
                  * widths[:, None] ** np.arange(1, DEGREE + 2)).sum(axis=1)
        return np.append(0.0, np.cumsum(within)[:-1])

    return tabulated(_STOP, _END, _PIECES, quantities, energy)


def lever(deflections: ArrayLike) -> tuple[Array, Array]:
    """Return g over its value at rest, and the derivative, at deflections within the tables."""
    wanted = np.asarray(deflections, dtype=np.float64)
    size = np.clip(np.abs(wanted), 0.0, _END)
    breaks, factors = _lever_pieces()
    piece = np.searchsorted(breaks, size, side='right') - 1
    within, rows = size - breaks[piece], factors[piece]
    value = slope_there = np.zeros_like(size)
    for k in range(DEGREE, -1, -1):
        slope_there = slope_there * within + value
        value = value * within + rows[..., k]
    return value, np.sign(wanted) * slope_there


@cache
def _lever_pieces() -> tuple[Array, Array]:
    """Return the starts of the pieces, and the polynomial coefficients of g over its rest."""
    rows = np.array(packed()[8:]).reshape(_PIECES, -1)
    first = 2 + 3 * (DEGREE + 1)
    return rows[:, 0], rows[:, first:first + DEGREE + 1]
