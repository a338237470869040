"""Fits with secondary modes, from a fit of one mode."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
import math
from typing import Any

import numpy as np

from hmsa.identification import quantities
from hmsa.identification.diagnosis import frequency_of
from hmsa.identification.fit import Fit, fit, loss
from hmsa.identification.lines import highest_ratio, LEAST_RATIO, lines_of
from hmsa.identification.measurement import Measurement
from hmsa.identification.noise import HALF_95, whiteness
from hmsa.identification.quantities import MODES, SECONDARY
from hmsa.identification.result import Mode
from hmsa.model import equations
from hmsa.model.equations import Array
from hmsa.model.laws.record import BEAMS

# Frequency ratios from which each mode is sought, besides those of the lines in the residuals.
_STARTS = (1.2, 1.4, 1.7, 2.1, 2.7, 3.4, 4.5, 6.0)
_SHARE, _LEAST_DAMPING, _MOST_DAMPING = 0.1, 0.03, 0.3
# Transverse factor and maximum J_lim at which to begin.
_TRANSVERSE, _LOOSE = 1.5, 1e6
# Simulations from each start, and for the best; for the first mode with its factor.
_FEW, _FULL, _FIRST = 8, 30, 8
# Maximum sum of the sizes of all shares.
_WHOLE = 0.9
# Minimum improvement of chi-squared by a mode; and of the loss, as a fraction, if it leaves more
# than noise.
_CHI_SQUARED, _PART = 30.0, 0.15
# Ratio of two frequencies below which they are those of one mode that changes with the stretch.
_NEAR = 1.02 * LEAST_RATIO
# Lowest ratio of a mode of a beam: the second has 6.3 where straight, 3.6 where bent to 0.75.
_OF_BEAMS = 2.5
# Relative change of the force by J_lim that is noticeable.
_STIFFENS = 0.04
#: Fraction of the residuals' sum of squares that all modes together explain at least.
ENOUGH = 0.25


def without_modes(
        values: Mapping[str, Any], free: Sequence[str], known: Collection[str]
) -> tuple[dict[str, Any], tuple[str, ...], tuple[str, ...]]:
    """
    Return values of one mode, what to free for it, and what to free together with modes.

    The mass factor takes the place of the shear modulus, as only their ratio acts on the motion,
    unless another parameter of the frequency is free, or it is known.
    """
    values = {**values, **{x[1]: 0.0 for x in SECONDARY}}
    first = tuple(x for x in free if x != MODES and x not in quantities.FACTORS
                  and not any(x in names for names in SECONDARY))
    timed = {'density', 'time_unit', *quantities.constants_of(values['law'])}
    if timed.intersection(first) or 'mass_factor' in known:
        return values, first, first
    others = tuple(x for x in first if x != 'shear_modulus')
    # Against a known remanence, rest determines the modulus.
    kept = () if 'remanence' in others else ('shear_modulus',)
    return values, ('shear_modulus', *others), ('mass_factor', *kept, *others)


def stiffens(recording: Measurement, chain_limit: float) -> bool:
    """
    Return whether the limiting extensibility changes the force noticeably in a motion.

    Otherwise it would stand for the change of modes with the stretch.
    """
    ends = np.quantile(recording.stretch, (0.01, 0.99))
    return bool(np.max(2.0 / ends + ends ** 2 - 3.0) > _STIFFENS * chain_limit)


def rescaled(
        values: Mapping[str, Any], modulus: float, free: Collection[str]) -> dict[str, Any]:
    """Return values with another shear modulus and, as far as they are free, the same motion."""
    factor = modulus / values['shear_modulus']
    return {**values, 'shear_modulus': modulus, **{
        x: factor * values[x] for x in (
            'remanence', 'damping_coefficient', 'mass_factor', 'constant_force') if x in free}}


def with_modes(
        one: Fit, start: Mapping[str, Any], free: Sequence[str], limit: float,
        given: Sequence[Sequence[float]] = (), most: int = len(SECONDARY)) -> Fit:
    """
    Return the best fit with secondary modes, from one of the first mode alone.

    Without a mode that explains residuals, the fit has none.

    Parameters
    ----------
    one : Fit
        The fit of the first mode.
    start : mapping of str to float
        Values at which to begin.
    free : sequence of str
        What is free besides modes.
    limit : float
        Given J_lim. Beside modes that are not known yet, a recording does not determine it.
    given : sequence of sequence of float
        Numbers of modes to try first, as `Modes.numbers`.
    most : int
        Maximum number of modes.

    Returns
    -------
    Fit
        For a block, it may also free how the frequency changes with the stretch.

    """
    recording = one.recording
    best = fit(recording, start, free, most=_FIRST) or one
    own = frequency_of(best)
    highest, lowest = highest_ratio(recording, own), _lowest(best.values)
    wide, values = tuple(free), dict(best.values)
    if values['law'] is None or not values['law'].section:
        wide = (*(x for x in free if x != 'chain_limit'), 'transverse_mass_factor')
        if values['transverse_mass_factor'] == 1.0:
            values['transverse_mass_factor'] = _TRANSVERSE
        if 'chain_limit' in free:
            values['chain_limit'] = min(limit, _LOOSE)
    damping = _damping_ratio(values)
    for i, names in enumerate(SECONDARY[:most]):
        begins = [(x.ratio, x.damping) for x in lines_of(best, own, 2)[0]]
        begins += [(x, min(max(damping, _LEAST_DAMPING) * x, _MOST_DAMPING)) for x in _STARTS]
        rows = [
            *given[i:i + 1], *((x, _SHARE, y) for x, y in begins if lowest < x < highest)]
        wanted = (*wide, *names[:3])
        trials = [y for x in rows if (y := fit(
            recording, {**values, **dict(zip(names, x, strict=False))}, wanted,
            most=_FEW)) is not None and _possible(y)]
        if not trials:
            break
        found = min(trials, key=lambda x: loss(x.residual, best.scale))
        found = fit(recording, found.values, wanted, most=_FULL) or found
        if not (_possible(found) and _better(best, found)):
            break
        best, wide, values = found, found.free, found.values
    return _completed(best, free) if quantities.modes_of(best.values) else best


def _completed(best: Fit, free: Sequence[str]) -> Fit:
    """Return a fit in which J_lim is free, too, and the transverse factor if it matters."""
    recording = best.recording
    if 'chain_limit' in free and 'chain_limit' not in best.free:
        found = fit(recording, best.values, (*best.free, 'chain_limit'), most=_FULL)
        if found is not None and _possible(found):
            best = found
    if 'transverse_mass_factor' in best.free:
        values = {**best.values, 'transverse_mass_factor': 1.0}
        less = fit(recording, values, tuple(
            x for x in best.free if x != 'transverse_mass_factor'), most=_FULL)
        if less is not None and _possible(less) and _gain(less, best)[0] < _CHI_SQUARED:
            best = less
    return best if best.converged else fit(recording, best.values, best.free) or best


def _damping_ratio(values: Mapping[str, Any]) -> float:
    """Return the damping ratio of the first mode about rest."""
    group = quantities.group_of(values)
    return float(values['damping_coefficient'] / quantities.damping_unit(values) / float(
        equations.critical_zeta(group.rest, group)))


def _lowest(values: Mapping[str, Any]) -> float:
    """Return the lowest possible ratio of a secondary mode."""
    law = values['law']
    return _OF_BEAMS if law is not None and law.family in BEAMS else 1.0


def _possible(found: Fit) -> bool:
    """Return whether the modes of a fit are those of an actuator."""
    values = found.values
    modes = quantities.modes_of(values)
    ratios = sorted((1.0, *(values[x[0]] for x in modes)))
    if len(ratios) > 1 and ratios[1] < _lowest(values):
        return False
    return all(y > _NEAR * x for x, y in pairwise(ratios)) and sum(
        abs(values[x[1]]) for x in modes) < _WHOLE


def _gain(before: Fit, after: Fit) -> tuple[float, float]:
    """Return by how much chi-squared improves, and the fraction by which the loss does."""
    scale = min(before.scale, after.scale)
    one, two = (loss(x.residual, scale) for x in (before, after))
    return 2.0 * (one - two), 1.0 - two / max(one, 1e-300)


def _better(before: Fit, after: Fit) -> bool:
    """Return whether a fit explains more than one with fewer parameters by chance does."""
    chi_squared, part = _gain(before, after)
    return chi_squared > _CHI_SQUARED and (
        part > _PART or whiteness(after.root * after.residual).white)


def explained(one: Fit, found: Fit) -> float:
    """Return the fraction of the residuals' sum of squares that modes explain."""
    before, after = (float(np.sum(x.residual ** 2 * (x.weights > 0.0))) for x in (one, found))
    return 1.0 - after / before if before > 0.0 else 0.0


def modes_in(found: Fit, covariance: Array) -> tuple[Mode, ...]:
    """Return the secondary modes of a fit, by frequency; the covariance is of its coordinates."""
    values, own = found.values, frequency_of(found)
    modes = []
    for names in quantities.modes_of(values):
        ends = []
        for name in names[:2]:
            value = float(values[name])
            half = 0.0
            if name in found.free:
                place = found.free.index(name)
                half = HALF_95 * math.sqrt(float(covariance[place, place])) * (
                    quantities.derivative(name, value))
            ends.append((value, value - half, value + half))
        modes.append(Mode(own * ends[0][0], ends[0], ends[1], float(values[names[2]])))
    modes.sort(key=lambda x: x.frequency)
    return tuple(replace(x, number=i) for i, x in enumerate(modes, 2))
