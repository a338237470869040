"""Identification: from start values to the verdict."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
import math
from typing import Any

import numpy as np

from hmsa.errors import BadInputError, check_number
from hmsa.identification import diagnosis, quantities
from hmsa.identification.defects import dead_band, GAIN, USUAL_GAIN
from hmsa.identification.diagnosis import repeated
from hmsa.identification.fit import (
    errors_of_stamps,
    Fit,
    fit,
    HALF_95,
    loss,
    robust_scale,
    whiteness,
    widening,
)
from hmsa.identification.initial_guess import begins_at_rest
from hmsa.identification.intervals import estimates_of, Precision, precision_of, stamp_error
from hmsa.identification.measurement import Measurement
from hmsa.identification.modal import (
    as_computed,
    begun,
    BESIDES,
    contested,
    ENOUGH,
    explained,
    lines_of,
    modes_in,
    narrower,
    possible,
    rescaled,
    stiffens,
    with_modes,
    without_modes,
)
from hmsa.identification.result import Defect, Identification, IdentificationVerdict, Mode
from hmsa.identification.search import rivals, search, unmoved
from hmsa.interfaces.actuator import along_elastica, parameters_of
from hmsa.model.equations import Array
from hmsa.model.modes import BROAD
from hmsa.model.parameters import ActuatorParameters, paper_actuator
from hmsa.table import RESOLVED

# Maximum number of iterations for the timestamp errors.
_MOST_SPREADS = 3
# P-value of the test for whiteness below which residuals are certainly not white.
_CERTAIN = 1e-4
# Parameters that are freed because residuals advise it; excess of chi-squared that decides between
# them and a mode; and number of standard deviations that is no chance.
_ADVISED = (GAIN, 'sensor_latency', 'coil_time_constant', 'constant_force', *(
    x for names in quantities.BRANCHES for x in names))
_WORSE, _SURE = 10.0, 3.0
# Size of a mode in standard deviations that rejects a fit alone, and so does the fraction of the
# residuals' sum of squares that modes explain: correlated noise leaves more.
_CLEAR, _NEARLY_ALL = 8.0, 0.9
# Residuals along the elastica in units of those with the shape of the first mode, below which a
# beam that this does not describe to the noise is fitted so; and what is said then.
_CLOSER = 0.97
_ALONG = (
    'the beam is fitted along its elastica (law.shape: elastica), and plans with these values '
    'need the same')
# Largest bulk modulus to begin with, in units of G.
_BULK_RATIO = 100.0


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
    asked = free = quantities.check_free(free, actuator.law)
    along = along_elastica(actuator)
    if quantities.MODES in free and along is not actuator:
        # With the shape of the first mode, a remanence 2.5 % off would stand for the statics.
        actuator = along
        notes.append(_ALONG)
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
    if 'bulk_ratio' in free:
        values['bulk_ratio'] = min(values['bulk_ratio'], _BULK_RATIO)
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
    given = {**dict.fromkeys(known), **uncertain}
    if quantities.MODES in free:
        kept = actuator.chain_limit
        if 'chain_limit' in free and not stiffens(recording, kept):
            recording, values = _keeping(recording, kept), {**values, 'chain_limit': kept}
            free = tuple(x for x in free if x != 'chain_limit')
        found = _with_modes(recording, free, values, actuator, known, given)
    else:
        best, tried, agreed = search(recording, values, free)
        best, others = rivals(best)
        found = _conclude(
            *_with_errors_of_stamps(best), others, tried, agreed, given, actuator.chain_limit)
    found = _challenged(found, set(free) - set(given), actuator.chain_limit)
    if along is not actuator and (
            found.verdict == 'model_rejected' or not found.whiteness.white):
        bent = identify(
            replace(recording, notes=(*recording.notes, _ALONG)), asked, actuator=along,
            known=known, uncertain=uncertain)
        if bent.residual_rms < _CLOSER * found.residual_rms:
            return bent
    return found


def _keeping(recording: Measurement, limit: float) -> Measurement:
    """Return a recording with a note that J_lim is kept as given."""
    return replace(recording, notes=(
        *recording.notes,
        f'chain_limit is kept at {limit:g}: the recording shows its modes, and hardly this'))


def _with_modes(
        recording: Measurement, free: Sequence[str], values: Mapping[str, Any],
        actuator: ActuatorParameters, known: Collection[str],
        given: Mapping[str, float | None]) -> Identification:
    """Return the result with as many secondary modes as a recording shows."""
    limit = actuator.chain_limit
    begin, first, together = without_modes(values, free, known)
    one, tried, agreed = search(recording, begin, first)
    start = one.values if 'shear_modulus' in together or together == first else rescaled(
        one.values, values['shear_modulus'], together)

    def concluded(best: Fit) -> Identification:
        return _conclude(*_with_errors_of_stamps(best), [], tried, agreed, given, limit, one)

    def determined(best: Fit) -> Identification:
        found = concluded(best)
        # J_lim, what nobody asked for, where a broad mode is, and shares of computed modes keep
        # their values where errors of the modes hide them.
        modes = quantities.modes_of(best.values)
        usual = {'chain_limit': limit} | {
            x: y for x, (y, _) in BESIDES.items() if x not in free} | {
            x[0]: best.values[x[0]] for x in modes if best.values[x[2]] >= BROAD} | {
            x[1]: best.values[x[1]] for x in modes if x[0] not in best.free}
        while found.verdict == 'not_identifiable' and (hidden := {
                x: y for x, y in usual.items()
                if x in best.free and math.isnan(found.parameters[x].value)}):
            less = fit(
                _keeping(best.recording, limit) if 'chain_limit' in hidden else best.recording,
                {**best.values, **hidden}, tuple(x for x in best.free if x not in hidden))
            if less is None or not possible(less):
                break
            best, found = less, concluded(less)
        return found

    beginning = begun(one, start, together)
    best = narrower(beginning, together, limit, actuator.modes.numbers)
    told = as_computed(best, beginning, together, limit, actuator.modes)
    if told is not None and (found := determined(told)).verdict == 'identified':
        return found
    return determined(best)


def _challenged(
        found: Identification, free: Collection[str], limit: float) -> Identification:
    """
    Return an identification that no secondary mode contests.

    Parameters of coil, sensor and creep that were freed, as residuals advised, may imitate a mode:
    where one explains as much of what they do, it is fitted in their place.
    """
    best = found.fit
    added = [x for x in best.free if x in free and x in _ADVISED]
    if not added or found.verdict != 'identified':
        return found
    found = replace(found, warnings=(*found.warnings, _on_trust(found, added)))
    law = best.values['law']
    if GAIN in added and (law is not None and law.section or (
            diagnosis.modal(best) and not found.whiteness.white)):
        # Only a force that is known exactly separates gain and remanence. That of a beam has no
        # free constant, and a block that does not deform uniformly has another one.
        gain = found.parameters[GAIN]
        if abs(gain.value - 1.0) > min(_SURE * gain.std, USUAL_GAIN):
            return replace(found, verdict='not_identifiable', reason=(
                f'{GAIN} comes out as {gain.value:.4g}, and an error of the statics of the '
                'actuator would look the same; calibrate the sensor, and give --known '
                f'{GAIN}=VALUE+-STD'))
    if diagnosis.modal(best):
        return found
    kept = tuple(x for x in best.free if x not in added)
    values = {**best.values, **{
        x: quantities.QUANTITIES[x].default for x in added if x in quantities.QUANTITIES}}
    one = fit(best.recording, values, kept)
    if one is None or not contested(one, best):
        return found
    rival = _with_others(one, limit, len(quantities.SECONDARY))
    if not quantities.modes_of(rival.values):
        return found
    scale = min(best.scale, rival.scale)
    excess = 2.0 * (loss(rival.residual, scale) - loss(best.residual, scale))
    if excess > _WORSE:
        return found
    modes = modes_in(rival, _inverse(rival) * rival.scale ** 2)
    return replace(found, verdict='not_identifiable', modes=modes, reason=(
        f'{modes[0].words} explains the samples '
        f'{"better than" if excess < -_WORSE else "as well as"} {", ".join(added)}: try --free '
        f'+{quantities.MODES} instead, or calibrate, and give --known {added[0]}=VALUE+-STD'))


def _on_trust(found: Identification, added: Sequence[str]) -> str:
    """Return a sentence about parameters that only this recording supports."""
    words = ', '.join(f'{x} {found.parameters[x].value:.4g}' for x in added)
    return (
        f'{words}: freed for this fit, and no other measurement supports '
        f'{"it" if len(added) == 1 else "them"}')


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
        check_number(f'the standard deviation of {name}', std, least=0.0)


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
        given: Mapping[str, float | None], limit: float, one: Fit | None = None
) -> Identification:
    """
    Return the result of a fit.

    ``variance`` is that of its coordinates due to timestamp errors, ``others`` are fits that are
    nearly as good, and ``given`` are values known to the caller, with standard deviations;
    ``limit`` is the prior J_lim. With secondary modes, ``one`` is the fit of the first alone.
    """
    known = precision_of(best, variance, given)
    found, marks = known.whiteness, known.missing.signatures
    alike = repeated(
        best, 1.0 / diagnosis.frequency_of(best), dead_band(best, known.deviation))
    modes, named = modes_in(best, known.covariance), list[Defect]()
    if not found.white:
        marks = tuple(sorted(
            [*marks, *diagnosis.second_mode(best)], key=lambda x: (-x.found, -x.share)))
        if one is None:
            left, named = _modes_left(
                best, marks, limit, bool(diagnosis.misfit(best, found, marks, alike)))
            modes, marks = left or modes, (*named, *marks)
    distant = diagnosis.distant(best, found)
    # Where modes are what is missing, the values are those of the first.
    lost, weak = (set(best.free) if distant and not modes else set(), '') \
        if distant or named else diagnosis.weakness(best, known.deviation, known.proved)
    still = set() if lost else unmoved(best)
    strange = '' if distant or others or still else diagnosis.implausible(best, found, lost)
    verdict: IdentificationVerdict = 'model_rejected'
    reason = diagnosis.misfit(best, found, marks, alike) or strange
    if weak:
        # Errors of the model widen all intervals, and may be why nothing is determined.
        verdict = 'not_identifiable'
        reason = f'{weak}; besides, {reason}' if reason else weak
    elif not reason and (still or others):
        verdict, lost = 'not_identifiable', still or set(best.free) - quantities.STATIC
        reason = diagnosis.resting(best, still) if still else diagnosis.alike(best, others)
    elif not reason and one is not None and not found.white and (
            explained(one, best) < ENOUGH):
        reason = (
            'secondary modes explain hardly more than the first alone, which leaves residuals '
            f'of {best.scale:.3g}: the model does not describe the motion; see the figures of '
            '--report page.html')
    elif not reason and not best.converged and not (modes and not found.white):
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
        agreed, diagnosis.cost(best, marks, alike), modes)


def _inverse(found: Fit) -> Array:
    """Return the inverse of the information of a fit."""
    inverse: Array = np.asarray(np.linalg.pinv(found.information), dtype=np.float64)
    return inverse


def _modes_left(
        best: Fit, marks: Sequence[Defect], limit: float, rejected: bool
) -> tuple[tuple[Mode, ...], list[Defect]]:
    """
    Return the modes that residuals show more than any other departure, also as departures.

    A fit that is not rejected for other reasons needs stronger evidence of them. Residuals of
    rounding, as a simulation without noise leaves, show none. Modes of the parameter file may be
    wrong or too few.
    """
    if best.scale < RESOLVED * float(np.ptp(best.recording.stretch)):
        return (), []
    leading = max((x.share for x in marks if x.found and x.remedy), default=0.0)
    distant = diagnosis.distant(best, whiteness(best.root * best.residual))
    if not quantities.modes_of(best.values) and not distant:
        lines = lines_of(best, diagnosis.frequency_of(best), 1)
        if not lines or lines[0].explained < leading:
            return (), []
    found = _with_others(best, limit, 2)
    part = explained(best, found)
    if distant and part >= ENOUGH:
        # Directions hold only near the motion: compare fits.
        leading = max((
            explained(best, y) for x in dict.fromkeys(x.remedy for x in marks if x.remedy)
            if (y := fit(best.recording, best.values, (*best.free, *x.split(',')))) is not None),
            default=0.0)
    if not quantities.modes_of(found.values) or part < max(ENOUGH, leading):
        return (), []
    weighted = found.root * found.residual
    inverse = _inverse(found)
    wider = widening(found.root[:, None] * found.jacobian, weighted, inverse, whiteness(weighted))
    modes = modes_in(found, inverse * found.scale ** 2 * np.outer(wider, wider))
    sizes = [2.0 * HALF_95 * abs(x.share[0]) / max(x.share[2] - x.share[1], 1e-9) for x in modes]
    if not rejected and max(sizes) < _CLEAR and part < _NEARLY_ALL:
        return (), []
    return modes, [Defect(x.words, part, size, True, quantities.MODES)
                   for x, size in zip(modes, sizes, strict=True)]


def _with_others(one: Fit, limit: float, most: int) -> Fit:
    """Return the best fit with secondary modes, in place of those that were given."""
    given = [[one.values[x] for x in names] for names in quantities.modes_of(one.values)]
    if given:
        one = fit(one.recording, {
            **one.values, **{x[1]: 0.0 for x in quantities.SECONDARY}}, one.free) or one
    return with_modes(
        begun(one, one.values, one.free), one.free, limit, given, max(most, len(given) + 1))


def _warnings(
        best: Fit, known: Precision, outliers: int, given: Collection[str]) -> list[str]:
    """Return further information for the reader, one sentence each."""
    found, recording = [], best.recording
    if diagnosis.modal(best):
        if 'mass_factor' in best.free:
            found.append(
                'mass_factor is free in place of shear_modulus, of which the motion shows only '
                f'their ratio: it is for {best.values["shear_modulus"]:.6g} Pa')
        if any(best.values[x] for names in quantities.SECONDARY for x in names[3:]):
            found.append(
                'modes change with the stretch as computed for a block of this shape, or as given')
        if not known.whiteness.white:
            left = 100.0 * diagnosis.unexplained(best)
            found.append(
                f'the modes leave {left:.2g} % of the motion, as those of a continuum change with '
                'the stretch: intervals include it, and plans of modal leave up to '
                f'{100.0 * diagnosis.cost(best, (), None):.2g} % of a step, and up to '
                f'{left * diagnosis.LEFT_AT_3:.2g} % with robust_order 3')
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
        widened = f'{float(np.max(known.correlated)):.3g}'
        found.append('the residuals are not white' + (
            f': correlation widened the intervals by up to {widened} times'
            if widened != '1' else ''))
    if recording.quantum:
        found.append(f'the {recording.coordinate.name} comes in steps of {recording.quantum:.3g}')
    std = np.sqrt(np.diag(known.covariance))
    found += diagnosis.considered(known.missing.considered, std, best.free, given)
    if known.missing.late is not None:
        found += diagnosis.undetected(known.missing.late, std, best)
    if max(diagnosis.overshoots(best), default=1.0) < diagnosis.SHAPED:
        found.append(
            'all moves are shaped so that nothing rings: they carry about a sixth of the '
            'information of unshaped steps; record what hmsa excite --out levels.csv proposes')
    return found
