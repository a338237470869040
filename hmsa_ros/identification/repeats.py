"""
Whether residuals repeat with the levels, which noise does not.

What follows on equal changes of level is laid over one another. A model that lacks something
leaves the same after each of them. Noise is as likely to have either sign, in all of what follows
on one change at once, whatever it does from sample to sample: how often random signs of whole
repeats agree as well as the residuals do is how likely chance is.
"""

from dataclasses import dataclass
import math

import numpy as np
from numpy.typing import NDArray

from hmsa_ros.identification.fit import Fit
from hmsa_ros.identification.start import segments
from hmsa_ros.model.equations import Array

_DRAWS = 1999
_MOST = 48  # repeats of one change; of more several share a sign
_FEWEST = 4  # samples on a level
# Shares of the time on a level that are looked at, and the rest that its mean is of.
_WINDOWS, _REST = (0.125, 0.25, 0.5, 1.0), 2.0 / 3.0
_FINEST = 12.0  # parts of a period that one place in time is


@dataclass(frozen=True)
class Repeated:
    """What of the residuals follows on equal changes of level alike."""

    p_value: float  # of as much by chance
    size: float  # root mean square over all samples, stretch
    cost: float  # largest peak to peak, over the change of the stretch


def repeated(fit: Fit, period: float, floor: float = 0.0) -> Repeated | None:
    """
    Return what repeats; None if no change of level does.

    The period is that of the motion in s. What is below the floor, a root mean square, is none:
    the steps of the values make it.
    """
    found = segments(fit.recording, _FEWEST)
    groups: dict[tuple[float, float], list[tuple[int, int, float]]] = {}
    unit = 1e-6 * max(float(np.max(np.abs(fit.recording.levels))), 1e-12)
    for (*_, before), (begin, end, when, level) in zip(found[:-1], found[1:], strict=True):
        key = round(before / unit), round(level / unit)
        groups.setdefault(key, []).append((begin, end, when))
    whole = [x for x in groups.values() if len(x) > 1]
    if not whole:
        return None
    residual = fit.root * fit.residual
    gap = float(np.median(np.diff(fit.recording.time)))
    width = min(gap, period / _FINEST)
    random = np.random.default_rng(0)
    drawn = np.zeros((_DRAWS + 1, len(_WINDOWS) + 1))
    squares, count, cost = 0.0, 0.0, 0.0
    for group in whole:
        table, seen = _folded(fit.recording.time, residual, group, width)
        signs = np.ones((_DRAWS + 1, len(table)))
        signs[1:] = random.choice([-1.0, 1.0], (_DRAWS, len(table)))
        size = table.shape[1]
        products = [table[:, :max(int(x * size), 1)] for x in _WINDOWS]
        late = seen[:, int(_REST * size):]
        products.append(np.sum(table[:, int(_REST * size):], axis=1, keepdims=True) / np.maximum(
            np.sum(late, axis=1, keepdims=True), 1.0))
        for i, part in enumerate(products):
            gram = part @ part.T
            np.fill_diagonal(gram, 0.0)
            drawn[:, i] += np.einsum('ij,ij->i', signs @ gram, signs)
        both = seen @ seen.T
        np.fill_diagonal(both, 0.0)
        gram = table @ table.T
        np.fill_diagonal(gram, 0.0)
        pairs = float(np.sum(both))
        mean = float(np.sum(gram)) / max(pairs, 1.0)
        number = float(np.sum(seen))
        squares, count = squares + mean * number, count + number
        begin, end, _ = group[0]
        step = abs(float(fit.response.stretch[end - 1] - fit.response.stretch[max(begin - 1, 0)]))
        if step > 0.0:
            cost = max(cost, 2.0 * math.sqrt(2.0 * max(mean, 0.0)) / step)
    middle, apart = np.mean(drawn[1:], axis=0), np.std(drawn[1:], axis=0)
    scores = np.max((drawn - middle) / np.where(apart > 0.0, apart, 1.0), axis=1)
    chance = (1.0 + np.count_nonzero(scores[1:] >= scores[0])) / (_DRAWS + 1.0)
    size = math.sqrt(max(squares, 0.0) / max(count, 1.0))
    return Repeated(chance if size > floor else 1.0, size, cost)


def _folded(
        time: Array, residual: Array, group: list[tuple[int, int, float]], width: float
) -> tuple[Array, NDArray[np.float64]]:
    """Return residuals by repeat and place in time, 0 where none is, and how many there are."""
    places = [((time[begin:end] - when) / width).astype(np.int64) for begin, end, when in group]
    size = min(int(x[-1]) for x in places) + 1
    rows = min(len(group), _MOST)
    table, seen = np.zeros((rows, size)), np.zeros((rows, size))
    for i, ((begin, end, _), place) in enumerate(zip(group, places, strict=True)):
        inside = (place >= 0) & (place < size)
        row = i * rows // len(group)
        np.add.at(table[row], place[inside], residual[begin:end][inside])
        np.add.at(seen[row], place[inside], 1.0)
    return table, seen
