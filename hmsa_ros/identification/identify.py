"""Identification from start to verdict."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
import math

import numpy as np
from numpy.typing import ArrayLike

from hmsa_ros.errors import BadInputError
from hmsa_ros.identification import diagnosis
from hmsa_ros.identification.departures import dead_band, departures
from hmsa_ros.identification.fit import Fit, fit, LEAST_SCALE, moved, robust_scale
from hmsa_ros.identification.noise import errors_of_stamps, whiteness, widening
from hmsa_ros.identification.quantities import (
    BRANCHES,
    check_free,
    constant_values,
    constants_of,
    DEFAULT_FREE,
    derivative,
    from_coordinate,
    GEOMETRY,
    modulus_of,
    QUANTITIES,
    quantity_of,
    STATIC,
    to_coordinate,
    values_of,
)
from hmsa_ros.identification.recording import Recording
from hmsa_ros.identification.repeats import repeated
from hmsa_ros.identification.response import complete, respond
from hmsa_ros.identification.result import Estimate, Identification, Verdict
from hmsa_ros.identification.search import rivals, search
from hmsa_ros.identification.start import deviations, segments
from hmsa_ros.model.equations import Array
from hmsa_ros.model.parameters import ActuatorParameters, paper_actuator

# Share of what is allowed from which on a deviation is looked at twice.
_NEARLY_LOST = 0.3
# Times that the errors of the stamps are estimated anew.
_MOST_SPREADS = 3
# Probability of residuals to be white below which no chance makes them look like this.
_CERTAIN = 1e-4
# A run whose fastest motion after a change of level is this much slower than a step's is shaped.
_SHAPED = 0.15


def identify(
        time: ArrayLike | Recording, stretch: ArrayLike | None = None,
        level_times: ArrayLike | None = None, levels: ArrayLike | None = None, *,
        free: Sequence[str] = DEFAULT_FREE, actuator: ActuatorParameters | None = None,
        known: Mapping[str, float] | None = None,
        uncertain: Mapping[str, float] | None = None, slew_limit: float = math.inf
) -> Identification:
    """
    Find the parameters of an actuator in a recording of its motion.

    Parameters
    ----------
    time : array_like, shape (n,), or Recording
        Times of the samples in s, increasing; or all of the measured in one record.
    stretch : array_like, shape (n,)
        Measured stretch.
    level_times, levels : array_like, shape (m,)
        Flux density in T in force from each time in s on.
    free : sequence of str
        What is sought, names of `hmsa_ros.identification.quantities.QUANTITIES`.
    actuator : ActuatorParameters, optional
        The block as far as it is known, its law included; default the paper's.
    known : mapping of str to float, optional
        What is known besides, in SI: of coil and sensor, or of the block. A gain of the sensor
        that is not among these may be 2 % off: where that would not show, intervals hold it.
    uncertain : mapping of str to float, optional
        Standard deviations of what is known, by name; intervals hold what they do.
    slew_limit : float
        Rate in T/s at which the amplifier ramps; infinite for steps.

    Returns
    -------
    Identification
        Values, covariance, residuals and verdict.

    Raises
    ------
    BadInputError
        If the data or the names cannot be used, or the motion is that of no elastomer.

    """
    actuator = actuator or paper_actuator()
    if isinstance(time, Recording):
        recording = time
        if recording.coordinate != actuator.coordinate:
            raise BadInputError(
                f'{recording.label} has {recording.coordinate.plural}: expected '
                f'{actuator.coordinate.plural}, as the law of the actuator has')
    else:
        if stretch is None or level_times is None or levels is None:
            raise BadInputError(
                'stretch, level_times or levels is missing: expected all three beside time')
        recording = Recording(
            np.asarray(time, dtype=np.float64), np.asarray(stretch, dtype=np.float64),
            np.atleast_1d(np.asarray(level_times, dtype=np.float64)),
            np.atleast_1d(np.asarray(levels, dtype=np.float64)), slew_limit,
            coordinate=actuator.coordinate)
    free = check_free(free, actuator.law)
    known, uncertain = known or {}, uncertain or {}
    values = _values(actuator, known, uncertain, free)
    if actuator.law is not None and set(free) & set(constants_of(actuator.law)):
        values |= constant_values(actuator.law, actuator.shear_modulus)
    sought = [time for ratio, time in BRANCHES if ratio in free]
    if len(sought) > 1:
        # From the swing on to what is left at the end.
        span = 0.2 * float(recording.time[-1] - recording.time[0])
        values |= {x: y for x, y in zip(sought, np.geomspace(
            min(2.0 * values['time_unit'], 0.2 * span), span, len(sought)).tolist(), strict=True)
            if x in free and x not in known}
    if 'chain_limit' in free:
        # Endless chains are no start: the derivative by their inverse is taken of the limit.
        values['chain_limit'] = min(values['chain_limit'], 1e9)
    at_rest = _begins_at_rest(recording) and not {'initial_stretch', 'initial_rate'} & set(free)
    if at_rest != recording.at_rest:
        recording = replace(recording, at_rest=at_rest)
    if not at_rest:
        values['initial_stretch'] = float(np.median(recording.stretch[:3]))
        free = tuple(dict.fromkeys((*free, 'initial_stretch', 'initial_rate')))
    if len(recording.time) < 2 * len(free):
        raise BadInputError(
            f'{recording.label} has {len(recording.time)} samples for {len(free)} free '
            f'parameters: expected {2 * len(free)} or more')
    best, tried, agreed = search(recording, values, free)
    best, others = rivals(best)
    return _conclude(
        *_with_errors_of_stamps(best), others, tried, agreed,
        {**dict.fromkeys(known), **uncertain})


def _values(
        actuator: ActuatorParameters, known: Mapping[str, float],
        uncertain: Mapping[str, float], free: Sequence[str]) -> dict[str, float]:
    """Return start values of all that there is, with what is known."""
    actuator = replace(
        actuator, half_length=known.get('half_length', actuator.half_length),
        half_thickness=known.get('half_thickness', actuator.half_thickness))
    both = [x for x in {**known, **uncertain} if x in free and x in uncertain]
    bad = [x for x, y in uncertain.items() if not 0.0 <= y < math.inf]
    if both or bad:
        raise BadInputError(
            f'{both[0]} is free and known to a standard deviation: expected one of the two'
            if both else
            f'the standard deviation of {bad[0]} is {uncertain[bad[0]]:g}: expected a finite '
            'number of at least 0')
    values = values_of(actuator, {x: y for x, y in known.items() if x not in GEOMETRY})
    return complete(values, ('time_unit',) if 'time_unit' in known else ())


def _begins_at_rest(recording: Recording) -> bool:
    """Whether the samples before the first change of level show no motion."""
    spans = segments(recording, 4)
    changes = recording.level_times[1:][np.diff(recording.levels) != 0.0]
    first = float(changes[0]) if len(changes) else math.inf
    before = recording.stretch[recording.time <= first]
    if len(before) < 4:
        return True
    # Of white noise second differences have a deviation of sqrt(6).
    tails = np.array([(begin + (end - begin) * 2 // 3, end)
                      for begin, end, _, _ in spans if end - begin >= 15],
                     np.int64).reshape(-1, 2)
    quiet = float(min(
        np.min(deviations(recording.stretch, tails), initial=math.inf),
        np.min(deviations(np.diff(recording.stretch, 2), tails - np.array([0, 2])),
               initial=math.inf) / math.sqrt(6.0))) if len(tails) else 0.0
    quiet = max(quiet, 0.5 * recording.quantum, 1e-6)
    return float(np.std(before)) < 4.0 * quiet


def _with_errors_of_stamps(best: Fit) -> tuple[Fit, Array]:
    """
    Return a fit in which samples in motion count less, if errors of the stamps show there.

    With it comes the variance of its coordinates, with what is not known of these errors.
    """
    found, recording = best, best.recording
    for _ in range(_MOST_SPREADS):
        spread, variance = errors_of_stamps(found.jacobian, found.residual, found.response.rate)
        if np.array_equal(spread, found.spread):
            return found, variance
        again = fit(recording, found.values, found.free, spread=spread)
        # What the model leaves out is larger in motion too, but not from sample to sample.
        if again is None or not again.converged or whiteness(
                again.root * again.residual).p_value < _CERTAIN or (
                robust_scale(again.residual) > 2.0 * diagnosis.DISTANT * float(
                    np.std(recording.stretch))):
            return found, variance
        found = again
    return found, errors_of_stamps(found.jacobian, found.residual, found.response.rate)[1]


def _conclude(
        best: Fit, variance: Array, others: Sequence[Fit], tried: int, agreed: int,
        given: Mapping[str, float | None]) -> Identification:
    """
    Return the result of a fit.

    With it come the variance of its coordinates where stamps may be off, others that are nearly as
    good, and what the caller knows, with standard deviations.
    """
    root, recording = best.root, best.recording
    weighted = root * best.residual
    freedom = max(float(np.sum(best.weights)) - len(best.free), 1.0)
    deviation = max(math.sqrt(
        float(weighted @ weighted) / freedom), LEAST_SCALE)
    found = whiteness(weighted)
    inverse = _inverse(best.information)
    columns = root[:, None] * best.jacobian
    correlated = widening(columns, weighted, inverse, found)
    variance = variance + _blurred(best, deviation, columns, inverse)
    missing = departures(best, found, inverse, deviation, given)
    # A hint that becomes a proof rejects the model: it does not make a recording a weak one.
    held, factors = (
        correlated * np.sqrt(np.maximum(x / np.diag(inverse) / deviation ** 2, 1.0))
        for x in (variance, variance + missing.hint))
    bent = _bent(best, inverse, deviation, held)
    held, factors = bent * held, bent * factors
    covariance = inverse * deviation ** 2 * np.outer(factors, factors)
    weak = diagnosis.weakness(best, deviation, held)
    alike = repeated(
        best, 1.0 / diagnosis.frequency_of(best), dead_band(best, deviation))
    marks = missing.signatures
    if not found.white:
        marks = tuple(sorted(
            [*marks, *diagnosis.second_mode(best)], key=lambda x: (-x.found, -x.share)))
    reason = diagnosis.misfit(best, found, marks, alike)
    verdict: Verdict = 'model_rejected'
    distant = diagnosis.distant(best, found)
    lost = set(best.free) if distant else set(weak.names if weak else ())
    if not distant and not others:
        diagnosis.check_plausible(best, weak.names if weak else ())
    if weak is not None and not distant:
        # What the model lacks widens all intervals, and may be why nothing is held.
        verdict = 'not_identifiable'
        reason = f'{weak.words}; besides, {reason}' if reason else weak.words
    elif others and not reason:
        verdict, reason = 'not_identifiable', diagnosis.alike(best, others)
        lost = set(best.free) - STATIC
    elif not reason and not best.converged:
        reason = (
            f'the search did not come to an end from {tried} starts: the best leaves residuals '
            f'of {best.scale:.3g}; give a --params-file that is nearer, or free less')
    elif not reason:
        verdict = 'identified'
        reason = (
            f'{len(best.free)} parameters from {len(recording.time)} samples with a noise of '
            f'{deviation:.3g}')
    # A beam's modulus is known as Young's.
    reason = reason.replace('shear_modulus', modulus_of(best.values.get('law'))[0])
    parameters, matrix = _estimates(best, covariance, missing.considered, freedom, lost)
    outliers = int(np.count_nonzero(best.weights == 0.0))
    warnings = [*recording.notes, *_warnings(
        best, deviation, correlated, outliers, found.white)]
    if missing.hidden:
        warnings.append(diagnosis.of_gain(missing.considered, inverse, deviation, best.free))
    return Identification(
        verdict, reason, tuple(warnings), parameters, best.free, matrix, deviation,
        float(np.sqrt(np.mean(best.residual ** 2))), len(recording.time), outliers, recording,
        best.response.stretch, best.residual, best.weights, best.spread, found, marks,
        float(np.max(correlated)), complete(best.values, best.free), tried, agreed,
        diagnosis.cost(best, marks, alike))


def _stamp_error(best: Fit, deviation: float) -> float:
    """Return the root mean square error of the stamps in s, as far as one was estimated."""
    place = int(np.argmax(best.spread))
    return deviation * math.sqrt(float(best.spread[place]) ** 2 - 1.0) / max(
        abs(float(best.response.rate[place])), 1e-300)


def _blurred(best: Fit, deviation: float, columns: Array, inverse: Array) -> Array:
    """Return the squares of what the curvature of the motion moves where stamps are off."""
    error = _stamp_error(best, deviation)
    nothing: Array = np.zeros(len(best.free))
    late = {**best.values, 'sensor_latency': best.values['sensor_latency'] + error}
    after = respond(best.recording, late, ()) if error else None
    if after is None:
        return nothing
    # In the mean a sample lies half the square of the error times the acceleration off.
    missed = 0.5 * error * best.values['stretch_gain'] * (best.response.rate - after.rate)
    moved: Array = inverse @ (columns.T @ (best.root * missed))
    return moved ** 2


def _bent(best: Fit, inverse: Array, deviation: float, held: Array) -> Array:
    """
    Return by how much deviations are larger than the information at the optimum says.

    Looked at where a parameter is nearly lost: two deviations off, the best fit of the others
    has to be as much worse as those say.
    """
    std = np.sqrt(np.diag(inverse)) * deviation * held
    limits, weights = diagnosis.allowed(best), best.root ** 2
    base = float(weights @ best.residual ** 2)
    factors: Array = np.ones(len(best.free))
    for place in np.flatnonzero((std > _NEARLY_LOST * limits) & (std <= limits)):
        name, largest = best.free[place], 1.0
        others = tuple(x for x in best.free if x != name)
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
    """Return the inverse of an information matrix, large where it is singular."""
    size = np.sqrt(np.maximum(np.diag(information), 1e-12))
    values, vectors = np.linalg.eigh(information / np.outer(size, size))
    values = np.maximum(values, 1e-13 * values[-1])
    found: Array = (vectors / values) @ vectors.T / np.outer(size, size)
    return found


def _estimates(
        best: Fit, covariance: Array, considered: Array, freedom: float, lost: set[str]
) -> tuple[dict[str, Estimate], Array]:
    """
    Return all parameters with intervals, and the covariance of the free values in SI.

    What is considered widens the intervals alone: with the same sizes and the same sensor what
    the values predict is as good as without.
    """
    # Slow to load, and no use to a planner that estimates.
    from scipy.special import stdtrit

    # The noise is estimated too: Student's interval.
    quantile = float(stdtrit(freedom, 0.975))
    values = complete(best.values, best.free)
    scales = np.array([derivative(x, values[x]) for x in best.free])
    matrix = covariance * np.outer(scales, scales)
    estimates: dict[str, Estimate] = {}
    constants = [x for x in constants_of(values.get('law')) if x in values]
    for name in (*QUANTITIES, *constants):
        value, quantity = values[name], quantity_of(name)
        if name in lost:
            estimates[name] = Estimate(
                math.nan, math.nan, math.nan, math.nan, quantity.unit, True)
        elif name in best.free:
            place = best.free.index(name)
            half = quantile * math.sqrt(covariance[place, place] + considered[place, place])
            x = to_coordinate(name, value)
            ends = sorted(from_coordinate(name, y) for y in (x - half, x + half))
            if quantity.scale == 'inverse' and x - half <= 1e-9:
                ends[1] = math.inf
            estimates[name] = Estimate(
                value, math.sqrt(matrix[place, place]), ends[0], ends[1], quantity.unit, True)
        else:
            estimates[name] = Estimate(value, 0.0, value, value, quantity.unit, False)
    for name in GEOMETRY:
        value = values[name]
        estimates[name] = Estimate(value, 0.0, value, value, 'm', False)
    for place, name in enumerate(best.free):
        if name in lost:
            matrix[place, :] = matrix[:, place] = math.nan
    return estimates, matrix


def _warnings(
        best: Fit, deviation: float, factors: Array, outliers: int, white: bool) -> list[str]:
    """Return what a reader should know besides the verdict, a sentence each."""
    found, recording = [], best.recording
    if outliers:
        found.append(
            f'{outliers} of {len(recording.time)} samples are more than six deviations off and '
            'did not count')
    if np.max(best.spread) > 1.0:
        found.append(
            'the residuals grow with the rate, as with stamps that are off by '
            f'{_stamp_error(best, deviation):.2g} s rms: samples in motion count less')
    if not white:
        found.append(
            'the residuals are not white: correlation widened the intervals by up to '
            f'{float(np.max(factors)):.3g} times')
    if recording.quantum:
        found.append(f'the {recording.coordinate.name} comes in steps of {recording.quantum:.3g}')
    if _shaped(best):
        found.append(
            'all moves are shaped so that nothing rings: they carry about a sixth of the '
            'information of unshaped steps; record what hmsa excite proposes')
    return found


def _shaped(best: Fit) -> bool:
    """Whether hardly any motion goes past the stretch that it comes to rest at."""
    fitted, before = best.response.stretch, None
    past = []
    for begin, end, _, _ in segments(best.recording, 6):
        rest = float(fitted[end - 1])
        before = float(fitted[begin]) if before is None else before
        if abs(rest - before) > 0.01:
            part = (fitted[begin:end] - rest) / (rest - before)
            past.append(float(np.max(part)))
        before = rest
    return bool(past) and max(past) < _SHAPED


def profile(
        found: Identification, name: str, points: int = 11
) -> list[tuple[float, float]]:
    """
    Return the profile likelihood of a parameter: the best of all others at each of its values.

    Parameters
    ----------
    found : Identification
        The optimum.
    name : str
        Of a free parameter.
    points : int
        Values over its interval of four deviations on either side.

    Returns
    -------
    list of (float, float)
        Value, and how much the deviance, twice the negative logarithm of the likelihood, lies
        above that of the optimum: 3.84 at the ends of a 95 % interval.

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
    centre = to_coordinate(name, found.values[name])
    std = math.sqrt(float(found.covariance[place, place])) / abs(
        derivative(name, found.values[name])) if math.isfinite(
            found.covariance[place, place]) else 0.2 * max(abs(centre), 0.1)
    weights = found.weights / found.spread ** 2
    base = float(np.sum(weights * found.residual ** 2))
    kept = replace(found.recording, notes=())
    rows = []
    for x in centre + 4.0 * std * np.linspace(-1.0, 1.0, points):
        values = {**found.values, name: from_coordinate(name, float(x))}
        one = fit(kept, values, others, spread=found.spread) if others else None
        if one is not None:
            loss = float(np.sum(weights * one.residual ** 2))
            rows.append((values[name], max(loss - base, 0.0) / found.noise_std ** 2))
    return rows
