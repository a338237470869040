"""
Whether data determine the parameters, and whether the model fits the data.

An incomplete model leaves the same residuals after equal changes of level, unlike noise. Noise
after each change has either sign with equal probability, jointly for all samples, whatever its
correlation: the p-value is the probability that random signs of whole repeats agree as well as
the residuals do.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
import math

import numpy as np

from hmsa.columns import remedy
from hmsa.errors import BadInputError
from hmsa.identification import quantities
from hmsa.identification.defects import GAIN, USUAL_GAIN
from hmsa.identification.fit import autocorrelation, Fit, Whiteness, whiteness
from hmsa.identification.initial_guess import segments
from hmsa.identification.measurement import Measurement
from hmsa.identification.result import Defect
from hmsa.model import equations
from hmsa.model.equations import Array

# Numbers of random draws: first, and if the p-value is not clearly above a limit.
_DRAWS, _CLEAR = (199, 3999), 0.04
_MOST = 48  # maximum number of repeats of one change; beyond it several share a sign
_FEWEST = 4  # samples on a level
# Fractions of the time on a level to test, and the last part that determines its mean.
_WINDOWS, _REST = (0.125, 0.25, 0.5, 1.0), 2.0 / 3.0
_FINEST = 12.0  # time bins per period
# Maximum standard deviation of a determined coordinate: for positive values a quarter.
_RELATIVE = 0.25
# Limiting stretch above which stiffening hardly shows, and minimum stress relative to the modulus.
_LOOSE, _SMALL_STRESS = 10.0, 0.02
# Minimum component of a direction, relative to the largest, to report it.
_NAMED = 0.2
# Ratio of residuals in motion to those at rest above which they are due to the model.
_IN_MOTION = 2.0
_FEWEST_PARTS = 8
_OUT = 0.5  # weight below which a sample is an outlier
_SOON = 10  # samples after a change of level
_CHANCE = 2e-3  # probability below which repeating residuals are not due to chance
_FEW_WORDS = 4  # maximum number of frequencies to list
_FIRST_KEPT = ('density', 'chain_limit', 'stretch_gain')  # easiest to know from other sources
_WORTH_SAYING = 0.3  # minimum change of a parameter to report, in standard deviations
_NUMERICAL = 1e-6  # residuals below this are integration errors
# Advice where modes change with the stretch, and for a departure of unknown kind.
_SMALLER = 'record steps half as large'
_LOOK = '; see the figures of --report page.html'
# Deflection of a beam up to which it moves along its elastica: recordings of an exact rod up to
# 0.76 are described, and those to 0.81 look like other departures, which lead to each other.
_FAR = 0.8
# Parameters that determine the frequency.
_TIMED = {'shear_modulus', 'density', 'time_unit'}
DISTANT = 0.1  # residual relative to the motion above which nothing was fitted
# Residual relative to the motion that fits with secondary modes may leave: an actuator has more of
# them, whose shares change with the stretch. Plans of modal then leave less than `_LEFT` of it,
# and at order 3 less than `LEFT_AT_3` (benchmarks continuum). Shaped moves ring less, so that
# their residuals stand for more: on finite elements, plans then left up to 2.9 times as much.
TOLERATED, _LEFT, LEFT_AT_3, _OF_SHAPED = 0.15, 1.7, 0.3, 2.0
# Overshoot below which moves are shaped, as a fraction of the step; and with modes unknown to it.
SHAPED, _ROUGHLY_SHAPED = 0.15, 0.35
# Fraction of these residuals above which another departure explains them.
_MOSTLY = 0.3
# Correlation of position and level below which one of them has the wrong sign.
_OPPOSED = -0.5
# Wide ranges for soft actuators, in SI units, and the power of the time unit in each.
_USUAL = {'shear_modulus': (100.0, 1e8, -2), 'density': (100.0, 2e4, 2),
          'time_unit': (1e-6, 1.0, 1), 'remanence': (3e-4, 3.0, -2)}
_FINER = {'ms': 1e-3, 'us': 1e-6, 'ns': 1e-9}


@dataclass(frozen=True)
class Repeated:
    """Part of the residuals that repeats after equal changes of level."""

    p_value: float  # probability by chance
    size: float  # root mean square over all samples, stretch
    cost: float  # largest peak-to-peak value, relative to the median change of the stretch


def repeated(fit: Fit, period: float, floor: float = 0.0) -> Repeated | None:
    """
    Return the repeating part; None if no change of level repeats.

    The period is that of the motion in s. Values below the floor, an RMS value, are ignored: they
    are due to quantisation.
    """
    found = segments(fit.recording, _FEWEST)
    groups: dict[tuple[float, float], list[tuple[int, int, float]]] = {}
    unit = 1e-6 * max(float(np.max(np.abs(fit.recording.levels))), 1e-12)
    for (*_, before), (begin, end, when, level) in zip(found[:-1], found[1:], strict=True):
        groups.setdefault((round(before / unit), round(level / unit)), []).append(
            (begin, end, when))
    whole = [x for x in groups.values() if len(x) > 1]
    if not whole:
        return None
    residual, shown = fit.root * fit.residual, fit.response.stretch
    width = min(fit.recording.gap, period / _FINEST)
    grams: list[list[Array]] = []
    squares, count, largest, steps = 0.0, 0.0, 0.0, list[float]()
    for group in whole:
        table, seen = _folded(fit.recording.time, residual, group, width)
        size = table.shape[1]
        rest = np.sum(table[:, int(_REST * size):], axis=1, keepdims=True) / np.maximum(
            np.sum(seen[:, int(_REST * size):], axis=1, keepdims=True), 1.0)
        grams.append([_apart(x) for x in (
            *(table[:, :max(int(x * size), 1)] for x in _WINDOWS), rest)])
        mean = float(np.sum(grams[-1][-2])) / max(float(np.sum(_apart(seen))), 1.0)
        squares += mean * float(np.sum(seen))
        count += float(np.sum(seen))
        begin, end, _ = group[0]
        steps.append(abs(float(shown[end - 1] - shown[max(begin - 1, 0)])))
        largest = max(largest, mean)
    rms = math.sqrt(max(squares, 0.0) / max(count, 1.0))
    step = float(np.median(steps))
    return Repeated(
        _chance(grams) if rms > floor else 1.0, rms,
        2.0 * math.sqrt(2.0 * largest) / step if step > 0.0 else 0.0)


def _apart(rows: Array) -> Array:
    """Return the products of each row with every other, and 0 with itself."""
    gram: Array = rows @ rows.T
    np.fill_diagonal(gram, 0.0)
    return gram


def _chance(grams: list[list[Array]]) -> float:
    """Return the probability that random signs of the repeats agree as well in any window."""
    random = np.random.default_rng(0)
    for draws in _DRAWS:
        drawn: Array = np.zeros((draws + 1, len(grams[0])))
        for group in grams:
            signs = np.ones((draws + 1, len(group[0])))
            signs[1:] = random.choice([-1.0, 1.0], (draws, len(group[0])))
            drawn += np.stack([np.sum((signs @ x) * signs, axis=1) for x in group], axis=1)
        spread = np.std(drawn[1:], axis=0)
        scores = np.max((drawn - np.mean(drawn[1:], axis=0)) / np.where(
            spread > 0.0, spread, 1.0), axis=1)
        chance = (1.0 + np.count_nonzero(scores[1:] >= scores[0])) / (draws + 1.0)
        if chance > _CLEAR:
            break
    return chance


def _folded(
        time: Array, residual: Array, group: list[tuple[int, int, float]], width: float
) -> tuple[Array, Array]:
    """Return sums and counts of residuals by repeat and time bin; 0 in empty bins."""
    places = [((time[begin:end] - when) / width).astype(np.int64) for begin, end, when in group]
    size = min(int(x[-1]) for x in places) + 1
    rows = min(len(group), _MOST)
    table, seen = np.zeros((rows, size)), np.zeros((rows, size))
    for i, ((begin, end, _), place) in enumerate(zip(group, places, strict=True)):
        inside = (place >= 0) & (place < size)
        row = i * rows // len(group)
        at = place[inside]
        table[row] += np.bincount(at, residual[begin:end][inside], size)
        seen[row] += np.bincount(at, minlength=size)
    return table, seen


def allowed(fit: Fit) -> Array:
    """Return the standard deviation of each free coordinate above which it is undetermined."""
    values = fit.values
    unit = values['time_unit']
    load = quantities.geometry_of(values).loaded * values['shear_modulus']
    limits = {
        'chain_limit': _RELATIVE / min(values['chain_limit'], 1e3),
        'damping_coefficient': _RELATIVE * max(
            values['damping_coefficient'], 0.05 * quantities.damping_unit(values)),
        'stretch_bias': 0.05, 'stretch_gain': 0.1, 'sensor_latency': 0.5 * unit,
        'coil_time_constant': max(_RELATIVE * values['coil_time_constant'], 0.1 * unit),
        # Between stretches of 0.9 and 1.1 it changes the damping by a fifth.
        'damping_exponent': 1.0,
        # That of a cube changes its frequency by 2 %.
        'transverse_mass_factor': 0.5,
        'constant_force': 0.1 * load, 'initial_stretch': 0.05, 'initial_rate': 0.5 / unit,
        # The share of a mode shows more of it than its damping does.
        **{x[2]: 0.5 for x in quantities.SECONDARY},
        **{x: y for pair in quantities.BRANCHES for x, y in zip(pair, (0.05, 0.5), strict=True)}}
    return np.array([limits.get(x, _of_law(fit, x)) for x in fit.free])


def _of_law(fit: Fit, name: str) -> float:
    """Return that limit for a constant of the model, and for all logarithmic coordinates."""
    quantity, value = quantities.quantity_of(name), float(fit.values[name])
    if quantity.scale == 'log':
        return _RELATIVE
    if quantity.scale == 'inverse':
        return _RELATIVE / min(value, _LOOSE)
    least = _SMALL_STRESS * float(fit.values['shear_modulus']) if quantity.unit == 'Pa' else 1.0
    return _RELATIVE * max(abs(value), least)


def weakness(fit: Fit, deviation: float, factors: Array) -> tuple[set[str], str]:
    """
    Return undetermined parameters, the reason and what to record; empty if all are determined.

    ``deviation`` is that of a sample; ``factors``, due to correlation, multiply those of the
    parameters.
    """
    limits = allowed(fit)
    scaled = limits / np.maximum(factors, 1.0) / deviation
    matrix = fit.information * np.outer(scaled, scaled)
    size, directions = np.linalg.eigh(matrix)
    size = np.maximum(size, 1e-13 * max(float(size[-1]), 1e-300))
    variances = (directions ** 2) @ (1.0 / size)
    names = [x for x, y in zip(fit.free, variances, strict=True) if y > 1.0]
    if not names:
        return set(), ''
    sentences = []
    for i in np.flatnonzero(size < 1.0 * len(limits)):
        parts = directions[:, i] * limits
        relative = np.abs(directions[:, i])
        chosen = [j for j in np.argsort(-relative) if relative[j] >= _NAMED * np.max(relative)]
        if not set(names).intersection(fit.free[j] for j in chosen):
            continue
        if len(chosen) == 1:
            sentences.append(f'{fit.free[chosen[0]]} hardly changes the recorded motion')
        else:
            share = 0.1 / _RELATIVE / max(relative[chosen[0]], 1e-12)
            words = ', '.join(
                _change(fit, j, parts[j] * share, parts[chosen[0]]) for j in chosen)
            sentences.append(
                f'{_listed([fit.free[j] for j in chosen])} are determined only in combination: '
                f'{words} at the same time leaves the recorded motion unchanged within the '
                'noise')
    advice = list(dict.fromkeys(
        quantities.quantity_of(x).advice for x in names if quantities.quantity_of(x).advice))
    if {'shear_modulus', 'density', 'remanence'} <= set(fit.free) or (
            {'shear_modulus', 'time_unit', 'remanence'} <= set(fit.free)):
        advice = [quantities.QUANTITIES['density'].advice]
    kept = next((x for x in _FIRST_KEPT if x in names), names[0])
    listed = '; '.join(sentences) or 'the recorded motion hardly depends on them'
    keep = (
        f'keep what is known, as with --free=-{kept} or --known {kept}=VALUE+-STD'
        if kept in quantities.DEFAULT_FREE else
        f'leave {kept} out, as with {freeing(fit, [kept])}')
    instead = _SMALLER if modal(fit) and not whiteness(fit.root * fit.residual).white else (
        f'{"; or ".join(advice[:3])}; or {keep}')
    return set(names), (
        f'{_listed(names)} cannot be identified from this recording: {listed}. Instead, {instead}')


def _change(fit: Fit, place: int, change: float, first: float) -> str:
    """Describe the change of a parameter along a direction in which the first one increases."""
    name = fit.free[place]
    change = math.copysign(1.0, first) * change
    kind = quantities.quantity_of(name).scale
    if kind == 'linear':
        value = fit.values[name]
        if name == 'damping_coefficient' and value > 0.0:
            return f'{name} {100.0 * change / value:+.3g} %'
        unit = quantities.quantity_of(name).unit
        return f'{name} {change:+.3g}{" " + unit if unit else ""}'
    if kind == 'inverse':
        change = -change * fit.values[name]
    return f'{name} {100.0 * change:+.3g} %'


def freeing(fit: Fit, without: Collection[str]) -> str:
    """Return the option to free the parameters of a fit, except some."""
    # The initial state is freed automatically.
    kept = [x for x in fit.free if x not in without and not x.startswith('initial_')]
    return f'--free {",".join(kept or quantities.DEFAULT_FREE[3:])}'


def _listed(names: Sequence[str]) -> str:
    return names[0] if len(names) == 1 else f'{", ".join(names[:-1])} and {names[-1]}'


def second_mode(fit: Fit) -> list[Defect]:
    """Search for a single sharp frequency in the residuals of evenly spaced samples."""
    time = fit.recording.time
    gaps = np.diff(time)
    if np.max(gaps) > 1.5 * np.min(gaps):
        return []
    power = np.abs(np.fft.rfft(fit.residual * fit.weights)) ** 2
    power = power[3:]
    if len(power) < 32 or not np.any(power):
        return []
    place = int(np.argmax(power))
    near = power[max(place - 2, 0):place + 3]
    share = float(np.sum(near) / np.sum(power))
    # Fisher's g: the probability of the largest of m exponential fractions.
    chance = len(power) * math.exp(-len(power) * float(power[place]) / float(np.sum(power)))
    frequency = (place + 3) / (float(np.mean(np.diff(time))) * len(time))
    own = frequency_of(fit)
    apart = not 0.5 < frequency / own < 2.0
    return [Defect(
        f'a second mode at {frequency:.4g} Hz', share,
        math.sqrt(max(-2.0 * math.log(max(chance, 1e-300)), 0.0)),
        bool(share > 0.3 and chance < 1e-6 and apart and frequency > own))]


def frequency_of(fit: Fit) -> float:
    """Return the natural frequency in Hz about rest."""
    group = quantities.group_of(fit.values)
    return float(equations.natural_frequency(group.rest, group) / (
        2.0 * math.pi * fit.values['time_unit']))


def in_motion(fit: Fit) -> float:
    """Return the ratio of residuals in motion to those at rest; 1 if undetermined."""
    speed = np.abs(fit.response.rate)
    order = np.argsort(speed)
    part = len(order) // 4
    if part < _FEWEST_PARTS:
        return 1.0
    slow, fast = (np.sqrt(np.mean((fit.root * fit.residual)[x] ** 2))
                  for x in (order[:part], order[-part:]))
    return float(fast / slow) if slow > 0.0 else 1.0


def mistaken(fit: Fit, chance: float = 0.02) -> bool:
    """
    Return whether the outliers are motion, as they lie right after the changes of level.

    A fit only to the levels at rest may take the few samples in motion for outliers. True outliers
    lie there with at most the given probability.
    """
    # Slow to import, and not needed by a planner that estimates.
    from scipy.special import bdtrc

    out, recording = fit.weights < _OUT, fit.recording
    changes = recording.changes
    if not np.any(out) or not len(changes):
        return False
    place = np.searchsorted(recording.time, changes)
    last = np.searchsorted(changes, recording.time, side='right') - 1
    # At low sampling rates use at most a third of the samples on a level.
    soon = min(_SOON, max(len(out) // (3 * len(changes)), 1))
    after = (last >= 0) & (np.arange(len(out)) - place[last] < soon)
    usual = float(np.mean(after))
    return float(np.mean(after[out])) > usual + 0.4 * (1.0 - usual) and bool(bdtrc(
        np.count_nonzero(after & out) - 1, np.count_nonzero(out), usual) < chance)


def modal(fit: Fit) -> bool:
    """Return whether secondary modes were fitted."""
    return any(set(x) & set(fit.free) for x in quantities.SECONDARY)


def unexplained(fit: Fit) -> float:
    """Return the residuals relative to the motion, both rms."""
    return float(np.sqrt(np.mean((fit.residual[fit.weights > 0.0]) ** 2))) / max(
        float(np.std(fit.recording.stretch)), 1e-300)


def distant(fit: Fit, found: Whiteness) -> bool:
    """Return whether the fit fails to reproduce the motion."""
    if modal(fit):
        return not found.white and unexplained(fit) > TOLERATED
    return not found.white and fit.scale > DISTANT * float(np.std(fit.recording.stretch)) and abs(
        float(found.autocorrelation[1])) > 0.2


def implausible(fit: Fit, found: Whiteness, unknown: Collection[str]) -> str:
    """
    Return which value no actuator has; empty if there is none.

    Raise `BadInputError` if the data are in other units: the model then leaves only noise, or
    usual units make the value that of an actuator.
    """
    recording = fit.recording
    modulus, ratio = quantities.modulus_of(fit.values.get('law'))
    for name, (least, most, power) in _USUAL.items():
        value, label = fit.values[name], name
        if name == 'shear_modulus':
            value, label = ratio * value, modulus
        if name not in fit.free or name in unknown or least <= value <= most:
            continue
        hint = next((
            f'; if all times are in {x}, {remedy("time", x, recording.from_csv)}'
            for x, y in _FINER.items() if least <= value * y ** power <= most), '')
        if not hint and name == 'remanence' and least <= 1e3 * value <= most:
            hint = '; if flux densities are in mT, ' + remedy(
                'flux_density', 'mT', recording.from_csv)
        unit = quantities.QUANTITIES[name].unit
        words = (
            f'the motion in {recording.label} corresponds to a {label} of {value:.3g} {unit}, '
            f'with samples {recording.gap:.3g} s apart: expected {least:g} to '
            f'{most:g} {unit}; check that times are in s, flux densities in T, and the size of '
            f'the actuator in its parameter file{hint}')
        if hint or found.white:
            raise BadInputError(words)
        return words
    return ''


def _opposed(recording: Measurement) -> str:
    """Return what to do if the position falls where the level rises; empty if it does not."""
    levels = recording.levels[recording.place(recording.time)]
    if np.ptp(levels) == 0.0 or np.corrcoef(levels, recording.stretch)[0, 1] > _OPPOSED:
        return ''
    return (
        f'; the {recording.coordinate.name} falls where the flux density rises: change the sign '
        'of the levels, or the direction in which the sensor counts')


def misfit(
        fit: Fit, found: Whiteness, marks: Sequence[Defect], alike: Repeated | None) -> str:
    """Return why the model is rejected, with numbers; empty if it is not."""
    motion = float(np.std(fit.recording.stretch))
    tolerant = modal(fit)
    seen = [x for x in marks if x.found and not (tolerant and x.share < _MOSTLY)]
    figures = (
        f'residuals of {fit.scale:.3g} with an autocorrelation of '
        f'{float(autocorrelation(fit.residual * fit.root)[1]):.2f} from one sample '
        f'to the next (white with a probability of {found.p_value:.2g})')
    if distant(fit, found) and not any(x.remedy == quantities.MODES for x in seen):
        if quantities.modes_of(fit.values) and not _remedy(seen):
            name, most = fit.recording.coordinate.name, TOLERATED if tolerant else DISTANT
            return (
                f'secondary modes leave {unexplained(fit):.1%} of the recorded motion, more than '
                f'{most:.0%}: those of a continuum change with the {name}; {_SMALLER}, and if '
                'they leave as much, check units, clock and --params-file')
        return (
            f'the model cannot reproduce the recorded motion: {figures}, against a motion of '
            f'{motion:.3g} rms; check that times are in s and levels in tesla, of one clock and '
            'one run, and that --params-file describes the actuator'
            f'{_opposed(fit.recording) or _advice(fit, seen)}')
    if fit.scale < _NUMERICAL:
        return ''
    if seen:
        words = '; '.join(
            f'{x.name} ({x.share:.0%} of them, {x.deviations:.0f} standard deviations)'
            for x in seen[:3])
        return f'the model leaves {figures}, which look like {words}{_advice(fit, seen)}'
    if tolerant:
        return ''
    lost = int(np.count_nonzero(fit.weights < _OUT))
    if lost > 1 and mistaken(fit):
        return (
            f'{lost} samples right after changes of level are not those of the model, which '
            f'leaves {figures} elsewhere: the model does not describe the motion; check the '
            f'times of the levels, and record more samples in motion{_advice(fit)}')
    if alike is not None:
        return '' if alike.p_value > _CHANCE else (
            f'the model leaves {figures}, and {alike.size:.2g} of them rms, after equal changes '
            f'of level the same (by chance with a probability of {alike.p_value:.2g}): an effect '
            f'is missing from the model{_advice(fit)}')
    ratio = in_motion(fit)
    if not found.white and ratio > _IN_MOTION and fit.recording.quantum == 0.0 and (
            abs(float(found.autocorrelation[1])) > 0.3):
        return (
            f'the model leaves {figures}, {ratio:.1f} times as large in fast motion as in '
            f'slow: a motion is missing from the model{_advice(fit)}')
    return ''


def _advice(fit: Fit, seen: Sequence[Defect] = ()) -> str:
    """Return what to record or to free."""
    farthest = float(np.max(np.abs(fit.recording.stretch)))
    if quantities.of_beam(fit.values) and farthest > _FAR:
        return (
            f'; the beam swings to a deflection of {farthest:.2g}, and beyond {_FAR:g} it leaves '
            f'its elastica: {_SMALLER}')
    return _remedy(seen) or _LOOK


def _remedy(seen: Sequence[Defect]) -> str:
    """Return which parameters to free for departures nearly as large as the first."""
    names = dict.fromkeys(
        x.remedy for x in seen if x.remedy and x.share > 0.8 * seen[0].share)
    lines = ' or '.join(f'--free +{x.replace(",", ",+")}' for x in names)
    return f'; try {lines}' if lines else ''


def cost(fit: Fit, marks: Sequence[Defect], alike: Repeated | None) -> float:
    """Return the peak-to-peak error of the model, relative to a step."""
    if modal(fit):
        shaped = float(np.median(overshoots(fit) or [1.0])) < _ROUGHLY_SHAPED
        return (_OF_SHAPED if shaped else 1.0) * _LEFT * unexplained(fit)
    share = max((x.share for x in marks if x.found), default=0.0)
    ends = [float(fit.response.stretch[end - 1]) for _, end, _, _ in segments(fit.recording, 1)]
    steps = np.abs(np.diff(ends))
    step = float(np.median(steps[steps > 0.0])) if np.any(steps > 0.0) else 1.0
    rms = float(np.sqrt(np.mean((fit.root * fit.residual) ** 2)))
    repeats = alike.cost if alike is not None and alike.p_value <= _CHANCE else 0.0
    return max(2.0 * math.sqrt(2.0 * share) * rms / step, repeats)


def overshoots(fit: Fit) -> list[float]:
    """Return by how much each motion overshoots its final stretch, as a fraction of the step."""
    fitted, before = fit.response.stretch, None
    past = []
    for begin, end, _, _ in segments(fit.recording, 6):
        rest = float(fitted[end - 1])
        before = float(fitted[begin]) if before is None else before
        if abs(rest - before) > 0.01:
            past.append(float(np.max((fitted[begin:end] - rest) / (rest - before))))
        before = rest
    return past


def considered(
        moves: Mapping[str, Array], std: Array, free: Sequence[str], given: Collection[str]
) -> list[str]:
    """
    Return undetectable errors that the intervals account for, one sentence each.

    ``moves`` contains the changes of the coordinates by description of the error; ``std`` are the
    standard deviations of the coordinates, and ``given`` the names known to the caller.
    """
    found = []
    for name, way in moves.items():
        # Undetermined coordinates have no standard deviation.
        ratio = np.divide(np.abs(way), std, out=np.zeros(len(std)), where=np.isfinite(std))
        place = int(np.argmax(ratio))
        if ratio[place] > _WORTH_SAYING:
            found.append(
                f'an error of {name} does not show in this recording: the intervals allow for '
                f'one standard deviation of it, which moves {free[place]} by '
                f'{ratio[place]:.3g} of its standard deviations' + (
                    f'; {100.0 * USUAL_GAIN:g} % is assumed: calibrate the sensor, and give '
                    f'--known {name}=1+-0.1%' if name == GAIN and name not in given else ''))
    return found


def undetected(late: tuple[float, Array], std: Array, fit: Fit) -> list[str]:
    """
    Return the effect of an undetectable latency, if it exceeds a standard deviation.

    ``late`` contains the latency in s and the changes of the coordinates; ``std`` are their
    standard deviations.
    """
    seconds, moves = late
    modulus, ratio = quantities.modulus_of(fit.values.get('law'))
    words = []
    for name, move, one in zip(fit.free, moves.tolist(), std.tolist(), strict=True):
        if abs(move) > one:
            size = abs(move * quantities.derivative(name, fit.values[name]))
            label, size = (modulus, ratio * size) if name == 'shear_modulus' else (name, size)
            words.append(f'{label} by {size:.2g} {quantities.quantity_of(name).unit}'.rstrip())
    return [
        f'a sensor latency below {seconds:.2g} s would not be detected, and moves '
        f'{_listed(words)}: if it is not zero, give --known sensor_latency=VALUE+-STD '
        'or --free +sensor_latency'
    ] if words else []


def resting(fit: Fit, names: Collection[str]) -> str:
    """Return the message that samples show only rest, so that ``names`` are undetermined."""
    return (
        f'{_listed([x for x in fit.free if x in names])} cannot be identified from this '
        f'recording: rest at each level explains the samples, {fit.recording.gap:.3g} s apart, as '
        'well as any motion does; record the motion after each change of level, with ten '
        'samples a period or more, or free only what rest determines, as with --free '
        'remanence,chain_limit,stretch_bias')


def alike(best: Fit, others: Sequence[Fit]) -> str:
    """Return the frequencies that fit the samples equally well, and what to record instead."""
    frequencies = sorted(frequency_of(x) for x in (best, *others))
    words = [f'{x:.4g} Hz' for x in frequencies]
    if len(words) > _FEW_WORDS:
        words[2:-1] = [f'{len(words) - 3} between']
    return (
        f'these frequencies fit equally well: {_listed(words)}; record '
        f'at more than {2.0 * frequencies[-1]:.3g} samples per second, or give a --params-file '
        'whose shear_modulus and density are known, and free what is not, as with '
        f'--params-file actuator.yaml {freeing(best, _TIMED)}')
