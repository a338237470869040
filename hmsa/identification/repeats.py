"""
Test whether residuals repeat with the levels, unlike noise.

Residuals after equal changes of level are overlaid. An incomplete model leaves the same residuals
after each of them. Noise after each change has either sign with equal probability, jointly for all
samples, whatever its correlation: the p-value is the probability that random signs of whole
repeats agree as well as the residuals do.
"""

from dataclasses import dataclass
import math

import numpy as np

from hmsa.identification.fit import Fit
from hmsa.identification.initial_guess import segments
from hmsa.model.equations import Array

# Numbers of random draws: first, and if the p-value is not clearly above a limit.
_DRAWS, _CLEAR = (199, 3999), 0.04
_MOST = 48  # maximum number of repeats of one change; beyond it several share a sign
_FEWEST = 4  # samples on a level
# Fractions of the time on a level to test, and the last part that determines its mean.
_WINDOWS, _REST = (0.125, 0.25, 0.5, 1.0), 2.0 / 3.0
_FINEST = 12.0  # time bins per period


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
