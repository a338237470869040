"""
Modes of a block as a continuum, by the Rayleigh-Ritz method with polynomials.

The model of the paper deforms the block uniformly, which is exact at rest in a uniform field, but
not in motion: its faces bulge, and several modes take part. Small motion of an incompressible
Gent block about uniform stretch l, under the dead traction of the field on its faces across it
(R. Zhao et al., J. Mech. Phys. Solids 124, 244, 2019), has the energy

    W1 dF:dF + 2 W11 (F:dF)^2 + p/2 (tr(A A) - tr(A)^2) + K/2 tr(A)^2,    A = F^-1 dF,

per volume of the undeformed block, with F = diag(l^-1/2, l^-1/2, l), W1 and W11 the derivatives of
the energy by the first invariant, and p = 2 W1/l, for which the sides are free of stress. A bulk
modulus K that is far above G replaces constant volume; a block with a given one has the energy of
`hmsa.model.compressible` instead. Displacements are products of Legendre
polynomials, as in resonant ultrasound spectroscopy (W. M. Visscher et al., J. Acoust. Soc. Am. 90,
2154, 1991). Lengths are in units of L, with G = rho = 1.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import product
import math

import numpy as np
from numpy.polynomial import legendre
from numpy.typing import NDArray

from hmsa.errors import check_choice, check_number
from hmsa.model import compressible, law
from hmsa.model.equations import Array
from hmsa.model.laws import elastica
from hmsa.model.modes import BROAD, Modes, MOUNTS
from hmsa.model.parameters import Geometry

# Degree of the polynomials: the first frequency of the cube is then within 1e-4 of that of its
# Lame mode (test_continuum).
_DEGREE = {'free': 11, 'glued': 9}
_BULK = 300.0
# Modes of frequencies this close act as one.
_TOGETHER = 1e-3
# Shares of the static stretch below which a mode is none that the field excites, and below which a
# secondary mode is left out.
_UNSEEN, _WEAKEST = 1e-6, 0.01
# Least share of the first mode about a stretch, where another one may have more.
_STRONG = 0.05
# Secondary modes that are kept, and the maximum ratio of their frequencies. With a third one,
# `modal` takes longer and leaves as much on finite elements (benchmarks continuum).
_COUNT, _FASTEST = 2, 5.0
#: Shapes H/L: finite elements confirm 0.1 to 4 (benchmarks continuum), bar theory 10.
SHAPES = 0.02, 10.0
# Largest damping ratio of a secondary mode.
_MOST_DAMPED = 0.95
# Logarithms between which the transverse factor is sought, and largest exponent.
_LOGS, _GRADED = (-9.0, 3.0), compressible.STEEPEST
# Stretches about which the natural frequency of the first mode determines the transverse factor.
_STRETCHES = (0.9, 1.1, 1.2)
# Stretches near rest that determine how the ratios of frequencies change with it.
_BESIDE = (0.97, 1.03)
# Ratio of two frequencies below which their modes count as one; and logarithm of the ratio to a
# mode at rest up to which modes about another stretch belong to it.
_ALIKE, _REACH = 1.05, 0.1


@dataclass(frozen=True)
class Spectrum:
    """Modes that the field excites, by frequency."""

    frequencies: Array  #: natural frequencies, in units of sqrt(G/rho)/L, shape (n,)
    shares: Array  #: of the static mean stretch, shape (n,)
    #: Static mean stretch under a small load, in units of that of the free block.
    compliance: float

    @property
    def first(self) -> int:
        """Index of the mode with the largest share."""
        return int(np.argmax(self.shares))

    def like(self, frequency: float) -> int:
        """Return the index of the strong mode whose frequency is nearest to that at rest."""
        off = np.where(self.shares > _STRONG, abs(self.frequencies - frequency), math.inf)
        return int(np.argmin(off))


@dataclass(frozen=True)
class Mounted:
    """How a mounted block differs from the paper's model."""

    stiffness: float  #: factor on the shear modulus
    mass_factor: float
    transverse_mass_factor: float
    transverse_mass_exponent: float  #: 0 for constant volume
    modes: Modes


@lru_cache(maxsize=64)
def spectrum(
        shape: float, mount: str, stretch: float = 1.0, j_lim: float = math.inf,
        bulk_ratio: float = math.inf) -> Spectrum:
    """
    Return the modes of a block that a field along its axis excites.

    Parameters
    ----------
    shape : float
        H/L.
    mount : {'free', 'glued'}
        Free, or with one face across the field glued to a rigid support.
    stretch : float
        Stretch about which the block vibrates, taken as uniform; that of a glued one is not.
    j_lim : float
        Limiting extensibility of the Gent model; infinite for neo-Hookean.
    bulk_ratio : float
        Bulk over shear modulus; infinite for constant volume.

    Returns
    -------
    Spectrum
        In units of L, G and rho.

    """
    from scipy.linalg import solve  # slow to import

    basis, stiffness, squared, vectors = _solved(shape, mount, stretch, j_lim, bulk_ratio)
    flexible = float(basis.load @ solve(stiffness, basis.load, assume_a='sym'))
    shares = (vectors.T @ basis.load) ** 2 / squared / flexible
    # A unit load stretches a free block by 1/3, if it is small.
    return Spectrum(*_together(np.sqrt(np.abs(squared)), shares), 3.0 * flexible / basis.span)


def mode_shapes(shape: float, count: int, points: Array) -> Array:
    """
    Return the strongest modes of a free block at rest, by frequency.

    Parameters
    ----------
    shape : float
        H/L.
    count : int
        Number of modes.
    points : ndarray, shape (n, 3)
        Places in the block, in units of L, L and H from its centre.

    Returns
    -------
    ndarray, shape (count, n, 3)
        Displacements in units of L, with a mean of 1 along the field on the face of the load.

    """
    basis, _, squared, vectors = _solved(shape, 'free', 1.0, math.inf, math.inf)
    forces, frequencies = vectors.T @ basis.load, np.sqrt(np.abs(squared))
    # Vectors of one frequency are one mode: their sum that the load excites.
    begins = np.flatnonzero(np.diff(frequencies, prepend=0.0) >= _TOGETHER * frequencies)
    groups = np.split(np.arange(len(forces)), begins[1:])
    strong = np.sort(np.argsort(-np.add.reduceat(forces ** 2 / squared, begins))[:count])
    shapes = np.column_stack([
        vectors[:, x] @ forces[x] / (forces[x] @ forces[x]) for x in (groups[i] for i in strong)])
    values = basis.at(np.asarray(points, dtype=np.float64))
    found: Array = np.einsum('njc,jm->mnc', values, shapes)
    return found


def _solved(
        shape: float, mount: str, stretch: float, j_lim: float, bulk_ratio: float
) -> tuple['_Basis', Array, Array, Array]:
    """Return the basis, its stiffness, and squared frequencies and shapes of all modes."""
    from scipy.linalg import eigh  # slow to import

    basis = _Basis.of(mount, 2.0 * shape if mount == 'glued' else shape)
    even, along, across = (
        _constant_volume(stretch, j_lim) if math.isinf(bulk_ratio)
        else _compressible(stretch, j_lim, bulk_ratio))
    component = basis.component
    alike = component[:, None] == component
    mass = np.where(alike, basis.integral(), 0.0)
    stiffness = np.where(
        alike, even * sum(basis.integral(x, x) for x in range(3)), 0.0)
    for c, e in product(range(3), repeat=2):
        # F:dF and tr(A) contain the gradient of each displacement along itself, tr(A A) also
        # others.
        stiffness += np.where(
            (component == c)[:, None] & (component == e),
            along[c, e] * basis.integral(c, e) + across[c, e] * basis.integral(e, c), 0.0)
    return basis, stiffness, *eigh(stiffness, mass)


def _constant_volume(stretch: float, j_lim: float) -> tuple[float, Array, Array]:
    """Return the factors of dF:dF, and of the products of gradients, at constant volume."""
    side = stretch ** -0.5
    scale = np.array([side, side, stretch])
    left = 1.0 - (2.0 * side ** 2 + stretch ** 2 - 3.0) / j_lim
    by_invariant, bend = 0.5 / left, 0.5 / (j_lim * left ** 2)
    pressure = 2.0 * by_invariant * side ** 2
    inverse = 1.0 / np.outer(scale, scale)
    return (
        2.0 * by_invariant,
        4.0 * bend * scale[:, None] * scale + (_BULK - pressure) * inverse,
        pressure * inverse)


def _compressible(stretch: float, j_lim: float, bulk_ratio: float) -> tuple[float, Array, Array]:
    """
    Return those factors with the energy of `hmsa.model.compressible`.

    With the invariant I = J^(-2/3) F:F of the stretches without the change of volume, and its
    derivative I' by F, the second derivative of the energy is

        W1 I'' + W11 I'^2 + K (J^2 tr(A)^2 + (J - 1) J (tr(A)^2 - tr(A A))).
    """
    side = compressible.side(stretch, None, j_lim, bulk_ratio)
    scale = np.array([side, side, stretch])
    volume, square = float(np.prod(scale)), float(scale @ scale)
    even = volume ** (-2.0 / 3.0)
    left = 1.0 - (even * square - 3.0) / j_lim
    by_invariant, bend = 0.5 / left, 0.5 / (j_lim * left ** 2)
    slope = even * (2.0 * scale - 2.0 / 3.0 * square / scale)
    inverse, ratio = 1.0 / np.outer(scale, scale), np.outer(scale, 1.0 / scale)
    twice = by_invariant * even
    return (
        2.0 * twice,
        bend * np.outer(slope, slope) - 4.0 / 3.0 * twice * (ratio + ratio.T)
        + (4.0 / 9.0 * twice * square + bulk_ratio * volume * (2.0 * volume - 1.0)) * inverse,
        (2.0 / 3.0 * twice * square - bulk_ratio * volume * (volume - 1.0)) * inverse)


@dataclass(frozen=True)
class _Basis:
    """Products of polynomials in the three directions, for a part of the block by symmetry."""

    component: NDArray[np.int64]  #: direction of each displacement, shape (n,)
    degrees: NDArray[np.int64]  #: of its polynomials, shape (3, n)
    tables: tuple[Array, ...]  #: integrals by direction, see `_integrals`
    load: Array  #: mean on the face of the load, along the field, shape (n,)
    span: float  #: half of the height, all of it if glued

    @classmethod
    def of(cls, mount: str, span: float) -> '_Basis':
        """
        Return the basis for an eighth of a free block, and a quarter of a glued one.

        Each displacement is odd in its own direction and even in the others; those of a glued
        block are in proportion to the distance from the support.
        """
        most, glued = _DEGREE[mount], mount == 'glued'
        across = [legendre.Legendre.basis(n) for n in range(most + 1)]
        along = across
        if glued:
            distance = legendre.Legendre([0.5, 0.5], domain=[0.0, 1.0])
            along = [
                distance * legendre.Legendre.basis(n, domain=[0.0, 1.0]) for n in range(most)]
        rows = []
        for c in range(3):
            x, y, z = (range(c == axis, most + 1, 2) for axis in range(3))
            rows += [
                (c, *degrees) for degrees in product(x, y, range(most) if glued else z)
                if sum(degrees) + glued <= most]
        component, *degrees = np.array(rows, dtype=np.int64).T
        tables = (
            _integrals(across, 1.0), _integrals(across, 1.0), _integrals(along, span))
        means, ends = tables[0][0, 0, 0], np.array([float(x(1.0)) for x in along])
        load = np.where(component == 2, 1.0, 0.0) * (
            means[degrees[0]] * means[degrees[1]] * ends[degrees[2]])
        return cls(component, np.array(degrees), tables, load, span)

    def at(self, points: Array) -> Array:
        """Return the displacements of a free block at points from -1 to 1, shape (m, n, 3)."""
        values = np.prod([
            np.array([legendre.Legendre.basis(n)(x) for n in range(int(np.max(own)) + 1)]).T[
                :, own] for x, own in zip(points.T, self.degrees, strict=True)], axis=0)
        found: Array = values[:, :, None] * (self.component[:, None] == np.arange(3))
        return found

    def integral(self, one: int | None = None, other: int | None = None) -> Array:
        """
        Return the integrals of all products of two displacements, shape (n, n).

        Of the first, the derivative by direction ``one`` is taken, of the second that by
        ``other``.
        """
        found: Array = np.ones(())
        for axis, (table, degree) in enumerate(zip(self.tables, self.degrees, strict=True)):
            found = found * table[int(axis == one), int(axis == other)][
                degree[:, None], degree]
        return found


def _integrals(polynomials: Sequence[legendre.Legendre], length: float) -> Array:
    """Return integrals over a length of products of polynomials of 0 to 1, or their slopes."""
    points, weights = legendre.leggauss(len(polynomials) + 2)
    at: Array = 0.5 + 0.5 * points
    lengths: Array = 0.5 * length * weights
    values = np.array([
        [x(at) for x in polynomials], [x.deriv()(at) / length for x in polynomials]])
    found: Array = np.einsum('dim,ejm,m->deij', values, values, lengths)
    return found


def _together(frequencies: Array, shares: Array) -> tuple[Array, Array]:
    """Return the modes without those that the field does not excite, near ones as one."""
    kept = np.flatnonzero(shares > _UNSEEN)
    found: list[list[float]] = []
    for frequency, share in zip(frequencies[kept], shares[kept], strict=True):
        if found and frequency < found[-1][0] * (1.0 + _TOGETHER):
            found[-1][1] += share
        else:
            found.append([frequency, share])
    return tuple(np.array(found).T)


@lru_cache(maxsize=64)
def mounted(
        shape: float, mount: str, j_lim: float, damping_ratio: float,
        bulk_ratio: float = math.inf) -> Mounted:
    """
    Return how a mounted block differs from the paper's model.

    Parameters
    ----------
    shape : float
        H/L, 0.02 to 10.
    mount : {'free', 'glued'}
        Free, or with one face across the field glued to a rigid support.
    j_lim : float
        Limiting extensibility.
    damping_ratio : float
        Of the first mode. That of the others grows with their frequency, as by a viscous stress.
    bulk_ratio : float
        Bulk over shear modulus; infinite for constant volume.

    Returns
    -------
    Mounted
        Factors, and up to two secondary modes and a broad one in place of all weaker ones.

    Raises
    ------
    BadInputError
        If an argument is out of range.

    """
    check_choice('mount', mount, MOUNTS)
    check_number(
        f'with mount {mount} half_thickness/half_length', shape, least=SHAPES[0], most=SHAPES[1])
    found = spectrum(shape, mount, bulk_ratio=bulk_ratio)
    free = mount == 'free'
    # E/(3 G), and the transverse inertia.
    young = 1.0 if math.isinf(bulk_ratio) else 3.0 * bulk_ratio / (3.0 * bulk_ratio + 1.0)
    across = Geometry(1.0, shape, bulk_ratio=bulk_ratio).transverse
    # A free block deforms uniformly at rest: its compliance exceeds 1 by that of the volume.
    stiffness = 1.0 if free else 1.0 / (young * found.compliance)
    first = found.first
    frequency = float(found.frequencies[first])
    factor = stiffness * young * 18.0 / (across + 2.0 * shape ** 2) / frequency ** 2
    ratios, shares = _lines(found)
    # Levels that bring the first mode to rest excite those near it little, and fast ones less.
    # Powers 1 and 2 in place of 1.5 leave more on elements at H/L 0.2 and 0.05.
    strong = sorted([i for i in np.argsort(-shares * (ratios - 1.0) ** 1.5 / ratios ** 2.5)
                     if ratios[i] <= _FASTEST and shares[i] >= _WEAKEST][:_COUNT])

    def about(stretch: float) -> tuple[Array, Array]:
        there = spectrum(shape, mount, stretch, j_lim, bulk_ratio)
        return there.frequencies / there.frequencies[there.like(frequency)], there.shares

    rows = [*zip(
        ratios[strong].tolist(), shares[strong].tolist(),
        (min(damping_ratio * x, _MOST_DAMPED) for x in ratios[strong].tolist()),
        *_exponents(about, ratios[strong], shares[strong]), strict=True)]
    weak = np.delete(np.arange(len(ratios)), strong)
    left = 1.0 - float(found.shares[first] + np.sum(shares[strong]))
    if left >= _WEAKEST:
        # Together they fade sooner than each of them.
        ratio = float(np.sum(shares[weak]) / np.sum(shares[weak] / ratios[weak]))
        rows.append((ratio, left, BROAD, 0.0, 0.0))
    return Mounted(
        stiffness, float(factor),
        *_transverse(shape, mount, j_lim, bulk_ratio, frequency, factor / stiffness),
        Modes.of_numbers(rows))


def _lines(found: Spectrum) -> tuple[Array, Array]:
    """Return frequency ratios and shares of the modes above the first, near ones as one."""
    groups: list[list[tuple[float, float]]] = []
    for ratio, share in zip(
            found.frequencies / found.frequencies[found.first], found.shares, strict=True):
        if groups and ratio < _mean(groups[-1]) * _ALIKE:
            groups[-1].append((ratio, share))
        elif ratio > 1.0:
            groups.append([(ratio, share)])
    return (np.array([_mean(x) for x in groups]),
            np.array([sum(y for _, y in x) for x in groups]))


def _mean(lines: Sequence[tuple[float, float]]) -> float:
    """Return the mean of ratios, weighted by their shares."""
    return float(sum(x * y for x, y in lines) / sum(y for _, y in lines))


def clamped(damping_ratio: float) -> Modes:
    """
    Return the secondary mode of a beam along its elastica.

    That of the first mode of the straight beam is the damping ratio; of the second, it grows with
    the frequency, as by a viscous stress.
    """
    second = elastica.second_mode()
    return Modes(
        (second.ratio,), (second.share,), (min(damping_ratio * second.ratio, _MOST_DAMPED),))


def _exponents(
        about: Callable[[float], tuple[Array, Array]], ratios: Array, shares: Array
) -> tuple[list[float], list[float]]:
    """Return the exponents of the stretch in the frequency ratios and shares of some modes."""
    low, high = (_near(*about(x), ratios)[0] for x in _BESIDE)
    exponents: Array = np.log(high / low) / math.log(_BESIDE[1] / _BESIDE[0])
    logs: Array = np.log(_STRETCHES)
    grown = np.array([
        _odds(_near(*about(x), ratios * x ** exponents)[1]) for x in _STRETCHES])
    slopes: Array = logs @ (grown - _odds(shares)) / (logs @ logs)
    return np.clip(exponents, -5.0, 5.0).tolist(), np.clip(slopes, -10.0, 10.0).tolist()


def _near(lines: Array, shares: Array, ratios: Array) -> tuple[Array, Array]:
    """
    Return frequency ratios and shares about a stretch of the modes nearest to some ratios.

    Modes that come close to each other exchange their shares, and count as one.
    """
    apart = np.abs(np.log(lines[:, None] / ratios))
    own = (apart < _REACH) & (apart == np.min(apart, axis=1, keepdims=True))
    own |= apart == np.min(apart, axis=0)
    parts = own * shares[:, None]
    return lines @ parts / np.sum(parts, axis=0), np.sum(parts, axis=0)


def _odds(shares: Array) -> Array:
    """Return the logarithms of shares relative to that of the first mode."""
    found: Array = np.log(shares / (1.0 - np.sum(shares)))
    return found


def _transverse(
        shape: float, mount: str, j_lim: float, bulk_ratio: float, first: float,
        factor: float) -> tuple[float, float]:
    """
    Return the transverse factor and exponent that fit the first mode about several stretches best.

    The exponent is that of a compressible block, whose inertia is a table.
    """
    from scipy.optimize import least_squares, minimize_scalar  # slow to import

    c1 = 2.0 * shape ** 2
    wide = Geometry(1.0, shape, bulk_ratio=bulk_ratio).transverse
    material = law.pack(0.0, j_lim, c1, None if math.isinf(bulk_ratio) else compressible.condensed(
        None, j_lim, bulk_ratio))
    wanted, lateral = [], []
    for stretch in _STRETCHES:
        found = spectrum(shape, mount, stretch, j_lim, bulk_ratio)
        stiffness = float(law.elastic_stiffness(stretch, material))
        lateral.append(stretch ** -3 if math.isinf(bulk_ratio)
                       else 6.0 * float(law.mass(stretch, material)) - c1)
        wanted.append(stiffness / float(found.frequencies[found.like(first)]) ** 2)

    def off(log: float, exponent: float = 0.0) -> Array:
        more = math.exp(log)
        graded = np.array(lateral) * np.array(_STRETCHES) ** -exponent
        return np.asarray(np.log(
            factor * (wide + c1) / (more * wide + c1) * (more * graded + c1) / 6.0 / wanted))

    log = float(minimize_scalar(
        lambda x: float(np.sum(off(x) ** 2)), bounds=_LOGS, method='bounded').x)
    if math.isinf(bulk_ratio):
        return math.exp(log), 0.0
    found = least_squares(lambda x: off(*x), [log, 0.0], bounds=([_LOGS[0], -_GRADED], [
        _LOGS[1], _GRADED]))
    return math.exp(found.x[0]), float(found.x[1])
