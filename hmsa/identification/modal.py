"""
Fits with secondary modes, from a fit of one mode, and the lines of such modes in its residuals.

A mode of the actuator is an oscillator about the rest under each level, so that its motion follows
from its frequency ratio and its damping ratio alone. The difference between its motion and that of
the first mode, of which the residuals contain the share, is computed for all ratios and several
dampings, and compared with the residuals as in `hmsa.identification.defects`. The strongest line
is refined, its columns join those that the fit explains, and the search is repeated. Lines may be
broad or close to the first mode, and samples need not be evenly spaced.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
import math
from typing import Any

import numpy as np

from hmsa import motion
from hmsa.identification import quantities
from hmsa.identification.diagnosis import DISTANT, distant, frequency_of, unexplained
from hmsa.identification.fit import Fit, fit, HALF_95, loss, whiteness
from hmsa.identification.measurement import Measurement, pieces
from hmsa.identification.quantities import MODES, SECONDARY
from hmsa.identification.response import ResponseArguments
from hmsa.identification.result import Mode
from hmsa.model import equations
from hmsa.model.continuum import mounted, SHAPES
from hmsa.model.equations import Array
from hmsa.model.modes import BROAD, Modes
from hmsa.motion import derivatives

#: Minimum ratio to the frequency of the first mode.
LEAST_RATIO = 1.04
_MOST_RATIO = 12.0
# Ratio of neighbouring frequencies of the search, and its damping ratios.
_SPACING = 1.03
_DAMPINGS = (0.03, 0.1, 0.3)
# Grids of the refinement: steps in the logarithms of both, and how often they shrink.
_STEPS, _REFINED, _SHRINK = np.linspace(-1.0, 1.0, 5), 4, 0.45
_DAMPED = 0.002, BROAD
# Ratio from which a mode of a block stands for all weak ones, as none is as fast and strong: with
# the damping of one, plans of modal left 5 % where they leave 2 (benchmarks continuum).
_FAST = 5.0
# Samples a period that resolve a line.
_RESOLVED = 2.5
# Minimum size of a line in standard deviations, and of the part of the residuals that it explains.
_DEVIATIONS, _FEEBLE = 6.0, 0.04
# Steps a period in which a field that does not step is replaced by one that does.
_PIECES = 24.0
# Change of a field, relative to its range, that is none.
_FADED = 1e-3
_MOST_SAMPLES = 2000
# Frequency ratios from which each mode is sought, besides those of the lines in the residuals.
_STARTS = (1.1, 1.2, 1.4, 1.7, 2.1, 2.7, 3.4, 4.5, 6.0)
_SHARE, _LEAST_DAMPING, _MOST_DAMPING = 0.1, 0.03, 0.3
#: What a block has besides, with the values of one that deforms uniformly, and at which to begin.
BESIDES = {'transverse_mass_factor': (1.0, 1.5), 'damping_exponent': (0.0, 0.0)}
# Maximum J_lim at which a fit begins.
_LOOSE = 1e6
# Simulations from each start, and for the best; for the first mode with its factor.
_FEW, _FULL, _FIRST = 8, 30, 8
# Fits in which the damping ratios follow the frequencies.
_REPEATS = 2
# Maximum sum of the sizes of all shares.
_WHOLE = 0.9
# Minimum improvement of chi-squared by a mode; and of the loss, as a fraction, if it leaves more
# than noise: a mode of given damping stands for less else.
_CHI_SQUARED, _PART, _PART_VISCOUS = 30.0, 0.15, 0.05
# Ratio of two frequencies below which fitted ones are those of one mode that changes with the
# stretch; and to the first, which a flat glued block has at 1.09 of it (benchmarks continuum).
_NEAR, _NEAR_FIRST = 1.122, 1.06
# Lowest ratio of a mode of a beam: the second has 6.3 where straight, 3.6 where bent to 0.75.
_OF_BEAMS = 2.5
# Relative change of the force by J_lim that is noticeable.
_STIFFENS = 0.04
# Residuals in units of those of fitted modes up to which computed ones are preferred: on finite
# elements, they have 0.7 to 1.7 (benchmarks continuum). Least share of a strong mode.
_ALIKE, _STRONG = 2.0, 0.04
# Lines in place of other parameters, and the fraction of what these explain below which modes are
# no rival: they explain all of it in 50 simulations with modes, and 0.65 in one with a lag, creep
# and a force.
_LINES, _NEARLY = 2, 0.8
#: Fraction of the residuals' sum of squares that all modes together explain at least, and their
#: dampings beside those of a viscous material.
ENOUGH = 0.25


@dataclass(frozen=True)
class Line:
    """A secondary mode that the residuals show."""

    ratio: float  #: of its frequency to that of the first mode
    damping: float  #: damping ratio
    share: float  #: of the static stretch
    explained: float  #: fraction of the residuals' sum of squares, 0 to 1


def highest_ratio(recording: Measurement, own: float) -> float:
    """Return the highest ratio, to a frequency in Hz, that samples resolve."""
    return min(1.0 / (_RESOLVED * recording.gap * own), _MOST_RATIO)


def lines_of(fit: Fit, own: float, most: int) -> list[Line]:
    """
    Return the secondary modes in the residuals of a fit, the strongest first.

    Parameters
    ----------
    fit : Fit
        A fit of the first mode, or of several.
    own : float
        Frequency of the first mode about rest in Hz.
    most : int
        Maximum number of lines.

    """
    highest = highest_ratio(fit.recording, own)
    if highest <= LEAST_RATIO * _SPACING:
        return []
    residual = fit.root * fit.residual
    base = fit.root[:, None] * np.hstack([fit.response.jacobian, fit.response.by_switch])
    left = _without(base, residual)
    total = float(left @ left)
    if total == 0.0:
        return []
    response = _ModalResponse.of(fit, own)
    ratios = np.exp(np.arange(
        math.log(LEAST_RATIO), math.log(highest), math.log(_SPACING), dtype=np.float64))
    grid = np.array([(x, y) for y in _DAMPINGS for x in ratios.tolist()])
    # A thinned copy for the search.
    thin = slice(None, None, max(len(residual) // _MOST_SAMPLES, 1))
    table = response.columns(grid, thin)
    lines = list[Line]()
    for _ in range(most):
        start = grid[int(np.argmax(_scores(base[thin], table, residual[thin])))]
        ratio, damping = _refined(response, base[thin], residual[thin], thin, start, highest)
        column = response.columns(np.array([(ratio, damping)]))
        direction = _without(base, column)[:, 0]
        norm = float(direction @ direction)
        size = float(direction @ residual) / max(norm, 1e-300)
        part = size ** 2 * norm
        rest = max(float(left @ left) - part, 1e-300)
        if part < _FEEBLE * float(left @ left) or part * len(left) < _DEVIATIONS ** 2 * rest:
            break
        lines.append(Line(ratio, damping, size, part / total))
        base = np.hstack([base, column])
        left = _without(base, residual)
    return lines


def _without(base: Array, of: Array) -> Array:
    """Return columns without what the base explains."""
    scale = np.maximum(np.linalg.norm(base, axis=0), 1e-300)
    base = base / scale
    gram = base.T @ base
    solved = np.linalg.inv(gram + 1e-12 * np.trace(gram) * np.eye(len(gram)))
    found = of
    for _ in range(2):
        found = found - base @ (solved @ (base.T @ found))
    return found


def _scores(base: Array, columns: Array, residual: Array) -> Array:
    """Return the sums of squares that columns explain beyond the base."""
    directions = _without(base, columns)
    norms = np.linalg.norm(directions, axis=0)
    found: Array = np.where(
        norms > 1e-4 * np.linalg.norm(columns, axis=0),
        (directions.T @ residual) / np.maximum(norms, 1e-300), 0.0) ** 2
    return found


def _refined(
        response: '_ModalResponse', base: Array, residual: Array, thin: slice, start: Array,
        highest: float) -> tuple[float, float]:
    """Return ratio and damping of the best line near a start."""
    ratio, damping = start.tolist()
    width, deep = math.log(_SPACING), 1.0
    for _ in range(_REFINED):
        grid = np.array([
            (min(max(ratio * math.exp(width * x), LEAST_RATIO), highest),
             min(max(damping * math.exp(deep * y), _DAMPED[0]), _DAMPED[1]))
            for x in _STEPS for y in _STEPS])
        score = _scores(base, response.columns(grid, thin), residual)
        ratio, damping = grid[int(np.argmax(score))].tolist()
        width, deep = _SHRINK * width, _SHRINK * deep
    return ratio, damping


@dataclass(frozen=True, eq=False)
class _ModalResponse:
    """The field of a recording in steps, and what the first mode does."""

    time: Array  # of the motion that a sample shows, shape (n,)
    first: Array  # stretch of the first mode, shape (n,)
    weight: Array  # of each sample, times the gain of the sensor, shape (n,)
    begins: Array  # shape (m,), in s
    rests: Array  # shape (m,)
    frequencies: Array  # natural frequency of the first mode about each rest in 1/s, shape (m,)

    @classmethod
    def of(cls, fit: Fit, own: float) -> '_ModalResponse':
        """Return the field and the first mode of a fit."""
        recording, values = fit.recording, fit.values
        setup = ResponseArguments.of(values, ())
        times = recording.time - values['sensor_latency']
        begin = float(min(recording.time[0], times[0]))
        if recording.at_rest:
            begin = min(begin, float(recording.level_times[0]))
        begins, levels, slopes = pieces(
            recording.level_times, recording.levels, recording.slew_limit, begin)
        lag = values['coil_time_constant']
        if lag > 0.0 or np.any(slopes):
            begins, levels = _stepped(begins, levels, slopes, lag, float(times[-1]), own)
        fields, which = np.unique(levels, return_inverse=True)
        sparse = fields if len(fields) < 100 else np.linspace(fields[0], fields[-1], 100)
        nothing: Array = np.empty(0)
        held = np.array([derivatives.rest(
            setup.theta, setup.material, float(x), setup.wanted, nothing) for x in sparse])
        pace = math.sqrt(float(setup.theta[derivatives.STIFFNESS])) * np.array([
            motion.natural_frequency(float(x), setup.material) for x in held])
        if sparse is not fields:
            held, pace = (np.interp(fields, sparse, x) for x in (held, pace))
        gain = values['stretch_gain']
        return cls(
            times, (fit.response.stretch - values['stretch_bias']) / gain, fit.root * gain,
            begins, held[which], pace[which])

    def columns(self, grid: Array, part: slice = slice(None)) -> Array:
        """
        Return the change of samples by the share of modes, shape (n, g).

        ``grid`` has their frequency ratios and damping ratios, shape (g, 2).
        """
        time = self.time[part]
        places_of = np.searchsorted(self.begins, time, side='right').clip(1) - 1
        edges = np.searchsorted(places_of, np.arange(len(self.begins) + 1))
        found = np.empty((len(time), len(grid)))
        apart: Array = np.zeros(len(grid))  # from rest
        speed: Array = np.zeros(len(grid))
        for i, begin in enumerate(self.begins.tolist()):
            decay = grid[:, 1] * grid[:, 0] * self.frequencies[i]
            pace = grid[:, 0] * self.frequencies[i] * np.sqrt(1.0 - grid[:, 1] ** 2)
            sine = (speed + decay * apart) / pace
            here = slice(edges[i], edges[i + 1])
            since = time[here, None] - begin
            found[here] = self.rests[i] + np.exp(-decay * np.maximum(since, 0.0)) * (
                apart * np.cos(pace * since) + sine * np.sin(pace * since))
            if i + 1 < len(self.begins):
                span = self.begins[i + 1] - begin
                fade, cosine, sines = (
                    np.exp(-decay * span), np.cos(pace * span), np.sin(pace * span))
                after = fade * (apart * cosine + sine * sines)
                speed = fade * (pace * (sine * cosine - apart * sines)) - decay * after
                apart = after + self.rests[i] - self.rests[i + 1]
        return self.weight[part, None] * (found - self.first[part, None])


def _stepped(
        begins: Array, levels: Array, slopes: Array, lag: float, end: float, own: float
) -> tuple[Array, Array]:
    """Return a field that ramps or lags as one in short steps."""
    step = 1.0 / (_PIECES * own)
    count = max(int((end - begins[0]) / step), 1)
    edges: Array = begins[0] + step * np.arange(count)
    middle = edges + 0.5 * step
    place = np.searchsorted(begins, middle, side='right') - 1
    ahead = levels[place] + slopes[place] * (middle - begins[place])
    if lag > 0.0:
        kept, field = math.exp(-step / lag), float(levels[0])
        for i, level in enumerate(ahead.tolist()):
            field = level + (field - level) * kept
            ahead[i] = field
    # A lag has faded long before the next level.
    moved = np.append(True, np.diff(np.round(ahead / (_FADED * np.ptp(ahead) or 1.0))) != 0.0)
    return edges[moved], ahead[moved]


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


def begun(one: Fit, start: Mapping[str, Any], free: Sequence[str]) -> Fit:
    """Return a fit of the first mode to begin with, from values, or else the one that is there."""
    return fit(one.recording, start, free, most=_FIRST) or one


def with_modes(
        best: Fit, free: Sequence[str], limit: float, given: Sequence[Sequence[float]] = (),
        most: int = len(SECONDARY), *, viscous: bool = False) -> Fit:
    """
    Return the best fit with secondary modes, from one of the first mode alone.

    Without a mode that explains residuals, the fit has none.

    Parameters
    ----------
    best : Fit
        The fit of the first mode at which to begin; see `begun`.
    free : sequence of str
        What is free besides modes.
    limit : float
        Given J_lim. Beside modes that are not known yet, a recording does not determine it.
    given : sequence of sequence of float
        Numbers of modes to try first, as `Modes.numbers`.
    most : int
        Maximum number of modes.
    viscous : bool
        Whether their damping ratios are those of a viscous material, as long as they leave more
        than noise with dampings of their own.

    Returns
    -------
    Fit
        For a block, it may also free how frequency and damping change with the stretch.

    """
    recording, own = best.recording, frequency_of(best)
    highest, lowest = highest_ratio(recording, own), _lowest(best.values)
    wide, values = _widened(best, free, limit)
    damping = _damping_ratio(values)
    for i, names in enumerate(SECONDARY[:most]):
        begins = [(x.ratio, x.damping) for x in lines_of(best, own, 2)]
        begins += [(x, min(max(damping, _LEAST_DAMPING) * x, _MOST_DAMPING)) for x in _STARTS]
        rows = [
            *given[i:i + 1], *((x, _SHARE, y) for x, y in begins if lowest < x < highest)]
        if viscous:
            rows = [(*x[:2], max(damping, _DAMPED[0]) * x[0], *x[3:]) for x in rows]
        wanted = (*wide, *names[:2 if viscous else 3])
        trials = [y for x in rows if (y := fit(
            recording, {**values, **dict(zip(names, x, strict=False))}, wanted,
            most=_FEW)) is not None and _apart(y)]
        if not trials:
            break
        found = min(trials, key=lambda x: loss(x.residual, best.scale))
        found = fit(recording, found.values, wanted, most=_FULL) or found
        found = _viscous(found) if viscous else found
        if not (_apart(found) and _better(best, found, _PART_VISCOUS if viscous else _PART)):
            break
        best, wide, values = found, found.free, found.values
        freed = fit(recording, values, (*wide, *(x[2] for x in SECONDARY[:i + 1])),
                    most=_FULL) if viscous else None
        if freed is not None and _apart(freed) and whiteness(
                freed.root * freed.residual).white:
            # Modes with dampings of their own explain all but noise; so may further ones.
            best, wide, values, viscous = freed, freed.free, freed.values, False
    return _completed(best, free) if quantities.modes_of(best.values) else best


def _widened(
        best: Fit, free: Sequence[str], limit: float) -> tuple[tuple[str, ...], dict[str, Any]]:
    """Return what to free besides modes, and the values at which to begin."""
    wide, values = tuple(free), dict(best.values)
    if values['law'] is None or not values['law'].section:
        wide = tuple(dict.fromkeys((*(x for x in free if x != 'chain_limit'), *BESIDES)))
        values |= {x: begin for x, (usual, begin) in BESIDES.items() if values[x] == usual}
        if 'chain_limit' in free:
            values['chain_limit'] = min(limit, _LOOSE)
    return wide, values


def as_computed(
        best: Fit, first: Fit, free: Sequence[str], limit: float, given: Modes) -> Fit | None:
    """
    Return a fit with the computed modes of a block; None if it leaves far more than the best one.

    How their ratios and shares change with the stretch is that of the parameter file or of a block
    that is free or glued, whichever is nearest; shares are free, and ratios of strong modes. Of
    fitted modes that leave more than noise, several stand for one that changes, or one for many
    weak ones, and plans that bring these to rest leave more (benchmarks continuum). ``first`` is
    the fit of the first mode at which to begin, and other arguments are those of `with_modes`.
    """
    values = best.values
    shape = values['half_thickness'] / values['half_length']
    if (values['law'] is not None or not SHAPES[0] <= shape <= SHAPES[1]
            or whiteness(best.root * best.residual).white):
        return None
    wide, values = _widened(first, free, limit)
    damping = max(_damping_ratio(values), _DAMPED[0])
    blocks = [mounted(shape, x, values['chain_limit'], damping, values['bulk_ratio'])
              for x in ('free', 'glued')]
    begins = [{
        'transverse_mass_factor': x.transverse_mass_factor,
        'transverse_mass_exponent': x.transverse_mass_exponent,
        **quantities.values_of_modes(x.modes)} for x in blocks]
    begins += [quantities.values_of_modes(given)] if given.ratios else []
    kept = [x for x in wide if x != 'transverse_mass_factor']
    alike = [y for x in begins if (
        y := fit(first.recording, {**values, **x}, kept, most=_FULL)) is not None]
    if not alike:
        return None
    values = min(alike, key=lambda x: loss(x.residual, best.scale)).values
    modes = quantities.modes_of(values)
    found = fit(first.recording, values, (*wide, *(x[1] for x in modes)), most=_FULL)
    if found is None:
        return None
    # A recording shows where a mode is only if it is strong and rings.
    strong = [x[0] for x in modes
              if found.values[x[1]] > _STRONG and found.values[x[2]] < BROAD]
    found = fit(first.recording, found.values, (*found.free, *strong), most=_FULL) or found
    found = _completed(_viscous(found), free)
    return found if possible(found) and (
        unexplained(found) < _ALIKE * unexplained(best)) else None


def narrower(
        first: Fit, free: Sequence[str], limit: float, given: Sequence[Sequence[float]]) -> Fit:
    """
    Return a fit with modes, in which none stands for several if the recording allows it.

    Several modes of a continuum that lose step look like one of more damping, but keep their
    vibration: plans that count on its decay leave several times as much (benchmarks continuum).
    Where modes leave more than noise, those with the damping of a viscous material are better,
    unless they leave clearly more. Arguments are those of `with_modes`.
    """
    narrow = with_modes(first, free, limit, given, viscous=True)
    modes, freed = quantities.modes_of(narrow.values), None
    if modes and whiteness(narrow.root * narrow.residual).white:
        return narrow
    if modes and unexplained(narrow) < DISTANT:
        freed = fit(
            narrow.recording, narrow.values, (*narrow.free, *(x[2] for x in modes)),
            most=_FULL)
        if freed is not None and _gain(narrow, freed)[1] < ENOUGH:
            return narrow
    best = with_modes(first, free, limit, given)
    found = whiteness(best.root * best.residual)
    if not modes or found.white or distant(best, found):
        return best
    # With dampings of their own from the start, two modes may oppose each other.
    return next((x for x in (narrow, freed) if x is not None and _apart(x) and _gain(
        x, best)[1] < ENOUGH), best)


def _viscous(found: Fit) -> Fit:
    """Return a fit whose damping ratios grow with the frequency, as by a viscous stress."""
    for _ in range(_REPEATS):
        values, damping = found.values, max(_damping_ratio(found.values), _DAMPED[0])
        fast = math.inf if quantities.of_beam(values) else _FAST
        dampings = {
            x[2]: min(damping * values[x[0]], BROAD)
            if values[x[0]] < fast and values[x[2]] < BROAD else BROAD
            for x in quantities.modes_of(values)}
        found = fit(found.recording, {**values, **dampings}, found.free, most=_FULL) or found
    return found


def _completed(best: Fit, free: Sequence[str]) -> Fit:
    """Return a fit in which J_lim is free, too, and of `BESIDES` what matters."""
    recording = best.recording
    if 'chain_limit' in free and 'chain_limit' not in best.free:
        found = fit(recording, best.values, (*best.free, 'chain_limit'), most=_FULL)
        if found is not None and possible(found):
            best = found
    for name in [x for x in BESIDES if x in best.free and x not in free]:
        values = {**best.values, name: BESIDES[name][0]}
        less = fit(recording, values, tuple(x for x in best.free if x != name), most=_FULL)
        if less is not None and possible(less) and _gain(less, best)[0] < _CHI_SQUARED:
            best = less
    return best if best.converged else fit(recording, best.values, best.free) or best


def _damping_ratio(values: Mapping[str, Any]) -> float:
    """Return the damping ratio of the first mode about rest."""
    group = quantities.group_of(values)
    return float(values['damping_coefficient'] / quantities.damping_unit(values) / float(
        equations.critical_zeta(group.rest, group)))


def _lowest(values: Mapping[str, Any]) -> float:
    """Return the lowest possible ratio of a secondary mode."""
    return _OF_BEAMS if quantities.of_beam(values) else 1.0


def possible(found: Fit) -> bool:
    """Return whether the modes of a fit are those of an actuator."""
    values = found.values
    return all(x > max(_lowest(values), _NEAR_FIRST) for x in _ratios(values)) and sum(
        abs(values[x[1]]) for x in quantities.modes_of(values)) < _WHOLE


def _apart(found: Fit) -> bool:
    """Return whether the modes of a fit are also too far apart to be one that changes."""
    return possible(found) and all(y > _NEAR * x for x, y in pairwise(_ratios(found.values)))


def _ratios(values: Mapping[str, Any]) -> list[float]:
    """Return the frequency ratios of all modes but broad ones, in order."""
    return sorted(values[x[0]] for x in quantities.modes_of(values) if values[x[2]] < BROAD)


def _gain(before: Fit, after: Fit) -> tuple[float, float]:
    """Return by how much chi-squared improves, and the fraction by which the loss does."""
    scale = min(before.scale, after.scale)
    one, two = (loss(x.residual, scale) for x in (before, after))
    return 2.0 * (one - two), 1.0 - two / max(one, 1e-300)


def _close(found: Fit) -> bool:
    """Return whether a mode is as close to the first as what changes with the stretch."""
    return any(found.values[x[0]] < _NEAR for x in quantities.modes_of(found.values))


def _better(before: Fit, after: Fit, least: float) -> bool:
    """Return whether a fit explains more than one with fewer parameters by chance does."""
    chi_squared, part = _gain(before, after)
    if _close(after) and not _close(before):
        # On finite elements, one that explained 6 % was none, and one of a glued block, 57 %.
        least = max(least, ENOUGH)
    return chi_squared > _CHI_SQUARED and (
        part > least or whiteness(after.root * after.residual).white)


def explained(one: Fit, found: Fit) -> float:
    """Return the fraction of the residuals' sum of squares that modes explain."""
    before, after = (float(np.sum(x.residual ** 2 * (x.weights > 0.0))) for x in (one, found))
    return 1.0 - after / before if before > 0.0 else 0.0


def contested(one: Fit, best: Fit) -> bool:
    """
    Return whether modes may explain nearly what parameters do that the fit of the first lacks.

    Short fits tell, which begin with the strongest lines in its residuals.
    """
    values, free = dict(one.values), one.free
    for names, line in zip(SECONDARY, lines_of(one, frequency_of(one), _LINES), strict=False):
        free = (*free, *names[:3])
        values |= dict(zip(names, (line.ratio, line.share, line.damping), strict=False))
        found = fit(one.recording, values, free, most=_FEW)
        if found is not None and explained(one, found) > _NEARLY * explained(one, best):
            return True
    return False


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
