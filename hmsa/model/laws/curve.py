"""
An increasing curve of level against stretch, fitted to measured points.

The curve is a spline of degree 5 with four continuous derivatives. It minimises the squared errors
plus, weighted, the squared third derivative. The weight is that of generalised cross-validation
(P. Craven, G. Wahba, Numer. Math. 31, 377 (1979)), or larger if the curve would not increase.
Points with a scatter below 1/5000 of their range are interpolated.
"""

from collections.abc import Sequence
from functools import lru_cache
import math
import os
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import BSpline, PPoly

from hmsa.errors import BadInputError

Array = NDArray[np.float64]

#: Minimum and maximum number of points.
FEWEST, MOST = 6, 2000
# Valid ranges; larger levels are likely in mT, other stretches in percent or mm.
_STRETCHES, _LARGEST_LEVEL = (0.1, 10.0), 5.0
_DEGREE = 5
# Maximum number of basis functions.
_FUNCTIONS = 40
# Weights of the roughness to try, for levels and stretches normalised to a range of 1.
_WEIGHTS = np.logspace(-18.0, 2.0, 61)
# Cost of a degree of freedom in cross-validation; with 1 the curve sometimes follows noise.
_PRICE = 1.2
# Maximum deviation of a curve from points: in standard deviations, and relative to their range.
_DEVIATIONS, _SHARE = 4.0, 0.02
# Points with a smaller scatter, relative to the range, are interpolated.
_EXACT = 2e-4
# Maximum scatter, relative to the range, and minimum slope, relative to the mean slope.
_MOST_SCATTER, _LEAST_SLOPE = 0.05, 0.02
# Tolerance within which the level at stretch 1 counts as 0, relative to the range.
_ZERO = 5e-3
# Distance of the stop from an end, as a fraction of that from stretch 1 to the end.
_STOP = 0.1
_LOOK = 24


class StaticCharacteristic(NamedTuple):
    """Level in T against stretch."""

    level: PPoly  #: of degree 5, 0 at stretch 1
    slope: float  #: at stretch 1, in T
    scatter: float  #: standard deviation of the points in T, estimated

    def packed(self, unit: float) -> tuple[float, ...]:
        """
        Return the constants of ``Table`` in ``motion/hmsa/law.hpp``, for a unit in T.

        The order is: number of pieces and depths of the stops; start, initial energy and
        coefficients of each piece; end, with energy, force and stiffness there.
        """
        level, breaks = self.level, self.level.x
        energy = level.antiderivative()
        rows = np.column_stack([
            breaks[:-1], (energy(breaks[:-1]) - energy(1.0)) / unit, level.c[::-1].T / unit])
        end = breaks[-1]
        at_end = np.array([energy(end) - energy(1.0), level(end), level(end, 1)]) / unit
        return (
            float(len(rows)), *(_STOP * (breaks[[0, -1]] - 1.0)).tolist(), *rows.ravel().tolist(),
            float(end), *at_end.tolist())


def points_in(name: str) -> tuple[list[float], list[float]]:
    """
    Return stretches and levels in T of a CSV file with columns ``stretch`` and ``flux_density``.

    Raise `BadInputError` if the file or a row cannot be used.
    """
    from hmsa.columns import read_table

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
    """Raise `BadInputError` for points that no block can have, with their place."""
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
                f'{source} {places[i]} has stretch {stretch[i]:g} {how}: expected increasing '
                'stretches, each once; take the mean of repeated measurements')
    if not stretch[0] < 1.0 < stretch[-1]:
        raise BadInputError(
            f'{source} has stretches {stretch[0]:g} to {stretch[-1]:g}: expected some on both '
            'sides of 1, since a block swings there on its way to rest')
    if not flux[-1] > flux[0]:
        raise BadInputError(
            f'{source} has flux densities from {flux[0]:g} T at the smallest stretch to '
            f'{flux[-1]:g} T at the largest: expected increasing ones; a level that stretches the '
            'block is positive')


@lru_cache(maxsize=32)
def fitted(stretch: tuple[float, ...], flux: tuple[float, ...]) -> StaticCharacteristic:
    """
    Return the curve through points, which increases everywhere and is 0 at stretch 1.

    Points are stretches, increasing from below 1 to above, and the levels in T that hold them.
    Raise `BadInputError` if no increasing curve fits them within their scatter.
    """
    _check(stretch, flux, 'law table', [f'row {i}' for i in range(1, len(stretch) + 1)])
    x, y = np.array(stretch), np.array(flux)
    span, height = float(x[-1] - x[0]), float(y[-1] - y[0])
    u, v = (x - x[0]) / span, y / height
    knots = _knots(u)
    basis = BSpline(knots, np.eye(len(knots) - _DEGREE - 1), _DEGREE)
    design = basis(u)
    curves, roughness, parts = _separated(design, _roughness(basis), v)
    shares = 1.0 / (1.0 + _WEIGHTS[:, None] * roughness)
    coefficients = shares * parts @ curves.T
    squares = np.sum((v - coefficients @ design.T) ** 2, axis=1)
    used = np.sum(shares, axis=1)
    free = len(u) - _PRICE * used
    best = int(np.argmin(np.divide(
        squares, free ** 2, out=np.full_like(squares, np.inf), where=free > 0.0)))
    scatter = math.sqrt(squares[best] / max(len(u) - used[best], 1e-6))
    if scatter > _MOST_SCATTER:
        raise BadInputError(
            f'law table has a scatter of {scatter * height:.3g} T about a smooth curve: expected '
            f'at most {_MOST_SCATTER * height:.3g} T, {_MOST_SCATTER:.0%} of its range')
    # Use the roughest curve that increases everywhere; if there is none, 0, which fits no points.
    slopes = basis.derivative()(_points(knots, np.linspace(0.0, 1.0, _LOOK)))
    chosen = next((x for x in coefficients[best if scatter > _EXACT else 0:]
                   if np.min(slopes @ x) > _LEAST_SLOPE), np.zeros(len(basis.c)))
    missed = np.abs(design @ chosen - v)
    if np.max(missed) > max(_DEVIATIONS * scatter, _SHARE):
        # Report the point of the largest decrease.
        falls = np.maximum.accumulate(v) - v
        i = int(np.argmax(falls if np.max(falls) > 0.0 else missed))
        raise BadInputError(
            f'law table does not rise beyond its scatter of {scatter * height:.2g} T near row '
            f'{i + 1} (stretch {x[i]:g}, {y[i]:g} T): expected flux densities that rise with '
            'stretch; repeat the measurement there')
    spline = PPoly.from_spline(BSpline(x[0] + span * knots, height * chosen, _DEGREE))
    level = PPoly(spline.c[:, _DEGREE:-_DEGREE], spline.x[_DEGREE:-_DEGREE])
    offset, allowed = float(level(1.0)), max(_DEVIATIONS * scatter, _ZERO) * height
    if abs(offset) > allowed:
        raise BadInputError(
            f'law table has a flux density of {offset:.4g} T at stretch 1: expected 0 within '
            f'{allowed:.2g} T; stretch is the length over the length at rest without field')
    level.c[-1] -= offset
    return StaticCharacteristic(level, float(level(1.0, 1)), scatter * height)


def _knots(u: Array) -> Array:
    """Return knots from 0 to 1: the points, or quantiles of many, without those near the ends."""
    edge = (_DEGREE + 1) // 2
    inner = u[edge:-edge] if len(u) <= _FUNCTIONS else np.quantile(
        u, np.linspace(0.0, 1.0, _FUNCTIONS - _DEGREE + 1)[1:-1])
    knots: Array = np.concatenate(
        [np.zeros(_DEGREE + 1), inner, np.ones(_DEGREE + 1)]).astype(np.float64)
    return knots


def _points(knots: Array, shares: ArrayLike) -> Array:
    """Return points at fractions of each piece between knots."""
    breaks = knots[_DEGREE:-_DEGREE, None]
    points: Array = (breaks[:-1] + np.diff(breaks, axis=0) * np.asarray(shares)).ravel()
    return points


def _roughness(basis: BSpline) -> Array:
    """Return the matrix whose squared norm is the integral of the squared third derivative."""
    nodes, weights = np.polynomial.legendre.leggauss(3)
    third = basis.derivative(3)(_points(basis.t, 0.5 + 0.5 * nodes))
    widths = np.diff(basis.t[_DEGREE:-_DEGREE])
    made: Array = third * np.sqrt(np.outer(widths, 0.5 * weights)).reshape(-1, 1)
    return made


def _separated(design: Array, rough: Array, levels: Array) -> tuple[Array, Array, Array]:
    """
    Return coefficients of the curves that diagonalise the roughness, by column.

    Also return their roughness and their coefficients in the fit; one decomposition serves all
    weights.
    """
    q, r = np.linalg.qr(design)
    inverse = np.linalg.inv(r)
    # A piece has 3 rows: with few pieces there may be fewer rows than directions.
    square = np.vstack([rough @ inverse, np.zeros_like(inverse)])
    _, sizes, directions = np.linalg.svd(square, full_matrices=False)
    roughness = sizes ** 2
    roughness[-3:] = 0.0  # parabolas have no third derivative
    return inverse @ directions.T, roughness, directions @ (q.T @ levels)
