"""
Start values from the data alone: levels at rest, and the spectrum of the ringing.

The mean stretch at the end of each level gives the drive and J_lim. A decaying
oscillation fitted after each change of level gives frequency and decay, and with the inertia
the modulus and the damping. Frequencies above half the sampling rate are aliased, so that several
candidates are returned.
"""

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hmsa.errors import BadInputError
from hmsa.identification import quantities
from hmsa.identification.measurement import Measurement
from hmsa.identification.response import respond
from hmsa.model import equations
from hmsa.model.equations import Array
from hmsa.model.law import EQUILIBRIUM, evaluate, FORCE, pack
from hmsa.model.units import MU_0

_FEWEST = 6  # minimum samples on a level for ringing
_FEWEST_AT_REST = 4  # minimum samples before the first change of level to test for rest
_BY_CHANCE = 1e-4  # probability of scatter there that counts as motion
_MOST_SAMPLES = 150  # maximum samples of a level to use
_MOST_LEVELS = 3
_CHAIN_LIMITS = (1.0, 1.5, 2.0, 3.0, 5.0, 8.0, 15.0, 40.0, 1000.0)
_FREQUENCIES = 160
_DECAYS = (0.02, 0.1, 0.3)
# Scan of the time unit: range, points, damping ratios, and number of samples.
_SCAN_RANGE, _SCAN_POINTS, _SCAN_DECAYS, _SCAN_SAMPLES = 12.0, 192, (0.05, 0.4), 300
# Number of best candidates per damping ratio, and minimum ratio of their time units. With few
# samples in the ringing, strong damping converges from farther away.
_BEST, _APART = 5, 1.06
_SHORTEST = 0.02  # minimum time unit, in sampling intervals


@dataclass(frozen=True)
class Static:
    """Properties of the levels at rest."""

    per_tesla: float  # load psi' of 1 T, Br/(mu0 G); NaN without rest at two or more levels
    chain_limit: float  # best of several values
    # Start of the level in s, flux density in T, mean stretch at its end.
    rests: tuple[tuple[float, float, float], ...]


def segments(
        recording: Measurement, fewest: int = _FEWEST) -> list[tuple[int, int, float, float]]:
    """Return begin and end index, start in s and flux density of each level with samples."""
    times, levels = recording.level_times, recording.levels
    changed = np.flatnonzero(np.append(True, np.diff(levels) != 0.0))
    edges = np.searchsorted(recording.time, np.append(times[changed], math.inf))
    found = []
    for i, place in enumerate(changed):
        begin = 0 if i == 0 else int(edges[i])
        end = int(edges[i + 1])
        if end - begin >= fewest:
            found.append((begin, end, float(times[place]), float(levels[place])))
    return found


def changes_of(recording: Measurement) -> NDArray[np.int64]:
    """Return a number for each sample: that of the last change of level, equal ones alike."""
    levels = recording.levels
    before = np.append(levels[0], levels[:-1])
    place = recording.place(recording.time)
    pairs = np.round(np.column_stack([before, levels])[place], 9)
    found: NDArray[np.int64] = np.unique(pairs, axis=0, return_inverse=True)[1].ravel()
    return found


def deviations(values: Array, parts: NDArray[np.int64]) -> Array:
    """Return the standard deviations of parts of values, given by begin and end indices (n, 2)."""
    apart = values - np.mean(values)
    begins, ends = parts.T
    sums = np.append(0.0, np.cumsum(apart)), np.append(0.0, np.cumsum(apart ** 2))
    mean, square = ((x[ends] - x[begins]) / (ends - begins) for x in sums)
    found: Array = np.sqrt(np.maximum(square - mean ** 2, 0.0))
    return found


def begins_at_rest(recording: Measurement) -> bool:
    """Return whether the samples before the first change of level show no motion."""
    # Slow to import, and not needed by a planner that estimates.
    from scipy.special import fdtri

    before = recording.stretch[recording.time <= np.min(recording.changes, initial=math.inf)]
    if len(before) < _FEWEST_AT_REST:
        return True
    tails = np.array([(end - max((end - begin) // 3, 3), end)
                      for begin, end, _, _ in segments(recording, _FEWEST_AT_REST)],
                     np.int64).reshape(-1, 2)
    size = tails[:, 1] - tails[:, 0]
    # Second differences of white noise have a standard deviation larger by sqrt(6).
    steps = np.where(size < 2 * _FEWEST_AT_REST, math.inf, deviations(
        np.diff(recording.stretch, 2), tails - np.array([0, 2])) / math.sqrt(6.0))
    quiet = np.minimum(deviations(recording.stretch, tails) * np.sqrt(size / (size - 1.0)), steps)
    # Use the quietest end of a level, with a margin for short ones that are quiet by chance.
    chance = fdtri(len(before) - 1.0, size - 1.0, 1.0 - _BY_CHANCE)
    allowed = np.maximum(4.0, np.sqrt(chance)) * np.maximum(
        quiet, max(0.5 * recording.quantum, 1e-6))
    return float(np.std(before)) < float(np.min(allowed, initial=math.inf))


def _evaluated(what: int, values: Array, material: Array) -> Array:
    found = np.empty_like(values)
    evaluate(what, values, material, found)
    return found


def static(
        recording: Measurement, values: Mapping[str, float], free: Sequence[str]) -> Static:
    """Return properties of the levels at rest; the model, and J_lim unless free, are kept."""
    limits = _CHAIN_LIMITS if 'chain_limit' in free else (values['chain_limit'],)
    usual = 5.0 if 'chain_limit' in free else values['chain_limit']
    rests = []
    for begin, end, when, level in segments(recording, 1):
        tail = recording.stretch[begin + (end - begin) * 2 // 3:end]
        rests.append((when, level, float(np.median(tail))))
    # Take the median of each level: at the end of short ones, the motion still vibrates.
    fields = np.unique([x[1] for x in rests])
    if len(fields) < 2:
        return Static(math.nan, usual, tuple(rests))
    stretch = np.array([np.median([x for _, level, x in rests if level == y]) for y in fields])
    low, high = float(np.min(recording.stretch)), float(np.max(recording.stretch))
    best = (math.inf, math.nan, usual)
    group = quantities.group_of(values)
    # Motion may exceed the range that can be held, but not that in which the force is defined.
    ends = group.rest + 1.002 * (np.array([low, high]) - group.rest)
    shape = np.full(len(limits), group.c1)
    materials: Any = pack(0.0 * shape, np.array(limits), shape, group.law)
    if math.isfinite(values['bulk_ratio']):
        materials = [quantities.group_of({**values, 'chain_limit': x}).packed for x in limits]
    for limit, material in zip(limits, materials, strict=True):
        if not np.all(np.isfinite(_evaluated(FORCE, ends, material))):
            continue
        force = _evaluated(FORCE, stretch, material)
        slope = float(fields @ force) / float(fields @ fields)
        if slope > 0.0:
            held = _evaluated(EQUILIBRIUM, slope * fields, material)
            miss = float(np.sum((held - stretch) ** 2))
            if miss < 0.98 * best[0]:
                best = miss, slope, limit
    return Static(best[1], best[2], tuple(rests))


def ringing(recording: Measurement, rests: Sequence[tuple[float, float, float]]) -> list[
        tuple[float, float, float]]:
    """
    Return candidates of frequency (rad/s), decay (1/s) and the stretch of equilibrium.

    For each frequency and decay of a grid, least squares give the amplitude; the explained part of
    the motion is summed over the levels, relative to the frequency at rest.
    """
    means = {when: mean for when, _, mean in rests}
    spans = [x for x in segments(recording) if x[2] in means]
    parts = np.array([x[:2] for x in spans], np.int64).reshape(-1, 2)
    sizes = deviations(recording.stretch, parts)
    found: list[tuple[float, float, float, float]] = []
    for place in np.argsort(-sizes, kind='stable')[:_MOST_LEVELS].tolist():
        begin, end, when, _ = spans[place]
        part = slice(begin, min(end, begin + _MOST_SAMPLES))
        found += [(*x, means[when]) for x in _oscillations(
            recording.time[part] - recording.time[begin], recording.stretch[part] - means[when])]
    return [x[1:] for x in sorted(found, key=lambda x: -x[0])]


def _oscillations(t: Array, y: Array) -> list[tuple[float, float, float]]:
    """Return explained sum of squares, frequency and decay of the best peaks."""
    span, gap = float(t[-1]), float(np.median(np.diff(t)))
    lowest, highest = math.pi / span, 2.0 * math.pi / gap
    if not 0.0 < lowest < highest:
        return []
    frequencies = np.geomspace(lowest, highest, _FREQUENCIES)
    angle = np.outer(frequencies, t)
    cosine, sine = np.cos(angle), np.sin(angle)
    power = np.zeros((len(_DECAYS), _FREQUENCIES))
    for i, ratio in enumerate(_DECAYS):
        fading = np.exp(-ratio * angle)
        c, s = fading * cosine, fading * sine
        cc, ss, cs = (np.einsum('ij,ij->i', a, b) for a, b in ((c, c), (s, s), (c, s)))
        yc, ys = c @ y, s @ y
        determinant = cc * ss - cs * cs
        good = determinant > 1e-9 * cc * ss
        power[i] = np.where(good, (
            ss * yc ** 2 - 2.0 * cs * yc * ys + cc * ys ** 2) / np.where(
                good, determinant, 1.0), 0.0)
    best = np.max(power, axis=0)
    inner = np.flatnonzero((best[1:-1] >= best[:-2]) & (best[1:-1] >= best[2:])) + 1
    peaks = sorted(inner.tolist(), key=lambda j: -best[j])[:3]
    return [(float(best[j]), float(frequencies[j]),
             _DECAYS[int(np.argmax(power[:, j]))] * float(frequencies[j])) for j in peaks
            if best[j] > 0.2 * best[peaks[0]]]


def starts(
        recording: Measurement, values: Mapping[str, float], free: Sequence[str]
) -> list[dict[str, float]]:
    """Return start values, the most likely first; the given values come last."""
    given = dict(values)
    if 'stretch_gain' in free:
        given['stretch_gain'] = 1.0
    found = static(recording, given, free)
    material = quantities.group_of({**given, 'chain_limit': found.chain_limit})
    lower, upper = equations.stretch_limits(material)
    candidates: list[dict[str, float]] = []
    for frequency, decay, mean in ringing(recording, found.rests):
        if not lower < mean < upper:
            continue
        natural = math.hypot(frequency, decay)
        unit = float(equations.natural_frequency(mean, material)) / natural
        candidate = _candidate(given, free, unit, found)
        if 'damping_coefficient' in free:
            critical = float(equations.critical_zeta(mean, material))
            candidate['damping_coefficient'] = (
                decay / natural * critical * quantities.damping_unit(candidate))
        if all(abs(math.log(x['time_unit'] / candidate['time_unit'])) > 0.02
               for x in candidates):
            candidates.append(candidate)
    return [*candidates[:4], given]


def scan(
        recording: Measurement, values: Mapping[str, float], free: Sequence[str]
) -> list[dict[str, float]]:
    """
    Return start values from trials of time units and damping ratios on the first part of the data.

    They succeed without ringing, or with too few samples to resolve it.
    """
    found = static(recording, values, free)
    changes = np.searchsorted(recording.time, recording.level_times)
    begins = changes[(changes > 0) & (changes < len(recording.time))]
    first = _SCAN_SAMPLES + (int(begins[0]) if len(begins) else 0)
    part = replace(recording, time=recording.time[:first], stretch=recording.stretch[:first]) \
        if first < len(recording.time) else recording
    shortest = _SHORTEST * float(np.median(np.diff(recording.time)))
    tried: list[tuple[float, float, dict[str, float]]] = []
    timed = seeks_time(values, free)
    factors = np.geomspace(1.0 / _SCAN_RANGE, _SCAN_RANGE, _SCAN_POINTS) if timed else np.ones(1)
    # Without duplicates: at low sampling rates many equal the shortest.
    units = np.unique(np.maximum(factors * values['time_unit'], shortest))
    for decay in _SCAN_DECAYS if 'damping_coefficient' in free else (0.0,):
        for candidate in at_units(values, free, units, decay, found):
            response = respond(part, candidate, (), rtol=1e-5)
            if response is not None:
                miss = float(np.mean(np.abs(part.stretch - response.stretch)))
                tried.append((miss, decay, candidate))
    best: list[tuple[float, dict[str, float]]] = []
    for _, decay, candidate in sorted(tried, key=lambda x: x[0]):
        alike = [x['time_unit'] for y, x in best if y == decay]
        if len(alike) < _BEST and (not timed or all(
                abs(math.log(candidate['time_unit'] / x)) > math.log(_APART) for x in alike)):
            best.append((decay, candidate))
    return [x for _, x in best]


def at_units(
        values: Mapping[str, float], free: Sequence[str], units: Array, decay: float,
        found: Static) -> list[dict[str, float]]:
    """Return start values for time units in s, and a damping ratio about rest."""
    group = quantities.group_of(values)
    critical = float(equations.critical_zeta(group.rest, group))
    candidates = [_candidate(values, free, x, found) for x in units.tolist()]
    if 'damping_coefficient' in free:
        for candidate in candidates:
            candidate['damping_coefficient'] = (
                decay * critical * quantities.damping_unit(candidate))
    return candidates


def seeks_time(values: Mapping[str, Any], free: Sequence[str]) -> bool:
    """Return whether a free parameter changes the time unit."""
    return bool({'shear_modulus', 'density', 'time_unit', *_stresses(values)}.intersection(free))


def _stresses(values: Mapping[str, Any]) -> list[str]:
    """Return the constants of the model that determine its modulus."""
    return [x for x, (constant, _) in quantities.constants_of(values.get('law')).items()
            if constant.unit == 'Pa']


def _candidate(
        given: Mapping[str, float], free: Sequence[str], unit: float, found: Static
) -> dict[str, float]:
    """Return values with a time unit and the properties of the levels at rest."""
    values = dict(given)
    if 'chain_limit' in free:
        values['chain_limit'] = found.chain_limit
    length = given['half_length']
    stresses = [x for x in _stresses(values) if x in free]
    if ('shear_modulus' in free or stresses) and 'time_unit' not in free:
        before = values['shear_modulus']
        values['shear_modulus'] = values['density'] * (length / unit) ** 2
        for name in stresses:
            values[name] *= values['shear_modulus'] / before
        with suppress(BadInputError):
            values = quantities.complete(values, ())
    elif 'time_unit' in free or 'density' in free:
        values['density'] = values['shear_modulus'] * (unit / length) ** 2
    values['time_unit'] = unit
    if math.isfinite(found.per_tesla):
        if 'remanence' in free:
            values['remanence'] = found.per_tesla * MU_0 * values['shear_modulus']
        elif 'shear_modulus' in free and 'time_unit' in free:
            values['shear_modulus'] = values['remanence'] / (MU_0 * found.per_tesla)
            values['density'] = values['shear_modulus'] * (unit / length) ** 2
    return values
