"""
A compressible block: its transverse stretch follows the stretch.

The elastic energy is that of the hyperelastic model at constant volume, of the stretches without
the change of volume J (P. J. Flory, Trans. Faraday Soc. 57, 829, 1961), and a volumetric one:

    W = psi(s) + K/2 (J - 1)^2,    s = J^(-1/3) l,    J = l q^2

with the stretch l along the field, q across it, and K in units of G. R. Zhao et al., J. Mech.
Phys. Solids 124, 244 (2019), take it for hard-magnetic blocks. The sides are free of stress, so
that q is in equilibrium at each l, which depends on s alone:

    3 K J (J - 1) = s psi'(s),    l = s J^(1/3),    force dW/dl = s psi'(s)/l

That the block has one degree of freedom means that q follows at once. Then the transverse motion
adds (2/3) (dq/dl)^2 to the mass, which is l^-3/6 at constant volume (Eq. 7). In the first mode of
a free block, whose faces bulge, this is multiplied by a power of l (`hmsa.model.continuum`).
"""

from functools import lru_cache
import math

import numpy as np
from numpy.polynomial import chebyshev
from numpy.typing import NDArray

from hmsa.errors import BadInputError, check_number
from hmsa.model.law import (
    boundary,
    ENERGY,
    evaluate,
    FORCE,
    LOWER,
    pack,
    STIFFNESS,
    UPPER,
)
from hmsa.model.laws.record import BEAMS, CONDENSED, Elastic, TABLE

Array = NDArray[np.float64]

#: Range of a finite bulk modulus in units of the shear modulus. Below it, where Poisson's ratio is
#: 0.125, a foam buckles and has another energy; above, no sensor shows the change of volume.
BULK_RATIOS = 1.0, 1e6
#: Largest exponent of the transverse inertia: a cube of K/G 1 needs 8.
STEEPEST = 10.0
# Changes of volume and stretches s of the tables. Below a volume of 1/2 the pressure would fall.
_VOLUMES, _STRETCHES = (0.6, 2.0), (0.1, 10.0)
# Points of the search for the ends.
_LOOK = 2000
# Degree of the pieces and their relative error, where rounding of the stretch permits it. The
# inertia, which is 0 where the side stops to shrink, has a least size.
_DEGREE, _EXACT, _ROUNDING, _LEAST = 9, 1e-13, 1e-15, 0.01
# Halvings at most.
_HALVINGS = 20
# Half width of the piece about rest, unless a smaller one is needed.
_BESIDE = 0.0625
# Steps of Newton's method, and a relative step of the size of rounding, which ends it: steps below
# may never end.
_NEWTON, _ROUNDED = 100, 1e-15
_NODES: Array = -np.cos(np.pi * (np.arange(_DEGREE + 1) + 0.5) / (_DEGREE + 1))
_TO_SERIES: Array = np.linalg.inv(
    chebyshev.chebvander(_NODES, _DEGREE)).astype(np.float64)
_TO_POWERS: Array = np.linalg.inv(np.vander(_NODES, increasing=True)).astype(np.float64)


def check(bulk_ratio: float, law: Elastic | None, exponent: float = 0.0) -> None:
    """Raise `BadInputError` for a finite bulk modulus that no block of a model has."""
    least, most = BULK_RATIOS
    if not least <= bulk_ratio <= most:
        raise BadInputError(
            f'bulk_ratio is {bulk_ratio:g}: expected {least:g} to {most:g}, or inf for constant '
            'volume')
    if law is not None and law.family in (TABLE, *BEAMS):
        what = 'a table, whose levels contain the change of volume' if law.family == TABLE else (
            'a beam, whose volume its bending does not change')
        raise BadInputError(f'bulk_ratio is {bulk_ratio:g} for {what}: expected inf')
    check_number('transverse_mass_exponent', exponent, least=-STEEPEST, most=STEEPEST)


@lru_cache(maxsize=64)
def condensed(
        law: Elastic | None, j_lim: float, bulk_ratio: float, exponent: float = 0.0) -> Elastic:
    """
    Return the elastic energy of a compressible block over its stretch, and its inertia.

    Parameters
    ----------
    law : Elastic, optional
        Model at constant volume; None for Gent.
    j_lim : float
        Limiting extensibility of the Gent model; infinite for neo-Hookean.
    bulk_ratio : float
        Bulk over shear modulus, finite, see `check`.
    exponent : float
        Exponent of the inverse stretch by which the transverse inertia grows in addition.

    Returns
    -------
    Elastic
        Tables for ``Condensed`` in ``motion/hmsa/system.hpp``: number of pieces and end; start,
        middle, energy there, and the coefficients of force and inertia about it of each piece.

    """
    block = _block(law, j_lim, bulk_ratio, exponent)
    starts, ends, values = _pieces(block)
    middles: Array = 0.5 * (starts + ends)
    powers = np.einsum('kn,vpn->vpk', _TO_POWERS, values) / (
        0.5 * (ends - starts))[:, None] ** np.arange(_DEGREE + 1)
    powers[0, middles == 1.0, 0] = 0.0  # no force on a block at rest
    rows = np.column_stack([starts, middles, block.energy(middles), *powers])
    name = law.law if law is not None else 'neo_hookean' if math.isinf(j_lim) else 'gent'
    return Elastic(
        name, CONDENSED, (float(len(rows)), float(ends[-1]), *rows.ravel().tolist()),
        () if law is None else law.given, (float(starts[0]), float(ends[-1])),
        bulk_ratio=bulk_ratio, inertia_exponent=exponent, isochoric=law)


def side(stretch: float, law: Elastic | None, j_lim: float, bulk_ratio: float) -> float:
    """Return the transverse stretch of a block at rest under a stretch, with a finite ratio."""
    s = float(_block(law, j_lim, bulk_ratio).isochoric(np.array([stretch]))[0])
    return float(stretch / s**1.5)


@lru_cache(maxsize=64)
def _block(
        law: Elastic | None, j_lim: float, bulk_ratio: float, exponent: float = 0.0) -> '_Block':
    return _Block(pack(0.0, j_lim, 1.0, law), bulk_ratio, exponent)


class _Block:
    """Equilibrium of the transverse stretch of a block, over the stretch s at constant volume."""

    def __init__(self, material: Array, bulk_ratio: float, exponent: float) -> None:
        self._material, self._bulk, self._exponent = material, bulk_ratio, exponent
        least, most = (3.0 * bulk_ratio * x * (x - 1.0) for x in _VOLUMES)

        def holds(s: Array) -> NDArray[np.bool_]:
            force, stiffness = (self._evaluated(x, s) for x in (FORCE, STIFFNESS))
            stress = s * force
            # The stress has to increase with s, and a field has to hold the block.
            return (least <= stress) & (stress <= most) & (stiffness > 0.0) & (
                force + s * stiffness > 0.0)

        def end(limit: float) -> float:
            path: Array = np.geomspace(1.0, limit, _LOOK).astype(np.float64)
            path[-1] = limit
            beyond = np.flatnonzero(~holds(path))
            if not len(beyond):
                return limit
            return boundary(
                lambda x: bool(holds(np.array([x]))[0]), float(path[beyond[0] - 1]),
                float(path[beyond[0]]))

        #: Range of s.
        self.ends = (end(max(float(material[LOWER]), _STRETCHES[0])),
                     end(min(float(material[UPPER]), _STRETCHES[1])))

    def _evaluated(self, what: int, s: Array) -> Array:
        out = np.empty(s.size)
        evaluate(what, np.ascontiguousarray(s).ravel(), self._material, out)
        return out.reshape(s.shape)

    def _volume(self, s: Array) -> tuple[Array, Array, Array]:
        """Return the change of volume, its logarithmic derivative by s, and the force psi'."""
        force, stiffness = (self._evaluated(x, s) for x in (FORCE, STIFFNESS))
        volume = 0.5 + np.sqrt(0.25 + s * force / (3.0 * self._bulk))
        grows = s * (force + s * stiffness) / (
            3.0 * self._bulk * volume * (2.0 * volume - 1.0))
        return volume, grows, force

    def stretch(self, s: float) -> float:
        """Return the stretch of the block."""
        return float(s * self._volume(np.array([s]))[0][0] ** (1.0 / 3.0))

    def isochoric(self, stretches: Array) -> Array:
        """Return s of stretches, by Newton's method on its logarithm between bounds."""
        low, high = (np.full(stretches.shape, x) for x in self.ends)
        s, target = np.clip(stretches, low, high), np.log(stretches)
        for _ in range(_NEWTON):
            volume, grows, _ = self._volume(s)
            off = np.log(s) + np.log(volume) / 3.0 - target
            low, high = np.where(off < 0.0, s, low), np.where(off > 0.0, s, high)
            nearer = s * np.exp(-off / (1.0 + grows / 3.0))
            nearer = np.where((low <= nearer) & (nearer <= high), nearer, 0.5 * (low + high))
            step, s = nearer - s, nearer
            if np.all(np.abs(step) <= _ROUNDED * s):
                break
        return s

    def states(self, stretches: Array) -> Array:
        """Return force and six times the transverse inertia, shape (2, ...)."""
        s = self.isochoric(stretches)
        _, grows, force = self._volume(s)
        volume = (stretches / s) ** 3
        # By the pressure where the chains are nearly extended, and errors in s are large in psi'.
        force = np.where(
            grows < 3.0, s * force, 3.0 * self._bulk * volume * (volume - 1.0)) / stretches
        change = np.sqrt(volume / stretches) / stretches * (
            (grows / 3.0 - 0.5) / (1.0 + grows / 3.0))
        return np.stack([force, 4.0 * change ** 2 * stretches ** -self._exponent])

    def energy(self, stretches: Array) -> Array:
        """Return the energy in units of G, 0 at rest."""
        s = self.isochoric(stretches)
        return self._evaluated(ENERGY, s) + 0.5 * self._bulk * ((stretches / s) ** 3 - 1.0) ** 2


def _pieces(block: _Block) -> tuple[Array, Array, Array]:
    """Return starts and ends of exact pieces, and states at their nodes, shape (2, n, m)."""
    lower, upper = (block.stretch(x) for x in block.ends)

    def states(starts: Array, ends: Array) -> tuple[Array, NDArray[np.bool_]]:
        middles, half = 0.5 * (starts + ends), 0.5 * (ends - starts)
        values = block.states(middles[:, None] + half[:, None] * _NODES)
        series = np.abs(values @ _TO_SERIES.T)
        size = np.maximum(series.max(axis=-1), np.array([[0.0], [_LEAST]]))
        rounding = _ROUNDING * series[..., 1] * middles / half
        return values, np.all(
            series[..., -2:].max(axis=-1) <= _EXACT * size + rounding, axis=0)

    # One piece has its middle at rest, where the force is exactly 0.
    beside = _BESIDE
    for _ in range(_HALVINGS):
        one: Array = np.array([1.0])
        if lower < 1.0 - beside and 1.0 + beside < upper:
            values, exact = states(one - beside, one + beside)
            if exact[0]:
                break
        beside *= 0.5
    found = [(one - beside, one + beside, values)]
    starts: Array = np.array([lower, 1.0 + beside])
    ends: Array = np.array([1.0 - beside, upper])
    for _ in range(_HALVINGS):
        values, exact = states(starts, ends)
        found.append((starts[exact], ends[exact], values[:, exact]))
        starts, ends = starts[~exact], ends[~exact]
        if not len(starts):
            break
        middles = 0.5 * (starts + ends)
        starts, ends = np.append(starts, middles), np.append(middles, ends)
    else:
        found.append((starts, ends, states(starts, ends)[0]))
    order = np.argsort(np.concatenate([x for x, _, _ in found]))
    return (
        np.concatenate([x for x, _, _ in found])[order],
        np.concatenate([x for _, x, _ in found])[order],
        np.concatenate([x for _, _, x in found], axis=1)[:, order])
