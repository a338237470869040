"""Precision of the parameters: covariance, intervals, profiles."""

from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
import math

import numpy as np

from hmsa.errors import BadInputError
from hmsa.identification import diagnosis, quantities
from hmsa.identification.defects import Departures, departures
from hmsa.identification.fit import (
    clustered,
    Fit,
    fit,
    LEAST_SCALE,
    moved,
    Whiteness,
    whiteness,
    widening,
)
from hmsa.identification.initial_guess import changes_of
from hmsa.identification.modal import BESIDES
from hmsa.identification.response import respond
from hmsa.identification.result import Estimate, Identification
from hmsa.model.equations import Array

# Fraction of the allowed standard deviation above which it is checked by a profile.
_NEARLY_LOST = 0.3
# Quantiles of the stretch between which errors of a continuum's model count as one draw: with
# more parts, intervals missed the first frequency of finite elements more often.
_PARTS = 1.0 / 3.0, 2.0 / 3.0
# Fraction of a derivative below which the free parameters explain all of it; J_lim in place of an
# infinite one.
_HIDDEN, _LOOSE = 1e-10, 1e9


@dataclass(frozen=True, eq=False)
class Precision:
    """Precision of the coordinates of a fit; factors multiply their standard deviations."""

    deviation: float  # of a sample
    freedom: float  # weighted number of samples minus parameters
    whiteness: Whiteness
    inverse: Array  # of the information for unit noise
    correlated: Array  # factors due to correlation of the noise
    proved: Array  # factors without likely departures, to decide which values are determined
    covariance: Array
    missing: Departures


def precision_of(best: Fit, variance: Array, given: Mapping[str, float | None]) -> Precision:
    """
    Compute the precision of a fit.

    ``variance`` is that of its coordinates due to timestamp errors; ``given`` contains parameters
    known to the caller, with standard deviations, None if exact.
    """
    weighted = best.root * best.residual
    freedom = max(float(np.sum(best.weights)) - len(best.free), 1.0)
    deviation = max(math.sqrt(float(weighted @ weighted) / freedom), LEAST_SCALE)
    found, inverse = whiteness(weighted), _inverse(best.information)
    columns = best.root[:, None] * best.jacobian
    correlated = widening(columns, weighted, inverse, found)
    missing = departures(best, found, inverse, deviation, given)
    if diagnosis.modal(best) and not found.white:
        # Errors of the model are what residuals contain, and stand for all departures. They are
        # alike after equal changes of level, and at similar stretches, of which intervals contain
        # the values at each: the deviation of one, not that of their mean.
        shown = best.response.stretch
        correlated, similar = (np.maximum(correlated, clustered(columns, weighted, inverse, x))
                               for x in (changes_of(best.recording), np.digitize(
                                   shown, np.quantile(shown, _PARTS))))
        factors = np.maximum(correlated, math.sqrt(len(_PARTS) + 1.0) * similar)
        moves = _of_forms(best, columns, inverse, given)
        return Precision(
            deviation, freedom, found, inverse, correlated, correlated,
            inverse * deviation ** 2 * np.outer(factors, factors) + moves.T @ moves, missing)
    variance = variance + _blurred(best, deviation, columns, inverse)
    proved, factors = (
        correlated * np.sqrt(np.maximum(x / np.diag(inverse) / deviation ** 2, 1.0))
        for x in (variance, variance + missing.hint))
    curved = _bent(best, inverse, deviation, proved)
    factors = curved * factors
    return Precision(
        deviation, freedom, found, inverse, correlated, curved * proved,
        inverse * deviation ** 2 * np.outer(factors, factors), missing)


def stamp_error(best: Fit, deviation: float) -> float:
    """Return the RMS timestamp error in s, if one was estimated."""
    place = int(np.argmax(best.spread))
    return deviation * math.sqrt(float(best.spread[place]) ** 2 - 1.0) / max(
        abs(float(best.response.rate[place])), 1e-300)


def _of_forms(
        best: Fit, columns: Array, inverse: Array, given: Collection[str]) -> Array:
    """
    Return changes of the coordinates by one standard deviation of errors of form, shape (k, p).

    Residuals do not show these errors of a block with modes, as other parameters compensate.
    J_lim, and how inertia and damping change with the stretch, have usual values where the
    recording hardly shows them: the change is that to their optimum.
    """
    values, law = best.values, best.values['law']
    if law is not None and law.section:
        return np.empty((0, len(best.free)))
    kept = [x for x in ('chain_limit', *BESIDES) if x not in best.free and x not in given
            and not (x == 'chain_limit' and law is not None)]
    response = respond(best.recording, {
        **values, 'chain_limit': min(values['chain_limit'], _LOOSE)}, kept)
    if response is None:
        return np.empty((0, len(best.free)))
    added = best.root[:, None] * response.jacobian
    ways = inverse @ (columns.T @ added)
    shown = added - columns @ ways
    norms = np.sum(shown ** 2, axis=0)
    sizes = np.divide(
        shown.T @ (best.root * best.residual), norms, out=np.zeros(len(norms)),
        where=norms > _HIDDEN * np.sum(added ** 2, axis=0))
    moves: Array = -(ways * sizes).T
    return moves


def _blurred(best: Fit, deviation: float, columns: Array, inverse: Array) -> Array:
    """Return the squared bias of the coordinates due to curvature with timestamp errors."""
    error = stamp_error(best, deviation)
    nothing: Array = np.zeros(len(best.free))
    late = {**best.values, 'sensor_latency': best.values['sensor_latency'] + error}
    after = respond(best.recording, late, ()) if error else None
    if after is None:
        return nothing
    # On average, the error is half the squared time error times the acceleration.
    missed = 0.5 * error * best.values['stretch_gain'] * (best.response.rate - after.rate)
    shift: Array = inverse @ (columns.T @ (best.root * missed))
    return shift ** 2


def _bent(best: Fit, inverse: Array, deviation: float, held: Array) -> Array:
    """
    Return the factors by which standard deviations exceed those from the information matrix.

    Poorly determined parameters are checked: at two standard deviations, the best fit of the
    others has to be worse by the expected amount.
    """
    std = np.sqrt(np.diag(inverse)) * deviation * held
    limits, weights = diagnosis.allowed(best), best.root ** 2
    base = float(weights @ best.residual ** 2)
    factors: Array = np.ones(len(best.free))
    for place in np.flatnonzero((std > _NEARLY_LOST * limits) & (std <= limits)):
        largest, others = 1.0, tuple(x for i, x in enumerate(best.free) if i != place)
        for change in (-2.0 * std[place], 2.0 * std[place]):
            step = inverse[:, place] / inverse[place, place] * change
            start = moved(best.values, best.free, step)
            one = fit(best.recording, start, others, spread=best.spread) if others else None
            if one is not None:
                worse = (float(weights @ one.residual ** 2) - base) / deviation ** 2
                largest = max(largest, 2.0 * held[place] / math.sqrt(max(worse, 1e-2)))
        shared = inverse[:, place] ** 2 / inverse[place, place] / np.diag(inverse)
        factors = np.maximum(factors, np.sqrt(1.0 + shared * (largest ** 2 - 1.0)))
    return factors


def _inverse(information: Array) -> Array:
    """Return the inverse of an information matrix, large if it is singular."""
    size = np.sqrt(np.maximum(np.diag(information), 1e-12))
    values, vectors = np.linalg.eigh(information / np.outer(size, size))
    values = np.maximum(values, 1e-13 * values[-1])
    found: Array = (vectors / values) @ vectors.T / np.outer(size, size)
    return found


def estimates_of(
        best: Fit, known: Precision, lost: set[str]) -> tuple[dict[str, Estimate], Array]:
    """
    Return all parameters with intervals, and the covariance of the free values in SI units.

    Undetectable errors only widen the intervals: for the same sizes and sensor, predictions from
    the values do not depend on them.
    """
    # Slow to import, and not needed by a planner that estimates.
    from scipy.special import stdtrit

    # The noise is estimated, too: use Student's t.
    quantile = float(stdtrit(known.freedom, 0.975))
    whole = np.sqrt(np.diag(known.covariance) + sum(
        x ** 2 for x in known.missing.considered.values()))
    values = best.values
    scales = np.array([quantities.derivative(x, values[x]) for x in best.free])
    matrix = known.covariance * np.outer(scales, scales)
    estimates: dict[str, Estimate] = {}
    constants = [x for x in quantities.constants_of(values.get('law')) if x in values]
    for name in (*quantities.QUANTITIES, *constants):
        value, quantity = values[name], quantities.quantity_of(name)
        std, ends = 0.0, [value, value]
        if name in lost:
            value, std, ends = math.nan, math.nan, [math.nan, math.nan]
        elif name in best.free:
            place = best.free.index(name)
            half = quantile * float(whole[place])
            x = quantities.to_coordinate(name, value)
            ends = sorted(quantities.from_coordinate(name, y) for y in (x - half, x + half))
            if quantity.scale == 'inverse' and x - half <= 1e-9:
                ends[1] = math.inf
            std = math.sqrt(matrix[place, place])
        estimates[name] = Estimate(
            value, std, ends[0], ends[1], quantity.unit, name in best.free)
    for place, name in enumerate(best.free):
        if name in lost:
            matrix[place, :] = matrix[:, place] = math.nan
    return estimates, matrix


def profile(
        found: Identification, name: str, points: int = 11
) -> list[tuple[float, float]]:
    """
    Return the profile likelihood of a parameter: the best fit of the others at each of its values.

    Parameters
    ----------
    found : Identification
        The optimum.
    name : str
        Name of a free parameter.
    points : int
        Number of values in an interval of four standard deviations on either side.

    Returns
    -------
    list of (float, float)
        Values, and excess of the deviance (twice the negative log likelihood) over that of the
        optimum: 3.84 at the ends of a 95 % interval.

    Raises
    ------
    BadInputError
        If the parameter was not free.

    """
    if name not in found.names:
        raise BadInputError(
            f'{name} was not free: expected one of {", ".join(found.names)}')
    others = tuple(x for x in found.names if x != name)
    place = found.names.index(name)
    centre = quantities.to_coordinate(name, found.values[name])
    std = math.sqrt(float(found.covariance[place, place])) / abs(
        quantities.derivative(name, found.values[name])) if math.isfinite(
            found.covariance[place, place]) else 0.2 * max(abs(centre), 0.1)
    best, weights = found.fit, found.fit.root ** 2
    base = float(np.sum(weights * best.residual ** 2))
    kept = replace(found.recording, notes=())
    rows = []
    for x in centre + 4.0 * std * np.linspace(-1.0, 1.0, points):
        values = {**found.values, name: quantities.from_coordinate(name, float(x))}
        one = fit(kept, values, others, spread=best.spread) if others else None
        if one is not None:
            loss = float(np.sum(weights * one.residual ** 2))
            rows.append((values[name], max(loss - base, 0.0) / found.noise_std ** 2))
    return rows
