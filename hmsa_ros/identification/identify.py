"""Identification from start to verdict."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
import math

import numpy as np
from numpy.typing import ArrayLike

from hmsa_ros.errors import BadInputError
from hmsa_ros.identification import diagnosis
from hmsa_ros.identification.fit import Fit, fit, LEAST_SCALE, loss, moved, robust_scale
from hmsa_ros.identification.noise import errors_of_stamps, hinted, whiteness, widening
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
    to_coordinate,
    values_of,
)
from hmsa_ros.identification.recording import Recording
from hmsa_ros.identification.response import complete, respond
from hmsa_ros.identification.result import Estimate, Identification, Verdict
from hmsa_ros.identification.start import deviations, scan, segments, starts
from hmsa_ros.model.equations import Array
from hmsa_ros.model.parameters import ActuatorParameters, paper_actuator

# Of these, each does what an offset of the stamps does.
_DELAYS = {'sensor_latency', 'coil_time_constant'}
# Residuals this near to the scatter of their differences are white enough for a first look.
_NEAR_WHITE = 1.5
# Neighbours that are both outliers, as a share of all, from which on they may be motion.
_ADJACENT = 0.002
# Simulations for each of the starts; the best one goes on. Once there is a fit, the others get
# fewer, and the rest only if the loss is within this factor of the best.
_FIRST_PASSES, _FEW_PASSES, _PROMISING = 25, 8, 4.0
# A time unit seen in the data is tried before the others up to this factor from the given one.
_FAR = 4.0
# Outliers so unlikely to lie in motion by chance make a fit one to go on from.
_DOUBT = 0.05
# As many fits at one optimum end the search.
_ENOUGH = 2
# Share of what is allowed from which on a deviation is looked at twice.
_NEARLY_LOST = 0.3
# Times that the errors of the stamps are estimated anew.
_MOST_SPREADS = 3
# Probability of residuals to be white below which no chance makes them look like this.
_CERTAIN = 1e-4
# Fits within this share of the deviations, or of the scale, are one optimum.
_SAME = 0.02
# A run whose fastest motion after a change of level is this much slower than a step's is shaped.
_SHAPED = 0.15


def identify(
        time: ArrayLike | Recording, stretch: ArrayLike | None = None,
        level_times: ArrayLike | None = None, levels: ArrayLike | None = None, *,
        free: Sequence[str] = DEFAULT_FREE, actuator: ActuatorParameters | None = None,
        known: Mapping[str, float] | None = None, slew_limit: float = math.inf
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
        Of coil and sensor, where they are not the defaults.
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
    values = complete(values_of(actuator, known), ())
    if actuator.law is not None and set(free) & set(constants_of(actuator.law)):
        values |= constant_values(actuator.law, actuator.shear_modulus)
    sought = [time for ratio, time in BRANCHES if ratio in free]
    if len(sought) > 1:
        # From the swing on to what is left at the end.
        span = 0.2 * float(recording.time[-1] - recording.time[0])
        values |= {x: y for x, y in zip(sought, np.geomspace(
            min(2.0 * values['time_unit'], 0.2 * span), span, len(sought)).tolist(), strict=True)
            if x in free and x not in (known or {})}
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
    best, tried, agreed = _search(recording, values, free)
    return _conclude(*_with_errors_of_stamps(best), tried, agreed)


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


def _good(found: Fit) -> bool:
    """Whether a fit leaves little but white noise, and outliers here and there."""
    differences = np.diff(found.residual)
    out = found.weights < 0.5
    return bool(
        found.converged
        and found.scale < _NEAR_WHITE * robust_scale(differences) / math.sqrt(2.0)
        # Of few samples a level even what is far off differs from one to the next.
        and found.scale < diagnosis.DISTANT * float(np.std(found.recording.stretch))
        and np.count_nonzero(out[1:] & out[:-1]) <= _ADJACENT * len(out)
        and not diagnosis.mistaken(found, _DOUBT))


def _search(
        recording: Recording, values: Mapping[str, float], free: Sequence[str]
) -> tuple[Fit, int, int]:
    """Return the best of the fits, how many there are, and how many ended there."""
    found: list[Fit] = []

    def tried(candidates: Sequence[Mapping[str, float]]) -> bool:
        for candidate in candidates:
            few = any(x.converged for x in found)
            one = fit(recording, candidate, free, most=_FEW_PASSES if few else _FIRST_PASSES)
            if few and one is not None and not one.converged and _promising(found, one):
                one = fit(recording, one.values, free, most=_FIRST_PASSES)
            if one is not None:
                found.append(one)
                if _good(one) or _settled(found):
                    return True
        return False

    given = starts(recording, values, free)
    nearest = min((given[0], given[-1]), key=lambda x: _miss(recording, x))
    # A frequency far from that of the values given may be one of the noise.
    near = abs(math.log(nearest['time_unit'] / values['time_unit'])) < math.log(_FAR)
    if not near or not tried([nearest]):
        # All time units, and what else was seen in the data; the likeliest first.
        others = [*scan(recording, values, free),
                  *(x for x in given if not near or x is not nearest)]
        tried(sorted(others, key=lambda x: _miss(recording, x)))
    if not found:
        raise BadInputError(
            f'no start value leads to a motion that {recording.label} could be compared with: '
            'expected levels in T and an actuator as --params-file describes it; a level may be '
            'more than it can hold')
    best, agreed = _best(found)
    if not best.converged:
        best = fit(recording, best.values, free) or best
    return best, len(found), agreed


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


def _best(found: Sequence[Fit]) -> tuple[Fit, int]:
    """Return the likeliest fit, and how many ended there."""
    scale = min(x.scale for x in found)
    losses = [loss(x.residual, scale) for x in found]
    agreed = sum(x < (1.0 + _SAME) * min(losses) for x in losses)
    return found[int(np.argmin(losses))], agreed


def _promising(found: Sequence[Fit], one: Fit) -> bool:
    """Whether a fit that has not ended may still become the likeliest."""
    best, _ = _best([x for x in found if x.converged])
    return loss(one.residual, best.scale, convex=True) < _PROMISING * loss(
        best.residual, best.scale, convex=True)


def _settled(found: Sequence[Fit]) -> bool:
    """Whether several starts ended at the likeliest fit, though it leaves more than noise."""
    best, agreed = _best(found)
    return (
        agreed >= _ENOUGH and best.converged
        and best.scale < diagnosis.DISTANT * float(np.std(best.recording.stretch))
        and not diagnosis.mistaken(best, _DOUBT))


def _miss(recording: Recording, candidate: Mapping[str, float]) -> float:
    """Return how far the motion of some values is from the recorded one in the mean."""
    response = respond(recording, candidate, (), rtol=1e-4)
    return math.inf if response is None else float(
        np.mean(np.abs(recording.stretch - response.stretch)))


def _conclude(best: Fit, variance: Array, tried: int, agreed: int) -> Identification:
    """Return the result of a fit, with the variance of its coordinates where stamps may be off."""
    root, recording = best.root, best.recording
    weighted = root * best.residual
    counted = float(np.sum(best.weights))
    freedom = max(counted - len(best.free), 1.0)
    deviation = max(math.sqrt(
        float(weighted @ weighted) / freedom), LEAST_SCALE)
    found = whiteness(weighted)
    inverse = _inverse(best.information)
    columns = root[:, None] * best.jacobian
    correlated = widening(columns, weighted, inverse, found)
    variance = variance + _blurred(best, deviation, columns, inverse)
    hint: Array = np.zeros(len(best.free))
    if not recording.earlier and not _DELAYS.intersection(best.free):
        hint = hinted(root * best.response.rate, columns, weighted, inverse, found)
    # A hint that becomes a proof rejects the model: it does not make a recording a weak one.
    held, factors = (
        correlated * np.sqrt(np.maximum(x / np.diag(inverse) / deviation ** 2, 1.0))
        for x in (variance, variance + hint))
    bent = _bent(best, inverse, deviation, held)
    held, factors = bent * held, bent * factors
    covariance = inverse * deviation ** 2 * np.outer(factors, factors)
    weak = diagnosis.weakness(best, deviation, held)
    marks = diagnosis.signatures(best, found)
    reason = diagnosis.misfit(best, found, marks)
    verdict: Verdict = 'model_rejected'
    distant = diagnosis.distant(best, found)
    if not distant:
        diagnosis.check_plausible(best, weak.names if weak else ())
    if weak is not None and not distant:
        # What the model lacks widens all intervals, and may be why nothing is held.
        verdict = 'not_identifiable'
        reason = f'{weak.words}; besides, {reason}' if reason else weak.words
    elif not reason and not best.converged:
        reason = (
            f'the search did not come to an end from {tried} starts: the best leaves residuals '
            f'of {best.scale:.3g}; give a --params-file that is nearer, or free less')
    elif not reason:
        verdict = 'identified'
        reason = (
            f'{len(best.free)} parameters from {len(recording.time)} samples with a noise of '
            f'{deviation:.3g}')
    lost = set(best.free) if verdict == 'model_rejected' and distant else set(
        weak.names if weak else ())
    # A beam's modulus is known as Young's.
    reason = reason.replace('shear_modulus', modulus_of(best.values.get('law'))[0])
    parameters, matrix = _estimates(best, covariance, freedom, lost)
    outliers = int(np.count_nonzero(best.weights == 0.0))
    warnings = (*recording.notes, *_warnings(
        best, deviation, correlated, outliers, found.white))
    return Identification(
        verdict, reason, warnings, parameters, best.free, matrix, deviation,
        float(np.sqrt(np.mean(best.residual ** 2))), len(recording.time), outliers, recording,
        best.response.stretch, best.residual, best.weights, best.spread, found, marks,
        float(np.max(correlated)), complete(best.values, best.free), tried, agreed)


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
        best: Fit, covariance: Array, freedom: float, lost: set[str]
) -> tuple[dict[str, Estimate], Array]:
    """Return all parameters with intervals, and the covariance of the free values in SI."""
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
            half = quantile * math.sqrt(covariance[place, place])
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
            'information of plain steps; record what hmsa excite proposes')
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
