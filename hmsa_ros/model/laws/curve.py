"""
A rising curve of level against stretch, out of measured points.

A spline of degree 5 with four continuous derivatives. It minimises the squares of what it misses
and, weighted, of its third derivative; the weight is that of generalised cross-validation
(P. Craven, G. Wahba, Numer. Math. 31, 377 (1979)), or larger where the curve would not rise.
Points without scatter, less than 1/5000 of their range, are interpolated.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
import math
import os
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hmsa_ros.errors import BadInputError

Array = NDArray[np.float64]

#: Fewest and most points.
FEWEST, MOST = 6, 2000
# Ranges; levels beyond are likely in mT, stretches in percent or mm.
_STRETCHES, _LARGEST_LEVEL = (0.1, 10.0), 5.0
_DEGREE = 5
# Functions of the basis: with more points than that they are fewer than the points.
_FUNCTIONS = 40
# Weights of the roughness, for levels and stretches of a range of 1.
_WEIGHTS = np.logspace(-18.0, 2.0, 61)
# What cross-validation counts for a degree of freedom: with 1 it follows noise now and then.
_PRICE = 1.2
# What a curve may miss of points: in units of the scatter, and as a share of their range.
_DEVIATIONS, _SHARE = 4.0, 0.02
# Less scatter than this share of the range is interpolated.
_EXACT = 2e-4
# Most scatter, as a share of the range, and least slope, as one of the mean slope.
_MOST_SCATTER, _LEAST_SLOPE = 0.05, 0.02
# Within which share of the range the level at stretch 1 counts as 0.
_ZERO = 5e-3
# From an end the stop is so far, as a share of the way from stretch 1 to the end.
_STOP = 0.1
_LOOK = 24


@dataclass(frozen=True, eq=False)
class Curve:
    """Level in T against stretch, as a spline of degree 5."""

    breaks: Array  #: (p + 1,), stretches at which the pieces meet
    #: (p, 6), factors in T of the powers of the stretch beyond the beginning of each piece.
    pieces: Array
    slope: float  #: at stretch 1, in T
    scatter: float  #: standard deviation of the points in T, estimated

    def at(self, stretch: float, order: int = 0) -> float:
        """Return the level at a stretch, or a derivative of it."""
        i = min(max(int(np.searchsorted(self.breaks, stretch, 'right')) - 1, 0),
                len(self.pieces) - 1)
        poly = np.polynomial.Polynomial(self.pieces[i])
        return float((poly.deriv(order) if order else poly)(stretch - self.breaks[i]))

    def packed(self, unit: float) -> tuple[float, ...]:
        """
        Return the constants of ``Table`` in ``motion/hmsa/law.hpp``, for a unit in T.

        Number of pieces and depths of the stops; of each piece begin, energy there and factors;
        end, energy, force and stiffness there.
        """
        pieces = self.pieces / unit
        widths = np.diff(self.breaks)
        powers = np.arange(1, _DEGREE + 2)
        work = np.sum(pieces / powers * widths[:, None] ** powers, axis=1)
        energy = np.append(0.0, np.cumsum(work))
        first = int(np.searchsorted(self.breaks, 1.0, 'right')) - 1
        rest = energy[first] + float(np.sum(
            pieces[first] / powers * (1.0 - self.breaks[first]) ** powers))
        energy -= rest
        rows = np.column_stack([self.breaks[:-1], energy[:-1], pieces])
        end = float(self.breaks[-1])
        return (
            float(len(pieces)), *(_STOP * (self.breaks[[0, -1]] - 1.0)).tolist(),
            *rows.ravel().tolist(), end, float(energy[-1]), self.at(end) / unit,
            self.at(end, 1) / unit)


def points_in(name: str) -> tuple[list[float], list[float]]:
    """
    Return stretches and levels in T of a CSV with the columns ``stretch`` and ``flux_density``.

    A file or row that cannot be used is a `BadInputError`.
    """
    from hmsa_ros.columns import read_table

    path = Path(os.path.abspath(Path(name).expanduser()))
    if path.exists() and not (path.is_file() or path.is_dir()):
        raise BadInputError(f'{path} is a device or a pipe: expected a CSV')
    table = read_table(path, ('stretch', 'flux_density'))
    stretch, flux = (table.columns[x].tolist() for x in ('stretch', 'flux_density'))
    _check(stretch, flux, str(path), [f'line {x}' for x in table.lines])
    return stretch, flux


def _check(
        stretch: Sequence[float], flux: Sequence[float], source: str,
        places: Sequence[str]) -> None:
    """Refuse points that no block can have, with where they are."""
    if len(stretch) != len(flux) or not FEWEST <= len(stretch) <= MOST:
        rows = f'{len(stretch)}' if len(stretch) == len(flux) \
            else f'{len(stretch)} stretches and {len(flux)} levels'
        raise BadInputError(
            f'{source} has {rows} rows: expected {FEWEST} to {MOST} rows of stretch and '
            'flux_density')
    for x, level, place in zip(stretch, flux, places, strict=True):
        if not _STRETCHES[0] <= x <= _STRETCHES[1]:
            raise BadInputError(
                f'{source} {place} has stretch {x:g}: expected {_STRETCHES[0]:g} to '
                f'{_STRETCHES[1]:g}, the length over the length at rest without field')
        if not abs(level) <= _LARGEST_LEVEL:
            raise BadInputError(
                f'{source} {place} has flux density {level:g} T: expected at most '
                f'{_LARGEST_LEVEL:g} T; levels in mT need a column flux_density [mT]')
    for i in range(1, len(stretch)):
        if not stretch[i] > stretch[i - 1]:
            how = 'again' if stretch[i] == stretch[i - 1] else f'after {stretch[i - 1]:g}'
            raise BadInputError(
                f'{source} {places[i]} has stretch {stretch[i]:g} {how}: expected rising '
                'stretches, each once; take the mean of repeated measurements')
    if not stretch[0] < 1.0 < stretch[-1]:
        raise BadInputError(
            f'{source} has stretches {stretch[0]:g} to {stretch[-1]:g}: expected some on both '
            'sides of 1, since a block swings there on its way to rest')
    if not flux[-1] > flux[0]:
        raise BadInputError(
            f'{source} has flux densities from {flux[0]:g} T at the least stretch to '
            f'{flux[-1]:g} T at the largest: expected rising ones; a level that stretches the '
            'block is positive')


@lru_cache(maxsize=32)
def fitted(stretch: tuple[float, ...], flux: tuple[float, ...]) -> Curve:
    """
    Return the curve through points, which rises everywhere and is 0 at stretch 1.

    Points are stretches, rising from below 1 to above, and the levels in T that hold them. Points
    that no rising curve follows within their scatter are a `BadInputError`.
    """
    _check(stretch, flux, 'law table', [f'row {i}' for i in range(1, len(stretch) + 1)])
    x, y = np.array(stretch), np.array(flux)
    span, height = float(x[-1] - x[0]), float(y[-1] - y[0])
    u, v = (x - x[0]) / span, y / height
    knots = _knots(u)
    breaks = knots[_DEGREE:-_DEGREE]
    local = _local(knots, breaks)
    solve = _Smoothing.of(_basis(u, knots), _roughness(local, np.diff(breaks)), v)
    best, scatter = solve.best()
    if scatter > _MOST_SCATTER:
        raise BadInputError(
            f'law table has a scatter of {scatter * height:.3g} T about a smooth curve: expected '
            f'at most {_MOST_SCATTER * height:.3g} T, {_MOST_SCATTER:.0%} of its range')
    chosen = _rising(solve, best, local, breaks)
    missed = np.abs(solve.design @ chosen - v)
    if np.max(missed) > max(_DEVIATIONS * scatter, _SHARE):
        # Where the points themselves turn back the most.
        falls = np.maximum.accumulate(v) - v
        i = int(np.argmax(falls if np.max(falls) > 0.0 else missed))
        raise BadInputError(
            f'law table does not rise beyond its scatter of {scatter * height:.2g} T near row '
            f'{i + 1} (stretch {x[i]:g}, {y[i]:g} T): expected flux densities that rise with '
            'stretch; repeat the measurement there')
    widths = np.diff(breaks) * span
    pieces = height * (local @ chosen) / widths[:, None] ** np.arange(_DEGREE + 1)
    curve = Curve(x[0] + span * breaks, pieces, 0.0, scatter * height)
    return _through_rest(curve, height)


def _rising(solve: '_Smoothing', first: int, local: Array, breaks: Array) -> Array:
    """Return the coefficients of the roughest curve from a weight on that rises everywhere."""
    shares = np.linspace(0.0, 1.0, _LOOK)[:, None] ** np.arange(_DEGREE)
    for weight in _WEIGHTS[first:]:
        coefficients = solve.coefficients(weight)
        pieces = local @ coefficients
        slopes = (shares @ (pieces[:, 1:] * np.arange(1, _DEGREE + 1)).T) / np.diff(breaks)
        if np.min(slopes) > _LEAST_SLOPE:
            return coefficients
    # Not even a parabola does: a curve that misses the points.
    return np.zeros(local.shape[2])


def _through_rest(curve: Curve, height: float) -> Curve:
    """Return a curve that is 0 at stretch 1, where it was nearly so."""
    offset = curve.at(1.0)
    allowed = max(_DEVIATIONS * curve.scatter, _ZERO * height)
    if abs(offset) > allowed:
        raise BadInputError(
            f'law table has a flux density of {offset:.4g} T at stretch 1: expected 0 within '
            f'{allowed:.2g} T; stretch is the length over the length at rest without field')
    pieces = curve.pieces.copy()
    pieces[:, 0] -= offset
    return Curve(curve.breaks, pieces, curve.at(1.0, 1), curve.scatter)


def _knots(u: Array) -> Array:
    """Return knots from 0 to 1: points, or quantiles of many, without those next to the ends."""
    edge = (_DEGREE + 1) // 2
    inner = u[edge:-edge] if len(u) <= _FUNCTIONS else np.quantile(
        u, np.linspace(0.0, 1.0, _FUNCTIONS - _DEGREE + 1)[1:-1])
    knots: Array = np.concatenate(
        [np.zeros(_DEGREE + 1), inner, np.ones(_DEGREE + 1)]).astype(np.float64)
    return knots


def _basis(u: Array, knots: Array) -> Array:
    """Return the B-splines at points, a row each, by the recursion of Cox and de Boor."""
    column = np.minimum(u, np.nextafter(1.0, 0.0))[:, None]
    made: Array = ((knots[:-1] <= column) & (column < knots[1:])).astype(np.float64)
    for k in range(1, _DEGREE + 1):
        spans = knots[k:] - knots[:-k]
        shares = (column - knots[:-k]) / np.where(spans > 0.0, spans, 1.0)
        made = np.where(spans[:-1] > 0.0, shares[:, :-1], 0.0) * made[:, :-1] + np.where(
            spans[1:] > 0.0, 1.0 - shares[:, 1:], 0.0) * made[:, 1:]
    return made


def _local(knots: Array, breaks: Array) -> Array:
    """Return (p, 6, m): B-splines on each piece by powers of the share of it that is passed."""
    nodes = 0.5 - 0.5 * np.cos(np.pi * (np.arange(_DEGREE + 1) + 0.5) / (_DEGREE + 1))
    points = breaks[:-1, None] + np.diff(breaks)[:, None] * nodes
    values = _basis(points.ravel(), knots).reshape(*points.shape, -1)
    powers = nodes[:, None] ** np.arange(_DEGREE + 1)
    local: Array = np.linalg.solve(
        np.broadcast_to(powers, (len(points), *powers.shape)), values).astype(np.float64)
    return local


def _roughness(local: Array, widths: Array) -> Array:
    """Return what squared and added gives the integral of the squared third derivative."""
    nodes, weights = np.polynomial.legendre.leggauss(3)
    share = 0.5 + 0.5 * nodes
    third = np.stack([np.full(3, 6.0), 24.0 * share, 60.0 * share ** 2], axis=1)
    rows: Array = third @ local[:, 3:, :] * np.sqrt(0.5 * weights)[:, None]
    made: Array = rows / widths[:, None, None] ** 2.5
    return made.reshape(-1, local.shape[2])


@dataclass(frozen=True, eq=False)
class _Smoothing:
    """All smooth curves through points: one decomposition serves every weight of the roughness."""

    design: Array
    levels: Array
    # Coefficients of the curves that the roughness tells apart, how rough each is, and what the
    # points say of each.
    curves: Array
    roughness: Array
    parts: Array

    @classmethod
    def of(cls, design: Array, rough: Array, levels: Array) -> '_Smoothing':
        q, r = np.linalg.qr(design)
        inverse = np.linalg.inv(r)
        # A piece has 3 rows: few pieces have fewer than there are directions.
        square = np.vstack([rough @ inverse, np.zeros_like(inverse)])
        _, sizes, directions = np.linalg.svd(square, full_matrices=False)
        roughness = sizes ** 2
        roughness[-3:] = 0.0  # parabolas have no third derivative
        return cls(design, levels, inverse @ directions.T, roughness, directions @ (q.T @ levels))

    def coefficients(self, weight: float) -> Array:
        """Return the coefficients of a curve."""
        made: Array = self.curves @ (self.parts / (1.0 + weight * self.roughness))
        return made

    def best(self) -> tuple[int, float]:
        """Return which weight cross-validation takes, and the scatter."""
        scores, scatters = [], []
        for weight in _WEIGHTS:
            missed = self.levels - self.design @ self.coefficients(weight)
            used = float(np.sum(1.0 / (1.0 + weight * self.roughness)))
            squares, free = float(missed @ missed), len(missed) - _PRICE * used
            scores.append(squares / free ** 2 if free > 0.0 else math.inf)
            scatters.append(math.sqrt(squares / max(len(missed) - used, 1e-6)))
        best = int(np.argmin(scores))
        return (best, scatters[best]) if scatters[best] > _EXACT else (0, scatters[best])
