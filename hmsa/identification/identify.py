"""Identification: from start values to the verdict."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
import math

import numpy as np

from hmsa.errors import BadInputError
from hmsa.identification import diagnosis, quantities
from hmsa.identification.defects import dead_band
from hmsa.identification.fit import Fit, fit, robust_scale
from hmsa.identification.initial_guess import begins_at_rest, segments
from hmsa.identification.intervals import estimates_of, Precision, precision_of, stamp_error
from hmsa.identification.measurement import Measurement
from hmsa.identification.noise import errors_of_stamps, whiteness
from hmsa.identification.repeats import repeated
from hmsa.identification.result import Identification, IdentificationVerdict
from hmsa.identification.search import rivals, search, unmoved
from hmsa.interfaces.actuator import parameters_of
from hmsa.model.equations import Array
from hmsa.model.parameters import ActuatorParameters, paper_actuator

# Maximum number of iterations for the timestamp errors.
_MOST_SPREADS = 3
# P-value of the test for whiteness below which residuals are certainly not white.
_CERTAIN = 1e-4
# Maximum overshoot of the moves of a shaped run, as a fraction of the step.
_SHAPED = 0.15


def identify(
        recording: Measurement, free: Sequence[str] = quantities.DEFAULT_FREE, *,
        actuator: ActuatorParameters | None = None, known: Mapping[str, float] | None = None,
        uncertain: Mapping[str, float] | None = None) -> Identification:
    """
    Identify the parameters of an actuator from a recording of its motion.

    Parameters
    ----------
    recording : Recording
        Measured samples and levels.
    free : sequence of str
        Parameters to identify, keys of `hmsa.identification.quantities.QUANTITIES`.
    actuator : ActuatorParameters, optional
        Prior values of the block, including its hyperelastic model; default the paper's.
    known : mapping of str to float, optional
        Other known values in SI units: of coil and sensor, or of the block. An unknown gain of the
        sensor may have an error of 2 %: if this would not be detected, intervals include it.
    uncertain : mapping of str to float, optional
        Standard deviations of known values, by name; intervals include their effect.

    Returns
    -------
    Identification
        Values, covariance, residuals and verdict.

    Raises
    ------
    BadInputError
        If the data or the names cannot be used, or the motion is that of no elastomer.

    """
    notes = [] if actuator is not None else [_defaults(free, known or {})]
    actuator = actuator or paper_actuator()
    if recording.coordinate != actuator.coordinate:
        raise BadInputError(
            f'{recording.label} has {recording.coordinate.plural}: expected '
            f'{actuator.coordinate.plural}, as the law of the actuator has')
    free = quantities.check_free(free, actuator.law)
    known, uncertain = known or {}, uncertain or {}
    values = quantities.complete(
        quantities.values_of(actuator, known), ('time_unit',) if 'time_unit' in known else ())
    _check_uncertain(uncertain, free)
    constants = quantities.constants_of(actuator.law)
    if set(free) & set(constants):
        given = parameters_of(actuator)
        values |= {name: given[x.name][i] if x.kind is list else given[x.name]
                   for name, (x, i) in constants.items()}
    sought = [time for ratio, time in quantities.BRANCHES if ratio in free]
    if len(sought) > 1:
        # From the swing to slow creep at the end.
        span = 0.2 * float(recording.time[-1] - recording.time[0])
        values |= {x: y for x, y in zip(sought, np.geomspace(
            min(2.0 * values['time_unit'], 0.2 * span), span, len(sought)).tolist(), strict=True)
            if x in free and x not in known}
    if 'chain_limit' in free:
        # Infinite J_lim is no start value: the derivative is by its inverse.
        values['chain_limit'] = min(values['chain_limit'], 1e9)
    at_rest = begins_at_rest(recording) and not {'initial_stretch', 'initial_rate'} & set(free)
    recording = replace(
        recording, at_rest=at_rest, notes=(*recording.notes, *filter(None, notes)))
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


def _defaults(free: Collection[str], known: Collection[str]) -> str:
    """Return a sentence about the values that are those of the example block."""
    own = paper_actuator().numbers
    taken = [x for x in ('half_length', 'half_thickness', *own) if x not in free and x not in known
             and not (x == 'density' and 'time_unit' in {*free, *known})]
    taken = list(dict.fromkeys(taken))
    return taken and (
        f'{", ".join(taken)} {"are" if len(taken) > 1 else "is"} not given: '
        + ', '.join(f'{own[x]:g} {quantities.QUANTITIES[x].unit}'.rstrip() for x in taken)
        + ' of the example block; a parameter file (--params-file) or known values (--known) '
        'give those of yours') or ''


def _check_uncertain(uncertain: Mapping[str, float], free: Sequence[str]) -> None:
    """Raise `BadInputError` for invalid standard deviations, or those of free parameters."""
    for name, std in uncertain.items():
        quantities.quantity_of(name)
        if name in free:
            raise BadInputError(
                f'{name} is free and known to a standard deviation: expected one of the two')
        if not 0.0 <= std < math.inf:
            raise BadInputError(
                f'the standard deviation of {name} is {std:g}: expected a finite number of at '
                'least 0')


def _with_errors_of_stamps(best: Fit) -> tuple[Fit, Array]:
    """
    Return a fit in which samples in motion have less weight, if timestamp errors show there.

    Also return the variance of its coordinates due to the uncertainty of these errors.
    """
    found, recording = best, best.recording
    for _ in range(_MOST_SPREADS):
        spread, variance = errors_of_stamps(found.jacobian, found.residual, found.response.rate)
        if np.array_equal(spread, found.spread):
            return found, variance
        again = fit(recording, found.values, found.free, spread=spread)
        # Errors of the model are also larger in motion, but are correlated between samples.
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

    ``variance`` is that of its coordinates due to timestamp errors, ``others`` are fits that are
    nearly as good, and ``given`` are values known to the caller, with standard deviations.
    """
    known = precision_of(best, variance, given)
    found, marks = known.whiteness, known.missing.signatures
    alike = repeated(
        best, 1.0 / diagnosis.frequency_of(best), dead_band(best, known.deviation))
    if not found.white:
        marks = tuple(sorted(
            [*marks, *diagnosis.second_mode(best)], key=lambda x: (-x.found, -x.share)))
    distant = diagnosis.distant(best, found)
    lost, weak = (set(best.free), '') if distant else diagnosis.weakness(
        best, known.deviation, known.proved)
    still = set() if lost else unmoved(best)
    if not distant and not others and not still:
        diagnosis.check_plausible(best, lost)
    verdict: IdentificationVerdict = 'model_rejected'
    reason = diagnosis.misfit(best, found, marks, alike)
    if weak:
        # Errors of the model widen all intervals, and may be why nothing is determined.
        verdict = 'not_identifiable'
        reason = f'{weak}; besides, {reason}' if reason else weak
    elif not reason and (still or others):
        verdict, lost = 'not_identifiable', still or set(best.free) - quantities.STATIC
        reason = diagnosis.resting(best, still) if still else diagnosis.alike(best, others)
    elif not reason and not best.converged:
        reason = (
            f'the search did not converge from {tried} starts: the best fit leaves residuals '
            f'of {best.scale:.3g}; give a file with closer values (--params-file actuator.yaml), '
            f'or free fewer parameters, as with {diagnosis.freeing(best, best.free[-1:])}')
    elif not reason:
        verdict = 'identified'
        reason = (
            f'{len(best.free)} parameters from {len(best.recording.time)} samples with a noise of '
            f'{known.deviation:.3g}')
    # The modulus of a beam is reported as Young's modulus.
    reason = reason.replace('shear_modulus', quantities.modulus_of(best.values.get('law'))[0])
    parameters, matrix = estimates_of(best, known, lost)
    outliers = int(np.count_nonzero(best.weights == 0.0))
    warnings = best.recording.notes if distant else (
        *best.recording.notes, *_warnings(best, known, outliers, given))
    return Identification(
        verdict, reason, warnings, parameters, best.free, matrix, known.deviation,
        float(np.sqrt(np.mean(best.residual ** 2))), len(best.recording.time), outliers,
        best.recording, best, found, marks, float(np.max(known.correlated)), best.values, tried,
        agreed, diagnosis.cost(best, marks, alike))


def _warnings(
        best: Fit, known: Precision, outliers: int, given: Collection[str]) -> list[str]:
    """Return further information for the reader, one sentence each."""
    found, recording = [], best.recording
    if best.values['modes']:
        found.append(
            'secondary modes are kept from the parameters, and the fit is of one mode: their '
            'vibration counts as noise')
    if outliers:
        found.append(
            f'{outliers} of {len(recording.time)} samples are more than six standard deviations '
            'from the fit and did not count')
    if np.max(best.spread) > 1.0:
        found.append(
            'the residuals grow with the rate, as timestamp errors of '
            f'{stamp_error(best, known.deviation):.2g} s rms would cause: samples in '
            'motion count less')
    if not known.whiteness.white:
        found.append(
            'the residuals are not white: correlation widened the intervals by up to '
            f'{float(np.max(known.correlated)):.3g} times')
    if recording.quantum:
        found.append(f'the {recording.coordinate.name} comes in steps of {recording.quantum:.3g}')
    std = np.sqrt(np.diag(known.covariance))
    found += diagnosis.considered(known.missing.considered, std, best.free, given)
    if known.missing.late is not None:
        found += diagnosis.undetected(known.missing.late, std, best)
    if _shaped(best):
        found.append(
            'all moves are shaped so that nothing rings: they carry about a sixth of the '
            'information of unshaped steps; record what hmsa excite --out levels.csv proposes')
    return found


def _shaped(best: Fit) -> bool:
    """Return whether hardly any motion overshoots its final stretch."""
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
